# SPDX-License-Identifier: Apache-2.0
"""Small pictures of an evaluation for the report: its best and worst views, and evenly spaced ones.

A folder `previews` beside `metrics.json` has NUMBER_render.webp, NUMBER_photograph.webp and
NUMBER_error.webp, where NUMBER is that of the camera among all of the run, and `views.json`, the list of
these numbers.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from torch import Tensor

from blitzgs.capture.pictures import error_map, to_uint8

FOLDER, INDEX = "previews", "views.json"
PARTS = ("render", "photograph", "error")
# Longest side in pixels, and quality of WebP.
_SIDE, _QUALITY = 720, 80
# So many of the best and as many of the worst views.
_EXTREMES = 4


class Previews:
    """Keeps the encoded pictures of this rank's candidates until all views are measured."""

    def __init__(self, folder: Path, fixed: set[int]) -> None:
        """Begin; `fixed` are cameras whose pictures are kept whatever their PSNR."""
        self._folder, self._fixed = folder / FOLDER, fixed
        self._kept: dict[int, dict[str, bytes]] = {}
        # The smallest entry of each is the next to be dropped: (PSNR, camera) and (-PSNR, camera).
        self._best: list[tuple[float, int]] = []
        self._worst: list[tuple[float, int]] = []

    def add(self, index: int, psnr: float, render: Tensor, target: Tensor, mask: Tensor | None) -> None:
        """Take a measured view; arguments are those of `blitzgs.capture.pictures.comparison`."""
        dropped = _push(self._best, (psnr, index)) | _push(self._worst, (-psnr, index))
        if index in self._needed():
            pictures = (to_uint8(render), to_uint8(target), to_uint8(error_map(render, target, mask)))
            self._kept[index] = {
                part: _encoded(picture) for part, picture in zip(PARTS, pictures, strict=True)
            }
        for other in dropped - self._needed():
            self._kept.pop(other, None)

    def _needed(self) -> set[int]:
        return {index for _, index in (*self._best, *self._worst)} | self._fixed

    def files(self, psnr: Mapping[int, float], lists: bool) -> Iterator[tuple[Path, bytes]]:
        """Return the files of this rank.

        Args:
            psnr: of all measured views of all ranks, by their cameras.
            lists: whether this rank writes the list.
        """
        ordered = sorted(psnr, key=lambda index: (psnr[index], index))
        chosen = {*ordered[:_EXTREMES], *ordered[-_EXTREMES:]} | (self._fixed & psnr.keys())
        for index in sorted(chosen & self._kept.keys()):
            for part, content in self._kept[index].items():
                yield preview_file(self._folder, index, part), content
        if lists:
            yield self._folder / INDEX, json.dumps(sorted(chosen)).encode()


def preview_file(folder: Path, index: int, part: str) -> Path:
    """Return the file of one of `PARTS` of a camera."""
    return folder / f"{index:06d}_{part}.webp"


def _push(heap: list[tuple[float, int]], entry: tuple[float, int]) -> set[int]:
    """Add an entry; return the camera of the one that no longer fits, if any."""
    if len(heap) < _EXTREMES:
        heapq.heappush(heap, entry)
        return set()
    return {heapq.heappushpop(heap, entry)[1]}


def _encoded(picture: npt.NDArray[np.uint8]) -> bytes:
    height, width = picture.shape[:2]
    scale = min(1.0, _SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    if scale < 1:
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    _, data = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return bytes(data)
