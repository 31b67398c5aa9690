# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch
import torch.nn.functional as F

from blitzgs.training.evaluation import image_metrics, load_lpips


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


def test_lpips_is_a_torchscript_module(tmp_path):
    class Distance(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    path = tmp_path / "lpips.pt"
    torch.jit.script(Distance()).save(str(path))
    metric = load_lpips(str(path))
    assert metric is not None
    assert float(metric(torch.zeros(1, 3, 4, 4), torch.ones(1, 3, 4, 4))) == 1.0
    with pytest.raises(ValueError, match="log.lpips_weights: .*missing.pt"):
        load_lpips(str(tmp_path / "missing.pt"))
