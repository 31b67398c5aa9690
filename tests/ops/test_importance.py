# SPDX-License-Identifier: Apache-2.0
"""The instrumented rasterisation has the renderer's bits and agrees with the definition in float64."""

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.ops.importance import UNITS, splat_contributions
from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import project
from blitzgs.ops.rasterize import rasterize
from blitzgs.reference.importance import contributions as by_definition
from tests.helpers import BACKENDS, random_scene


def lists_of(scene, tile_size=16):
    """Projected splats and their lists, and the grid as keywords."""
    projected = project(
        scene.means, scene.quats, scene.scales, scene.opacities, None, scene.viewmats, scene.Ks, scene.width,
        scene.height, raw=False,
    )  # fmt: skip
    splats = projected.means2d, projected.conics, projected.opacities
    grid = {
        "n_cameras": len(scene.Ks),
        "width": scene.width,
        "height": scene.height,
        "tile_size": tile_size,
    }
    return splats, intersect(*splats, projected.depths, projected.camera_ids, **grid), grid


def crowded(device="cpu", dtype=torch.float32):
    """Opaque splats in front of others, so that pixels end, over several tiles and uneven borders."""
    scene = random_scene(150, 3, 45, 37, seed=3, scale=0.2)
    scene.opacities[::3] = 0.999
    return scene.to(dtype, device)


@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("backend", BACKENDS)
def test_sees_what_the_renderer_composites_bit_for_bit(backend, tile_size):
    if backend[0] == "cuda" and tile_size != 16:
        pytest.skip("CUDA composites tiles of 16 pixels")
    """One channel per splat: its image is alpha T of that splat."""
    splats, lists, grid = lists_of(crowded(*backend), tile_size)
    count = len(splats[0])
    channels = torch.eye(count, device=backend[0], dtype=backend[1])
    images, _ = rasterize(*splats, channels, *lists, **grid)
    weights, pixels, squares = splat_contributions(*splats, *lists, **grid, squares=True)
    shares = images.double() * UNITS
    assert torch.equal(weights, shares.round().long().sum((0, 1, 2)))
    assert torch.equal(pixels, (images > 0).sum((0, 1, 2)).int())
    high, low = shares.round().long() >> 16, shares.round().long() & 0xFFFF
    exact = high**2 + (
        (high * low << 17) + low**2 >> 32
    )  # of 64 bits, of which neither int64 nor float64 holds all
    assert torch.equal(squares, exact.sum((0, 1, 2)))
    assert pixels.max() > 100 and (pixels == 0).any()
    without = splat_contributions(*splats, *lists, **grid)
    assert torch.equal(without[0], weights) and torch.equal(without[1], pixels) and not len(without[2])


@pytest.mark.parametrize("backend", BACKENDS)
def test_parts_add_up_and_repeat(backend):
    splats, lists, grid = lists_of(crowded(*backend))
    sums = splat_contributions(*splats, *lists, **grid, squares=True)
    tiles = len(lists[1]) - 1
    cuts = [0, 1, 1, 7, 20, tiles]
    parts = [
        splat_contributions(*splats, *lists, **grid, tile_begin=begin, tile_end=end, squares=True)
        for begin, end in zip(cuts, cuts[1:], strict=False)
    ]
    assert all(torch.equal(sum(pieces), whole) for *pieces, whole in zip(*parts, sums, strict=True))
    for _ in range(3):
        again = splat_contributions(*splats, *lists, **grid, squares=True)
        assert all(torch.equal(a, b) for a, b in zip(again, sums, strict=True))


