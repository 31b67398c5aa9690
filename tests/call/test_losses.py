# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.l1_ssim` is the mean of `photometric_loss`, which has tests of its own."""

import contextlib
import warnings
from itertools import count

import pytest
import torch
from torch._subclasses.fake_tensor import DynamicOutputShapeException, FakeTensorMode
from torch.autograd import forward_ad

import blitzgs
from tests.helpers import refused, relative_error, ssim_map


def images(device, dtype, *lead):
    generator = torch.Generator().manual_seed(0)
    renders = torch.rand(*lead, 21, 34, 3, generator=generator, dtype=torch.float64)
    targets = torch.randint(256, renders.shape, generator=generator, dtype=torch.uint8)
    masks = torch.rand(*lead, 21, 34, generator=generator) > 0.3
    return renders.to(device, dtype), targets.to(device), masks.to(device)


def by_definition(x, y, masks, weight, padding):
    """The loss in float64, with torch's convolution."""
    margin = 0 if padding == "same" else 5
    inner = masks[:, margin : x.shape[1] - margin, margin : x.shape[2] - margin]
    ssim = ssim_map(x, y, 5 - margin)
    losses = []
    for b in range(len(x)):
        l1 = (x[b].double() - y[b]).abs()[masks[b]].mean() if masks[b].any() else 0
        structure = 1 - ssim[b][inner[b]].mean() if inner[b].any() else 0
        losses.append((1 - weight) * l1 + weight * structure)
    return sum(losses) / len(losses)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_and_gradient_are_those_of_the_definition(backend, masked, padding, weight):
    renders, targets, masks = images(*backend, 3)
    masks[1] = masks[1] & False if masked else True
    results = []
    for loss_of in (blitzgs.l1_ssim, by_definition):
        x = renders.clone().requires_grad_()
        own = loss_of is blitzgs.l1_ssim
        y = targets if own else targets.double() / 255
        m = torch.ones_like(masks) if not masked else masks
        loss = loss_of(x, y, None if own and not masked else m, weight, padding)
        (3 * loss).backward()
        results.append((loss.detach(), x.grad))
    bound = 1e-12 if renders.dtype == torch.float64 else 1e-4
    assert results[0][0].shape == () and results[0][0].dtype == renders.dtype
    without_gradient = blitzgs.l1_ssim(renders, targets, masks if masked else None, weight, padding)
    assert relative_error(without_gradient, results[0][0]) < bound
    for actual, expected in zip(*results, strict=True):
        assert relative_error(actual, expected) < bound


def test_zeroed_renders_under_a_mask_raise_the_loss():
    """The mask suffices; a trainer that also zeroes its render compares zeros with the photograph."""
    x, targets, masks = images("cpu", torch.float64, 1)
    y = targets.double() / 255
    x = (y + 0.05 * (x - 0.5)).clamp(0, 1)
    masks = masks[:, ::7, ::7].repeat_interleave(7, 1).repeat_interleave(7, 2)[:, : x.shape[1], : x.shape[2]]
    zeroed = x * masks[..., None]
    assert blitzgs.l1_ssim(zeroed, y, masks) > 1.5 * blitzgs.l1_ssim(x, y, masks)


def test_leading_dimensions_and_floating_targets():
    renders, targets, masks = images("cpu", torch.float64, 2, 2)
    expected = blitzgs.l1_ssim(renders.flatten(0, 1), targets.flatten(0, 1), masks.flatten(0, 1))
    assert torch.equal(blitzgs.l1_ssim(renders, targets, masks), expected)
    single = blitzgs.l1_ssim(renders[0, 0], targets[0, 0].double() / 255, masks[0, 0])
    assert relative_error(single, blitzgs.l1_ssim(renders[:1, 0], targets[:1, 0], masks[:1, 0])) < 1e-12


def test_the_first_photographs_that_are_no_shares_are_named(monkeypatch):
    renders, targets, _ = images("cpu", torch.float64, 2, 2)
    monkeypatch.setattr("blitzgs.call.losses._float_calls", count())
    with pytest.warns(UserWarning, match=r"targets go to 25\d: they are uint8, or floats from 0 to 1"):
        blitzgs.l1_ssim(renders, targets.double())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        blitzgs.l1_ssim(renders, targets.double())


