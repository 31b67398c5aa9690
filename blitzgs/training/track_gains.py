# SPDX-License-Identifier: Apache-2.0
"""Gains of photographs against each other, from the colours that they show of the same points."""

from __future__ import annotations

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

# Photographs whose gains differ by less than this, as a standard deviation of their logarithms, have the same
# exposure: so much is what shading and blur do to photographs of equal exposure.
LEAST_SPREAD = 0.04
# Edge of the square whose mean colour is a point's, in pixels: keypoints are where colours change.
_BLUR = 5
# Colours between these, of 255, have not been cut off.
_DARKEST, _BRIGHTEST = 5, 250
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
    observed = _observed_points(capture)
    if observed is None:
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


def differ(gains: Tensor) -> bool:
    """Tell whether photographs with these gains, [T, 3], have different exposures."""
    return float(gains.log().std(0, correction=0).mean()) >= LEAST_SPREAD


def _observed_points(capture: Capture) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]] | None:
    """Return the points, [M, 3] re-centred, and those that each training photograph has in its tracks."""
    folder = colmap.find_model(Path(capture.root))
    if folder is None:
        return None
    model = colmap.read_model(folder, points2d=True)
    names = {name: place for place, name in enumerate(model.images.names)}
    wanted = [capture.cameras[index].name for index in capture.train]
    ids = model.points.ids
    if len(ids) == 0 or len(model.images.point3d_ids) == 0 or not set(wanted) <= names.keys():
        return None
    order = np.argsort(ids)
    offsets = model.images.point2d_offsets.astype(np.int64)
    seen = []
    for name in wanted:
        place = names[name]
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
    good = ((colors > _DARKEST) & (colors < _BRIGHTEST)).all(1)
    mask = images.mask(index)
    if mask is not None:
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