@pytest.mark.parametrize("squares", [False, True])
def test_opcheck(squares):
    splats, lists, _ = lists_of(random_scene(20, 1, 40, 32))
    torch.library.opcheck(
        torch.ops.blitzgs.contributions, (*splats, *lists, 1, 40, 32, 16, 0, -1, None, squares)
    )


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_contributions_equal_the_definition(backend, mode):
    # These are more views than one call takes.
    scene = random_scene(70, 10, seed=5, scale=0.15).to(backend[1], backend[0])
    scene.means[:25] *= 4  # beyond the borders and in front of the near plane, in some views
    arguments = (
        scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, scene.width,
        scene.height,
    )  # fmt: skip
    weights, pixels, visible = blitzgs.contributions(*arguments, near_plane=2.5, rasterize_mode=mode)
    expected = by_definition(
        *(x.cpu() if isinstance(x, torch.Tensor) else x for x in arguments),
        near_plane=2.5,
        antialiased=mode == "antialiased",
    )
    weights, pixels, visible = weights.cpu(), pixels.cpu(), visible.cpu()
    assert weights.dtype == torch.float64 and pixels.dtype == torch.int64 and visible.dtype == torch.bool
    exact = backend[1] == torch.float64
    # At a pixel on a cut, rounding decides, and the splats behind may change, too.
    allowed = 0 if exact else 3 * expected.undecided + 3
    assert ((pixels - expected.pixels).abs() <= allowed).all()
    decided = expected.undecided == 0
    assert decided.float().mean() > 0.5
    tolerance = expected.pixels / UNITS if exact else 1e-4 * expected.pixels
    assert ((weights - expected.weights).abs() <= tolerance + 1e-12)[decided].all()
    assert torch.equal(visible, expected.visible)
    assert 0.1 < visible.double().mean() < 1


def test_hidden_and_missing_gaussians_contribute_nothing():
    scene = random_scene(4, 1)
    scene.means[:, 2] -= 100.0
    scene.scales[3] = float("nan")
    with pytest.warns(
        RuntimeWarning, match="contributions: NaN or infinite values in scales, first at 3;"
    ) as w:
        weights, pixels, visible = blitzgs.contributions(
            scene.means, scene.quats, scene.scales, scene.opacities, scene.viewmats, scene.Ks, 40, 32
        )
    assert w[0].filename == __file__
    assert not weights.any() and not pixels.any() and not visible.any()
    none = [scene.means[:0], scene.quats[:0], scene.scales[:0], scene.opacities[:0]]
    assert blitzgs.contributions(*none, scene.viewmats, scene.Ks, 40, 32)[0].shape == (1, 0)
    no_views = blitzgs.contributions(*none, scene.viewmats[:0], scene.Ks[:0], 40, 32)
    assert no_views[1].shape == (0, 0)


def test_bad_arguments_are_named():
    splats, lists, grid = lists_of(random_scene(5))
    with pytest.raises(RuntimeError, match="contributions: conics must have shape"):
        splat_contributions(splats[0], splats[1][:, :2], splats[2], *lists, **grid)
    with pytest.raises(RuntimeError, match="tile_begin and tile_end must be a range"):
        splat_contributions(*splats, *lists, **grid, tile_begin=5, tile_end=99)
    with pytest.raises(ValueError, match="rasterize_mode must be 'classic' or 'antialiased', got 'ewa'"):
        blitzgs.contributions(*splats, splats[2], *lists, 4, 4, rasterize_mode="ewa")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"means": np.zeros((5, 3))}, TypeError, "means must be a torch.Tensor, got ndarray"),
        ({"quats": torch.zeros(5, 3)}, ValueError, "quats must be"),
        ({"Ks": torch.zeros(1, 3, 3).double()}, ValueError, "Ks is torch.float64 and means torch.float32"),
        ({"means": torch.zeros(1, 5, 3)}, ValueError, r"means must be \[N, 3\]"),
        ({"width": 0}, ValueError, "width must be 1 to"),
        ({"eps2d": -1.0}, ValueError, "eps2d must be"),
    ],
    ids=str,
)
def test_bad_arguments_of_contributions_are_named(change, error, message):
    scene = random_scene(5, 1)
    given = {
        name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "viewmats", "Ks")
    }
    with pytest.raises(error, match=message):
        blitzgs.contributions(**{**given, "width": 40, "height": 32, **change})
