# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization` on CUDA has every mode of the CPU and gives the same results."""

import pytest
import torch

import blitzgs
from blitzgs.ops import project_gradient, splat_gradients
from tests.helpers import PARAMETERS, random_scene, relative_error

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
        random_scene(n=200, width=70, height=50),
        backgrounds,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        packed=packed,
    )


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

    def packed_table(columns):
        found.append(splat_gradients.packed_table(columns))
        return found[-1]

    monkeypatch.setattr(project_gradient, "packed_table", packed_table)
    for _ in range(3):
        leaves = scene.leaves()
        renders, _, meta = blitzgs.rasterization(*leaves.arguments(), sh_degree=scene.sh_degree)
        renders.sum().backward()
    assert [table.shape for table in found] == [(len(meta["depths"]), 12)] * 3
