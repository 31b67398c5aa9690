# SPDX-License-Identifier: Apache-2.0
"""What a view leaves out before projection: the LOD gate (paper Eq. 1 and 2) and the cull mask (Eq. 5).

The gate belongs to the model: it depends on distances alone, so training, evaluation and rendering apply it
alike. The mask belongs to the training views, which alone have columns in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.ops.blocks import ActiveRows, GateRules
from blitzgs.ops.counter_random import uniform
from blitzgs.ops.view_gate import gate_views_
from blitzgs.view.levels import farthest

# Gaussians by which the share that a view keeps is predicted: its standard error is 0.4 % at most.
SAMPLE = 16_384
# Sets the draws of the sample apart from others of the same ids.
_SAMPLE_KEY = 0x1EAF
# Distances in memory at once.
_MOST_DISTANCES = 1 << 24


@dataclass(frozen=True)
class LodGate:
    """The distances up to which views keep the Gaussians of each level.

    Attributes:
        reference_distance: d_0, in the unit of the means.
        fork: f, ratio of neighbouring levels.
        count: number of levels K.
        finest: the finest level that is kept at all, L_max in 0..K - 1.
        smooth: opacities fade out over half a level around these distances, a quarter to each side.
    """

    reference_distance: float
    fork: float
    count: int
    finest: int
    smooth: bool = False

    def reach(self) -> list[float]:
        """Return the distance up to which each of the K levels is kept; -1: nowhere."""
        longer = self.fork**0.25 if self.smooth else 1.0
        distances = (farthest(level, self.reference_distance, self.fork) for level in range(self.finest + 1))
        kept = [longer * distance for distance in distances]
        return kept + [-1.0] * (self.count - len(kept))

    def fade(self) -> tuple[float, ...]:
        """Return what the projection fades opacities by; empty: they do not fade.

        With r the reach of its level, the opacity of a Gaussian at distance d has the weight
        clamp((1 - d^2 / r^2) f / (f - 1), 0, 1): it is whole up to r / sqrt(f), and gone at r.

        Returns:
            f / (f - 1), then `reach`.
        """
        return (self.fork / (self.fork - 1), *self.reach()) if self.smooth else ()

    def weights(self, means: Tensor, level: Tensor, centre: Tensor) -> Tensor:
        """Return the weights of `fade` that a camera gives the opacities of Gaussians, float64 [N].

        Args:
            means: [N, 3].
            level: uint8 [N].
            centre: of the camera, float64 [3].
        """
        slope, *reach = self.fade()
        reaches = torch.tensor(reach, dtype=torch.float64, device=means.device)
        reaches = reaches[level.long().clamp(max=self.count - 1)]
        relative = (means.double() - centre).square().sum(1) / reaches.square()
        return torch.where(reaches > 0, slope * (1 - relative), 0.0).clamp(0.0, 1.0)


@dataclass(frozen=True)
class ViewGate:
    """What the views of one batch leave out.

    Attributes:
        reach: `LodGate.reach`.
        lod_views: bit v is set when view v has an LOD gate.
        columns: of the cull matrix, one for each view; empty: no view has a mask.
    """

    reach: Sequence[float]
    lod_views: int
    columns: Sequence[int] = ()

    def rules(self, table: GaussianTable) -> GateRules:
        """Return what the views leave out of a table, as the ops take it."""
        return GateRules(table["level"], list(self.reach), self.lod_views, table.cull, list(self.columns))


class SceneGate:
    """The LOD gate of a model, without the views for which it would leave out too little to pay.

    What a view would keep is predicted from a sample of the Gaussians of all ranks, drawn by their ids: the
    prediction does not depend on the number of ranks. Views that would keep at least `most_kept` of all have
    no gate.

    Attributes:
        gate: the distances.
        most_kept: that share.
    """

    def __init__(self, gate: LodGate, most_kept: float, table: GaussianTable, ranks: Ranks) -> None:
        """Draw the sample. Collective: every rank calls this with its share of the Gaussians, caught up."""
        self.gate, self.most_kept, self._ranks = gate, most_kept, ranks
        device = ranks.device  # which need not be that of the table
        count = int(ranks.all_reduce(torch.tensor([len(table)], device=device)).item())
        chosen = uniform(table["id"], _SAMPLE_KEY) < SAMPLE / max(count, 1)
        reach = torch.tensor(gate.reach(), dtype=torch.float64, device=device)
        level = table["level"][chosen].to(device).long().clamp(max=gate.count - 1)
        self._means, self._reach = table["means"][chosen].to(device).double(), reach[level]
        self._size = int(ranks.all_reduce(torch.tensor(len(level), device=device)).item())

    def kept(self, centres: Tensor) -> list[float]:
        """Predict the share of all Gaussians that views keep. Collective.

        Args:
            centres: of the cameras, float64 [V, 3].
        """
        counts = torch.zeros(len(centres), dtype=torch.int64, device=self._means.device)
        length = max(1, _MOST_DISTANCES // max(1, len(self._means)))
        for begin in range(0, len(centres), length):
            some = centres[begin : begin + length].to(self._means.device)
            distances = torch.cdist(some, self._means, compute_mode="donot_use_mm_for_euclid_dist")
            counts[begin : begin + length] = (distances <= self._reach).sum(1)
        self._ranks.all_reduce(counts)
        return (counts.double() / max(1, self._size)).tolist()

    def active(self, table: GaussianTable, viewmats: Tensor) -> ActiveRows | None:
        """Return the rows that each of some views keeps; None: all of them all. Collective.

        Args:
            table: this rank's Gaussians, caught up.
            viewmats: float32 [B, 4, 4], B <= 32.
        """
        return self._gated(table["means"], table["level"], viewmats)

    def rows(self, means: Tensor, level: Tensor, viewmat: Tensor) -> Tensor:
        """Return which of a single process's Gaussians a view keeps, bool [N].

        Args:
            means: float32 [N, 3].
            level: uint8 [N].
            viewmat: float32 [1, 4, 4].
        """
        active = self._gated(means, level, viewmat)
        return torch.ones_like(level, dtype=torch.bool) if active is None else active.views != 0

    def rules(self, level: Tensor, viewmats: Tensor) -> GateRules | None:
        """Return what some views leave out of rows with these levels; None: nothing. Collective."""
        shares = self.kept(centres_of(viewmats))
        lod_views = lod_bits([share < self.most_kept for share in shares])
        return None if lod_views == 0 else GateRules(level, self.gate.reach(), lod_views)

    def _gated(self, means: Tensor, level: Tensor, viewmats: Tensor) -> ActiveRows | None:
        rules = self.rules(level, viewmats)
        if rules is None:
            return None
        active = _all_rows(len(means), len(viewmats), means.device)
        gate_views_(active, means, viewmats, rules)
        return active


def lod_bits(gated: Sequence[bool]) -> int:
    """Return the bits of the views that have an LOD gate."""
    return sum(1 << view for view, has_gate in enumerate(gated) if has_gate)


def centres_of(viewmats: Tensor) -> Tensor:
    """Return where cameras of rigid poses [V, 4, 4] are, float64 [V, 3]."""
    poses = viewmats.double()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:]).squeeze(2)


def _all_rows(count: int, views: int, device: torch.device) -> ActiveRows:
    """Return the set in which each of some views may see every row."""
    bits = (1 << views) - 1
    return ActiveRows(
        torch.arange(count, dtype=torch.int32, device=device),
        torch.full((count,), bits - (1 << 32) if bits >> 31 else bits, dtype=torch.int32, device=device),
        torch.tensor([count], dtype=torch.int32, device=device),
    )
