# SPDX-License-Identifier: Apache-2.0
"""The training loss: (1 - lambda) L1 + lambda (1 - SSIM) and two regularisers, averaged over a batch."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from blitzgs.frame.tiles import LOSS_HALO
from blitzgs.ops.intersect import TILE_SIZE
from blitzgs.ops.photometric import photometric_fwd_bwd

if TYPE_CHECKING:
    from blitzgs.config.fields import LossConfig
    from blitzgs.frame.render import Frame
    from blitzgs.table.table import GaussianTable
    from blitzgs.training.batches import Batch

# The limits of the `loss.opacity` that a run computes from `loss.opacity_total`: about the range that was
# measured (docs/decisions.md).
LEAST_OPACITY, MAX_OPACITY = 0.005, 0.05
# `loss.scale` counts in this many extents.
SCALE_UNIT = 10.0


class LossTerms(NamedTuple):
    """A batch's loss and its gradients by the images and by the Gaussians' axes and opacities."""

    # Sums of |render - photograph| and of the SSIM map over this rank's pixels and the channels, float64 [B,
    # K, 2], in K parts; see `photometric`.
    parts: Tensor
    v_renders: Tensor  # gradient of the batch's mean loss by the images, [B, H, W, 3]
    # Gradient of the loss by the smallest axis of each visible Gaussian, per view [B]; None if `loss.scale`
    # is 0.
    scale_reg: Tensor | None
    # Gradient of the loss by the opacity of each visible Gaussian, per view [B]; None if `loss.opacity` is 0.
    opacity_reg: Tensor | None


def weighted(config: LossConfig, views: int) -> LossConfig:
    """Return the weights for a number of views: if `opacity_total` is set, `opacity` is its share for a view.

    This share, `opacity_total` / `views`, is kept between `LEAST_OPACITY` and `MAX_OPACITY`. The result has
    `opacity_total` 0, so that a second call changes nothing.
    """
    if config.opacity_total == 0:
        return config
    opacity = min(max(config.opacity_total / max(views, 1), LEAST_OPACITY), MAX_OPACITY)
    return replace(config, opacity=opacity, opacity_total=0.0)


def loss_terms(
    frame: Frame, batch: Batch, config: LossConfig, extent: float, shown: Tensor | None = None
) -> LossTerms:
    """Compare rendered views with their photographs; on several ranks each compares its own tiles.

    `extent`: size of the scene in the unit of the means; L_scale is relative to it. `shown`: the images to
    compare, [B, H, W, 3], instead of the frame's; `v_renders` is then their gradient. ValueError: a rank has
    not composited all pixels that its loss reads.
    """
    count, assignment = len(frame.views), frame.assignment
    if assignment is not None and assignment.ranges.halo < LOSS_HALO:
        raise ValueError(f"the loss reads {LOSS_HALO} px beyond a rank's tiles: divide them with that halo")
    parts, v_renders, scale_reg, opacity_reg = photometric_fwd_bwd(
        frame.renders if shown is None else shown,
        batch.targets,
        batch.masks,
        *_weights(config.ssim, count, batch.samples.device),
        TILE_SIZE,
        *frame.own_tiles,
        samples=batch.samples,
        visible=frame.visible,
        scale_weight=config.scale / (extent * SCALE_UNIT * count),
        opacity_weight=config.opacity,
    )
    return LossTerms(
        parts, v_renders, scale_reg if config.scale > 0 else None, opacity_reg if config.opacity > 0 else None
    )


@lru_cache(maxsize=64)
def _weights(ssim: float, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the weights of each view's L1 and SSIM sums, [B] each; they are uploaded once."""
    weights = torch.tensor([[(1.0 - ssim) / count], [-ssim / count]], dtype=torch.float32, device=device)
    l1_weights, ssim_weights = weights.repeat(1, count)
    return l1_weights, ssim_weights


def photometric(sums: Tensor, samples: Tensor, config: LossConfig) -> Tensor:
    """Return (1 - lambda) L1 + lambda (1 - SSIM) of each view, float32 [B].

    `sums` are `LossTerms.parts` added up over all ranks, [2 B] (`HostSum.read`); `samples` those of the
    batch, on their device.
    """
    l1, ssim = sums.view(2, -1)
    return ((1.0 - config.ssim) * l1 - config.ssim * ssim) / samples + config.ssim


def scale_term(frame: Frame, table: GaussianTable, length_unit: float) -> Tensor:
    """Return L_scale of each view, float32 [B]: the mean smallest axis of the Gaussians visible in it."""
    smallest = table["scales"][frame.projected.gaussian_ids].amin(dim=1).exp() / length_unit
    return _mean_over_visible(frame, smallest)


def opacity_term(frame: Frame, table: GaussianTable) -> Tensor:
    """Return L_opacity of each view, float32 [B]: the mean opacity of the Gaussians visible in it."""
    return _mean_over_visible(frame, table["opacities"][frame.projected.gaussian_ids].sigmoid())


def _mean_over_visible(frame: Frame, values: Tensor) -> Tensor:
    """Return, for each view, the mean of a per-splat value over the view's splats of all ranks, [B]."""
    views = torch.arange(len(frame.views), device=values.device)
    sums = (values[:, None] * (frame.projected.camera_ids[:, None] == views)).sum(dim=0)
    if frame.assignment is not None:
        frame.assignment.ranks.all_reduce(sums)
    return sums / frame.visible.clamp(min=1)


def batch_psnr(frame: Frame, batch: Batch, shown: Tensor | None = None) -> Tensor:
    """Return the PSNR of a batch in dB, over all pixels that are not masked; nan if all are masked.

    `shown`: as for `loss_terms`.
    """
    shown = frame.renders if shown is None else shown
    error = ((shown.clamp(0, 1) - batch.targets.float() / 255.0) ** 2).sum(-1)
    if batch.masks is not None:
        error *= batch.masks != 0
    if frame.assignment is not None:
        ranks, ranges = frame.assignment.ranks, frame.assignment.ranges
        error = error.where(ranges.pixel_mask(ranks.rank, error.device), 0.0)
    total = error.sum()
    if frame.assignment is not None:
        frame.assignment.ranks.all_reduce(total)
    psnr = -10.0 * (total / batch.samples.sum()).clamp(min=1e-12).log10()
    # A view without a pixel that counts has 1 sample, and any other has at least 3.
    return psnr.where(batch.samples.amax() > 1, torch.nan)
