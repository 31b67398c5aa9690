# SPDX-License-Identifier: Apache-2.0
"""Computes L1 and SSIM of rendered views in one kernel, differentiable in the renders; reports their sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.derivatives import first_only
from blitzgs.ops.intersect import TILE_SIZE


def photometric_loss(
    renders: Tensor, targets: Tensor, masks: Tensor | None = None, ssim_weight: float = 0.2
) -> Tensor:
    """Return ``(1 - w) mean |x - y| + w (1 - mean SSIM)`` of each view; differentiable in `renders`.

    Means are over the unmasked pixels and the channels of a view; a view with no such pixel has loss 0.

    Args:
        renders: x [B, H, W, 3], float32 (CPU also float64), nominal range [0, 1].
        targets: y [B, H, W, 3], uint8 (value / 255) or the dtype of `renders`.
        masks: [B, H, W], bool or uint8, 0 = excluded; windows centred at other pixels still read such a
            pixel.
        ssim_weight: w in [0, 1].

    Returns:
        [B], dtype of `renders`.
    """
    l1, ssim_sums = photometric_sums(renders, targets, masks)
    counts = pixel_counts(renders, masks)
    return ((1 - ssim_weight) * l1 + ssim_weight * (counts - ssim_sums)) / counts.clamp_min(1)


def ssim(renders: Tensor, targets: Tensor, masks: Tensor | None = None) -> Tensor:
    """Return the mean SSIM [B] of each view over unmasked pixels and channels, as for `photometric_loss`.

    11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2, C2 = 0.03^2, zero padding (Wang et al. 2004).
    """
    return photometric_sums(renders, targets, masks)[1] / pixel_counts(renders, masks).clamp_min(1)


def pixel_counts(renders: Tensor, masks: Tensor | None = None) -> Tensor:
    """Return how many values each view's means average: 3 x its unmasked pixels, [B], float."""
    if masks is None:
        views, height, width = renders.shape[:3]
        return renders.new_full((views,), 3.0 * height * width)
    return 3 * (masks != 0).sum((1, 2)).to(renders.dtype)


def photometric_sums(renders: Tensor, targets: Tensor, masks: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the sums of |x - y| and of the SSIM map of each view, [B] each, as for `photometric_loss`."""
    return torch.ops.blitzgs.photometric_fwd(renders, targets, _as_bytes(masks), TILE_SIZE, 0, -1)


def photometric_fwd_bwd(
    renders: Tensor,
    targets: Tensor,
    masks: Tensor | None,
    l1_weights: Tensor,
    ssim_weights: Tensor,
    tile_size: int = TILE_SIZE,
    tile_begin: int = 0,
    tile_end: int = -1,
    *,
    samples: Tensor | None = None,
    visible: Tensor | None = None,
    scale_weight: float = 0.0,
    opacity_weight: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the sums of `photometric_sums` and the gradient of their weighted total, without autograd.

    Only the pixels of the tiles [tile_begin, tile_end) of all views are summed, tile (b, ty, tx) having index
    ``(b * tiles_y + ty) * tiles_x + tx``. The gradient is that of the sums over ALL tiles, but it is defined
    only at these owned pixels. Sums and gradients over a partition of the tiles add up to the whole;
    `renders` must be valid within 10 pixels of the owned tiles. The sums are returned as K partial sums;
    `report_` adds them up later, off the critical path of a step.

    For the loss of `photometric_loss`, summed over views: ``l1_weights = 1 - w``, ``ssim_weights = -w`` and
    ``samples = pixel_counts(renders, masks)``.

    Args:
        l1_weights: [B], weight of each view's L1 sum, dtype of `renders`.
        ssim_weights: [B], weight of each view's SSIM sum.
        tile_size: edge of a tile in pixels.
        tile_begin: first owned tile.
        tile_end: one past the last owned tile; -1: all.
        samples: [B], divisors of the weights, dtype of `renders`; None: 1.
        visible: int64 [B], number of Gaussians visible in each view.
        scale_weight: weight of L_scale, a view's mean smallest axis of its visible Gaussians; only used to
            return the weight of a single Gaussian's axis.
        opacity_weight: weight of L_opacity, the mean over the views of the mean opacity of their visible
            Gaussians; only used to return the weight of a single Gaussian's opacity.

    Returns:
        (sums float64 [B, K, 2] in K parts, v_renders [B, H, W, 3], undefined beyond the owned pixels,
        ``scale_weight / max(visible, 1)`` [B], ``opacity_weight / (B max(visible, 1))`` [B]; the last two
        are [0] without `visible`, and zeros if the images have no pixels).
    """
    with below_autograd():
        return torch.ops.blitzgs.photometric_fwd_bwd(
            renders, targets, _as_bytes(masks), l1_weights, ssim_weights, tile_size, tile_begin, tile_end,
            samples, visible, scale_weight, opacity_weight,
        )  # fmt: skip


def _as_bytes(masks: Tensor | None) -> Tensor | None:
    return masks.view(torch.uint8) if masks is not None and masks.dtype == torch.bool else masks


def _save_inputs(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    renders, targets, masks, *tiles = inputs
    ctx.save_for_backward(renders, targets, masks)
    ctx.tiles = tiles


def _backward(ctx: Any, v_l1_sums: Tensor, v_ssim_sums: Tensor) -> tuple[Tensor | None, ...]:
    renders, targets, masks = ctx.saved_tensors
    sums = v_l1_sums, v_ssim_sums
    (v_renders,) = first_only(
        "photometric_loss",
        lambda: [torch.ops.blitzgs.photometric_bwd(renders, targets, masks, *sums, *ctx.tiles)],
        [renders, *sums],
    )
    return v_renders, None, None, None, None, None


torch.library.register_autograd("blitzgs::photometric_fwd", _backward, setup_context=_save_inputs)


def report_(
    parts: Tensor | None,
    tile_work: Tensor | None,
    tiles: tuple[int, int],
    rank: int,
    n_ranks: int,
    targets: Sequence[Tensor],
) -> None:
    """Write this rank's part of the report into all targets.

    A target has the loss sums of the M ranks, [M, 2, B], and then the work of the T tiles.

    Args:
        parts: float64 [B, K, 2], of `blitzgs.ops.photometric.photometric_fwd_bwd`; None: no views.
        tile_work: int32 [T], of `rasterize_fwd`; None: no tiles.
        tiles: this rank's [first, one past last).
        rank: this rank.
        n_ranks: M.
        targets: float32 [2 M B + T] each, on this device or in peer-accessible memory of other devices.
    """
    torch.ops.blitzgs.report_(parts, tile_work, *tiles, rank, n_ranks, targets)
