# SPDX-License-Identifier: Apache-2.0
"""The training path's backward pass, where the gradients of the splats stay in the rasteriser's table."""

import dataclasses

import pytest
import torch

from blitzgs.frame import frame as pipeline
from blitzgs.frame.transport import LocalTransport
from blitzgs.frame.transport.protocol import CapacityEstimate
from blitzgs.ops.projection_types import Sizes, WeightedViews
from blitzgs.ops.splat_gradients import gradient_columns
from blitzgs.table.blocks import BlockIndex, morton_order
from blitzgs.table.table import GaussianTable
from tests.cuda.scenes import ops, relative_error
from tests.frame.test_sharded_rendering import OPTIONS, cameras
from tests.helpers import parameter_gradients
from tests.training.tiny import random_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_packed_gradients_equal_those_from_columns(degree):
    small = random_gaussians(3000)
    columns = {name: small[name] for name in small if "exp_avg" not in name}
    columns["sh"] = torch.cat((columns["sh"], 0.1 * torch.randn(3000, 15, 3)), 1)
    table = GaussianTable.create({name: column.cuda() for name, column in columns.items()})
    options = dataclasses.replace(OPTIONS, sh_degree=degree, deterministic=True)
    views = cameras(3, device="cuda")
    frame = pipeline.forward(table, views, options)
    v_renders = torch.randn_like(frame.renders)
    (packed,) = pipeline.backward_splats(frame, v_renders).parts
    assert packed.shape == (len(frame.splats.depths), 12)
    projected, grid = frame.projected, pipeline.tile_grid(views, options, None)
    *unpacked, _ = ops.rasterize_bwd(*frame.saved, v_renders, None, *grid, False, True)
    for x, y in zip(gradient_columns(packed), unpacked, strict=True):
        assert y.any() and torch.equal(x, y)
    scale_reg = torch.linspace(0.1, 0.3, 3, device="cuda")
    projection = options.projection(views)
    *expected, _ = ops.project_bwd(
        list(table.parameters), *WeightedViews(views.viewmats, views.Ks, scale_reg),
        projected.camera_ids, projected.visible_ids, projected.splat_offsets, None, *projection,
        unpacked, None, False,
    )  # fmt: skip
    gradients = parameter_gradients(table, frame, v_renders, scale_reg)
    for x, y in zip(gradients, expected, strict=True):
        assert relative_error(x, y) < 1e-6


def test_a_second_backward_pass_starts_from_zeros_too():
    small = random_gaussians(2000)
    table = GaussianTable({name: small[name].cuda() for name in small})
    options, views = dataclasses.replace(OPTIONS, deterministic=True), cameras(2, device="cuda")
    plain = pipeline.forward(table, views, options)
    frame = pipeline.forward(table, views, options, backward_follows=True)
    assert torch.equal(frame.renders, plain.renders)
    v_renders = torch.randn_like(frame.renders)
    (expected,) = pipeline.backward_splats(plain, v_renders).parts
    assert expected.any()
    for _ in range(2):
        (found,) = pipeline.backward_splats(frame, v_renders).parts
        assert torch.equal(found, expected)


def composited_in(frame):
    """Return the tile offsets, transmittances and last_ids that a frame saves for its backward pass."""
    return [frame.saved.lists[1], *frame.saved.composited[:2]]


def test_frames_do_not_depend_on_the_room_that_was_guessed():
    small = random_gaussians(5000)
    table = GaussianTable({name: small[name].cuda() for name in small})
    options, views = dataclasses.replace(OPTIONS, deterministic=True), cameras(3, device="cuda")
    plain = pipeline.forward(table, views, options)
    needed = plain.projected.counts.tolist()
    v_renders = torch.randn_like(plain.renders)
    expected = parameter_gradients(table, plain, v_renders)
    rooms = [tuple(n * k // 100 for n in needed) for k in (100, 101, 250)]
    rooms += [tuple(n - (i == short) for i, n in enumerate(needed)) for short in range(3)]
    for sizes in [*rooms, (1, 1, 1)]:
        transport, attempts = LocalTransport(CapacityEstimate(Sizes(*sizes))), []
        enough = Sizes(*sizes).holds(needed)
        frame = pipeline.forward(
            table, views, options, transport=transport, mark=attempts.append, backward_follows=True
        )
        assert attempts.count("raster") == (1 if enough else 2)
        assert transport.capacity.sizes.holds(needed)
        for x, y in zip(frame.projected, plain.projected, strict=True):
            assert torch.equal(x, y)
        for x, y in zip(frame.splats, plain.splats, strict=True):
            assert torch.equal(x, y)
        for name in ("renders", "tile_work", "visible"):
            assert torch.equal(getattr(frame, name), getattr(plain, name)), name
        for kept, same in zip(composited_in(frame), composited_in(plain), strict=True):
            assert torch.equal(kept, same)
        for x, y in zip(parameter_gradients(table, frame, v_renders), expected, strict=True):
            assert torch.equal(x, y)


def test_an_active_set_that_did_not_fit_is_found_again():
    small = random_gaussians(5000)
    table = GaussianTable({name: small[name].cuda() for name in small})
    table.permute(morton_order(table["means"]))
    views, index, asked = cameras(3, device="cuda"), BlockIndex(table), []
    expected = pipeline.forward(table, views, OPTIONS)

    def find(sizes):
        capacity_blocks = None if sizes is None else sizes.blocks
        asked.append(capacity_blocks)
        return index.active(
            table, views.viewmats, views.Ks, views.width, views.height, OPTIONS.near_plane,
            OPTIONS.far_plane, capacity_blocks=capacity_blocks,
        )  # fmt: skip

    def rendered(transport):
        asked.clear()
        return pipeline.forward(table, views, OPTIONS, find, transport=transport)

    blocks = int(find(None).blocks)
    assert blocks > 2
    for sizes in (None, Sizes(1, 1, 1, 1), Sizes(10**5, 10**5, 10**6, blocks - 1), Sizes(1, 1, 1, blocks)):
        transport = LocalTransport(CapacityEstimate(sizes))
        assert torch.equal(rendered(transport).renders, expected.renders)
        assert asked[0] == (None if sizes is None else sizes.blocks)
        assert asked[-1] is None or asked[-1] >= blocks
        assert len(asked) == 1 + (sizes is not None and (sizes.blocks < blocks) + (sizes.visible == 1))
        rendered(transport)
        assert len(asked) == 1 and asked[0] >= blocks


def test_a_frame_without_splats_works_with_any_capacity():
    small = random_gaussians(500)
    table = GaussianTable({name: small[name].cuda() for name in small})
    table["means"].add_(1e6)
    views = cameras(2, device="cuda")
    for sizes in (Sizes(10, 10, 10), Sizes(1, 1, 1), None):
        transport = LocalTransport(CapacityEstimate(sizes))
        frame = pipeline.forward(table, views, OPTIONS, transport=transport, backward_follows=True)
        assert len(frame.projected.gaussian_ids) == 0 and (frame.saved.composited[0] == 1).all()
        v_renders = torch.ones_like(frame.renders)
        assert not any(g.any() for g in parameter_gradients(table, frame, v_renders))
