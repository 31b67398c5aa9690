# SPDX-License-Identifier: Apache-2.0
"""One training step, from a batch of views to moved Gaussians; what the trainer and its benchmark share."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs import pipeline
from blitzgs.distributed.host_sum import HostSum
from blitzgs.distributed.ownership import TileAssignment, TileOwners
from blitzgs.distributed.transport import Mark, open_transport, unmarked
from blitzgs.model import GaussianTable
from blitzgs.ops.view_gate import gate_views_
from blitzgs.pipeline import Frame, RenderOptions
from blitzgs.population.exploration import PositionNoise
from blitzgs.population.scale_floor import FLOOR, raise_scales
from blitzgs.training.batches import Batch
from blitzgs.training.config import LossConfig
from blitzgs.training.loss import LossTerms, loss_terms
from blitzgs.training.optimiser import LazyAdam
from blitzgs.view.blocks import BlockIndex
from blitzgs.view.gate import ViewGate
from blitzgs.view.seen import Scene


class Stepper:
    """Takes training steps with one table: `forward`, then `backward`. Neither waits for a loss.

    Attributes:
        table: whose rows frames speak of: this rank's Gaussians, all or those that a step may need.
        scene: what views are rendered from between steps, after `catch_up`: all of this rank's Gaussians.
    """

    table: GaussianTable
    scene: Scene

    def __init__(
        self,
        table: GaussianTable,
        optimiser: LazyAdam,
        owners: TileOwners,
        loss: LossConfig,
        length_unit: float,
        half_exchange: bool = False,
        noise: PositionNoise | None = None,
    ) -> None:
        """Prepare to step.

        Args:
            table: this rank's Gaussians, in `morton_order`.
            optimiser: of the table.
            owners: learns what the tiles cost.
            loss: weights of the loss.
            length_unit: L_scale's unit of length in the unit of the means (extent x `loss.scale_reference`).
            half_exchange: send splats in half precision, see `open_transport`.
            noise: of the means, after each step; None: none.
        """
        self.table = self.scene = table
        self._optimiser, self._owners = optimiser, owners
        self._loss, self._length_unit, self._noise = loss, length_unit, noise
        self._transport = open_transport(owners.ranks, half_exchange)
        self.reindex()

    def reindex(self) -> None:
        """Take note that rows of the table were added, removed or reordered, or that the schedule changed."""
        self._blocks = BlockIndex(self.table, self._optimiser.pending_table)

    def catch_up(self, step: int) -> None:
        """Apply every optimiser step that rows owe up to `step`, which was the last one."""
        self._optimiser.catch_up(self.table, None, step)

    def settle(self) -> None:
        """Have this rank's whole table hold what the steps have changed. Here it always does."""
        return None

    def report(self, whole: bool = False) -> dict[str, float]:
        """Return figures about the steps since the last call or, if `whole`, about all; none here."""
        return {}

    def forward(
        self,
        step: int,
        options: RenderOptions,
        batch: Batch,
        mark: Mark = unmarked,
        gate: ViewGate | None = None,
    ) -> tuple[Frame, LossTerms, HostSum]:
        """Catch up what the views may see, render them and compare them with their photographs.

        Args:
            step: number of the step, from 1.
            options: how to render.
            batch: B views, their photographs, and who composites which tiles.
            mark: called with its name at the end of each stage.
            gate: what the views leave out; None: nothing.

        Returns:
            The frame, the loss's terms, and the sums of its `LossTerms.parts` over all ranks, which
            begin with [2 B].
        """
        table, ranks, views = self.table, self._owners.ranks, batch.views
        rules = None if gate is None else gate.rules(table)

        assignment = None if batch.ranges is None else TileAssignment(ranks, batch.ranges)
        for attempt in self._transport.capacity.attempts():
            # On the CPU the number of blocks is there at once, so there is always room for them.
            room = attempt.sizes.blocks if attempt.sizes is not None and views.viewmats.is_cuda else None
            active = self._blocks.active(
                table, views.viewmats, views.Ks, views.width, views.height, options.near_plane,
                options.far_plane, options.eps2d, rules, room,
            )  # fmt: skip
            mark("other")
            self._optimiser.catch_up(table, active.ids, step - 1, active.length)
            mark("optimiser")
            if rules is not None:
                gate_views_(active, table["means"], views.viewmats, rules)
            frame = pipeline.render(
                table, views, options, active if views.viewmats.is_cuda else active._replace(blocks=None),
                assignment, self._transport, attempt, mark, backward_follows=True,
            )  # fmt: skip
        assert frame is not None  # or there would be another attempt
        terms = loss_terms(frame, batch, self._loss, self._length_unit)
        mark("loss")
        if batch.ranges is None:
            sums = HostSum(ranks, terms.parts)
        else:
            # Costs of tiles and losses travel together.
            sums = self._owners.record(batch.indices, frame.tile_work, batch.ranges, terms.parts)
        mark("other")
        return frame, terms, sums

    def backward(
        self,
        step: int,
        frame: Frame,
        terms: LossTerms,
        mark: Mark = unmarked,
        keep_means2d: bool = False,
        absolute: bool = False,
    ) -> Tensor | None:
        """Carry the gradients of `forward`'s loss back to the splats, and move the Gaussians by them.

        Args:
            step: as for `forward`.
            frame: from `forward`.
            terms: from `forward`.
            mark: called with its name at the end of each stage.
            keep_means2d: whether the caller wants the gradient of the splats' means2d.
            absolute: as the sum over pixels of its absolute values (AbsGS, Ye et al. 2024).

        Returns:
            That gradient, [P, 2] per pixel, or None.
        """
        table = self.table
        absolute &= keep_means2d
        gradients = pipeline.backward_splats(frame, terms.v_renders, mark, absolute)
        v_means2d, sums = gradients.means2d_abs if absolute else gradients.means2d, None
        if v_means2d is None and keep_means2d:
            v_means2d = sums = torch.empty_like(frame.projected.means2d)
        self._optimiser.step(
            table, frame, gradients, terms.scale_reg, terms.opacity_reg, step, sums, absolute
        )
        if self._noise is not None:
            self._noise.add(table, frame.projected.visible_ids, step, self._optimiser.position_rate(step))
        if FLOOR in table.columns:
            raise_scales(table, frame.projected.visible_ids)
        mark("optimiser")
        self._blocks.update(table, frame.projected.visible_ids)
        mark("other")
        return v_means2d if keep_means2d else None