@pytest.mark.parametrize("shape", [(0, 8, 8), (2, 0, 8), (2, 2, 0, 8), (0, 8)], ids=str)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("learned", [False, True])
def test_no_views_and_no_pixels_have_loss_zero(shape, masked, learned):
    renders = torch.rand(*shape, 3, requires_grad=learned)
    masks = torch.ones(shape, dtype=torch.bool) if masked else None
    loss = blitzgs.l1_ssim(renders, torch.zeros(*shape, 3), masks)
    assert loss.shape == () and loss.item() == 0
    if learned:
        loss.backward()
        assert renders.grad.shape == renders.shape


def test_renders_may_change_after_the_loss():
    renders, targets, _ = images("cpu", torch.float32, 1)
    x = renders.clone().requires_grad_()
    (expected,) = torch.autograd.grad(blitzgs.l1_ssim(x, targets), x)
    y = x * 1
    loss = blitzgs.l1_ssim(y, targets)
    y.zero_()
    assert torch.equal(torch.autograd.grad(loss, x)[0], expected)


@pytest.mark.parametrize("learned", [False, True])
def test_a_forward_mode_derivative_is_refused(learned):
    renders, targets, _ = images("cpu", torch.float64, 1)
    renders.requires_grad_(learned)
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match="jvp"):
        blitzgs.l1_ssim(forward_ad.make_dual(renders, torch.ones_like(renders)), targets)


def test_a_call_with_fake_tensors_leaves_later_calls_intact():
    shape = (1, 13, 17, 3)
    with FakeTensorMode(), contextlib.suppress(DynamicOutputShapeException):  # the op has no fake result
        blitzgs.l1_ssim(torch.rand(shape, requires_grad=True), torch.rand(shape))
    renders = torch.rand(shape, requires_grad=True)
    loss = blitzgs.l1_ssim(renders, renders.detach())
    assert type(loss) is torch.Tensor and loss.item() == pytest.approx(0, abs=1e-6)


def test_it_compiles():
    torch._dynamo.reset()
    renders, targets, masks = images("cpu", torch.float32, 2)
    x = renders.clone().requires_grad_()
    compiled = torch.compile(blitzgs.l1_ssim, fullgraph=True, backend="aot_eager")
    (gradient,) = torch.autograd.grad(compiled(x, targets, masks), x)
    (expected,) = torch.autograd.grad(blitzgs.l1_ssim(x, targets, masks), x)
    assert relative_error(gradient, expected) < 1e-5


def test_wrong_use_is_refused():
    x = torch.rand(1, 8, 8, 3)
    with pytest.raises(ValueError, match=r"must be \[..., H, W, 3\], got \[1, 8, 8, 3\] and \[1, 8, 7, 3\]"):
        blitzgs.l1_ssim(x, x[:, :, :7])
    with pytest.raises(ValueError, match=r"masks must be \[1, 8, 8\], got \[8, 8\]"):
        blitzgs.l1_ssim(x, x, torch.ones(8, 8, dtype=torch.bool))
    refused(ValueError, "targets is on meta and renders on cpu; move one", blitzgs.l1_ssim, x, x.to("meta"))
    refused(ValueError, r"ssim_weight must be in \[0, 1\], got 2", blitzgs.l1_ssim, x, x, ssim_weight=2)
    refused(TypeError, r"targets must be a torch\.Tensor, got ndarray", blitzgs.l1_ssim, x, x.numpy())
    refused(TypeError, "renders must be float32 or float64, got torch.float16", blitzgs.l1_ssim, x.half(), x)
    with pytest.raises(
        TypeError, match="targets must be uint8 or torch.float32 like renders, got torch.int32"
    ):
        blitzgs.l1_ssim(x, x.int())
    with pytest.raises(TypeError, match="masks must be bool or uint8, got torch.float32; pass masks != 0"):
        blitzgs.l1_ssim(x, x, torch.ones(1, 8, 8))
    learned = torch.rand(1, 8, 8, 3, requires_grad=True)
    for renders in (x, learned):
        with pytest.raises(ValueError, match=r"targets require a gradient, .*; pass targets.detach\(\)"):
            blitzgs.l1_ssim(renders, learned)
    with torch.no_grad():
        blitzgs.l1_ssim(x, learned)
