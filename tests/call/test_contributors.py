# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of each pixel, from `meta` as gsplat's functions take it."""

import pytest
import torch

import blitzgs
from tests.helpers import BACKENDS, random_scene, rasterize_scene


def arguments(meta):
    """What gsplat's functions take of `meta`."""
    names = ("means2d", "conics", "opacities", "isect_offsets", "flatten_ids", "width", "height", "tile_size")
    return [meta[name] for name in names]


def image_of(ids, weights, values):
    """Composite values [N, D] by ids and weights [..., K]."""
    shown = torch.where((ids < 0)[..., None], 0, values[ids.clamp(min=0).long()])
    return (shown * weights[..., None]).sum(dim=-2)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_image_is_the_sum_over_all_contributors(backend, packed):
    scene = random_scene(cameras=3).to(backend[1], backend[0])
    values = torch.rand(60, 3, generator=torch.Generator().manual_seed(2)).to(scene.means)
    image, alphas, meta = blitzgs.rasterization(
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        values,
        scene.viewmats,
        scene.Ks,
        40,
        32,
        packed=packed,
    )
    counts, also = blitzgs.rasterize_num_contributing_gaussians(*arguments(meta))
    assert torch.equal(also, alphas[..., 0]) and counts.shape == (3, 32, 40)
    ids, weights = blitzgs.rasterize_contributing_gaussian_ids(*arguments(meta), counts)
    assert ids.shape == weights.shape == (3, 32, 40, int(counts.max())) and ids.dtype == torch.int32
    assert torch.equal((ids >= 0).sum(dim=-1), counts)
    gaussians = torch.where(ids < 0, ids, meta["gaussian_ids"][ids.clamp(min=0).long()]) if packed else ids
    most = 1e-12 if backend[1] == torch.float64 else 1e-5
    assert (image_of(gaussians, weights, values) - image).abs().max() < most
    top, best = blitzgs.rasterize_top_contributing_gaussian_ids(*arguments(meta), 2)
    assert torch.equal(best.sort(dim=-1).values, weights.sort(dim=-1).values[..., -2:])
    assert torch.equal(top[..., 0] >= 0, counts > 0) and torch.equal(top[..., 1] >= 0, counts > 1)


def test_batches_and_lists_of_pixels():
    scene = random_scene(n=30)
    both = [torch.stack([t, t.flip(0)]) for t in scene.arguments()[:5]]
    cameras = [t.expand(2, *t.shape) for t in (scene.viewmats, scene.Ks)]
    _, _, meta = blitzgs.rasterization(*both, *cameras, 40, 32, sh_degree=3, packed=False)
    counts, alphas = blitzgs.rasterize_num_contributing_gaussians(*arguments(meta))
    assert counts.shape == (2, 2, 32, 40)
    ids, weights = blitzgs.rasterize_top_contributing_gaussian_ids(*arguments(meta), 3)
    assert ids.max() == 29
    pixels, images = torch.tensor([[3, 4], [31, 39], [16, 20]]), torch.tensor([0, 3, 2])
    at = (images // 2, images % 2, *pixels.T)
    some, own = blitzgs.rasterize_num_contributing_gaussians(
        *arguments(meta), pixels=pixels, image_ids=images
    )
    assert torch.equal(some, counts[at]) and torch.equal(own, alphas[at])
    chosen = blitzgs.rasterize_top_contributing_gaussian_ids(
        *arguments(meta), 3, pixels=pixels, image_ids=images
    )
    assert torch.equal(chosen[0], ids[at]) and torch.equal(chosen[1], weights[at])
    listed, shares = blitzgs.rasterize_contributing_gaussian_ids(
        *arguments(meta), some, pixels=pixels, image_ids=images
    )
    assert listed.shape == shares.shape == (3, int(some.max()))


@pytest.mark.parametrize(
    "change,error,message",
    [
        ({0: torch.zeros(3, 3)}, ValueError, "means2d must be"),
        ({3: torch.zeros(2, 1, 2, dtype=torch.int64)}, ValueError, r"tile_offsets must be \[2, 2, 3\]"),
        ({4: torch.zeros(3)}, TypeError, "flatten_ids must be a tensor of integers"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    _, _, meta = rasterize_scene(random_scene(n=5))
    given = arguments(meta)
    for at, value in change.items():
        given[at] = value
    with pytest.raises(error, match=message):
        blitzgs.rasterize_num_contributing_gaussians(*given)
