# SPDX-License-Identifier: Apache-2.0
"""The error measures and the cut detector must fail where they should."""

import math

import pytest
import torch

from blitzgs.reference import composite
from tests.helpers import image_error, random_scene, reference_images, relative_error


def test_relative_error_sees_one_wrong_value_a_nan_and_a_wrong_shape():
    expected = torch.arange(1.0, 9.0)
    assert relative_error(expected, expected) == 0.0
    wrong = expected.clone()
    wrong[3] += 0.8
    assert relative_error(wrong, expected) == pytest.approx(0.1)
    wrong[3] = math.nan
    assert relative_error(wrong, expected) == math.inf
    assert relative_error(expected, wrong) == math.inf
    with pytest.raises(AssertionError, match="shapes differ"):
        relative_error(expected[:, None], expected)


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
    with pytest.raises(AssertionError, match="on a cut"):
        image_error(expected, expected, torch.ones_like(cut))


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
