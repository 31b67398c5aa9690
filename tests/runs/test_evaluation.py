# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
import torch.nn.functional as F

from blitzgs.runs.evaluation import correct_colours, image_metrics, load_lpips


def plain_ssim(x, y):
    """SSIM map [H, W, 3] by direct convolution in float64."""
    taps = torch.exp(-0.5 * (torch.arange(11, dtype=torch.float64) - 5) ** 2 / 1.5**2)
    taps /= taps.sum()
    window = (taps[:, None] * taps[None, :])[None, None].repeat(3, 1, 1, 1)

    def blur(image):
        return F.conv2d(image, window, padding=5, groups=3)

    x, y = (image.permute(2, 0, 1)[None].double() for image in (x, y))
    mx, my = blur(x), blur(y)
    vx, vy, cxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mx * my + c1) * (2 * cxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return ssim[0].permute(1, 2, 0)


@pytest.mark.parametrize("masked", [False, True])
def test_metrics_match_plain_formulas(masked):
    g = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (37, 53, 3), generator=g, dtype=torch.uint8)
    render = target.float() / 255 + 0.3 * torch.randn(37, 53, 3, generator=g)
    mask = (torch.rand(37, 53, generator=g) > 0.3).to(torch.uint8) if masked else None
    counted = torch.ones(37, 53, dtype=torch.bool) if mask is None else mask.bool()
    clamped = render.clamp(0, 1)
    mse = ((clamped.double() - target.double() / 255) ** 2)[counted].mean().item()
    metrics = image_metrics(render, target, mask)
    assert metrics["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    expected = plain_ssim(clamped, target.double() / 255)[counted].mean().item()
    assert metrics["ssim"] == pytest.approx(expected, abs=1e-5)


def test_a_perfect_render():
    target = torch.randint(0, 256, (20, 20, 3), dtype=torch.uint8)
    metrics = image_metrics(target.float() / 255, target, None)
    assert metrics["psnr"] >= 100 and metrics["ssim"] == pytest.approx(1.0, abs=1e-5)


def test_the_corrected_psnr_forgives_an_affine_change_of_colour_and_nothing_else():
    g = torch.Generator().manual_seed(1)
    clean = torch.rand(40, 30, 3, generator=g) * 0.5 + 0.2
    turned = clean @ torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.7]]).T + 0.04
    target = (turned * 255).round().byte()
    metrics = image_metrics(clean, target, None)
    # Only the photograph's rounding to 256 values remains: a twelfth of a squared step.
    assert metrics["psnr"] < 30 and metrics["psnr_corrected"] == pytest.approx(
        -10 * math.log10(1 / 255**2 / 12), abs=0.3
    )
    noise = 0.1 * torch.randn(40, 30, 3, generator=g)
    noisy = image_metrics(clean, (clean + noise).clamp(0, 1).mul(255).byte(), None)
    assert noisy["psnr"] <= noisy["psnr_corrected"] < noisy["psnr"] + 1

    pixels, wanted = torch.rand(500, 3, generator=g).double(), torch.rand(500, 3, generator=g).double()
    known = torch.cat([pixels, torch.ones(500, 1, dtype=torch.float64)], dim=1)
    expected = known @ torch.linalg.lstsq(known, wanted).solution
    torch.testing.assert_close(correct_colours(pixels, wanted), expected.clamp(0, 1))
    # The image has one colour, so any map to the mean colour is the best one.
    flat = correct_colours(torch.full((500, 3), 0.25, dtype=torch.float64), wanted)
    torch.testing.assert_close(flat, wanted.mean(0).expand(500, 3))


def test_lpips_is_a_torchscript_module(tmp_path):
    class Distance(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    path = tmp_path / "lpips.pt"
    torch.jit.script(Distance()).save(str(path))
    metric = load_lpips(str(path))
    assert metric is not None
    assert float(metric(torch.zeros(1, 3, 4, 4), torch.ones(1, 3, 4, 4))) == 1.0
    with pytest.raises(ValueError, match=r"missing.pt is not .*--lpips, log.lpips_weights"):
        load_lpips(str(tmp_path / "missing.pt"))
