# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.route import route_count
from tests.helpers import needs_cuda

WIDTH, HEIGHT, CAMERAS = 100, 60, 2
TILES = 7 * 4


def cut(*bounds):
    """Ranges without overlap."""
    return list(zip(bounds, bounds[1:], strict=False))


def rows(n, seed=0, dtype=torch.float32):
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(n, 2, generator=g, dtype=dtype) * torch.tensor([140.0, 100.0], dtype=dtype) - 20
    a, c = torch.rand(2, n, generator=g, dtype=dtype).mul(4).exp() * 0.003
    b = (torch.rand(n, generator=g, dtype=dtype) - 0.5) * (a * c).sqrt()
    opacities = torch.rand(n, generator=g, dtype=dtype)
    return means2d, torch.stack((a, b, c), 1), opacities, torch.arange(n, dtype=torch.int32) % CAMERAS


@pytest.mark.parametrize(
    "ranges",
    [cut(0, 10, 10, 31, CAMERAS * TILES), [(0, 18), (2, 2), (2, 39), (23, CAMERAS * TILES)]],
    ids=["apart", "overlapping"],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_row_that_reaches_a_pixel_of_a_rank_is_sent_there(dtype, ranges):
    means2d, conics, opacities, cameras = rows(200, dtype=dtype)
    masks, counts = route_count(means2d, conics, opacities, cameras, ranges, WIDTH, HEIGHT)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    d = torch.stack((x, y), -1).to(dtype) - means2d[:, None, None, :]
    a, b, c = conics.T[:, :, None, None]
    q = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + c * d[..., 1] ** 2
    reached = opacities[:, None, None] * torch.exp(-q / 2) >= 1 / 255
    tile = (y.long() // 16) * 7 + x.long() // 16 + cameras.long()[:, None, None] * TILES
    slack = opacities[:, None, None] * torch.exp(-q / 2 + 0.02) >= 1 / 255
    for m in range(4):
        owned = (tile >= ranges[m][0]) & (tile < ranges[m][1])
        needed, sent = (reached & owned).flatten(1).any(1), (masks >> m) & 1 == 1
        assert not (needed & ~sent).any()  # never missing
        if m != 1:
            # Nearly nothing in vain: tile rows are tested by their interval, so a little slack is allowed.
            wanted = (slack & owned).flatten(1).any(1)
            assert (sent & ~wanted).sum() <= 0.02 * len(sent)
        assert counts[m, 0] == sent.sum()
    assert counts[1].tolist() == [0, 0]


def test_one_rank_gets_every_intersection():
    means2d, conics, opacities, cameras = rows(300)
    whole = route_count(means2d, conics, opacities, cameras, [(0, CAMERAS * TILES)], WIDTH, HEIGHT)[1]
    ranges = cut(0, 3, 20, 40, CAMERAS * TILES)
    parts = route_count(means2d, conics, opacities, cameras, ranges, WIDTH, HEIGHT)[1]
    assert parts[:, 1].sum() == whole[0, 1]
    assert parts[:, 0].max() <= whole[0, 0] <= parts[:, 0].sum()


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_cuda_equals_cpu(count):
    ranges = [(0, 18), (2, 2), (2, 39), (23, CAMERAS * TILES)]
    expected = route_count(*rows(count), ranges, WIDTH, HEIGHT)
    actual = route_count(*(t.cuda() for t in rows(count)), ranges, WIDTH, HEIGHT)
    # Logarithms differ in the last digit, and so may rows that end on a tile's border.
    assert (actual[0].cpu() != expected[0]).sum() <= count // 1000
    assert (actual[1].cpu() - expected[1]).abs().max() <= count // 500


def test_empty_and_errors():
    none = [t[:0] for t in rows(4)]
    masks, counts = route_count(*none, cut(0, 20, 56), WIDTH, HEIGHT)
    assert masks.shape == (0,)
    assert counts.tolist() == [[0, 0], [0, 0]]
    with pytest.raises(RuntimeError, match=r"ranges must begin in ascending .* got \[3, 9\) for rank 1"):
        route_count(*rows(4), [(5, 6), (3, 9)], WIDTH, HEIGHT)
    with pytest.raises(RuntimeError, match=r"end before they begin, got \[5, 3\) for rank 1"):
        route_count(*rows(4), [(0, 5), (5, 3)], WIDTH, HEIGHT)
    with pytest.raises(RuntimeError, match="1 to 63 ranks are supported, got 64"):
        route_count(*rows(4), cut(*range(65)), WIDTH, HEIGHT)


def test_opcheck():
    torch.library.opcheck(torch.ops.blitzgs.route_count, (*rows(9), [0, 20], [31, 56], WIDTH, HEIGHT, 16))
