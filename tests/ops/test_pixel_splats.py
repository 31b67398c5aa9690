# SPDX-License-Identifier: Apache-2.0
"""The splats of each pixel are those that the image is made of, and those of the definition in float64."""

import pytest
import torch

from blitzgs.ops.pixel_splats import pixel_splats
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions
from blitzgs.ops.rasterize import rasterize
from blitzgs.reference.compositing import composited_weights, median_splats, strongest_splats
from tests.helpers import BACKENDS, DEVICES
from tests.ops.test_importance import crowded, lists_of


def weights_of(splats, lists, grid):
    """Alpha T of each splat, [P, B, H, W], with the bits of the image: one channel per splat."""
    channels = torch.eye(len(splats[0])).to(splats[0])
    return rasterize(*splats, channels, *lists, **grid)[0].movedim(-1, 0)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("strongest", [0, 1, 3, 200])
def test_equal_the_image_bit_for_bit(backend, strongest):
    scene = crowded(*backend)
    splats, lists, grid = lists_of(scene)
    weights = weights_of(splats, lists, grid)
    _, alphas = rasterize(*splats, torch.ones_like(splats[0]), *lists, **grid)
    found = pixel_splats(*splats, *lists, **grid, strongest=strongest)
    counts = (weights > 0).sum(dim=0)
    assert torch.equal(found.counts.view(counts.shape), counts.int()) and counts.max() > 5
    assert torch.equal((1 - found.transmittances).view(alphas.shape), alphas)
    flat = weights.flatten(1)
    assert found.ids.shape == found.weights.shape == (flat.shape[1], strongest)
    # Each id has its own weight; they are different, and no other weight is larger.
    own = flat.T.gather(1, found.ids.clamp(min=0).long())
    assert torch.equal(found.weights, torch.where(found.ids < 0, 0, own))
    assert torch.equal((found.ids >= 0).sum(dim=1), counts.flatten().clamp(max=strongest))
    best = flat.T.sort(dim=1, descending=True).values
    best = torch.nn.functional.pad(best, (0, strongest))[:, :strongest]
    assert torch.equal(found.weights.sort(dim=1, descending=True).values, best)


