# SPDX-License-Identifier: Apache-2.0
"""Exact images and gradients of scenes far too large for the float64 reference, in a few small windows.

The splats that reach a window are found by their exact bounding boxes; the reference composites those alone,
which is what it would have made of all of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from scenes import BenchmarkScene
from torch import Tensor

from blitzgs.reference import Composite, Splats, composite, project_splats
from blitzgs.table.table import PARAMETERS

NEAR, FAR, EPS2D = 0.01, 1e10, 0.3


class ExactWindows:
    """A scene's images in windows: corners, centre and between, in every view.

    Attributes:
        ids: int64 [U], the Gaussians that reach a window of some view.
        inputs: their PARAMETERS as trained (log scales, logits), float64, requiring gradients.
        places: (view, rows, columns) of each window.
        images: float64 [h, w, 3] of each window, differentiable.
        cuts: bool [h, w]: pixels where rounding may decide.
    """

    def __init__(self, scene: BenchmarkScene, antialiased: bool = False, size: int = 24):
        self.scene, self.antialiased = scene, antialiased
        self.places = list(_places(scene, size))
        with torch.no_grad():
            everything = [scene.raw()[name].cpu().double() for name in PARAMETERS]
            self.ids = self._reaching(everything)
        self.inputs = [t[self.ids].requires_grad_() for t in everything]
        results = self._composite()
        self.images = [result.values for result in results]
        self.cuts = [result.cut for result in results]

    def _project(self, inputs: list[Tensor], view: int) -> Splats:
        means, quats, scales, opacities, sh = inputs
        scene = self.scene
        return project_splats(
            means,
            quats,
            scales.exp(),
            opacities.sigmoid(),
            sh,
            scene.viewmats[view].cpu().double(),
            scene.Ks[view].cpu().double(),
            scene.width,
            scene.height,
            sh_degree=3,
            near_plane=NEAR,
            far_plane=FAR,
            eps2d=EPS2D,
            antialiased=self.antialiased,
        )

    def _reaching(self, inputs: list[Tensor]) -> Tensor:
        found = torch.zeros(len(inputs[0]), dtype=torch.bool)
        for view in range(len(self.scene.viewmats)):
            splats = self._project(inputs, view)
            low, high = _boxes(splats)
            for _, rows, columns in (place for place in self.places if place[0] == view):
                found[splats.ids[_overlap(low, high, rows, columns)]] = True
        return found.nonzero()[:, 0]

    def _composite(self) -> list[Composite]:
        splats = [self._project(self.inputs, view) for view in range(len(self.scene.viewmats))]
        boxes = [_boxes(s) for s in splats]
        results = []
        for view, rows, columns in self.places:
            s, near = splats[view], _overlap(*boxes[view], rows, columns)
            means2d = s.means2d[near] - torch.tensor([columns.start, rows.start])
            size = columns.stop - columns.start, rows.stop - rows.start
            parts = (s.conics[near], s.opacities[near], s.colors[near], s.depths[near])
            results.append(composite(means2d, *parts, *size))
        return results


@torch.no_grad()
def _boxes(splats: Splats) -> tuple[Tensor, Tensor]:
    """Return the lower and upper corners [M, 2], px, of the boxes outside which alpha is below 1/255."""
    variances = splats.factors.square().sum(dim=-1) + EPS2D
    reach = (2 * torch.log(255 * splats.opacities).clamp(min=0)[:, None] * variances).sqrt()
    # The tenth of a pixel leaves room for rounding.
    return splats.means2d - reach - 0.1, splats.means2d + reach + 0.1


def _overlap(low: Tensor, high: Tensor, rows: slice, columns: slice) -> Tensor:
    """Return which boxes reach into a window, bool [M]."""
    first = torch.tensor([columns.start, rows.start])
    last = torch.tensor([columns.stop, rows.stop])
    return ((low < last) & (high > first)).all(dim=1)


def _places(scene: BenchmarkScene, size: int) -> Iterator[tuple[int, slice, slice]]:
    width, height = min(size, scene.width), min(size, scene.height)
    right, bottom = scene.width - width, scene.height - height
    corners = {(0, 0), (right, 0), (0, bottom), (right, bottom)}
    inner = {(right // 2, bottom // 2), (right // 3, 2 * bottom // 3), (3 * right // 4, bottom // 4)}
    for view in range(len(scene.viewmats)):
        for x, y in sorted(corners | inner):
            yield view, slice(y, y + height), slice(x, x + width)
