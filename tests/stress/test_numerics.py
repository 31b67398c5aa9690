# SPDX-License-Identifier: Apache-2.0
"""Inputs at the ends of every range give finite images and gradients, and the reference's image."""

import math

import pytest
import torch

import blitzgs
from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import project
from blitzgs.ops.rasterize import rasterize
from blitzgs.reference import composite, project_splats
from tests.helpers import (
    BACKENDS,
    PARAMETERS,
    Scene,
    image_error,
    random_scene,
    reference_images,
    relative_error,
)


def uniform(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def facing_scene(n: int, width: int, height: int, seed: int = 0, focal: float = 30.0) -> Scene:
    """One camera at the origin that looks along +z at n Gaussians spread over its image at depths 2 to 4."""
    scene = random_scene(n=n, cameras=1, width=width, height=height, seed=seed, dtype=torch.float64)
    scene.viewmats = torch.eye(4, dtype=torch.float64)[None]
    scene.Ks[:, 0, 0], scene.Ks[:, 1, 1] = focal, focal
    z = uniform(n, seed=seed + 1, low=2.0, high=4.0)
    pixels = uniform(n, 2, seed=seed + 2) * torch.tensor([width, height])
    scene.means = torch.stack(
        [(pixels[:, 0] - scene.Ks[0, 0, 2]) / focal * z, (pixels[:, 1] - scene.Ks[0, 1, 2]) / focal * z, z],
        dim=1,
    )
    return scene


def any_scale() -> Scene:
    scene = facing_scene(60, 32, 24)
    scene.scales = 10.0 ** uniform(60, 3, seed=5, low=-8.0, high=4.0)
    return scene


# Not round, or the true gradient of the quaternions is zero and its relative error means nothing.
NEARLY_ROUND = torch.tensor([1.0, 1.3, 0.8], dtype=torch.float64)


def nearly_round_of_each_size() -> Scene:
    scene = facing_scene(65, 32, 24)
    scene.scales = (10.0 ** torch.linspace(-8, 4, 65, dtype=torch.float64))[:, None] * NEARLY_ROUND
    return scene


def any_quaternion() -> Scene:
    scene = facing_scene(40, 32, 24)
    length = (10.0 ** torch.linspace(-37, 37, 40, dtype=torch.float64))[:, None]
    scene.quats = torch.nn.functional.normalize(scene.quats, dim=1) * length
    scene.quats[::5] = 0.0
    return scene


def any_opacity() -> Scene:
    scene = facing_scene(48, 32, 24)
    ends = [0.0, 1e-30, 1e-12, 1e-3, 0.99 / 255, 1.01 / 255, 1 - 1e-3, 1 - 1e-6, 1.0, 1.0, 1.0, 1.0]
    scene.opacities = torch.tensor(ends * 4, dtype=torch.float64)
    return scene


def around_the_near_plane() -> Scene:
    scene = facing_scene(48, 32, 24)
    factors = torch.tensor([-100.0, -1.0, 0.0, 0.5, 1 - 1e-6, 1 + 1e-6, 1 + 1e-3, 1.1, 2, 10, 100, 300])
    scene.means *= (0.01 * factors.repeat(4).double() / scene.means[:, 2])[:, None]
    scene.scales *= 1e-2
    return scene


def far_off_screen() -> Scene:
    scene = facing_scene(60, 32, 24)
    scene.means[:40, :2] *= 10.0 ** uniform(40, 1, seed=6, low=0.0, high=6.0)
    scene.scales[20:40] *= 10.0 ** uniform(20, 1, seed=7, low=0.0, high=4.0)
    return scene


def elongated() -> Scene:
    scene = facing_scene(40, 32, 24)
    scene.scales = torch.tensor([1.0, 1e-4, 1e-4], dtype=torch.float64).repeat(40, 1)
    scene.scales *= 10.0 ** uniform(40, 1, seed=8, low=-2.0, high=1.0)
    return scene


def needles(length: float) -> Scene:
    """Splats thinner than a pixel, `length` pixels from end to end (3 standard deviations each way)."""
    scene = facing_scene(40, 320, 240, focal=300.0)
    angle = uniform(40, seed=12, high=math.pi)
    zero = torch.zeros_like(angle)
    scene.quats = torch.stack([(angle / 2).cos(), zero, zero, (angle / 2).sin()], dim=1)
    sigma = length / 6 * scene.means[:, 2] / 300.0
    scene.scales = sigma[:, None] * torch.tensor([1.0, 1e-3, 1e-3], dtype=torch.float64)
    return scene


def equal_depths() -> Scene:
    scene = facing_scene(40, 32, 24)
    scene.means *= (3.0 / scene.means[:, 2])[:, None]
    scene.means[:, 2] = 3.0
    return scene


def focal_length(focal: float) -> Scene:
    scene = facing_scene(40, 32, 24, focal=focal)
    scene.scales *= 30.0 / focal
    return scene


def far_from_the_origin() -> Scene:
    scene = facing_scene(50, 32, 24)
    shift = torch.tensor([1e6, -3e5, 2e6], dtype=torch.float64)
    scene.means += shift
    scene.viewmats[0, :3, 3] = -shift
    return scene


def one_tile(n: int) -> Scene:
    """Every Gaussian covers the whole image; depths differ by more than rounding, in random order."""
    scene = facing_scene(n, 4, 4, focal=40.0)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(9))
    z = 2.0 * 100.0 ** (order.double() / n)
    scene.means *= (z / scene.means[:, 2])[:, None]
    scene.scales = 0.2 * z[:, None] * NEARLY_ROUND
    scene.opacities = 0.02 + 0.03 * scene.opacities
    return scene


