# SPDX-License-Identifier: Apache-2.0
"""Gain and bias of each training photograph's channels, refined during training."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.runs.cameras import EXPOSURES, SHARED_EXPOSURES, effective_exposures
from blitzgs.training.batches import Batch
from blitzgs.util.output import write_file

# One step in so many measures the photographs of its batch, at one pixel in so many of each row and column.
_EVERY, _STRIDE = 4, 4
# A new measurement replaces at least this share of the earlier ones: the model that it refers to improves.
_LEAST_SHARE = 0.2
# In squares of the range of colours: pulls the gain to 1 in pictures of nearly one colour.
_RIDGE = 1e-3
# Photographs are measured at colours between these, of 255: others may have been cut off.
_DARKEST, _BRIGHTEST = 3, 252
# Colours are added up as integers, so that the sums are the same in any order, and at any number of ranks.
_UNIT = 65535


class Exposures:
    """Maps what the model shows to what each photograph shows: photograph = gain x render + bias.

    The model has the mean exposure: over the training views the gains have the mean 1 and the biases the mean
    0. A photograph is measured by least squares against the render of its view, over the pixels that count.
    While the gains differ by less than `LEAST_SPREAD`, renders are compared with the photographs as they are.
    """

    def __init__(self, train: Sequence[int], ranks: Ranks) -> None:
        """Begin with equal exposures of the training views, which are indices into the capture."""
        self._ranks = ranks
        self._rows = {index: row for row, index in enumerate(train)}
        # Gain and bias of each training view's channels as measured, and by how many measurements.
        self.measured = torch.zeros(len(train), 2, 3, dtype=torch.float64, device=ranks.device)
        self.measured[:, 0] = 1
        self.counts = torch.zeros(len(train), dtype=torch.float64, device=ranks.device)

    def begin_with(self, gains: Tensor) -> None:
        """Begin with gains that were measured before the training, [T, 3]; they count as several visits."""
        self.measured[:, 0] = gains.to(self.measured)
        self.counts.fill_(1 / _LEAST_SHARE)

    def effective(self) -> Tensor:
        """Return gain and bias of each training view as they are used, float64 [T, 2, 3]; does not wait."""
        return effective_exposures(self.measured)

    def of(self, indices: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return gains and biases, float32 [B, 1, 1, 3] each; of views without any, 1 and 0."""
        chosen = self.effective()[[self._rows.get(index, 0) for index in indices]].float()
        for place, index in enumerate(indices):
            if index not in self._rows:
                chosen[place, 0], chosen[place, 1] = 1, 0
        return chosen[:, 0, None, None], chosen[:, 1, None, None]

    def measure(self, step: int, renders: Tensor, batch: Batch) -> None:
        """Measure a batch's photographs, in one step of `_EVERY`, by renders [B, H, W, 3]. Collective."""
        if step % _EVERY:
            return
        pick = (slice(None), slice(None, None, _STRIDE), slice(None, None, _STRIDE))
        targets = batch.targets[pick].long()
        counted = ((targets > _DARKEST) & (targets < _BRIGHTEST)).all(-1)
        if batch.masks is not None:
            counted &= batch.masks[pick] != 0
        if batch.ranges is not None:
            counted &= batch.ranges.pixel_mask(self._ranks.rank, targets.device)[pick]
        shown = (renders[pick].clamp(0, 1) * _UNIT).round().long()
        photo = targets * (_UNIT // 255)
        ones = torch.ones_like(shown)
        terms = torch.stack([ones, shown, photo, shown * shown, shown * photo])
        sums = (terms * counted[..., None]).sum((2, 3))
        self._update(batch.indices, self._ranks.all_reduce(sums).double())

    def _update(self, indices: Sequence[int], sums: Tensor) -> None:
        """Take sums, [5, B, 3], of 1, render, photograph, render^2 and render x photograph into account."""
        count, shown, photo = sums[0].clamp(min=1), sums[1], sums[2]
        shown, photo = shown / count / _UNIT, photo / count / _UNIT
        variance = sums[3] / count / _UNIT**2 - shown * shown
        covariance = sums[4] / count / _UNIT**2 - shown * photo
        gain = (covariance + _RIDGE) / (variance + _RIDGE)
        found = torch.stack([gain, photo - gain * shown], dim=1)
        rows = [self._rows[index] for index in indices]
        share = (1 / (1 + self.counts[rows])).clamp(min=_LEAST_SHARE) * (sums[0, :, 0] > 0)
        self.measured[rows] += share[:, None, None] * (found - self.measured[rows])
        self.counts[rows] += 1

    def columns(self) -> dict[str, Tensor]:
        """Return what a resumed run needs; the same on every rank."""
        return {SHARED_EXPOSURES: torch.cat([self.measured.flatten(1), self.counts[:, None]], dim=1)}

    def restore(self, columns: Mapping[str, Tensor]) -> None:
        """Restore the state from `columns`; those of other training views are ignored."""
        found = columns.get(SHARED_EXPOSURES)
        if found is not None and len(found) == len(self.counts):
            found = found.to(self.measured.device)
            self.measured, self.counts = found[:, :-1].reshape(-1, 2, 3).clone(), found[:, -1].clone()

    def write(self, folder: Path, names: Sequence[str]) -> None:
        """Write `effective` into the folder of a run, by the names of the training views."""
        found = self.effective().cpu().numpy().round(5).tolist()
        write_file(folder / EXPOSURES, json.dumps(dict(zip(names, found, strict=True))))

    def describe(self) -> dict[str, float]:
        """Return figures for the summary: spread and range of the gains in use, mean of the channels."""
        gains = self.effective()[:, 0].mean(1)
        return {
            "spread": gains.std(correction=0).item(),
            "least": gains.min().item(),
            "most": gains.max().item(),
        }
