# SPDX-License-Identifier: Apache-2.0
"""The log record of one step: loss, PSNR of the batch, active and visible Gaussians, speed."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.frame import Frame
from blitzgs.ops.host import HostCopy
from blitzgs.runs.files import memory_bytes
from blitzgs.runs.guard import check_table, find_bad
from blitzgs.training.batch import Batch
from blitzgs.training.loss import batch_psnr, opacity_term, photometric, scale_term
from blitzgs.training.state import TrainingState


class StepRecord(NamedTuple):
    """The figures of a step, which the host reads later, so that it does not wait for the device.

    Attributes:
        figures: float64 as int64 [7 + B]. Of all ranks: the number of ranks with parameters that are not
            finite, the Gaussians that the step projected, those of them that are visible in a view, and all
            Gaussians. Of the batch: L_scale and L_opacity (0 if their weights are), PSNR (nan if all
            pixels are masked), and `Batch.samples` [B].
        sums: `LossTerms.parts` over all ranks.
    """

    figures: HostCopy
    sums: HostSum


def measure_step(state: TrainingState, frame: Frame, batch: Batch, sums: HostSum) -> StepRecord:
    """Queue the measurement of a step between its forward and its backward pass. Collective."""
    loss, extent, table = state.config.loss, state.space.extent, state.stepper.table
    assert frame.active is not None  # as in every step of a training
    active = frame.active.considered()
    visible, population = (
        active.new_full((), count) for count in (len(frame.projected.visible_ids), len(state.table))
    )
    counts = state.ranks.all_reduce(torch.stack([find_bad(table), active, visible, population]))
    scale = opacity = batch.samples.new_zeros(())
    if loss.scale > 0:
        scale = scale_term(frame, table, extent * loss.scale_reference).mean()
    if loss.opacity > 0:
        opacity = opacity_term(frame, table).mean()
    terms = torch.stack([scale, opacity, batch_psnr(frame, batch)])
    figures = torch.cat([counts.double(), terms.double(), batch.samples.double()])
    return StepRecord(HostCopy(figures.view(torch.int64)), sums)


def log_step(state: TrainingState, record: StepRecord) -> None:
    """Write the log record of the last step; wait for its figures, and check the parameters.

    Args:
        state: state of the run after the step.
        record: of the step.

    Raises:
        NonFiniteError: a parameter is not finite.
    """
    with state.ranks.watchdog.waiting("read_figures"):
        figures = record.figures.read().view(torch.float64)
    bad, active, visible, population, scale, opacity, psnr = figures[:7].tolist()
    if bad:
        check_table(state.stepper.table, state.progress.step)
    samples, loss = figures[7:].float(), state.config.loss
    losses = photometric(record.sums.read()[: 2 * len(samples)], samples, loss)
    values = {
        "loss": losses.mean().item() + loss.scale * scale + loss.opacity * opacity,
        # Without a pixel that counts there is no PSNR, and JSON has no nan.
        **({} if math.isnan(psnr) else {"psnr": psnr}),
        "active": active,
        "visible": visible,
        "gaussians": int(population),
        "images_per_second": state.images_seen / max(state.progress.seconds, 1e-9),
        "seconds": state.progress.seconds,
        "memory_bytes": memory_bytes(state.ranks.device),
    } | state.stepper.report()
    if loss.scale > 0:
        values["l_scale"] = scale
    state.log.scalars(state.images_seen, values)
    warning = None if math.isnan(psnr) else state.curve.add(state.images_seen, psnr)
    if warning is not None:
        state.log.event(state.images_seen, "warning", {"warning": warning}, f"warning: {warning}")