def deep(n: int) -> Scene:
    """Each layer is faint, so two thousand are composited before a pixel ends."""
    scene = facing_scene(n, 3, 2)
    z = torch.linspace(2.0, 1e3, n, dtype=torch.float64)
    scene.means = torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], dim=1)
    scene.scales = z[:, None] * NEARLY_ROUND
    scene.opacities[:] = 0.0045
    return scene


def image_of_size(width: int, height: int) -> Scene:
    scene = facing_scene(20, width, height)
    scene.scales *= 4.0
    return scene


SCENES = {
    "scales 1e-8 to 1e4, each axis": any_scale,
    "scales 1e-8 to 1e4, nearly round": nearly_round_of_each_size,
    "quaternions zero and 1e-37 to 1e37": any_quaternion,
    "opacity to 0 and to 1": any_opacity,
    "around the near plane": around_the_near_plane,
    "far off-screen": far_off_screen,
    "elongated 1 : 1e4": elongated,
    "needles of 80 px": lambda: needles(80.0),
    "needles of 300 px": lambda: needles(300.0),
    "equal depths": equal_depths,
    "focal length 10": lambda: focal_length(10.0),
    "focal length 1e5": lambda: focal_length(1e5),
    "1e6 from the origin": far_from_the_origin,
    "5 000 on one tile": lambda: one_tile(5_000),
    "4 000 layers": lambda: deep(4_000),
    "1 x 1 image": lambda: image_of_size(1, 1),
    "2500 x 1 image": lambda: image_of_size(2500, 1),
    "1 x 2500 image": lambda: image_of_size(1, 2500),
}
IMAGE_BOUND, GRADIENT_BOUND = 2e-5, 1e-4  # float32, as shares of the largest value
# The gradient of a needle's conic loses what lies across the needle beside what lies along it.
GRADIENT_BOUNDS = {"needles of 80 px": 5e-4, "needles of 300 px": 2e-3}


def require_finite_and_correct(
    scene: Scene,
    backend: tuple[str, torch.dtype],
    image_bound: float = IMAGE_BOUND,
    gradient_bound: float = GRADIENT_BOUND,
    antialiased: bool = False,
) -> None:
    device, dtype = backend
    if dtype == torch.float64:
        image_bound, gradient_bound = 1e-9, 1e-6
    # The reference sees the inputs as rounded to the backend's dtype.
    rounded = scene.to(dtype).to(torch.float64).leaves()
    reference = reference_images(rounded, antialiased=antialiased)[0]
    leaves = scene.to(dtype, device).leaves()
    mode = "antialiased" if antialiased else "classic"
    renders, alphas, _ = blitzgs.rasterization(*leaves.arguments(), sh_degree=3, rasterize_mode=mode)
    size = max(1.0, reference.image.detach().abs().max().item())
    assert image_error(renders[0], reference.image, reference.cut, most_cut=0.5) <= image_bound * size
    assert image_error(alphas[0, ..., 0], reference.alpha, reference.cut, most_cut=0.5) <= image_bound

    weights = uniform(*reference.image.shape, seed=11) * ~reference.cut[..., None]
    (renders[0].double().cpu() * weights).sum().backward()
    (reference.image * weights).sum().backward()
    for name in PARAMETERS:
        actual, expected = getattr(leaves, name).grad, getattr(rounded, name).grad
        assert relative_error(actual, expected) <= gradient_bound, name


