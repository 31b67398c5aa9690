# SPDX-License-Identifier: Apache-2.0
"""Leaves Gaussians out of views before projection: LOD gate (BlitzGS Eq. 1 and 2) and cull mask (Eq. 3).

The gate is part of the model: it depends only on distances, so training, evaluation and rendering all apply
it. The mask exists only for training views.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.ops.blocks import ActiveRows, GateRules, gate_views_
from blitzgs.ops.counter_random import uniform
from blitzgs.table.table import CULL, GaussianTable, sectors_in
from blitzgs.view.levels import farthest

# Number of sampled Gaussians that predict the share that a view keeps; the standard error is at most 0.4 %.
SAMPLE = 16_384
# Key of the sample's random draws, so that they differ from other draws for the same ids.
_SAMPLE_KEY = 0x1EAF
# Largest number of distances that are in memory at once.
_MAX_DISTANCES = 1 << 24


@dataclass(frozen=True)
class LodGate:
    """The LOD gate: the distance up to which views keep the Gaussians of each octree level."""

    reference_distance: float  # d_0, in the unit of the means
    fork: float  # f, ratio of neighbouring levels
    count: int  # number of levels K
    finest: int  # the finest level that views keep, L_max in 0..K - 1
    smooth: bool = False  # opacities fade out over half a level instead of being cut off

    def reach(self) -> list[float]:
        """Return for each of the K levels the distance up to which views keep it; -1: no view keeps it."""
        longer = self.fork**0.25 if self.smooth else 1.0
        distances = (farthest(level, self.reference_distance, self.fork) for level in range(self.finest + 1))
        kept = [longer * distance for distance in distances]
        return kept + [-1.0] * (self.count - len(kept))

    def fade(self) -> tuple[float, ...]:
        """Return f / (f - 1), then `reach`, by which the projection fades opacities; empty: they do not fade.

        Let r be the reach of a Gaussian's level and d its distance from the camera. Its opacity is multiplied
        by clamp((1 - d^2 / r^2) f / (f - 1), 0, 1), which is 1 up to r / sqrt(f) and 0 from r on.
        """
        return (self.fork / (self.fork - 1), *self.reach()) if self.smooth else ()

    def weights(self, means: Tensor, level: Tensor, centre: Tensor) -> Tensor:
        """Return the factors of `fade` of means [N, 3] with levels [N], from a camera [3]; float64 [N]."""
        slope, *reach = self.fade()
        reaches = torch.tensor(reach, dtype=torch.float64, device=means.device)
        reaches = reaches[level.long().clamp(max=self.count - 1)]
        relative = (means.double() - centre).square().sum(1) / reaches.square()
        return torch.where(reaches > 0, slope * (1 - relative), 0.0).clamp(0.0, 1.0)


@dataclass(frozen=True)
class ViewGate:
    """LOD gate and cull mask of the views of one batch."""

    reach: Sequence[float]  # `LodGate.reach`
    lod_views: int  # bit v is set when view v has an LOD gate
    columns: Sequence[int] = ()  # the views' columns in the cull matrix; empty: no view has a mask

    def rules(self, table: GaussianTable) -> GateRules:
        """Return the rules for a table, as the ops take them."""
        mask = table.columns.get(CULL)
        sectors = None if mask is None else sectors_in(mask)
        return GateRules(table["level"], list(self.reach), self.lod_views, sectors, list(self.columns))


class ModelGate:
    """The LOD gate of a model, applied only to views for which it leaves out enough Gaussians to pay.

    A sample of the Gaussians of all ranks, drawn by their ids, predicts the share that each view would keep.
    A view that would keep at least `most_kept` of all is rendered without the gate, which would save little.
    So is one that would keep less than `least_kept`, which no training view does: there, coarse levels that
    have not been trained to stand alone would show holes.
    """

    def __init__(
        self, gate: LodGate, most_kept: float, table: GaussianTable, ranks: Ranks, least_kept: float = 0.0
    ) -> None:
        """Draw the sample. Collective: every rank calls this with its share of the Gaussians, caught up."""
        self.gate, self._ranks = gate, ranks
        # With smooth levels every view has the gate: a change from a view with it to one without would be a
        # visible jump.
        self.most_kept, self.least_kept = (math.inf, 0.0) if gate.smooth else (most_kept, least_kept)
        device = ranks.device  # the table may be on another device
        count = int(ranks.all_reduce(torch.tensor([len(table)], device=device)).item())
        chosen = uniform(table["id"], _SAMPLE_KEY) < SAMPLE / max(count, 1)
        reach = torch.tensor(gate.reach(), dtype=torch.float64, device=device)
        level = table["level"][chosen].to(device).long().clamp(max=gate.count - 1)
        self._means, self._reach = table["means"][chosen].to(device).double(), reach[level]
        self._size = int(ranks.all_reduce(torch.tensor(len(level), device=device)).item())

    def with_smooth(self, smooth: bool) -> ModelGate:
        """Return this gate with levels that fade, or that are cut off; a gate that fades is in every view."""
        other = copy.copy(self)
        other.gate = replace(self.gate, smooth=smooth)
        if smooth:
            other.most_kept, other.least_kept = math.inf, 0.0
        return other

    def kept(self, centres: Tensor) -> list[float]:
        """Predict the share of Gaussians that views from positions float64 [V, 3] keep. Collective."""
        counts = torch.zeros(len(centres), dtype=torch.int64, device=self._means.device)
        length = max(1, _MAX_DISTANCES // max(1, len(self._means)))
        for begin in range(0, len(centres), length):
            some = centres[begin : begin + length].to(self._means.device)
            distances = torch.cdist(some, self._means, compute_mode="donot_use_mm_for_euclid_dist")
            counts[begin : begin + length] = (distances <= self._reach).sum(1)
        self._ranks.all_reduce(counts)
        return (counts.double() / max(1, self._size)).tolist()

    def applies(self, share: float) -> bool:
        """Tell whether a view that keeps this share of all Gaussians has the gate."""
        return self.least_kept <= share < self.most_kept

    def active(self, table: GaussianTable | Mapping[str, Tensor], viewmats: Tensor) -> ActiveRows | None:
        """Return the rows that each of B views keeps; None if every view keeps every row. Collective.

        `table`: means and levels of this rank's Gaussians, caught up. `viewmats`: float32 [B, 4, 4], B <= 32.
        """
        means, rules = table["means"], self.rules(table["level"], viewmats)
        if rules is None:
            return None
        active = all_rows(len(means), len(viewmats), means.device)
        gate_views_(active, means, viewmats, rules)
        return active

    def rows(self, means: Tensor, level: Tensor, viewmat: Tensor) -> Tensor:
        """Return which Gaussians a view, float32 [1, 4, 4], keeps, bool [N]; only for a single process."""
        active = self.active({"means": means, "level": level}, viewmat)
        return torch.ones_like(level, dtype=torch.bool) if active is None else active.views != 0

    def rules(self, level: Tensor, viewmats: Tensor) -> GateRules | None:
        """Return the rules of B views for these levels; None if no view leaves a row out. Collective."""
        shares = self.kept(centres_of(viewmats))
        lod_views = lod_bits([self.applies(share) for share in shares])
        return None if lod_views == 0 else GateRules(level, self.gate.reach(), lod_views)


def lod_bits(gated: Sequence[bool]) -> int:
    """Return an integer whose bit v is set if `gated[v]`."""
    return sum(1 << view for view, has_gate in enumerate(gated) if has_gate)


def centres_of(viewmats: Tensor) -> Tensor:
    """Return the camera positions of rigid poses [V, 4, 4], float64 [V, 3]."""
    poses = viewmats.double()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:]).squeeze(2)


def all_rows(count: int, views: int, device: torch.device) -> ActiveRows:
    """Return the active set in which every view may see every row."""
    bits = (1 << views) - 1
    return ActiveRows(
        torch.arange(count, dtype=torch.int32, device=device),
        torch.full((count,), bits - (1 << 32) if bits >> 31 else bits, dtype=torch.int32, device=device),
        torch.tensor([count], dtype=torch.int32, device=device),
    )
