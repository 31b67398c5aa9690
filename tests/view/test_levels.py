# SPDX-License-Identifier: Apache-2.0
"""Levels of Gaussians; smooth levels agree with their definition in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import render_frame
from blitzgs.ops.project import differentiable_splats, project, queue_projection
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions, Views
from blitzgs.reference.render import render as reference_render
from blitzgs.view.gate import LodGate, ModelGate, centres_of
from blitzgs.view.levels import FOOTPRINT_LEVELS, Levels, footprint_levels, footprint_sizes, measure_levels
from tests.helpers import refused
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, make_views
from tests.view.test_gate import GATE, OPTIONS, make_scene


def cloud(count=5000, seed=0):
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=g, dtype=torch.float64) * torch.tensor([4.0, 6.0, 1.0]).double()
    centres = torch.rand(30, 3, generator=g, dtype=torch.float64) * 4 + torch.tensor([0.0, 0.0, 1.5]).double()
    return points, centres


@pytest.mark.parametrize("fork", [2.0, 1.5])
def test_matches_numpy_quantiles(fork):
    points, centres = (tensor.numpy() for tensor in cloud())
    distances = np.linalg.norm(points[None] - centres[:, None], axis=2)
    d_max = np.quantile(np.quantile(distances, 0.999, axis=1), 0.999)
    d_min = np.quantile(np.quantile(distances, 0.001, axis=1), 0.001)
    box = 1.1 * (np.quantile(points, 0.99, axis=0) - np.quantile(points, 0.01, axis=0)).max()
    count = max(1, round(math.log(d_max / d_min) / math.log(fork)) + 1)
    levels = measure_levels(*cloud(), fork)
    assert levels.count == count
    assert levels.reference_distance == pytest.approx(d_max, rel=1e-12)
    assert levels.voxel_size == pytest.approx(box / fork ** (10 - count // 2 + 1), rel=1e-12)


def test_scales_with_the_world_exactly():
    points, centres = cloud()
    levels, scaled = (
        measure_levels(points, centres, 2.0),
        measure_levels(points * 64, centres * 64, 2.0),
    )
    assert scaled == Levels(levels.count, 2.0, levels.reference_distance * 64, levels.voxel_size * 64)


def test_a_few_points_at_a_horizon_do_not_make_the_voxels_of_the_others_larger():
    points, centres = cloud()
    near = measure_levels(points, centres, 2.0)
    for factor in (1e3, 1e6, 1e30):
        levels = measure_levels(torch.cat([points[:-150], points[-150:] * factor]), centres, 2.0)
        assert levels.voxel_size_of(levels.count - 1) < 2 * near.voxel_size_of(near.count - 1)


def test_farthest_is_where_eq_1_still_rounds_up_to_the_level():
    levels = Levels(count=6, fork=2.0, reference_distance=10.0, voxel_size=1.0)
    for level in range(1, 6):
        d = levels.farthest(level)
        resolved = [round(math.log2(10.0 / (d * factor))) for factor in (0.999, 1.001)]
        assert resolved == [level, level - 1]
    assert levels.farthest(0) == math.inf
    assert levels.voxel_size_of(3) == 0.125


def test_degenerate_input_is_refused():
    points, centres = cloud(10)
    refused(ValueError, "got 0 points and 30 cameras", measure_levels, points[:0], centres, 2.0)
    with pytest.raises(ValueError, match="spread out, .* measures 0, .* Check the points of the capture"):
        measure_levels(points[:1].repeat(5, 1), centres, 2.0)


def test_levels_of_footprints_leave_out_only_what_is_too_small_and_most_of_that():
    generator = torch.Generator().manual_seed(3)
    scales = torch.rand(4000, 3, generator=generator, dtype=torch.float64) * 6 - 7
    opacities = torch.randn(4000, generator=generator, dtype=torch.float64) * 3
    focal, pixels, distance, fork = 900.0, 0.5, 300.0, 2**0.25
    levels = footprint_levels(footprint_sizes(scales, opacities), focal / pixels, distance, fork)
    reach = torch.tensor(LodGate(distance, fork, FOOTPRINT_LEVELS, FOOTPRINT_LEVELS - 1).reach())
    reach = reach.double()[levels.long()]
    _, middle, largest = scales.exp().sort(1).values.unbind(1)
    size = opacities.sigmoid() * (middle * largest).sqrt()
    kept_to = size * focal / pixels  # the footprint is `pixels` there
    assert (reach >= kept_to * (1 - 1e-9)).all()
    inside = (levels > 0) & (levels < FOOTPRINT_LEVELS - 1)
    assert inside.double().mean() > 0.5 and (reach < kept_to * fork * (1 + 1e-9))[inside].all()
    assert reach[levels == 0].isinf().all()


SMOOTH = replace(GATE, smooth=True)
FADED = replace(OPTIONS, fade=SMOOTH.fade())


def weights_by_levels(distances, level, gate):
    """Return the weight: 1 up to a quarter level before the cut, 0 from a quarter level after it."""
    resolved = (gate.reference_distance / distances).log() / math.log(gate.fork)
    # 0 where the Gaussian is gone, 1 where it is whole.
    share = ((resolved - (level.double() - 0.75)) * 2).clamp(0, 1)
    # The squared distance, relative to that where it is whole, goes from 1 to f; the weight is linear in it.
    squared = gate.fork ** (1 - share)
    weight = (gate.fork - squared) / (gate.fork - 1)
    weight[level == 0] = 1.0
    weight[level > gate.finest] = 0.0
    return weight


def faint_scene(n, device="cpu", seed=0):
    table = make_scene(n, device, seed)
    table.keep(table["means"].isfinite().all(1) & table["scales"].isfinite().all(1))
    table["scales"].clamp_(max=0.0)
    return table


@pytest.mark.parametrize("fork", [2.0, 1.3])
def test_the_weights_fall_over_half_a_level_around_the_cut(fork):
    gate = LodGate(45.0, fork, 6, 4, smooth=True)
    generator = torch.Generator().manual_seed(0)
    level = torch.randint(0, 6, (4000,), generator=generator).to(torch.uint8)
    distances = (
        45.0 * fork ** (5.5 - 7 * torch.rand(4000, generator=generator, dtype=torch.float64)) / fork**5
    )
    means = torch.zeros(4000, 3, dtype=torch.float64)
    means[:, 0] = distances
    found = gate.weights(means, level, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(found, weights_by_levels(distances, level, gate), rtol=0, atol=1e-9)
    between = (found > 0) & (found < 1)
    assert 100 < between.sum() < 2000
    reach = torch.tensor(gate.reach(), dtype=torch.float64)[level.long()]
    assert torch.equal(found > 0, distances < reach)
    cut = torch.tensor(replace(gate, smooth=False).reach(), dtype=torch.float64)[level.long()]
    near = (distances / cut).log() / math.log(fork)
    assert (near[between].abs() < 0.25).all()
    assert replace(gate, smooth=False).fade() == ()


@pytest.mark.parametrize("antialiased", [False, True])
def test_images_are_those_of_faded_opacities(device, antialiased):
    table = faint_scene(700, device)
    viewmats, Ks = make_views(2, device)
    options = replace(FADED, antialiased=antialiased)
    images = render_frame(table, Views(viewmats, Ks, WIDTH, HEIGHT), options).renders
    for view, centre in enumerate(centres_of(viewmats)):
        weights = SMOOTH.weights(table["means"], table["level"], centre)
        assert ((weights > 0) & (weights < 1)).sum() > 15
        expected = reference_render(
            table["means"], table["quats"], table["scales"].double().exp(),
            table["opacities"].double().sigmoid() * weights, table["sh"], viewmats[view], Ks[view],
            WIDTH, HEIGHT, sh_degree=0, near_plane=NEAR, far_plane=FAR, antialiased=antialiased,
        )  # fmt: skip
        sure = ~expected.cut
        assert sure.double().mean() > 0.9
        torch.testing.assert_close(images[view].double()[sure], expected.image[sure], rtol=0, atol=2e-4)


def test_the_gate_before_the_projection_changes_nothing(device):
    """All Gaussians that the gate leaves out have the weight 0."""
    table = faint_scene(6000, device)
    viewmats, Ks = make_views(device=device)
    views = Views(viewmats, Ks, WIDTH, HEIGHT)
    active = ModelGate(SMOOTH, math.inf, table, Ranks(device=torch.device(device))).active(table, viewmats)
    assert (active.views != 15).double().mean() > 0.2
    faded = render_frame(table, views, FADED, active)
    everything = render_frame(table, views, FADED)
    assert torch.equal(faded.renders, everything.renders)
    assert torch.equal(faded.projected.gaussian_ids, everything.projected.gaussian_ids)
    cut = ModelGate(GATE, math.inf, table, Ranks(device=torch.device(device))).active(table, viewmats)
    assert not torch.equal(faded.renders, render_frame(table, views, OPTIONS, cut).renders)


def test_images_change_little_where_the_gate_makes_them_jump(device):
    """One Gaussian of level 2, seen from around its cut."""
    table = faint_scene(100, device)
    table.keep(torch.arange(len(table), device=device) == 0)
    table["means"].zero_()
    table["level"].fill_(2)
    table["opacities"].fill_(2.0)
    ranks = Ranks(device=torch.device(device))
    gate = LodGate(8.0, 2.0, 3, 2)
    K = torch.tensor([[120.0, 0, 80], [0, 120.0, 60], [0, 0, 1]], device=device)[None]
    largest = {}
    for smooth in (False, True):
        faded = ModelGate(replace(gate, smooth=smooth), math.inf, table, ranks)
        images = []
        for step in range(80):
            viewmat = torch.eye(4, device=device)[None]
            viewmat[:, 2, 3] = gate.reach()[2] * 2 ** (0.5 - step / 80)
            options = replace(OPTIONS, fade=faded.gate.fade())
            frame = render_frame(table, Views(viewmat, K, 160, 120), options, faded.active(table, viewmat))
            images.append(frame.renders)
        stack = torch.cat(images)
        largest[smooth] = (stack[1:] - stack[:-1]).abs().max().item()
        assert stack[0].abs().max() == 0 and stack[-1].abs().max() > 0.1
    assert largest[True] < 0.15 * largest[False]


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_those_of_opacities_that_faded_before(device, antialiased):
    """The weight is a factor of the opacity's gradient, and a constant for means and poses."""
    dtype = torch.float64 if device == "cpu" else torch.float32
    table = faint_scene(3000, device)
    viewmats, Ks = (tensor.to(dtype) for tensor in make_views(3, device))
    leaves = [table[name].to(dtype) for name in ("means", "quats", "scales", "opacities", "sh")]
    leaves[2], leaves[3] = leaves[2].exp(), leaves[3].sigmoid()
    flags = {"near_plane": NEAR, "far_plane": FAR, "antialiased": antialiased, "raw": False}
    generator = torch.Generator().manual_seed(1)
    weights_of = lambda rows: [  # noqa: E731
        torch.rand(column.shape, generator=generator, dtype=torch.float64).to(column)
        for column in (rows.means2d, rows.conics, rows.opacities, rows.colors)
    ]
    columns = lambda rows: (rows.means2d, rows.conics, rows.opacities, rows.colors)  # noqa: E731

    first = [leaf.clone().requires_grad_() for leaf in (*leaves, viewmats)]
    options = ProjectionOptions(WIDTH, HEIGHT, fade=SMOOTH.fade(), **flags)
    inputs = ProjectionInputs(first[:5], (first[5], Ks), options, level=table["level"])
    splats = differentiable_splats(inputs, False)
    v = weights_of(splats)
    found = torch.autograd.grad(columns(splats), first, v)

    second = [leaf.clone().requires_grad_() for leaf in (*leaves, viewmats)]
    faded_splats, expected = 0, [torch.zeros_like(leaf) for leaf in second]
    for view, centre in enumerate(centres_of(viewmats)):
        weights = SMOOTH.weights(table["means"], table["level"], centre).to(dtype)
        own = (splats.camera_ids == view).nonzero()[:, 0]
        means, quats, scales, opacities, sh, poses = second
        alone = project(
            means, quats, scales, opacities * weights, sh, poses[view : view + 1], Ks[view : view + 1], WIDTH,
            HEIGHT, **flags,
        )  # fmt: skip
        assert torch.equal(alone.gaussian_ids, splats.gaussian_ids[own])
        torch.testing.assert_close(alone.opacities, splats.opacities[own], rtol=1e-5, atol=1e-6)
        faded_splats += int((weights[alone.gaussian_ids.long()] < 1).sum())
        parts = torch.autograd.grad(columns(alone), second, [column[own] for column in v])
        expected = [total + part for total, part in zip(expected, parts, strict=True)]
    assert faded_splats > 20
    tolerance = 1e-5 if dtype == torch.float64 else 2e-3
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance * b.abs().max().item())


def test_errors_name_the_value():
    table = faint_scene(13)
    viewmats, Ks = make_views(1)

    def call(level, fade):
        options = ProjectionOptions(WIDTH, HEIGHT, fade=fade)
        queue_projection(ProjectionInputs(table.parameters, (viewmats, Ks), options, level=level), None)

    refused(RuntimeError, "project_fwd: levels need a fade_slope of at least 1", call, table["level"], ())
    refused(RuntimeError, r"level must have shape \[10\], got \[9\]", call, table["level"][1:], SMOOTH.fade())
    refused(RuntimeError, "level must be Byte, got Int", call, table["level"].int(), SMOOTH.fade())


def test_opcheck(device):
    table = faint_scene(50, device)
    viewmats, Ks = make_views(2, device)
    options = FADED.projection(Views(viewmats, Ks, WIDTH, HEIGHT))
    arguments = (list(table.parameters), viewmats, Ks, *[None] * 5, table["level"], *options, [], None, None)
    torch.library.opcheck(
        torch.ops.blitzgs.project_fwd, arguments,
        test_utils=("test_schema", "test_faketensor", "test_autograd_registration"),
    )  # fmt: skip
