# SPDX-License-Identifier: Apache-2.0
"""The optimiser of a table: dense Adam that touches visible rows only, scaled to the batch."""

from __future__ import annotations

import math

from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.lazy_adam import lazy_adam_catch_up_, schedule_table
from blitzgs.ops.project_step import project_bwd_step_
from blitzgs.ops.splat_gradients import SplatGradients
from blitzgs.pipeline import Frame
from blitzgs.training.config import OptimiserConfig
from blitzgs.training.schedule import Schedule


class LazyAdam:
    """Adam over the rows of a table, batch-scaled as Grendel does: lr sqrt(B), beta^B, eps / sqrt(B).

    Rows that a step does not name fall behind (columns `last_step` and `moment_step`); their parameters must
    be caught up before they are read.

    Attributes:
        lr_table: float32 [S + 1, 6], the learning rates of every step; see `Schedule.learning_rates`.
        pending_table: what bounds the drift of rows that are behind (`lazy_adam.schedule_table`); None in the
            sparse variant, where nothing drifts.
    """

    def __init__(self, config: OptimiserConfig, schedule: Schedule, extent: float, device: object) -> None:
        """Tabulate the run's learning rates on `device`; `extent` is in the unit of the means."""
        batch = schedule.batch_size
        self._config, self._extent, self._device = config, extent, device
        self._betas = (config.beta1**batch, config.beta2**batch)
        self._eps = config.eps / math.sqrt(batch)
        self._sparse = config.sparse
        self.follow(schedule)

    def follow(self, schedule: Schedule) -> None:
        """Tabulate the learning rates of a schedule.

        Rows that are behind owe the steps already taken: the new schedule has the same rates for those.
        """
        rates = schedule.learning_rates(self._config, self._extent)
        self._position_rates = rates[:, 0].tolist()
        self.lr_table: Tensor = rates.to(self._device)  # type: ignore[call-overload]
        self.pending_table = None if self._sparse else schedule_table(self.lr_table, *self._betas)

    def position_rate(self, step: int) -> float:
        """Return the learning rate of the means in step `step` (from 1), in their unit."""
        rate: float = self._position_rates[step]
        return rate

    def catch_up(
        self, table: GaussianTable, ids: Tensor | None, step: int, count: Tensor | None = None
    ) -> None:
        """Bring the parameters of rows `ids` (int32 [A]; None: all) to the state after `step`.

        ``count``, int32 [1]: only the first `count` of `ids` are rows.
        """
        if self._sparse:
            return
        lazy_adam_catch_up_(
            table.parameters,
            table.exp_avgs,
            table.exp_avg_sqs,
            ids,
            table["last_step"],
            table["moment_step"],
            self.lr_table,
            step,
            *self._betas,
            self._eps,
            count,
        )

    def step(
        self,
        table: GaussianTable,
        frame: Frame,
        v: SplatGradients,
        scale_reg: Tensor | None,
        opacity_reg: Tensor | None,
        step: int,
        means2d_sums: Tensor | None = None,
        absolute_sums: bool = False,
    ) -> None:
        """Take step number `step` (from 1) for the Gaussians that a frame shows.

        Args:
            table: the table that was rendered, unchanged since.
            frame: of `pipeline.forward`.
            v: gradients of the frame's splats, from `pipeline.backward_splats`.
            scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no
                such term.
            opacity_reg: the same of its opacity.
            step: the visible rows stand at the step before.
            means2d_sums: [P, 2], becomes the gradient of the splats' means2d where `v` has it at ranks.
            absolute_sums: the sum over pixels of its absolute values instead.
        """
        project_bwd_step_(
            table.parameters,
            table.exp_avgs,
            table.exp_avg_sqs,
            table["last_step"],
            table["moment_step"],
            self.lr_table,
            step,
            *self._betas,
            self._eps,
            self._sparse,
            frame.projected,
            (frame.views.viewmats, frame.views.Ks),
            frame.options.projection(frame.views),
            v,
            scale_reg,
            means2d_sums,
            opacity_reg,
            table["level"] if frame.options.fade else None,
            absolute_sums,
        )
