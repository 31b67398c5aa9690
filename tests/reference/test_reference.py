# SPDX-License-Identifier: Apache-2.0
"""The reference equals a scalar loop and closed forms; error measures fail where they should."""

import math

import pytest
import torch

from blitzgs.reference import composite, render
from blitzgs.reference.projection import rotation_matrices, sh_basis
from tests.helpers import image_error, random_scene, reference_images, refused, relative_error


def loop_pixel(means2d, conics, opacities, colors, x, y):
    """The definition of a pixel, one statement for each sentence of it."""
    transmittance, value = 1.0, [0.0] * colors.shape[1]
    for (mx, my), (a, b, c), o, color in zip(
        means2d.tolist(), conics.tolist(), opacities.tolist(), colors.tolist(), strict=True
    ):
        dx, dy = x + 0.5 - mx, y + 0.5 - my
        alpha = min(0.99, o * math.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)))
        if alpha < 1 / 255:
            continue
        if transmittance * (1 - alpha) < 1e-4:
            break
        value = [v + alpha * transmittance * channel for v, channel in zip(value, color, strict=True)]
        transmittance *= 1 - alpha
    return value, transmittance


def test_compositing_equals_a_scalar_loop():
    splats = reference_images(random_scene(n=150, cameras=1, width=12, height=9, scale=0.4))[0].splats
    # Opaque enough that pixels end early.
    opacities = splats.opacities.clamp(min=0.6)
    result = composite(splats.means2d, splats.conics, opacities, splats.colors, splats.depths, 12, 9)
    ended = 0
    for y in range(9):
        for x in range(12):
            value, transmittance = loop_pixel(splats.means2d, splats.conics, opacities, splats.colors, x, y)
            assert result.values[y, x].tolist() == pytest.approx(value, abs=1e-13)
            assert result.transmittances[y, x].item() == pytest.approx(transmittance, abs=1e-13)
            ended += transmittance < 2e-4
    assert ended > 0


def test_projection_of_a_gaussian_on_the_axis_is_its_scaled_covariance():
    identity = torch.eye(4, dtype=torch.float64)
    K = torch.tensor([[50.0, 0, 8], [0, 60.0, 6], [0, 0, 1]], dtype=torch.float64)
    quat = torch.tensor([[math.cos(0.35), 0, 0, math.sin(0.35)]], dtype=torch.float64)
    means = torch.tensor([[0.0, 0, 5]])
    scales = torch.tensor([[0.3, 0.1, 0.7]])
    splats = render(means, quat, scales, torch.ones(1) * 0.5, torch.ones(1, 2), identity, K, 16, 12).splats
    assert splats.means2d.tolist() == [[8.0, 6.0]]
    R = torch.tensor([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]], dtype=torch.float64)
    zoom = torch.diag(torch.tensor([10.0, 12.0], dtype=torch.float64))
    s = scales[0, :2].double()
    covariance = zoom @ R @ torch.diag(s**2) @ R.T @ zoom + 0.3 * torch.eye(2)
    a, b, c = splats.conics[0]
    assert torch.allclose(torch.stack([a, b, b, c]).reshape(2, 2), covariance.inverse(), atol=1e-12)


def test_depth_range_is_open_at_near_and_closed_at_far():
    K = torch.tensor([[10.0, 0, 4], [0, 10.0, 4], [0, 0, 1]])
    means = torch.tensor([[0.0, 0, 1], [0, 0, 1.5], [0, 0, 2], [0, 0, 2.5], [0, 0, -1.5]])
    n = len(means)
    splats = render(
        means, torch.ones(n, 4), torch.ones(n, 3), torch.full((n,), 0.5), torch.ones(n, 1), torch.eye(4), K,
        8, 8, near_plane=1.0, far_plane=2.0,
    ).splats  # fmt: skip
    assert splats.ids.tolist() == [1, 2]


