# SPDX-License-Identifier: Apache-2.0
"""Chooses which Gaussians go into a file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.formats.gaussians import Gaussians, GaussianSource
from blitzgs.util.errors import WRONG_CONTENT

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Selection:
    """Conditions that a Gaussian has to meet; coordinates are those of the capture."""

    box: Array | None = None  # least and largest x, y, z of the means, float64 [2, 3]; None: any
    polygon: Array | None = None  # corners [P, 2] of a region that holds the means; None: any
    axes: tuple[int, int] = (0, 1)  # the two coordinates of the polygon's corners
    min_opacity: float = 0.0  # least opacity
    levels: tuple[int, int] | None = None  # first and last octree level; None: any
    sh_degree: int | None = None  # largest SH degree; None: the model's
    most: int | None = None  # largest number of Gaussians; those of the highest score stay. None: no limit

    def meets(self, block: Gaussians, origin: Array) -> Tensor:
        """Tell which Gaussians can be shown and meet the conditions but `most`, bool [N].

        `origin`: the capture's coordinates of their origin, [3].
        """
        met = block.sound()
        if self.min_opacity > 0:
            met &= block.opacities.sigmoid() >= self.min_opacity
        if self.levels is not None:
            if block.levels is None:
                raise ValueError(
                    "the model has no octree levels: view.lod was off, or left nothing out of any view"
                )
            met &= (block.levels >= self.levels[0]) & (block.levels <= self.levels[1])
        if self.box is not None or self.polygon is not None:
            places = block.means.double().numpy() + origin
            if self.box is not None:
                met &= torch.from_numpy(((places >= self.box[0]) & (places <= self.box[1])).all(axis=1))
            if self.polygon is not None:
                met &= torch.from_numpy(_inside(places[:, list(self.axes)], self.polygon))
        return met


class Selected:
    """The Gaussians of a source that meet a selection, a `GaussianSource`."""

    def __init__(
        self,
        source: GaussianSource,
        selection: Selection,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        kept: Tensor | None = None,
        score: Tensor | None = None,
    ) -> None:
        """Choose; reads the source once.

        `origin`: the capture's coordinates of the origin. `kept`: a further condition, bool [N]. `score`: for
        `Selection.most`, float32 [N]; None: opacity times length. ValueError: no Gaussian meets the
        conditions, or there are no levels.
        """
        self._source, self.comments, self.has_levels = source, source.comments, source.has_levels
        wanted = selection.sh_degree
        self.degree = source.degree if wanted is None else min(source.degree, wanted)
        met, scores, first = [], [], 0
        for block in source.blocks():
            rows = slice(first, first + len(block))
            first += len(block)
            met.append(selection.meets(block, np.array(origin)))
            if kept is not None:
                met[-1] &= kept[rows]
            if selection.most is not None:
                own = opacity_length(block.opacities, block.scales) if score is None else score[rows]
                scores.append(own)
        self._met = torch.cat(met) if met else torch.zeros(0, dtype=torch.bool)
        if selection.most is not None and int(self._met.sum()) > selection.most:
            chosen = self._met.nonzero()[:, 0]
            order = torch.cat(scores)[chosen].argsort(descending=True, stable=True)
            self._met[chosen[order[selection.most :]]] = False
        self._count = int(self._met.sum())
        if self._count == 0:
            raise ValueError(
                "no Gaussian meets the conditions: choose a larger region, or lower limits"
                + _where(source, np.array(origin))
            )

    def __len__(self) -> int:
        return self._count

    def blocks(self) -> Iterator[Gaussians]:
        """Yield the chosen Gaussians in order."""
        first = 0
        for block in self._source.blocks():
            chosen = block.rows(self._met[first : first + len(block)])
            first += len(block)
            if len(chosen):
                yield replace(chosen, sh=chosen.sh[:, : (self.degree + 1) ** 2])


def _where(source: GaussianSource, origin: Array) -> str:
    """Return where the Gaussians lie, [3] to [3], as the end of an error: regions may be of other systems."""
    means = (block.means[block.sound()] for block in source.blocks())
    ends = [some.aminmax(dim=0) for some in means if len(some)]
    if not ends:
        return ""
    least, largest = torch.stack([e.min for e in ends]).amin(0), torch.stack([e.max for e in ends]).amax(0)
    corners = (", ".join(f"{x:.9g}" for x in end.numpy() + origin) for end in (least, largest))
    return "; the model is from ({}) to ({})".format(*corners)


def opacity_length(opacities: Tensor, scales: Tensor) -> Tensor:
    """Return the logarithm of opacity times length, [N], of logits [N] and logarithms of scales [N, 3].

    Where no view tells what a Gaussian contributes, this order loses less than opacity times area.
    """
    return torch.nn.functional.logsigmoid(opacities) + scales.amax(dim=1)


def _inside(points: Array, polygon: Array) -> npt.NDArray[np.bool_]:
    """Tell which points [N, 2] are inside a polygon [P, 2]: a ray to +x crosses an odd number of edges."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay == by:
            continue
        crosses = (ay > y) != (by > y)
        inside ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def read_polygon(path: Path) -> Array:
    """Read the corners of a region, float64 [P, 2]: a GeoJSON polygon, or lines of text with "x y".

    ValueError: the file has no polygon of finite corners; names it.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    try:
        if text.lstrip().startswith("{"):
            content = json.loads(text)
            while "coordinates" not in content:
                if len(content.get("features", [0])) != 1:
                    raise ValueError(f"it has {len(content['features'])} features: leave one")
                content = content["features"][0] if "features" in content else content["geometry"]
            kind, rings = content["type"], content["coordinates"]
            if kind == "MultiPolygon" and len(rings) == 1:  # as QGIS writes all polygons
                kind, rings = "Polygon", rings[0]
            if kind != "Polygon" or len(rings) != 1:
                raise ValueError("it is no single polygon without holes")
            rows = [corner[:2] for corner in rings[0]]
        else:
            lines = (line.replace(",", " ").split() for line in text.splitlines())
            rows = [line for line in lines if line and not line[0].startswith("#")]
        corners = np.array(rows, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
            raise ValueError("a polygon has at least three corners of two finite numbers")
    except WRONG_CONTENT as error:
        raise ValueError(f"{path} cannot be read as a polygon: {error}") from error
    return corners
