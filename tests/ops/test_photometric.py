# SPDX-License-Identifier: Apache-2.0
import pytest
import torch
import torch.nn.functional as F  # noqa: N812

from blitzgs.ops.photometric import (
    photometric_fwd_bwd,
    photometric_loss,
    photometric_sums,
    pixel_counts,
    ssim,
)
from tests.helpers import on_threads, refused, relative_error, ssim_map, sum_parts


def reference_sums(x, y, masks=None):
    keep = 1 if masks is None else (masks != 0).double()[..., None]
    parts = (x.double() - y.double()).abs(), ssim_map(x, y)
    return tuple((part * keep).sum((1, 2, 3)) for part in parts)


def images(shape=(2, 53, 70), dtype=torch.float32, device="cpu", seed=0):
    """Smooth, flat and noisy areas; targets as bytes."""
    generator = torch.Generator().manual_seed(seed)
    b, h, w = shape
    coarse = torch.rand(b, 3, max(h // 8, 1), max(w // 8, 1), generator=generator, dtype=torch.float64)
    y = F.interpolate(coarse, (h, w), mode="bicubic").permute(0, 2, 3, 1).clamp(0, 1)
    y[:, : h // 4] = 1.0
    targets = (y * 255).round().to(torch.uint8)
    noise = 0.05 * torch.randn(y.shape, generator=generator, dtype=torch.float64)
    noise[:, :, w // 2 :] = 0
    masks = (torch.rand(b, h, w, generator=generator) > 0.2).to(torch.uint8)
    return (y + noise).to(device, dtype), targets.to(device), masks.to(device)


def sums_and_gradient(*arguments):
    parts, v_renders, *_ = photometric_fwd_bwd(*arguments)
    return *sum_parts(parts), v_renders


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(2, 53, 70), (1, 1, 1), (3, 7, 200), (1, 130, 3), (1, 200, 400)])
def test_float32_matches_the_definition(device, masked, shape):
    x, targets, masks = images(shape, device=device)
    masks = masks if masked else None
    weights = torch.tensor([0.8, 1.3, 0.2], device=device)[: shape[0]] / (shape[1] * shape[2])
    exact_x = x.double().requires_grad_()
    l1, ssims = reference_sums(exact_x, targets.double() / 255, masks)
    (expected,) = torch.autograd.grad((weights * l1 - 0.7 * weights * ssims).sum(), exact_x)

    got_l1, got_ssim, v_renders = sums_and_gradient(x, targets, masks, weights, -0.7 * weights)
    torch.testing.assert_close(got_l1.double(), l1.detach(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(got_ssim.double(), ssims.detach(), rtol=1e-6, atol=1e-6)
    assert (v_renders - expected).norm() <= 3e-5 * expected.norm()
    separate = photometric_sums(x, targets, masks)
    assert torch.equal(separate[0], got_l1) and torch.equal(separate[1], got_ssim)
    bwd = torch.ops.blitzgs.photometric_bwd(x, targets, masks, weights, -0.7 * weights, 16, 0, -1)
    assert torch.equal(bwd, v_renders)


@pytest.mark.parametrize("tiles", [(0, -1), (3, 9), (4, 4)])
def test_weights_are_divided_by_samples_and_visible_gaussians(device, tiles):
    x, targets, masks = images(device=device)
    weights, samples = torch.tensor([0.4, 0.3], device=device), torch.tensor([111.0, 7.0], device=device)
    visible = torch.tensor([0, 1_000_001], device=device)
    parts, v_renders, scale_reg, opacity_reg = photometric_fwd_bwd(
        x, targets, masks, weights, -weights, 16, *tiles, samples=samples, visible=visible, scale_weight=0.7,
        opacity_weight=0.3,
    )  # fmt: skip
    expected = photometric_fwd_bwd(x, targets, masks, weights / samples, -weights / samples, 16, *tiles)
    assert torch.equal(parts, expected[0])
    if tiles == (0, -1):
        assert torch.equal(v_renders, expected[1])
    assert torch.equal(scale_reg, torch.tensor(0.7, device=device) / visible.clamp(min=1))
    opacity = 0.3 / (2 * visible.clamp(min=1))
    torch.testing.assert_close(opacity_reg, opacity, rtol=0 if device == "cpu" else 2e-7, atol=0)
    assert len(expected[2]) == len(expected[3]) == 0


@pytest.mark.parametrize("masked", [False, True])
def test_float64_sums_and_gradients_match_to_rounding(masked):
    x, targets, masks = images(dtype=torch.float64)
    y, masks = targets.double() / 255, masks if masked else None
    counts = pixel_counts(x, masks)
    x.requires_grad_()
    exact = reference_sums(x, y, masks)
    losses = (0.8 * exact[0] + 0.2 * (counts - exact[1])) / counts
    pairs = *zip(photometric_sums(x, y, masks), exact, strict=True), (photometric_loss(x, y, masks), losses)
    for got, expected in pairs:
        torch.testing.assert_close(got, expected, rtol=1e-12, atol=0)
        weights = torch.tensor([0.7, -1.3], dtype=torch.float64)
        found, wanted = (torch.autograd.grad(v @ weights, x, retain_graph=True)[0] for v in (got, expected))
        assert relative_error(found, wanted) < 1e-12


@pytest.mark.parametrize("tile_size", [16, 7])
def test_a_partition_of_the_tiles_adds_up_to_the_whole(device, tile_size):
    x, targets, masks = images((3, 75, 61), device=device)
    weights = torch.tensor([1.0, 0.5, 2.0], device=device)
    whole = sums_and_gradient(x, targets, masks, weights, -weights, tile_size)
    tiles_x, tiles_y = -(-61 // tile_size), -(-75 // tile_size)
    total = 3 * tiles_x * tiles_y
    cuts = [0, 1, tiles_x + 2, tiles_x + 2, total // 3 + 1, total - 3, total]
    l1, ssims, v_renders = (torch.zeros_like(t) for t in whole)
    for begin, end in zip(cuts[:-1], cuts[1:], strict=True):
        index = torch.arange(total, device=device).reshape(3, tiles_y, tiles_x)
        owned = (
            ((index >= begin) & (index < end)).repeat_interleave(tile_size, 1).repeat_interleave(tile_size, 2)
        )
        owned = owned[:, :75, :61]
        # A rank has pixels of its own tiles and a ring of 10 pixels around them; the loss reads no others.
        known = F.max_pool2d(owned[:, None].float(), 21, 1, 10)[:, 0, :, :, None] > 0
        known_x = torch.where(known, x, torch.full_like(x, 7.0))
        part = sums_and_gradient(
            known_x, targets, masks, weights, -weights, tile_size, begin, end,
        )  # fmt: skip
        torch.testing.assert_close(part[2][owned], whole[2][owned], rtol=1e-5, atol=1e-6)
        clean = torch.ops.blitzgs.photometric_bwd(
            known_x, targets, masks, weights, -weights, tile_size, begin, end
        )
        assert torch.equal(clean[owned], part[2][owned]) and not clean[~owned].any()
        l1, ssims, v_renders = l1 + part[0], ssims + part[1], v_renders + clean
    torch.testing.assert_close(v_renders, whole[2], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(l1, whole[0], rtol=1e-6, atol=0)
    torch.testing.assert_close(ssims, whole[1], rtol=1e-6, atol=0)


def test_loss_and_ssim_are_means(device):
    x, targets, masks = images(device=device)
    l1, ssims = reference_sums(x, targets.double() / 255, masks)
    counts = 3 * (masks != 0).sum((1, 2)).double()
    expected = 0.8 * l1 / counts + 0.2 * (1 - ssims / counts)
    torch.testing.assert_close(
        photometric_loss(x, targets, masks.bool()).double(), expected, rtol=1e-6, atol=1e-7
    )
    torch.testing.assert_close(ssim(x, targets, masks).double(), ssims / counts, rtol=1e-6, atol=1e-7)
    assert pixel_counts(x).tolist() == [3 * 53 * 70] * 2
    assert photometric_loss(x, targets, torch.zeros_like(masks)).tolist() == [0.0, 0.0]


def test_equal_images_have_ssim_one_and_no_gradient(device):
    y = images(device=device)[1]
    x = (y.float() * (1 / 255)).requires_grad_()
    torch.testing.assert_close(ssim(x, y), torch.ones(2, device=device), rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(photometric_loss(x, y).sum(), x)
    assert gradient.abs().max() < 1e-7


def test_threads_do_not_change_the_result():
    x, targets, masks = images((2, 200, 90))
    weights = torch.ones(2)
    one, three = on_threads(lambda: photometric_fwd_bwd(x, targets, masks, weights, weights), (1, 3))
    assert all(torch.equal(a, b) for a, b in zip(one, three, strict=True))


def test_empty_batch(device):
    x = torch.zeros(0, 8, 8, 3, device=device)
    outputs = photometric_fwd_bwd(x, x, None, x.new_zeros(0), x.new_zeros(0))
    assert [tuple(t.shape) for t in outputs] == [(0, 0, 2), (0, 8, 8, 3), (0,), (0,)]


@pytest.mark.parametrize("size", [(0, 8), (8, 0)])
def test_images_without_pixels_have_no_weights(device, size):
    x, weights = torch.zeros(2, *size, 3, device=device), torch.ones(2, device=device)
    *_, scale_reg, opacity_reg = photometric_fwd_bwd(
        x, x, None, weights, weights, visible=torch.tensor([0, 5], device=device), scale_weight=0.7,
        opacity_weight=0.3,
    )  # fmt: skip
    assert scale_reg.tolist() == opacity_reg.tolist() == [0, 0]
    assert photometric_loss(x, x).tolist() == [0, 0]


def test_errors_name_the_value():
    x, targets, _ = images()
    refused(RuntimeError, r"targets .* \[2, 53, 70, 3\], got \[1, 5", photometric_sums, x, targets[:1])
    refused(RuntimeError, "masks must .* got Float", photometric_sums, x, targets, torch.ones(2, 53, 70))
    refused(RuntimeError, r"\(if not uint8\) .*, got Double", photometric_sums, x, targets.double())
    weights = torch.ones(2)
    arguments = (x, targets, None, weights, weights, 16, 3, 41)
    refused(RuntimeError, r"of the 40 tiles, got \[3, 41\)", photometric_fwd_bwd, *arguments)
    with pytest.raises(RuntimeError, match=r"samples must have shape \[2\], got \[3\]"):
        photometric_fwd_bwd(x, targets, None, weights, weights, samples=torch.ones(3))
    with pytest.raises(RuntimeError, match="samples must be Float, got Long"):
        photometric_fwd_bwd(x, targets, None, weights, weights, samples=torch.ones(2).long())
    with pytest.raises(RuntimeError, match="visible must be Long, got Int"):
        photometric_fwd_bwd(x, targets, None, weights, weights, visible=torch.ones(2).int())


def test_opcheck(device):
    x, targets, masks = images((1, 12, 9), device=device)
    weights = torch.ones(1, device=device)
    torch.library.opcheck(
        torch.ops.blitzgs.photometric_fwd, (x.clone().requires_grad_(), targets, masks, 16, 0, -1)
    )
    torch.library.opcheck(torch.ops.blitzgs.photometric_bwd, (x, targets, masks, weights, weights, 16, 0, -1))
    torch.library.opcheck(
        torch.ops.blitzgs.photometric_fwd_bwd,
        (x, targets, None, weights, weights, 16, 0, -1, weights, weights.long(), 0.5, 0.2),
    )
