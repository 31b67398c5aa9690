import numpy as np
import torch

from blitzgs.ops.blocks import WORD_BITS
from blitzgs.population.cleaning import floaters, views_counting


def test_views_are_counted_from_the_packed_bits():
    rng = np.random.default_rng(0)
    for n_views in (1, 32, 70):
        culled = rng.random((20, n_views)) < 0.5
        words = -(-n_views // WORD_BITS)
        bits = np.zeros((20, words * WORD_BITS), dtype=np.uint8)
        bits[:, :n_views] = culled
        packed = np.packbits(bits, axis=1, bitorder="little").view("<i4").copy()
        found = views_counting(torch.from_numpy(packed), n_views)
        np.testing.assert_array_equal(found.numpy(), (~culled).sum(axis=1))


def test_floaters_are_weak_and_far_or_large():
    grid = torch.stack(torch.meshgrid(*[torch.arange(12.0)] * 2, torch.arange(3.0), indexing="ij"), dim=-1)
    sound = grid.reshape(-1, 3)
    extra = torch.tensor([
        [5.5, 5.5, 1.5],     # seen once among the others: a detail
        [5.5, 5.5, 60.0],    # seen once, far above
        [-500.0, 0.0, 0.0],  # seen by none, far beyond
        [5.5, 4.5, 1.5],     # seen once, among the others, large
        [5.5, 5.5, 80.0],    # far, but seen by three
    ])  # fmt: skip
    means = torch.cat([sound, extra])
    scales = torch.full((len(means), 3), -2.0) + 0.1 * torch.rand(len(means), 3)
    scales[-2, 1] = 3.0
    counted = torch.full((len(means),), 9)
    counted[-5:] = torch.tensor([1, 1, 0, 1, 3])
    found = floaters(means, scales, counted, 1)
    assert found.nonzero()[:, 0].tolist() == [len(sound) + i for i in (1, 2, 3)]
    assert floaters(means, scales, counted, 3).nonzero()[:, 0].tolist()[-1] == len(means) - 1
    # The unit of length does not matter.
    assert torch.equal(floaters(means * 1000, scales + np.log(1000), counted, 1), found)
    # Without a well-seen part there is nothing to compare with.
    assert not floaters(means, scales, torch.zeros_like(counted), 1).any()
