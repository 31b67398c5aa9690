# SPDX-License-Identifier: Apache-2.0
"""The log record of one step: loss, PSNR of the batch, active and visible Gaussians, speed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from blitzgs.distributed.host_sum import HostSum
from blitzgs.pipeline import Frame
from blitzgs.training.batches import Batch
from blitzgs.training.guard import check_table
from blitzgs.training.loss import batch_psnr, opacity_term, photometric, scale_term, size_term
from blitzgs.training.state import TrainingState


def measure_step(state: TrainingState, frame: Frame, batch: Batch) -> Tensor:
    """Return figures about a batch, float64 [7], without waiting for the device.

    They are its L_scale, L_opacity, L_size and PSNR, and the Gaussians of all ranks: those that the step
    projected, those of them that are visible in a view, and all.
    """
    loss, extent = state.config.loss, state.space.extent
    scale = scale_term(frame, state.stepper.table, extent * loss.scale_reference).mean()
    opacity = size = scale.new_zeros(())
    if loss.opacity > 0:
        opacity = opacity_term(frame, state.stepper.table).mean()
    if loss.size > 0:
        size = size_term(frame, state.stepper.table, extent).mean()
    assert frame.active is not None  # as in every step of a training
    active = frame.active.considered().double()
    visible, population = (
        active.new_full((), float(count)) for count in (len(frame.projected.visible_ids), len(state.table))
    )
    counts = state.ranks.all_reduce(torch.stack([active, visible, population]))
    terms = torch.stack([scale, opacity, size, batch_psnr(frame, batch)]).double()
    return torch.cat([terms, counts])


def log_step(
    state: TrainingState, measured: Tensor, batch: Batch, names: Sequence[str], sums: HostSum
) -> None:
    """Write one log record; wait for the device, and check the parameters.

    Args:
        state: state of the run after the step.
        measured: from `measure_step`.
        batch: batch of the step.
        names: names of the batch's views.
        sums: `LossTerms.parts` over all ranks.

    Raises:
        NonFiniteError: a parameter is not finite.
    """
    check_table(state.stepper.table, state.progress.step)
    loss = state.config.loss
    losses = photometric(sums.read()[: 2 * len(names)], batch.samples.cpu(), loss)
    scale, opacity, size, psnr, active, visible, population = measured.tolist()
    values = {
        "loss": losses.mean().item() + loss.scale * scale + loss.opacity * opacity + loss.size * size,
        "l_scale": scale,
        "psnr": psnr,
        "active": active,
        "visible": visible,
        "gaussians": int(population),
        "images_per_second": state.images_seen / max(state.progress.seconds, 1e-9),
    } | state.stepper.report()
    state.log.scalars(state.images_seen, values)
