# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.l1_ssim`: the loss of images (3DGS, Kerbl et al. 2023, eq. 7)."""

from __future__ import annotations

from functools import lru_cache
from itertools import count
from typing import Any

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from blitzgs.call.arguments import check_choice, refuse_func_transforms
from blitzgs.ops.derivatives import first_only
from blitzgs.ops.photometric import photometric_fwd_bwd, photometric_loss, pixel_counts, ssim
from blitzgs.util.errors import warn

PADDINGS = ("same", "valid")
_REACH = 5  # of the window, px
_MOST = 2.0  # of float targets: more is no photograph from 0 to 1, however bright


def l1_ssim(
    renders: Tensor,
    targets: Tensor,
    masks: Tensor | None = None,
    ssim_weight: float = 0.2,
    padding: str = "same",
) -> Tensor:
    """Return ``(1 - w) mean |x - y| + w (1 - mean SSIM)``, the mean over views (Kerbl et al. 2023, eq. 7).

    SSIM has an 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2 and C2 = 0.03^2 (Wang et al. 2004). With
    zero padding, one pass over the images computes the loss and its gradient. Differentiable, once, in
    `renders`.

    Args:
        renders: x [..., H, W, 3], float32 (CPU also float64), nominal range [0, 1]: what
            `blitzgs.rasterization` returns.
        targets: y of the same shape, uint8 (value / 255) or the dtype of `renders`. They get no gradient.
        masks: [..., H, W], bool or uint8, 0 = excluded from the means. SSIM windows centred at other pixels
            still read an excluded pixel, so do not set it to zero in `renders` alone: the windows around it
            would then compare zeros with the photograph. A view whose pixels are all excluded has loss 0.
        ssim_weight: w in [0, 1].
        padding: "same": the mean SSIM is that of all pixels, whose windows read zeros beyond the image (3DGS,
            INRIA's code). "valid": that of the pixels whose windows are inside the image (gsplat's trainer);
            needs more passes over the images, and a view needs at least 11 x 11 pixels.

    Returns:
        A scalar, dtype of `renders`; 0 without views or pixels.

    Raises:
        TypeError: an argument is not a tensor, or has a dtype that is not listed above.
        ValueError: shapes or devices do not fit, the weight is outside [0, 1], the padding unknown or the
            image too small for it, or the targets require a gradient.
        RuntimeError: float64 images are on a GPU, or the call is inside a transform of `torch.func`.
        NotImplementedError: the images have forward-mode derivatives.
    """
    refuse_func_transforms()
    _check_types(renders, targets, masks)
    if renders.dim() < 3 or renders.shape[-1] != 3 or targets.shape != renders.shape:
        raise ValueError(
            f"renders and targets must be [..., H, W, 3], got {list(renders.shape)} and {list(targets.shape)}"
        )
    if masks is not None and masks.shape != renders.shape[:-1]:
        raise ValueError(f"masks must be {list(renders.shape[:-1])}, got {list(masks.shape)}")
    for name, tensor in (("targets", targets), ("masks", masks)):
        if tensor is not None and tensor.device != renders.device:
            raise ValueError(f"{name} is on {tensor.device} and renders on {renders.device}; move one")
    if not 0 <= ssim_weight <= 1:
        raise ValueError(f"ssim_weight must be in [0, 1], got {ssim_weight}")
    if targets.requires_grad and torch.is_grad_enabled():
        raise ValueError("targets require a gradient, which l1_ssim does not compute; pass targets.detach()")
    check_choice("padding", padding, PADDINGS)
    if padding == "valid" and min(renders.shape[-3:-1]) <= 2 * _REACH:
        raise ValueError(
            f"padding='valid' needs images of at least 11 x 11 px, got {list(renders.shape)}; use 'same'"
        )
    if renders.numel() == 0:
        return renders.sum()  # zero with a gradient; the mean over no views is NaN
    if targets.is_floating_point() and type(targets) is Tensor and not torch.compiler.is_compiling():
        _warn_of_range(targets)
    x, y = renders, targets
    if renders.dim() != 4:  # else leave the images as they are: a view would be a node of autograd's graph
        x, y = renders.reshape(-1, *renders.shape[-3:]), targets.reshape(-1, *targets.shape[-3:])
        masks = None if masks is None else masks.reshape(-1, *masks.shape[-2:])
    if padding == "valid":
        return _valid(x, y, masks, ssim_weight)
    if torch.compiler.is_compiling() or not (
        torch.is_grad_enabled() and renders.requires_grad or _has_tangent(renders) or _has_tangent(targets)
    ):
        return photometric_loss(x, y, masks, ssim_weight).mean()
    loss: Tensor = _L1Ssim.apply(x, y, masks, ssim_weight)  # type: ignore[no-untyped-call]
    return loss


