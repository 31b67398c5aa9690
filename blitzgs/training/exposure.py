# SPDX-License-Identifier: Apache-2.0
"""Gain and bias of each training photograph's channels: from points at first, then refined."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from blitzgs.capture import colmap
from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore
from blitzgs.distributed.group import Ranks
from blitzgs.runs.cameras import SHARED_EXPOSURES, effective_exposures
from blitzgs.runs.run_files import EXPOSURES
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
    While the gains differ by less than `blitzgs.runs.cameras.LEAST_SPREAD`, renders are compared with the
    photographs as they are.
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
        """Return gains and biases of training views, float32 [B, 1, 1, 3] each."""
        chosen = self.effective()[[self._rows[index] for index in indices]].float()
        return chosen[:, 0, None, None], chosen[:, 1, None, None]

    def shown(self, renders: Tensor, indices: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return renders [B, H, W, 3] of training views as their photographs show them, and the gains."""
        gains, biases = self.of(indices)
        return torch.addcmul(biases, renders, gains), gains

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
        terms = torch.stack([torch.ones_like(shown), shown, photo, shown * shown, shown * photo])
        sums = (terms * counted[..., None]).sum((2, 3))
        # Sums [B, 3] of 1, render, photograph, render^2 and render x photograph.
        number, first, second, square, product = self._ranks.all_reduce(sums).double()
        count = number.clamp(min=1)
        first, second = first / count / _UNIT, second / count / _UNIT
        variance = square / count / _UNIT**2 - first * first
        covariance = product / count / _UNIT**2 - first * second
        gain = (covariance + _RIDGE) / (variance + _RIDGE)
        found = torch.stack([gain, second - gain * first], dim=1)
        rows = [self._rows[index] for index in batch.indices]
        share = (1 / (1 + self.counts[rows])).clamp(min=_LEAST_SHARE) * (number[:, 0] > 0)
        self.measured[rows] += share[:, None, None] * (found - self.measured[rows])
        self.counts[rows] += 1

    def columns(self) -> dict[str, Tensor]:
        """Return what a resumed run needs; the same on every rank."""
        return {SHARED_EXPOSURES: torch.cat([self.measured.flatten(1), self.counts[:, None]], dim=1)}

    def restore(self, columns: Mapping[str, Tensor]) -> None:
        """Restore the state from `columns` of the same training views."""
        found = columns[SHARED_EXPOSURES].to(self.measured.device)
        self.measured, self.counts = found[:, :-1].reshape(-1, 2, 3).clone(), found[:, -1].clone()

    def write(self, folder: Path, names: Sequence[str]) -> None:
        """Write `effective` into the folder of a run, by the names of the training views."""
        found = self.effective().cpu().numpy().round(5).tolist()
        write_file(folder / EXPOSURES, json.dumps(dict(zip(names, found, strict=True))))

    def describe(self) -> dict[str, float]:
        """Return figures for the summary: spread and range of the gains in use, mean of the channels."""
        gains = self.effective()[:, 0].mean(1)
        found = {"spread": gains.std(correction=0), "least": gains.min(), "most": gains.max()}
        return {name: value.item() for name, value in found.items()}


# Photographs whose gains differ by less than this, as a standard deviation of their logarithms, have the same
# exposure: so much is what shading and blur do to photographs of equal exposure.
_LEAST_TRACK_SPREAD = 0.04
# Edge of the square whose mean colour is a point's, in pixels: keypoints are where colours change.
_BLUR = 5
# Points are compared at colours between these, of 255: in their square, single pixels may have been cut off.
_DARKEST_MEAN, _BRIGHTEST_MEAN = 5, 250
# Points of a photograph that are compared; more would change nothing.
_MAX_POINTS = 2000
# Photographs that are decoded ahead.
_AHEAD = 8
# The points' colours and the gains are found in turns; each turn halves the error or better.
_TURNS = 10

Rows = tuple[NDArray[np.int64], NDArray[np.float64]]