def test_sh_basis_is_orthonormal():
    # A product rule on the sphere, exact for the degree-6 products: Gauss-Legendre in z, equal angles.
    import numpy as np

    z, weight = np.polynomial.legendre.leggauss(8)
    z, weight = torch.tensor(z), torch.tensor(weight)
    angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()
    directions = torch.stack(
        [r[:, None] * angle.cos(), r[:, None] * angle.sin(), z[:, None].expand(-1, 16)], dim=-1
    ).reshape(-1, 3)
    basis = sh_basis(directions, 3)
    weights = (weight[:, None].expand(-1, 16) * (2 * math.pi / 16)).reshape(-1)
    assert torch.allclose(
        basis.T @ (weights[:, None] * basis), torch.eye(16, dtype=torch.float64), atol=1e-12
    )


def test_rotations_are_rotations_for_any_quaternion():
    quats = torch.tensor(
        [[0.0, 0, 0, 0], [1e150, 2e150, 0, 1e150], [1e-200, 0, 1e-200, 0], [1, 2, 3, 4]], dtype=torch.float64
    )
    R = rotation_matrices(quats)
    assert torch.allclose(
        R @ R.transpose(1, 2), torch.eye(3, dtype=torch.float64).expand(4, 3, 3), atol=1e-14
    )
    assert torch.allclose(torch.linalg.det(R), torch.ones(4, dtype=torch.float64))


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("viewmat", torch.eye(4)[None], r"viewmat must be \[4, 4\], got \[1, 4, 4\]"),
        ("viewmat", torch.eye(4)[:3], r"viewmat must be \[4, 4\], got \[3, 4\]"),
        ("scales", torch.ones(1, 3), r"scales must be \[5, 3\], got \[1, 3\]"),
        ("colors", torch.ones(5, 3, 3), r"colors must be \[5, 4, 3\], got \[5, 3, 3\]"),
        ("sh_degree", None, r"colors must be \[5, 3\], got \[5, 16, 3\]"),
        ("sh_degree", 4, "sh_degree must be 0 to 3 or None, got 4"),
        ("render_mode", "rgb", "render_mode must be one of RGB, .*, got 'rgb'"),
    ],
)
def test_what_does_not_fit_is_named(name, value, message):
    scene = random_scene(n=5, cameras=1)
    given = {key: getattr(scene, key) for key in ("means", "quats", "scales", "opacities", "colors")}
    given |= {"viewmat": scene.viewmats[0], "K": scene.Ks[0], "sh_degree": 1, name: value}
    refused(ValueError, message, render, width=8, height=8, **given)


def test_no_gaussians_leave_the_background():
    (image,) = reference_images(random_scene(n=0, cameras=1), torch.full((1, 3), 0.3), render_mode="RGB+ED")
    assert not (image.alpha.any() or image.cut.any() or image.image[..., 3].any())
    assert torch.equal(image.image[..., :3], torch.full((32, 40, 3), 0.3).double())


def test_non_finite_gaussians_spread_nowhere_not_even_into_gradients():
    scene = random_scene(n=20, cameras=1)
    clean = reference_images(scene)[0]
    scene.means[3, 1] = math.nan
    scene.scales[7, 0] = math.inf
    scene.quats[9] = math.nan
    scene.opacities[11] = math.nan
    scene.colors[13, 2, 0] = math.nan
    leaves = scene.leaves()
    image = reference_images(leaves)[0]
    assert image.image.isfinite().all() and not torch.equal(image.image, clean.image)
    image.image.sum().backward()
    for tensor in (
        leaves.means,
        leaves.quats,
        leaves.scales,
        leaves.opacities,
        leaves.colors,
        leaves.viewmats,
    ):
        assert tensor.grad.isfinite().all() and tensor.grad.abs().sum() > 0
    assert leaves.means.grad[3].tolist() == [0, 0, 0]


def test_relative_error_sees_one_wrong_value_a_nan_and_a_wrong_shape():
    expected = torch.arange(1.0, 9.0)
    assert relative_error(expected, expected) == 0.0
    wrong = expected.clone()
    wrong[3] += 0.8
    assert relative_error(wrong, expected) == pytest.approx(0.1)
    wrong[3] = math.nan
    assert relative_error(wrong, expected) == math.inf
    assert relative_error(expected, wrong) == math.inf
    refused(AssertionError, "shapes differ", relative_error, expected[:, None], expected)


def test_relative_error_of_zeros_is_zero_or_infinite():
    assert relative_error(torch.zeros(3), torch.zeros(3)) == 0.0
    assert relative_error(torch.full((3,), 1e-30), torch.zeros(3)) == math.inf