def _valid(x: Tensor, y: Tensor, masks: Tensor | None, weight: float) -> Tensor:
    """Return the loss of views [B, H, W, 3] whose SSIM is that of the windows inside the image."""
    shown = x.new_ones(x.shape[:-1], dtype=torch.bool) if masks is None else masks != 0
    inside = torch.zeros_like(shown)
    inside[:, _REACH:-_REACH, _REACH:-_REACH] = shown[:, _REACH:-_REACH, _REACH:-_REACH]
    photographs = y.to(x.dtype) / 255 if y.dtype == torch.uint8 else y
    l1 = ((x - photographs).abs() * shown.unsqueeze(-1)).sum((1, 2, 3)) / pixel_counts(x, shown).clamp_min(1)
    dissimilarity = torch.where(inside.any(2).any(1), 1 - ssim(x, y, inside), 0)
    return ((1 - weight) * l1 + weight * dissimilarity).mean()


def _check_types(renders: object, targets: object, masks: object) -> None:
    for name, value in (("renders", renders), ("targets", targets), ("masks", masks)):
        if not isinstance(value, Tensor) and not (value is None and name == "masks"):
            raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    assert isinstance(renders, Tensor) and isinstance(targets, Tensor)
    if renders.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"renders must be float32 or float64, got {renders.dtype}; convert them")
    if targets.dtype not in (torch.uint8, renders.dtype):
        raise TypeError(
            f"targets must be uint8 or {renders.dtype} like renders, got {targets.dtype}; convert them"
        )
    if isinstance(masks, Tensor) and masks.dtype not in (torch.bool, torch.uint8):
        raise TypeError(f"masks must be bool or uint8, got {masks.dtype}; pass masks != 0")


_float_calls = count()


def _warn_of_range(targets: Tensor) -> None:
    """Warn if the photographs of the process's first call go to 255; later ones would wait for the GPU."""
    if next(_float_calls) or (targets.is_cuda and torch.cuda.is_current_stream_capturing()):
        return
    if (most := float(targets.detach().amax())) > _MOST:
        warn(
            f"blitzgs.l1_ssim: targets go to {most:g}: they are uint8, or floats from 0 to 1 (targets / 255)"
        )


def _has_tangent(images: Tensor) -> bool:
    """Tell whether images have a forward-mode derivative, which an op drops and torch's Function refuses."""
    return unpack_dual(images).tangent is not None


class _L1Ssim(torch.autograd.Function):
    """The loss; its forward pass also computes the gradient by the images."""

    @staticmethod
    def forward(ctx: Any, renders: Tensor, targets: Tensor, masks: Tensor | None, weight: float) -> Tensor:
        # Constants of a fake tensor (FakeTensorMode) would be stored and break later calls.
        constant = masks is None and type(renders) is Tensor
        ctx.renders = renders  # not saved, as its values are not needed and may change
        if constant:
            views, height, width, _ = renders.shape
            samples = views * 3 * height * width
            weights = _constants(views, 3 * height * width, float(weight), renders.dtype, renders.device)
            factors = ((1 - weight) / samples, -weight / samples, weight)
            loss: Tensor
            loss, v_renders = torch.ops.blitzgs.l1_ssim_fwd_bwd(renders, targets, *weights, *factors)
            ctx.save_for_backward(v_renders)
            return loss
        counts = pixel_counts(renders, masks)
        divisors, share = counts.clamp_min(1), torch.full_like(counts, 1 / len(renders))
        parts, v_renders, *_ = photometric_fwd_bwd(
            renders, targets, masks, (1 - weight) * share, -weight * share, samples=divisors
        )
        ctx.save_for_backward(v_renders)
        l1, ssim = parts.sum(dim=1).unbind(dim=1)
        per_view = ((1 - weight) * l1 + weight * (counts - ssim)) / divisors
        return per_view.mean().to(renders.dtype)

    @staticmethod
    def backward(ctx: Any, v_loss: Tensor) -> Any:
        (v_renders,) = ctx.saved_tensors
        (gradient,) = first_only("l1_ssim", lambda: [v_renders * v_loss], [ctx.renders, v_loss])
        return gradient, None, None, None


@lru_cache(maxsize=16)
def _constants(
    views: int, count: int, weight: float, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Return weights of the sums of L1 and SSIM, and their divisors, [B] each, for views without a mask.

    Each of these tensors would cost a launch in every step. `count`: values that the mean of a view averages.
    """
    values = ((1 - weight) / views, -weight / views, count)
    l1, ssim, divisors = (torch.full((views,), value, dtype=dtype, device=device) for value in values)
    return l1, ssim, divisors