@pytest.mark.parametrize("backend", BACKENDS)
def test_agree_with_the_definition(backend):
    scene = crowded(*backend)
    splats, lists, grid = lists_of(scene)
    found = pixel_splats(*splats, *lists, **grid, strongest=4)
    pixels, shape = scene.width * scene.height, (scene.height, scene.width)
    options = ProjectionOptions(scene.width, scene.height, 16, raw=False)
    given = (scene.means, scene.quats, scene.scales, scene.opacities)
    projected = project_splats(ProjectionInputs(given, (scene.viewmats, scene.Ks), options))
    for view in range(len(scene.Ks)):
        own = (projected.camera_ids == view).nonzero()[:, 0]
        own = own[projected.depths[own].argsort(stable=True)]
        exact = [t[own].double().cpu() for t in (*splats, projected.depths)]
        weights, cut = composited_weights(*exact, scene.width, scene.height)
        before = 1 - (weights.cumsum(0) - weights)
        ids, shares = strongest_splats(weights, 4)
        # Where two weights are close, rounding decides.
        best = weights.sort(dim=0, descending=True).values[:5]
        close = ((best[:-1] - best[1:] < 1e-5) & (best[:-1] > 0)).any(dim=0)
        sure = ~(cut | ((before - 0.5).abs() < 1e-4).any(dim=0))
        assert sure.double().mean() > 0.8
        rows = slice(view * pixels, (view + 1) * pixels)
        own = torch.cat([own.cpu(), torch.tensor([-1])])  # number -1 is none
        assert torch.equal(found.counts[rows].cpu().view(shape)[sure], (weights > 0).sum(0).int()[sure])
        medians = own[median_splats(weights)]
        assert torch.equal(found.medians[rows].cpu().view(shape)[sure].long(), medians[sure])
        sure &= ~close
        assert sure.double().mean() > 0.3
        assert torch.equal(found.ids[rows].cpu().view(*shape, 4)[sure].long(), own[ids][sure])
        error = found.weights[rows].cpu().view(*shape, 4).double() - shares
        assert error[sure].abs().max() < (1e-9 if backend[1] == torch.float64 else 1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_of_equal_weights_the_front_ones_stay_in_their_order(device):
    """Ten splats whose opacities give all the same weight, but for one."""
    opacities = [1 / (20 - i) for i in range(10)]
    opacities[6] *= 1.5
    splats = [torch.tensor(v, device=device) for v in ([[2.5, 2.5]] * 10, [[1e-9, 0, 1e-9]] * 10, opacities)]
    lists = torch.arange(10, dtype=torch.int32, device=device), torch.tensor([0, 10], device=device)
    found = pixel_splats(*splats, *lists, n_cameras=1, width=5, height=5, strongest=10)
    weights = found.weights[0]
    order = weights.cpu().argsort(descending=True, stable=True)
    for k in range(1, 10):
        some = pixel_splats(*splats, *lists, n_cameras=1, width=5, height=5, strongest=k)
        expected = order[:k].sort().values
        assert some.ids.cpu().tolist() == [expected.tolist()] * 25
        assert torch.equal(some.weights[3], weights[expected.to(device)])


@pytest.mark.parametrize("device", DEVICES)
def test_a_list_of_pixels_has_their_rows_in_its_order(device):
    splats, lists, grid = lists_of(crowded(device))
    whole = pixel_splats(*splats, *lists, **grid, strongest=5)
    chosen = torch.randint(len(whole.counts), (70,), generator=torch.Generator().manual_seed(1)).to(device)
    chosen[9] = chosen[3]
    some = pixel_splats(*splats, *lists, **grid, strongest=5, pixels=chosen)
    assert all(torch.equal(a, b[chosen]) for a, b in zip(some, whole, strict=True))
    none = pixel_splats(*splats, *lists, **grid, strongest=5, pixels=chosen[:0])
    assert [len(column) for column in none] == [0] * 5


@pytest.mark.parametrize("device", DEVICES)
def test_nothing_to_composite(device):
    empty = [torch.zeros(0, *shape, device=device) for shape in ((2,), (3,), ())]
    lists = torch.zeros(0, dtype=torch.int32, device=device), torch.zeros(5, dtype=torch.int64, device=device)
    found = pixel_splats(*empty, *lists, n_cameras=1, width=20, height=20, strongest=2)
    assert found.transmittances.eq(1).all() and not found.counts.any() and found.medians.eq(-1).all()
    assert found.ids.eq(-1).all() and not found.weights.any()
    no_views = pixel_splats(*empty, lists[0], lists[1][:1], n_cameras=0, width=20, height=20, strongest=2)
    assert no_views.ids.shape == (0, 2)


def test_opcheck():
    splats, lists, grid = lists_of(crowded())
    slots = torch.full((3, 37, 45), -1, dtype=torch.int32)
    slots[1, 5, :40] = torch.arange(40)
    torch.library.opcheck(torch.ops.blitzgs.pixel_splats, (*splats, *lists, slots, 40, *grid.values(), 3))


@pytest.mark.parametrize(
    "change,message",
    [
        ({"strongest": -1}, "strongest must be 0"),
        ({"slots": torch.zeros(3, 37, 44, dtype=torch.int32)}, "slots"),
        ({"n_rows": 7}, "n_rows must be"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    splats, lists, grid = lists_of(crowded())
    options = {"slots": None, "n_rows": 3 * 37 * 45, **grid, "strongest": 1, **change}
    with pytest.raises(RuntimeError, match=message):
        torch.ops.blitzgs.pixel_splats(*splats, *lists, **options)