def test_image_error_counts_uncut_pixels_only_and_refuses_to_compare_nothing():
    expected = torch.zeros(10, 10, 3)
    actual = expected.clone()
    actual[2, 5] = 0.25
    cut = torch.zeros(10, 10, dtype=torch.bool)
    assert image_error(actual, expected, cut) == 0.25
    cut[2, 5] = True
    assert image_error(actual, expected, cut) == 0.0
    actual[2, 5] = math.nan
    assert image_error(actual, expected, cut) == math.inf
    refused(AssertionError, "on a cut", image_error, expected, expected, torch.ones_like(cut))


def one_row(offsets, opacities, depths, tolerance=1e-4):
    """Splats of unit variance, all at offset px left of the only pixel's centre."""
    n = len(offsets)
    return composite(
        torch.tensor([[0.5 - offset, 0.5] for offset in offsets], dtype=torch.float64),
        torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64).repeat(n, 1),
        torch.tensor(opacities, dtype=torch.float64),
        torch.ones(n, 1, dtype=torch.float64),
        torch.tensor(depths, dtype=torch.float64),
        1,
        1,
        tolerance=tolerance,
    )


@pytest.mark.parametrize(
    "case, offsets, opacities, depths, expected",
    [
        ("plain", [0.3], [0.5], [1.0], False),
        ("alpha at 1/255", [math.sqrt(2 * math.log(127.5)) * (1 + 1e-7)], [0.5], [1.0], True),
        ("alpha 1 % above 1/255", [math.sqrt(2 * math.log(127.5 / 1.01))], [0.5], [1.0], False),
        ("alpha at the cap", [0.0], [0.99 * (1 - 1e-6)], [1.0], True),
        ("capped alphas, 2e-4 left", [0.0, 0.0], [0.98, 1.0], [1.0, 2.0], False),
        ("depths 1e-8 apart", [0.0, 0.1], [0.5, 0.5], [1.0, 1.0 + 1e-8], True),
        ("depths equal", [0.0, 0.1], [0.5, 0.5], [1.0, 1.0], False),
        ("depths 1 % apart", [0.0, 0.1], [0.5, 0.5], [1.0, 1.01], False),
        (
            "close, with one that is not seen between",
            [0.0, 9.0, 0.1],
            [0.5] * 3,
            [1.0, 1 + 1e-8, 1 + 2e-8],
            True,
        ),
        ("close, but one is not seen", [0.0, 9.0], [0.5, 0.5], [1.0, 1 + 1e-8], False),
        ("behind the end", [0.0] * 4, [0.98, 0.98, 0.98, 0.5], [1.0, 2.0, 3.0, 3 + 1e-8], False),
    ],
)
def test_cut_detector(case, offsets, opacities, depths, expected):
    assert one_row(offsets, opacities, depths).cut.item() is expected, case


def test_cut_detector_sees_the_end_of_a_pixel():
    # 0.02 * 0.02 * 0.25 = 1e-4: whether the third splat is composited is a matter of rounding.
    on = one_row([0.0] * 3, [0.98, 0.98, 0.75 * (1 + 1e-7)], [1.0, 2.0, 3.0])
    off = one_row([0.0] * 3, [0.98, 0.98, 0.75 * (1 - 1e-3)], [1.0, 2.0, 3.0])
    assert on.cut.item() and not off.cut.item()


def test_rounding_changes_uncut_pixels_by_little_and_cuts_are_few():
    scene = random_scene(n=80, cameras=1, dtype=torch.float64)
    exact = reference_images(scene)[0]
    nudged = reference_images(scene.to(torch.float32).to(torch.float64))[0]
    assert image_error(nudged.image, exact.image, exact.cut, most_cut=0.05) < 1e-5


def test_a_decision_that_flips_on_a_cut_pixel_is_excluded_and_would_matter():
    above = one_row([0.0], [(1 + 1e-9) / 255], [1.0])
    below = one_row([0.0], [(1 - 1e-9) / 255], [1.0])
    assert (above.values - below.values).abs().max() > 1e-3
    assert above.cut.item() and below.cut.item()
