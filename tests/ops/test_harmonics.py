# SPDX-License-Identifier: Apache-2.0
"""SH of any number of channels and of degree 4: scipy's functions, gsplat's torch code, and the kernels'."""

import math

import pytest
import torch
from scipy.special import sph_harm_y

import blitzgs
from tests.helpers import PARAMETERS, random_scene, rasterize_scene, relative_error


def by_scipy(dirs, degree):
    """The basis from complex spherical harmonics, [N, K]."""
    x, y, z = torch.nn.functional.normalize(dirs, dim=1).unbind(1)
    polar, azimuth = torch.acos(z).numpy(), torch.atan2(y, x).numpy()
    basis = []
    for degree_l in range(degree + 1):
        for m in range(-degree_l, degree_l + 1):
            value = sph_harm_y(degree_l, abs(m), polar, azimuth)
            basis.append(math.sqrt(2 if m else 1) * (value.imag if m < 0 else value.real))
    return torch.stack([torch.from_numpy(values) for values in basis], dim=1)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_values_are_those_of_scipy(degree, channels):
    generator = torch.Generator().manual_seed(degree)
    dirs = 3 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    coeffs = torch.randn(30, 25, channels, generator=generator, dtype=torch.float64)
    masks = torch.rand(30, generator=generator) > 0.4
    basis = by_scipy(dirs, degree)
    expected = torch.einsum("nk,nkd->nd", basis, coeffs[:, : basis.shape[1]])
    assert relative_error(blitzgs.spherical_harmonics(degree, dirs, coeffs), expected) < 1e-14
    masked = blitzgs.spherical_harmonics(degree, dirs, coeffs, masks)
    assert torch.equal(masked[~masks], torch.zeros_like(expected[~masks]))
    assert relative_error(masked[masks], expected[masks]) < 1e-14


def test_values_are_those_of_gsplat():
    impl = pytest.importorskip("gsplat.cuda._torch_impl")
    dirs, coeffs = torch.randn(2, 20, 3, dtype=torch.float64), torch.randn(2, 20, 25, 3, dtype=torch.float64)
    for degree in range(5):
        expected = impl._spherical_harmonics(degree, torch.nn.functional.normalize(dirs, dim=-1), coeffs)
        assert relative_error(blitzgs.spherical_harmonics(degree, dirs, coeffs), expected) < 1e-12


def test_gradients():
    dirs = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(4, 25, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, c: blitzgs.spherical_harmonics(4, d, c), (dirs, coeffs))
    at_zero = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    blitzgs.spherical_harmonics(4, at_zero, coeffs[:1]).sum().backward()
    assert at_zero.grad.isfinite().all()


@pytest.mark.parametrize(
    ("degree", "dirs", "coeffs", "message"),
    [
        (5, (4, 3), (4, 36, 3), "degree must be 0 to 4, got 5"),
        (1, (4, 2), (4, 4, 3), r"dirs must be \[..., 3\], got \[4, 2\]"),
        (2, (4, 3), (4, 8, 3), r"coeffs must be \[..., K, D\] with K >= 9, got \[4, 8, 3\]"),
    ],
)
def test_errors(degree, dirs, coeffs, message):
    with pytest.raises(ValueError, match=message):
        blitzgs.spherical_harmonics(degree, torch.zeros(dirs), torch.zeros(coeffs))


def with_channels(scene, channels):
    """The scene with other SH channels; the last ones are those that it had."""
    extra = torch.randn(*scene.colors.shape[:-1], channels - 3, dtype=scene.colors.dtype)
    scene.colors = torch.cat([extra, scene.colors], dim=-1)
    return scene


@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}], ids=str)
@pytest.mark.parametrize("cameras", [1, 3])
def test_images_and_gradients_of_more_channels_are_those_of_the_kernels(options, cameras):
    scene = random_scene(n=60, cameras=cameras, dtype=torch.float64)
    results = []
    for channels in (3, 5):
        leaves = with_channels(scene, channels).leaves() if channels > 3 else scene.leaves()
        image = rasterize_scene(leaves, **options)[0][..., channels - 3 :]
        gradients = torch.autograd.grad(image.sin().sum(), [getattr(leaves, name) for name in PARAMETERS])
        results.append([image, *(g[..., -3:] if g.shape[-1] == channels else g for g in gradients)])
    for actual, expected in zip(*reversed(results), strict=True):
        assert relative_error(actual, expected) < 1e-10


def test_degree_4_is_degree_3_and_nine_more_functions():
    scene = random_scene(n=60, dtype=torch.float64)
    three = rasterize_scene(scene)[0]
    scene.colors = torch.cat([scene.colors, torch.zeros_like(scene.colors[:, :9])], dim=1)
    assert relative_error(rasterize_scene(scene, sh_degree=4)[0], three) < 1e-12
    scene.colors[:, 16:] = 0.2
    assert relative_error(rasterize_scene(scene, sh_degree=4)[0], three) > 1e-3


@pytest.mark.parametrize("channels", [3, 4])
def test_sh_without_batch_dimensions_are_those_of_all_scenes(channels):
    scene = random_scene(n=30, cameras=2, dtype=torch.float64)
    if channels > 3:
        with_channels(scene, channels)
    leaf = scene.colors.clone().requires_grad_()

    def twice(tensor):
        return torch.stack([tensor, tensor])

    image, _, _ = blitzgs.rasterization(
        *map(twice, (scene.means, scene.quats, scene.scales, scene.opacities)), leaf,
        *map(twice, (scene.viewmats, scene.Ks)), scene.width, scene.height, sh_degree=3,
    )  # fmt: skip
    scene.colors = alone = scene.colors.clone().requires_grad_()
    expected = rasterize_scene(scene)[0]
    assert relative_error(image, twice(expected)) < 1e-12
    (actual,), (one,) = (torch.autograd.grad(x.sin().sum(), y) for x, y in ((image, leaf), (expected, alone)))
    assert relative_error(actual, 2 * one) < 1e-12


@pytest.mark.filterwarnings("ignore:blitzgs.rasterization")
def test_what_is_not_finite_hides_its_own_gaussian_or_view():
    scene = with_channels(random_scene(n=30, cameras=3, dtype=torch.float64), 4)
    scene.means[3], scene.viewmats[1, 0, 3] = math.nan, math.inf
    image, alphas, meta = rasterize_scene(scene)
    assert set(meta["non_finite"]) == {"means", "viewmats"}
    assert image.isfinite().all() and (alphas[1] == 0).all() and (alphas[[0, 2]] > 0).any((1, 2, 3)).all()
