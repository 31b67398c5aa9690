# SPDX-License-Identifier: Apache-2.0
"""The training loss: (1 - lambda) L1 + lambda (1 - SSIM) + beta L_scale, averaged over a batch's views."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.photometric import photometric_fwd_bwd, pixel_counts
from blitzgs.pipeline import Frame
from blitzgs.training.config import LossConfig


class LossTerms(NamedTuple):
    """A batch's loss and where its gradients enter.

    Attributes:
        photometric: per view, float32 [B].
        v_renders: gradient of the batch's mean loss by the images, [B, H, W, 3].
        scale_reg: weight of the smallest axis of each visible Gaussian, per view [B]; None when the term is
            off.
    """

    photometric: Tensor
    v_renders: Tensor
    scale_reg: Tensor | None


def loss_terms(
    frame: Frame, targets: Tensor, masks: Tensor | None, config: LossConfig, length_unit: float
) -> LossTerms:
    """Compare rendered views with their photographs.

    Args:
        frame: rendered batch of B views.
        targets: uint8 [B, H, W, 3].
        masks: uint8 [B, H, W], 0 = pixel left out; or None.
        config: weights.
        length_unit: L_scale's unit of length in the unit of the means (extent x `loss.scale_reference`).
    """
    count = len(frame.views)
    samples = pixel_counts(frame.renders, masks).clamp(min=1)
    l1_sums, ssim_sums, v_renders = photometric_fwd_bwd(
        frame.renders,
        targets,
        masks,
        (1.0 - config.ssim) / (samples * count),
        -config.ssim / (samples * count),
        frame.options.tile_size,
    )
    photometric = ((1.0 - config.ssim) * l1_sums - config.ssim * ssim_sums) / samples + config.ssim
    scale_reg = None
    if config.scale > 0:
        scale_reg = config.scale / (length_unit * count * _visible(frame).clamp(min=1).to(l1_sums.dtype))
    return LossTerms(photometric, v_renders, scale_reg)


def scale_term(frame: Frame, table: GaussianTable, length_unit: float) -> Tensor:
    """Return L_scale of each view, float32 [B]: the mean smallest axis of the Gaussians visible in it."""
    smallest = table["scales"][frame.rows.gaussian_ids].amin(dim=1).exp() / length_unit
    views = torch.arange(len(frame.views), device=smallest.device)
    seen = frame.rows.camera_ids[:, None] == views
    return (smallest[:, None] * seen).sum(dim=0) / _visible(frame).clamp(min=1)


def _visible(frame: Frame) -> Tensor:
    """Gaussians visible in each view, int64 [B], without waiting for the device."""
    views = torch.arange(len(frame.views), device=frame.renders.device)
    return (frame.rows.camera_ids[:, None] == views).sum(dim=0)
