# SPDX-License-Identifier: Apache-2.0
"""The call on CUDA gives the CPU's results in every mode, and the training path its gradients."""

import dataclasses

import pytest
import torch

import blitzgs
from blitzgs.frame.render import backward_splats, render_frame, tile_grid
from blitzgs.frame.transport.protocol import CapacityEstimate, LocalTransport, stages_told_to
from blitzgs.ops import project
from blitzgs.ops.projection_types import Sizes
from blitzgs.ops.rasterize import gradient_columns, gradient_table_of
from blitzgs.table.blocks import BlockIndex, morton_order
from blitzgs.table.table import GaussianTable
from tests.cuda.conftest import ops
from tests.frame.test_sharded_rendering import OPTIONS, cameras
from tests.helpers import PARAMETERS, parameter_gradients, random_scene, relative_error
from tests.training.tiny import random_gaussians

PER_SPLAT = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")


class Rendering:
    """One call on one device, and its gradients for weights that are zero where `decided` is."""

    def __init__(self, scene, device, dtype, backgrounds=None, **options):
        leaves = scene.to(dtype, device).leaves()
        self.inputs = [getattr(leaves, name) for name in PARAMETERS]
        if backgrounds is not None:
            backgrounds = backgrounds.to(device, dtype).requires_grad_()
            self.inputs.append(backgrounds)
        self.renders, self.alphas, self.meta = blitzgs.rasterization(
            *leaves.arguments(), sh_degree=scene.sh_degree, backgrounds=backgrounds, **options
        )
        self.meta["means2d"].retain_grad()

    def backward(self, decided):
        g = torch.Generator().manual_seed(3)
        weights = torch.randn(self.renders.shape, generator=g) * decided
        alpha_weights = torch.randn(self.alphas.shape, generator=g) * decided
        like = {"device": self.renders.device, "dtype": self.renders.dtype}
        loss = (self.renders * weights.to(**like)).sum() + (self.alphas * alpha_weights.to(**like)).sum()
        loss.backward()
        return [torch.zeros_like(t) if t.grad is None else t.grad for t in self.inputs]


def require_agreement(scene, backgrounds=None, **options):
    """The float64 CPU's image, away from the few pixels on a cut, its gradients and its meta."""
    exact = Rendering(scene, "cpu", torch.float64, backgrounds, **options)
    ours = Rendering(scene, "cuda", torch.float32, backgrounds, **options)
    error = torch.maximum(
        (ours.renders.cpu() - exact.renders).abs().amax(-1, keepdim=True),
        (ours.alphas.cpu() - exact.alphas).abs(),
    )
    decided = error <= 2e-5 * max(1.0, exact.renders.abs().max().item())
    assert (~decided).float().mean() < 5e-3
    pairs = zip(ours.backward(decided), exact.backward(decided), strict=True)
    for name, (value, expected) in zip([*PARAMETERS, "backgrounds"], pairs, strict=False):
        assert relative_error(value.cpu(), expected) <= 1e-4, name
    require_same_meta(ours.meta, exact.meta, options.get("absgrad", False))