@pytest.mark.parametrize("name", SCENES)
def test_extremes(name, backend):
    require_finite_and_correct(
        SCENES[name](), backend, IMAGE_BOUND, GRADIENT_BOUNDS.get(name, GRADIENT_BOUND)
    )


@pytest.mark.parametrize("pixels", [30.0, 300.0, 3000.0])
def test_antialiased_splats_much_wider_than_the_blur(pixels, backend):
    """The compensation of such splats is nearly 1, and its derivative far below that of its parts."""
    scene = facing_scene(5, 32, 24)
    scene.scales = pixels / 30.0 * scene.means[:, 2:] * NEARLY_ROUND
    require_finite_and_correct(scene, backend, antialiased=True)


@pytest.mark.parametrize("backend", BACKENDS[1:])
@pytest.mark.parametrize("name", SCENES)
def test_extremes_as_they_are_trained(name, backend):
    """Log scales and logits, in two views at once."""
    scene = SCENES[name]().to(backend[1], backend[0])
    leaves = scene.leaves()
    leaves.scales = scene.scales.log().requires_grad_()
    leaves.opacities = scene.opacities.clamp(max=1 - 1e-7).logit().requires_grad_()
    means, quats, scales, opacities, colors, viewmats, Ks, width, height = leaves.arguments()
    viewmats, Ks = viewmats.expand(2, 4, 4), Ks.expand(2, 3, 3)
    rows = project(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree=3)
    grid = {"n_cameras": 2, "width": width, "height": height}
    lists = intersect(rows.means2d, rows.conics, rows.opacities, rows.depths, rows.camera_ids, **grid)
    renders, _ = rasterize(rows.means2d, rows.conics, rows.opacities, rows.colors, *lists, **grid)
    assert torch.equal(renders[0], renders[1])

    reference = reference_images(scene.to(torch.float64))[0]
    size = max(1.0, reference.image.abs().max().item())
    # exp(log(s)) keeps 6 digits of the smallest s.
    assert image_error(renders[0], reference.image, reference.cut, most_cut=0.5) <= 1e-4 * size
    renders.sum().backward()
    for name in PARAMETERS:
        assert getattr(leaves, name).grad.isfinite().all(), name


@pytest.mark.slow
@pytest.mark.parametrize("make_scene", [lambda: one_tile(1_000_000), lambda: deep(100_000)])
def test_a_million_on_one_tile_and_a_hundred_thousand_layers(make_scene, backend):
    require_finite_and_correct(make_scene(), backend)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS[1:])
def test_an_image_of_16k_by_16k_in_windows(backend):
    device, dtype = backend
    size, window = 16_384, 64
    scene = facing_scene(400, size, size, focal=16_384.0).to(dtype)
    on_device = scene.to(dtype, device)
    whole, _, _ = blitzgs.rasterization(*on_device.arguments(), sh_degree=3)
    assert whole.isfinite().all()
    options = {"near_plane": 0.01, "far_plane": 1e10, "eps2d": 0.3, "antialiased": False, "sh_degree": 3}
    arguments = [t[0] if t.dim() == 3 and len(t) == 1 else t for t in scene.to(torch.float64).arguments()[:7]]
    splats = project_splats(*arguments, size, size, **options)
    for x0, y0 in ((0, 0), (size - window, size - window), (8000, 5000)):
        means2d = splats.means2d - torch.tensor([x0, y0])
        expected = composite(
            means2d, splats.conics, splats.opacities, splats.colors, splats.depths, window, window
        )
        actual = whole[0, y0 : y0 + window, x0 : x0 + window]
        assert expected.values.abs().max() > 0
        # A float has 1e-3 px of a position at 16k.
        assert image_error(actual, expected.values, expected.cut) <= 1e-4