def track_gains(capture: Capture, images: ImageStore, ranks: Ranks) -> Tensor | None:
    """Return the gain of each training photograph's channels, float64 [T, 3] with mean 1. Collective.

    The logarithm of a photograph's gain is the median, over its points, of the logarithm of the colour that
    it shows against the mean over the point's photographs, each divided by its own gain. Each rank reads its
    share of the photographs. None: the capture has no tracks.
    """
    if (observed := _observed_points(capture)) is None:
        return None
    points, seen = observed
    own = list(range(ranks.rank, len(capture.train), ranks.world_size))
    found: dict[int, Rows] = {}
    for place, row in enumerate(own):
        images.prefetch([capture.train[other] for other in own[place : place + _AHEAD]])
        found[row] = _colors(capture, images, capture.train[row], points, seen[row])
    rows = {row: values for part in ranks.all_gather_object(found) for row, values in part.items()}
    gains = np.exp(_log_gains([rows[row] for row in range(len(capture.train))], len(points)))
    return torch.from_numpy(gains / gains.mean(0))


def exposures_differ(gains: Tensor) -> bool:
    """Tell whether photographs with these gains, [T, 3], have different exposures."""
    return float(gains.log().std(0, correction=0).mean()) >= _LEAST_TRACK_SPREAD


def _observed_points(capture: Capture) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]] | None:
    """Return the points, [M, 3] re-centred, and those that each training photograph has in its tracks."""
    models = colmap.find_models(Path(capture.root))
    if not models:
        return None
    model = colmap.read_model(models[0][0], points2d=True)
    names = {name: place for place, name in enumerate(model.images.names)}
    wanted = [capture.cameras[index].name for index in capture.train]
    ids = model.points.ids
    if len(ids) == 0 or len(model.images.point3d_ids) == 0 or not set(wanted) <= names.keys():
        return None
    order = np.argsort(ids)
    offsets = model.images.point2d_offsets.astype(np.int64)
    seen = []
    for place in map(names.__getitem__, wanted):
        found = model.images.point3d_ids[offsets[place] : offsets[place + 1]]
        rows = order[np.searchsorted(ids, found[found >= 0], sorter=order).clip(max=len(ids) - 1)]
        seen.append(rows[:: max(1, len(rows) // _MAX_POINTS)].astype(np.int64))
    return np.asarray(model.points.positions) - capture.offset, seen


def _colors(
    capture: Capture, images: ImageStore, index: int, points: NDArray[np.float64], seen: NDArray[np.int64]
) -> Rows:
    """Return the points of a photograph that can be compared, and the logarithms of their colours."""
    camera = capture.cameras[index]
    in_camera = points[seen] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    seen, in_camera = seen[in_camera[:, 2] > 0], in_camera[in_camera[:, 2] > 0]
    pixels = in_camera @ camera.K.T
    x, y = np.floor(pixels[:, :2] / pixels[:, 2:]).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y, seen = x[inside].astype(np.int64), y[inside].astype(np.int64), seen[inside]
    colors = cv2.blur(images.get(index).numpy(), (_BLUR, _BLUR))[y, x].astype(np.float64)
    good = ((colors > _DARKEST_MEAN) & (colors < _BRIGHTEST_MEAN)).all(1)
    if (mask := images.mask(index)) is not None:
        good &= mask.numpy()[y, x] != 0
    return seen[good], np.log(colors[good])


def _log_gains(rows: list[Rows], count: int) -> NDArray[np.float64]:
    """Return the logarithms of the gains, [T, 3] with mean 0, from the colours of `count` points."""
    gains = np.zeros((len(rows), 3))
    photographs = np.zeros(count)
    for points, _ in rows:
        photographs[points] += 1  # a photograph has a point once
    for _ in range(_TURNS):
        sums = np.zeros((count, 3))
        for (points, colors), gain in zip(rows, gains, strict=True):
            np.add.at(sums, points, colors - gain)
        means = sums / np.maximum(photographs, 1)[:, None]
        for row, (points, colors) in enumerate(rows):
            shared = photographs[points] > 1
            if shared.any():
                gains[row] = np.median((colors - means[points])[shared], axis=0)
        gains -= gains.mean(0)
    return gains