def require_same_meta(ours, exact, absgrad):
    assert ours.keys() == exact.keys()
    for name in PER_SPLAT:
        assert ours[name].shape == exact[name].shape, name
        assert relative_error(ours[name].detach().double().cpu(), exact[name].detach().double()) <= 1e-3, name
    for name in ("camera_ids", "gaussian_ids"):
        if exact[name] is None:
            assert ours[name] is None
        else:
            assert torch.equal(ours[name].cpu(), exact[name])
    for name in ("tile_width", "tile_height", "width", "height", "tile_size", "n_cameras"):
        assert ours[name] == exact[name]
    for name in ("isect_offsets", "flatten_ids", "isect_ids"):
        assert ours[name].dtype == exact[name].dtype
    assert ours["isect_offsets"].shape == exact["isect_offsets"].shape
    assert abs(len(ours["flatten_ids"]) - len(exact["flatten_ids"])) <= 2  # a boundary may round either way
    assert relative_error(ours["means2d"].grad.cpu(), exact["means2d"].grad) <= 1e-4
    if absgrad:
        assert relative_error(ours["means2d"].absgrad.cpu(), exact["means2d"].absgrad) <= 1e-4


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_every_render_mode(render_mode, rasterize_mode, packed):
    backgrounds = torch.tensor([[0.2, 0.5, 0.9], [1.0, 0.0, 0.3]]) if "RGB" in render_mode else None
    require_agreement(
        random_scene(n=200, width=70, height=50), backgrounds, render_mode=render_mode,
        rasterize_mode=rasterize_mode, packed=packed,
    )  # fmt: skip


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 6, 7, 16, 32])
def test_any_number_of_channels(channels, per_view, absgrad):
    scene = random_scene(n=200, width=70, height=50)
    scene.sh_degree = None
    g = torch.Generator().manual_seed(9)
    scene.colors = torch.rand(*((2,) if per_view else ()), 200, channels, generator=g)
    backgrounds = torch.rand(2, channels, generator=g)
    require_agreement(scene, backgrounds, absgrad=absgrad, render_mode="RGB+ED" if per_view else "RGB")


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("tile_size", [1, 4, 8, 16, 32, 50, 64])
def test_tile_sizes_and_absolute_gradients(tile_size, packed):
    scene = random_scene(n=200, width=70, height=50)
    require_agreement(scene, tile_size=tile_size, packed=packed, absgrad=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degrees_and_clipping(degree):
    scene = random_scene(n=200, width=70, height=50)
    scene.sh_degree = degree
    require_agreement(scene, near_plane=0.5, far_plane=4.0, radius_clip=2.0, eps2d=0.1)


@pytest.mark.parametrize("channels", [3, 7])
def test_deterministic_gradients(channels):
    scene = random_scene(n=200, width=70, height=50)
    scene.sh_degree = None
    scene.colors = torch.rand(200, channels, generator=torch.Generator().manual_seed(9))
    torch.use_deterministic_algorithms(True)
    try:
        require_agreement(scene, absgrad=True)
        runs = [Rendering(scene, "cuda", torch.float32, absgrad=True) for _ in range(3)]
        gradients = [[*run.backward(torch.ones(1)), run.meta["means2d"].absgrad] for run in runs]
    finally:
        torch.use_deterministic_algorithms(False)
    for again in gradients[1:]:
        assert all(torch.equal(a, b) for a, b in zip(gradients[0], again, strict=True))


def test_gradients_of_splats_stay_in_their_table(monkeypatch):
    # The capacity exceeds the number of splats, so the table is the first part of its memory.
    scene, found = random_scene(400, cameras=1, device="cuda"), []

    def noted(columns):
        found.append(gradient_table_of(columns))
        return found[-1]

    monkeypatch.setattr(project, "gradient_table_of", noted)
    for _ in range(3):
        leaves = scene.leaves()
        renders, _, meta = blitzgs.rasterization(*leaves.arguments(), sh_degree=scene.sh_degree)
        renders.sum().backward()
    assert [table.shape for table in found] == [(len(meta["depths"]), 12)] * 3


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_packed_gradients_equal_those_from_columns(degree):
    small = random_gaussians(3000)
    columns = {name: small[name] for name in small if "exp_avg" not in name}
    columns["sh"] = torch.cat((columns["sh"], 0.1 * torch.randn(3000, 15, 3)), 1)
    table = GaussianTable.create({name: column.cuda() for name, column in columns.items()})
    options = dataclasses.replace(OPTIONS, sh_degree=degree, deterministic=True)
    views = cameras(3, device="cuda")
    frame = render_frame(table, views, options)
    v_renders = torch.randn_like(frame.renders)
    (packed,) = backward_splats(frame, v_renders).parts
    assert packed.shape == (len(frame.splats.depths), 12)
    projected, grid = frame.projected, tile_grid(views, None)
    *unpacked, _ = ops.rasterize_bwd(*frame.saved, v_renders, None, *grid, False, True)
    for x, y in zip(gradient_columns(packed), unpacked, strict=True):
        assert y.any() and torch.equal(x, y)
    scale_reg = torch.linspace(0.1, 0.3, 3, device="cuda")
    projection = options.projection(views)
    *expected, _ = ops.project_bwd(
        list(table.parameters), views.viewmats, views.Ks, scale_reg, None,
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
    plain = render_frame(table, views, options)
    frame = render_frame(table, views, options, backward_follows=True)
    assert torch.equal(frame.renders, plain.renders)
    v_renders = torch.randn_like(frame.renders)
    (expected,) = backward_splats(plain, v_renders).parts
    assert expected.any()
    for _ in range(2):
        (found,) = backward_splats(frame, v_renders).parts
        assert torch.equal(found, expected)


def composited_in(frame):
    """Return the tile offsets, transmittances and last_ids that a frame saves for its backward pass."""
    return [frame.saved.lists[1], *frame.saved.composited[:2]]


def test_frames_do_not_depend_on_the_room_that_was_guessed():
    small = random_gaussians(5000)
    table = GaussianTable({name: small[name].cuda() for name in small})
    options, views = dataclasses.replace(OPTIONS, deterministic=True), cameras(3, device="cuda")
    plain = render_frame(table, views, options)
    needed = plain.projected.counts.tolist()
    v_renders = torch.randn_like(plain.renders)
    expected = parameter_gradients(table, plain, v_renders)
    rooms = [tuple(n * k // 100 for n in needed) for k in (100, 101, 250)]
    rooms += [tuple(n - (i == short) for i, n in enumerate(needed)) for short in range(3)]
    for sizes in [*rooms, (1, 1, 1)]:
        transport, attempts = LocalTransport(CapacityEstimate(Sizes(*sizes))), []
        enough = Sizes(*sizes).holds(needed)
        with stages_told_to(attempts.append):
            frame = render_frame(table, views, options, transport=transport, backward_follows=True)
        assert attempts.count("raster") == (1 if enough else 2)
        assert transport.estimate.sizes.holds(needed)
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
    expected = render_frame(table, views, OPTIONS)

    def find(sizes):
        capacity_blocks = None if sizes is None else sizes.blocks
        asked.append(capacity_blocks)
        return index.active(table, views, OPTIONS.limits, capacity_blocks=capacity_blocks)

    def rendered(transport):
        asked.clear()
        return render_frame(table, views, OPTIONS, find, transport=transport)

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
        frame = render_frame(table, views, OPTIONS, transport=transport, backward_follows=True)
        assert len(frame.projected.gaussian_ids) == 0 and (frame.saved.composited[0] == 1).all()
        v_renders = torch.ones_like(frame.renders)
        assert not any(g.any() for g in parameter_gradients(table, frame, v_renders))
