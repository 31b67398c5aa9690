# SPDX-License-Identifier: Apache-2.0
"""Training beyond the memory of a GPU: copies the Gaussians of a step from host memory in time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.render import Frame, RenderOptions
from blitzgs.frame.transport.protocol import stage_ended
from blitzgs.ops.host import to_device
from blitzgs.ops.projection_types import MAX_VIEWS
from blitzgs.table.blocks import Cameras
from blitzgs.table.pool import Pool
from blitzgs.training.batches import Batch
from blitzgs.training.loss import LossTerms
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.step import Stepper
from blitzgs.view.gate import ViewGate
from blitzgs.view.views import ViewSet


class UpcomingCameras:
    """The cameras of the present and the next steps."""

    def __init__(self, sampler: BatchSampler, train: Sequence[int], views: ViewSet) -> None:
        self.batch_size = sampler.batch_size
        self._sampler, self._train, self._views = sampler, list(train), views

    @cached_property
    def _columns(self) -> tuple[Tensor, ...]:
        return tuple(column[self._train] for column in self._views.columns())

    def cameras(self, step: int, limits: tuple[float, float, float]) -> Cameras:
        """Return the views of a step (from 1) and of the following ones, at most 32 views."""
        batches = [self._sampler.batch(step - 1 + ahead) for ahead in range(MAX_VIEWS // self.batch_size)]
        # A view's index among the training views is also its column in the cull matrix.
        views = torch.tensor([view for batch in batches for view in batch])
        columns = to_device(views, self._columns[0].device)
        viewmats, Ks, sizes = (column[columns] for column in self._columns)  # noqa: N806
        reductions = [self._sampler.reduction(step - 1 + ahead) for ahead in range(len(batches))]
        if reductions[0] > 1:  # they decrease
            factors = torch.tensor(reductions, dtype=torch.int32).repeat_interleave(self.batch_size)
            factors = to_device(factors, sizes.device)
            Ks[:, :2] /= factors[:, None, None]
            sizes //= factors[:, None]
        return Cameras(viewmats, Ks, sizes, limits, columns)


class OffloadingStepper(Stepper):
    """Takes the same steps as `Stepper` with a table in host memory.

    For a step, the rows that the pool holds are the table. The blocks of the next step are loaded while the
    step runs.
    """

    gaussians: Pool

    def __init__(self, pool: Pool, upcoming: UpcomingCameras, *shared: Any) -> None:
        """Prepare to step with a pool; further arguments are those of `Stepper` after the table."""
        self._pool, self._upcoming = pool, upcoming
        self._reported = pool.moved
        self._up_to_date_at: int | None = None
        super().__init__(pool.held, *shared)
        self.gaussians = pool

    def reindex(self) -> None:
        """See `Stepper.reindex`."""
        self._pool.reindex(self._optimiser.pending_table)
        self.table = self._pool.held

    @property
    def bounds(self) -> Tensor:
        """See `Stepper.bounds`."""
        return self._pool.bounds

    def catch_up(self, step: int) -> None:
        """See `Stepper.catch_up`; afterwards the table on the host is up to date."""
        self.write_back()
        if self._up_to_date_at != step:
            self._pool.catch_up(lambda held: self._optimiser.catch_up(held, None, step))
            self._up_to_date_at = step

    def write_back(self) -> None:
        """See `Stepper.write_back`: write changes back to the host, and empty the pool."""
        self._pool.write_back()

    def report(self, whole: bool = False) -> dict[str, float]:
        """See `Stepper.report`: the share of blocks that were on the device, and megabytes moved per step."""
        if whole:
            return self._pool.moved.values()
        moved = self._pool.moved.since(self._reported)
        self._reported = self._pool.moved
        return moved.values()

    def forward(
        self, step: int, options: RenderOptions, batch: Batch, view_filter: ViewGate | None = None
    ) -> tuple[Frame, LossTerms, HostSum]:
        """See `Stepper.forward`."""
        self._up_to_date_at = None
        cameras = self._upcoming.cameras(step, options.limits)
        if view_filter is None or not view_filter.columns:
            cameras = cameras._replace(columns=None)
        self._blocks = self._pool.load_for_step(step, cameras, self._upcoming.batch_size)
        stage_ended("other")
        rendered = super().forward(step, options, batch, view_filter)
        self._pool.prefetch(step + 1)
        return rendered

    def backward(
        self, step: int, frame: Frame, terms: LossTerms, keep_means2d: bool = False
    ) -> Tensor | None:
        """See `Stepper.backward`."""
        v_means2d = super().backward(step, frame, terms, keep_means2d)
        self._pool.store_bounds(self._blocks)
        return v_means2d
