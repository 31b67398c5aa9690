# SPDX-License-Identifier: Apache-2.0
"""The optimiser of a table: dense Adam that updates only visible rows, with batch scaling."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from blitzgs.config.fields import OptimiserConfig
from blitzgs.config.schedule import Schedule
from blitzgs.frame.render import Frame
from blitzgs.ops.blocks import put_rows_, take_rows
from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, lazy_adam_catch_up_, project_bwd_step_
from blitzgs.ops.rasterize import SplatGradients
from blitzgs.table.table import EXP_AVG_SQS, EXP_AVGS, PARAMETERS, GaussianTable

# Adam's constants for one view a step.
BETA1, BETA2, EPS = 0.9, 0.999, 1e-15
# Rows with 48 coefficients are about 200 MB together.
_PART = 1 << 18
_GROUPS = (PARAMETERS, EXP_AVGS, EXP_AVG_SQS)


class TableAdam:
    """Adam over the rows of a table, batch-scaled as Grendel does: lr sqrt(B), beta^B, eps / sqrt(B).

    The batch scaling is that of Grendel-GS (Zhao et al. 2024). A step does not touch rows that it does not
    update; the columns `last_step` and `moment_step` note how far each row is current. `catch_up` must be
    called before the parameters of such rows are read. In a loop of your own, use `blitzgs.optim.LazyAdam`.
    """

    def __init__(self, config: OptimiserConfig, schedule: Schedule, extent: float, device: object) -> None:
        """Tabulate the run's learning rates on `device`; `extent` is in the unit of the means."""
        batch = schedule.batch_size
        self._config, self._extent, self._device = config, extent, device
        self._betas = (BETA1**batch, BETA2**batch)
        self._eps = EPS / math.sqrt(batch)
        self.follow(schedule)

    def follow(self, schedule: Schedule) -> None:
        """Tabulate the learning rates of a changed schedule.

        Pending steps are steps already taken, so the new schedule must have the same rates for those.
        """
        rates = schedule.learning_rates(self._config, self._extent)
        self._position_rates = rates[:, 0].tolist()
        # float32 [S + 1, 6], the rates of every step; see `Schedule.learning_rates`.
        self.lr_table: Tensor = rates.to(self._device)  # type: ignore[call-overload]
        self.schedule = AdamSchedule(self.lr_table, *self._betas, self._eps)
        self.pending_table = self.schedule.table  # bounds the movement by pending steps
        self._alone: dict[str, AdamSchedule] = {}

    def position_rate(self, step: int) -> float:
        """Return the learning rate of the means in step `step` (from 1), in their unit."""
        rate: float = self._position_rates[step]
        return rate

    def catch_up(
        self, table: GaussianTable, ids: Tensor | None, step: int, count: Tensor | None = None
    ) -> None:
        """Apply the pending steps up to `step` to rows, int32 or int64 [A], or the first `count` of them."""
        lazy_adam_catch_up_(_state_of(table), self.schedule, step, ids, count)

    def pending(self, table: GaussianTable, step: int) -> Pending:
        """Return the pending steps of a table after step number `step`, which may be in host memory."""
        return Pending(self, table, step)

    def schedule_of(self, name: str) -> AdamSchedule:
        """Return the schedule of one column of `PARAMETERS` alone, which is not "sh"."""
        if name not in self._alone:
            self._alone[name] = self.schedule.of_group(PARAMETERS.index(name))
        return self._alone[name]

    def step(
        self,
        table: GaussianTable,  # the one that was rendered, unchanged since; visible rows are current
        frame: Frame,
        gradients: SplatGradients,  # of the frame's splats, from `frame.backward_splats`
        # `scale_reg`, `opacity_reg`: weights per view, [B], of the smallest axis and of the opacity of each
        # Gaussian visible in it; None: no such term
        scale_reg: Tensor | None,
        opacity_reg: Tensor | None,
        step: int,
    ) -> None:
        """Take step number `step` (from 1) for the Gaussians that a frame shows."""
        views, options = frame.views, frame.options
        project_bwd_step_(
            _state_of(table), self.schedule, step, (views.viewmats, views.Ks, scale_reg, opacity_reg),
            frame.projected, options.projection(views), gradients, table["level"] if options.fade else None,
        )  # fmt: skip


class Pending:
    """The pending steps of a table's rows, for code that changes few of them between two steps.

    Of a table in host memory, the optimiser's device has `_PART` rows at a time.
    """

    def __init__(self, optimiser: TableAdam, table: GaussianTable, step: int) -> None:
        self._optimiser, self._table, self._step = optimiser, table, step
        self._device = optimiser.lr_table.device

    def current(self, name: str) -> Tensor:
        """Return what a column of `PARAMETERS` (not "sh") is with all pending steps; no row catches up."""
        table, device = self._table, self._device
        size = max(1, len(table)) if table.device == device else _PART
        columns = (name, "last_step", f"exp_avg.{name}", f"exp_avg_sq.{name}", "moment_step")
        current = []
        for part in zip(*(table[column].split(size) for column in columns), strict=True):
            values, last_step = (column.to(device, copy=True) for column in part[:2])
            exp_avg, exp_avg_sq, moment_step = (column.to(device) for column in part[2:])
            state = AdamState([values], [exp_avg], [exp_avg_sq], last_step, moment_step)
            lazy_adam_catch_up_(state, self._optimiser.schedule_of(name), self._step)
            current.append(values.to(table.device))
        return current[0] if len(current) == 1 else torch.cat(current)

    def catch_up(self, rows: Tensor) -> None:
        """Apply the pending steps of some rows (int64 [M], each once)."""
        if self._table.device == self._device:
            self._optimiser.catch_up(self._table, rows, self._step)
            return
        for part in rows.split(_PART):
            self._catch_up_part(part)

    def _catch_up_part(self, rows: Tensor) -> None:
        table = self._table
        names = (*PARAMETERS, *EXP_AVGS, *EXP_AVG_SQS, "last_step", "moment_step")
        taken = take_rows([table[name] for name in names], rows)
        part = {name: column.to(self._device) for name, column in zip(names, taken, strict=True)}
        params, exp_avgs, exp_avg_sqs = ([part[name] for name in group] for group in _GROUPS)
        state = AdamState(params, exp_avgs, exp_avg_sqs, part["last_step"], part["moment_step"])
        lazy_adam_catch_up_(state, self._optimiser.schedule, self._step)
        names = (*PARAMETERS, "last_step")
        current = [part[name].to(table.device) for name in names]
        put_rows_([table[name] for name in names], rows, current)


def _state_of(table: GaussianTable) -> AdamState:
    return AdamState(
        table.parameters, table.exp_avgs, table.exp_avg_sqs, table["last_step"], table["moment_step"]
    )
