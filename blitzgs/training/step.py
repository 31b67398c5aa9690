# SPDX-License-Identifier: Apache-2.0
"""One training step: render a batch, compare it with its photographs, and update the Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.render import Frame, RenderOptions, backward_splats, render_frame
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport import open_transport
from blitzgs.frame.transport.protocol import stage_ended
from blitzgs.ops.blocks import ActiveRows, gate_views_
from blitzgs.ops.population import limit_scales_
from blitzgs.ops.projection_types import Sizes
from blitzgs.table.blocks import BlockIndex
from blitzgs.training.loss import LossTerms, loss_terms

if TYPE_CHECKING:
    from blitzgs.config.fields import LossConfig
    from blitzgs.frame.ownership import TileOwners
    from blitzgs.optim.table_adam import TableAdam
    from blitzgs.population.relocation import PositionNoise
    from blitzgs.table.table import GaussianTable
    from blitzgs.training.batches import Batch
    from blitzgs.training.exposure import Exposures
    from blitzgs.view.gate import ViewGate
    from blitzgs.view.visible import TableOrPool


class Stepper:
    """Takes training steps with one table: `forward`, then `backward`. Neither waits for the loss."""

    # The rows to which a frame's ids refer: all of this rank's Gaussians, or those of a pool.
    table: GaussianTable
    # All of this rank's Gaussians, for rendering between steps; call `catch_up` before.
    gaussians: TableOrPool
    exposures: Exposures | None = None  # of the training photographs; None: all are taken as they are

    def __init__(
        self,
        table: GaussianTable,
        optimiser: TableAdam,
        owners: TileOwners,
        loss: LossConfig,
        extent: float,
        noise: PositionNoise | None = None,
        limit: float = 0.0,
    ) -> None:
        """Prepare to step; `extent` is the scene's in the unit of the means.

        `limit`: share of the extent, or of the distance from the origin where that is larger, to which the
        axes of Gaussians are limited; 0: they are not.
        """
        self.table = self.gaussians = table
        self._optimiser, self._owners = optimiser, owners
        self._loss, self._extent, self._noise, self._limit = loss, extent, noise, limit
        self._transport = open_transport(owners.ranks)
        self.reindex()

    def reindex(self) -> None:
        """Rebuild the block index after rows were added, removed or reordered, or the schedule changed."""
        self._blocks = BlockIndex(self.table, self._optimiser.pending_table)

    @property
    def bounds(self) -> Tensor:
        """The bounds of all blocks of this rank's Gaussians, see `BlockIndex.bounds`."""
        return self._blocks.bounds

    def catch_up(self, step: int) -> None:
        """Apply all pending optimiser steps; `step` is the last step taken."""
        self._optimiser.catch_up(self.table, None, step)

    def write_back(self) -> None:
        """Write all changes back to this rank's whole table. Nothing to do here; see `OffloadingStepper`."""
        return None

    def report(self, whole: bool = False) -> dict[str, float]:
        """Return figures for the log, of the steps since the last call or, if `whole`, of all; none here."""
        return {}

    def forward(
        self, step: int, options: RenderOptions, batch: Batch, view_filter: ViewGate | None = None
    ) -> tuple[Frame, LossTerms, HostSum]:
        """Apply pending steps of the rows that the views may see, render, and compare with the photographs.

        Returns the frame, the loss's terms, and the sums of its `LossTerms.parts` over all ranks, which begin
        with [2 B].
        """
        table, ranks, views = self.table, self._owners.ranks, batch.views
        rules = None if view_filter is None else view_filter.rules(table)
        assignment = None if batch.ranges is None else TileAssignment(ranks, batch.ranges)

        def active(capacity: Sizes | None) -> ActiveRows:  # an attempt that lacks room repeats this
            if views.viewmats.is_cuda:
                blocks = None if capacity is None else capacity.blocks
                rows = self._blocks.active(table, views, options.limits, rules, blocks)
            else:
                # The number of blocks is known at once: lists of this size need no estimate, and are complete
                # at the first attempt.
                rows = self._blocks.active(table, views, options.limits, rules)._replace(blocks=None)
            stage_ended("other")
            self._optimiser.catch_up(table, rows.ids, step - 1, rows.length)
            stage_ended("optimiser")
            if rules is not None:
                gate_views_(rows, table["means"], views.viewmats, rules)
            return rows

        frame = render_frame(
            table, views, options, active, assignment, self._transport,
            backward_follows=True, backgrounds=batch.backgrounds,
        )  # fmt: skip
        if self.exposures is None:
            terms = loss_terms(frame, batch, self._loss, self._extent)
        else:
            self.exposures.measure(step, frame.renders, batch)
            shown, gains = self.exposures.shown(frame.renders, batch.indices)
            terms = loss_terms(frame, batch, self._loss, self._extent, shown)
            terms.v_renders.mul_(gains)
        stage_ended("loss")
        if batch.ranges is None:
            sums = HostSum(ranks, terms.parts)
        else:
            # The costs of tiles are sent together with the losses.
            sums = self._owners.record(batch.indices, frame.tile_work, batch.ranges, terms.parts)
        stage_ended("other")
        return frame, terms, sums

    def backward(
        self, step: int, frame: Frame, terms: LossTerms, keep_means2d: bool = False
    ) -> Tensor | None:
        """Propagate the gradients of `forward`'s loss to the Gaussians, and take an optimiser step.

        With `keep_means2d`, returns the gradient of the splats' means2d, [P, 2] per pixel.
        """
        table, ids = self.table, frame.projected.visible_ids
        gradients = backward_splats(frame, terms.v_renders)
        self._optimiser.step(table, frame, gradients, terms.scale_reg, terms.opacity_reg, step)
        if self._limit > 0:
            limit_scales_(table["scales"], table["means"], ids, share=self._limit, extent=self._extent)
        if self._noise is not None:
            self._noise.add(table, ids, step, self._optimiser.position_rate(step))
        stage_ended("optimiser")
        self._blocks.update(table, ids)
        stage_ended("other")
        return gradients.means2d if keep_means2d else None
