# SPDX-License-Identifier: Apache-2.0
"""Gaussians that stand for several, for views from afar.

Moments are float32 rows [N, 10 + 3 K]: mean (3), covariance (xx, xy, xz, yy, yz, zz), cover, SH coefficients.
The cover is opacity times the number of Gaussians of this size that would lie on each other. Cover times area
is what a Gaussian hides, and a merge keeps its sum. Area is that of a projection, averaged over directions:
sqrt((a^2 b^2 + a^2 c^2 + b^2 c^2) / 3) of the scales, without pi; 16 % too large for a flat disc. Means,
covariances and colours are averaged as in Kerbl et al. 2024, "A Hierarchical 3D Gaussian Representation for
Real-Time Rendering of Very Large Datasets".
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import Gaussians, unit_quats
from blitzgs.util.rotations import quaternion_matrices, quaternions

# The variance that viewers add to a splat, pixels squared (docs/image.md, step 2). Merged Gaussians are shown
# where a cell of the grid is about a pixel.
_BLUR = 0.3
# A cover above 1 widens a Gaussian by its root, up to this. A plane that fills cells of edge v has the
# variance v^2 / 12 in each; Gaussians hide it without holes if they are sqrt(12 / (2 pi)) times as wide.
_WIDEST = 1.38
_MOST_OPAQUE = 0.999
# Largest variance: float32 holds no square of a length above 1.8e19, which files may have.
_LARGEST = 1e30
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])

Rows = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]


def moments(gaussians: Gaussians) -> Rows:
    """Return the moments of Gaussians, [N, 10 + 3 K]."""
    axes = quaternion_matrices(unit_quats(gaussians.quats)) * gaussians.scales.double().exp()[:, None]
    covariances = (axes @ axes.mT)[:, _UPPER[0], _UPPER[1]].clamp(-_LARGEST, _LARGEST)
    cover = gaussians.opacities.double().sigmoid()[:, None]
    columns = [gaussians.means, covariances.float(), cover.float(), gaussians.sh.flatten(1)]
    return torch.cat(columns, dim=1).numpy()


def merged(rows: Rows, most: int, box: Array, antialiased: bool, least: float = 0.0) -> tuple[Rows, float]:
    """Merge Gaussians that are in the same cell of a grid, the finest that has at most so many cells.

    Each cell's Gaussian has the weighted mean, covariance and SH coefficients; weights are cover times area.
    The areas of a model that is not antialiased are those of the blurred splats, as viewers show it.

    Args:
        rows: moments [N, 10 + 3 K], N >= 1.
        most: number of cells, at least 1.
        box: [2, 3], where most of the model is. Cells are cubes inside, and grow with the distance outside.
        antialiased: whether viewers compensate the blur.
        least: least edge of the cells.

    Returns:
        Moments [M, 10 + 3 K] in the order of the cells, M <= most, and the edge of a cell inside the box.
    """
    centre, half = box.mean(axis=0), float(np.ptp(box, axis=0).max()) / 2 or 1.0
    places = (rows[:, :3] - centre) / half
    far = np.maximum(np.abs(places), 1)
    places = np.where(far > 1, np.sign(places) * (1 + np.log(far)), places)
    places -= places.min(axis=0)
    # At most 2^20 cells along an axis, so that a cell has a number below 2^63.
    finest = max(least / half, float(places.max()) / 2**20, 1e-30)
    coarsest = max(finest, 2 * float(places.max()))

    def cells(edge: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        index = np.floor(places / edge).astype(np.int64)
        found = np.unique(index @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
        return found[0], found[1].ravel()

    edge, found = finest, cells(finest)
    if len(found[0]) > most:
        for _ in range(14):
            edge = (finest * coarsest) ** 0.5
            if len(cells(edge)[0]) > most:
                finest = edge
            else:
                coarsest = edge
        edge, found = coarsest, cells(coarsest)
    return _matched(rows, *found, 0.0 if antialiased else _BLUR * (edge * half) ** 2), edge * half


def _matched(rows: Rows, cells: npt.NDArray[np.int64], cell_of: npt.NDArray[np.int64], blur: float) -> Rows:
    """Return the moments [M, 10 + 3 K] of the Gaussians in each cell; `blur` is a variance."""
    weights = np.maximum(rows[:, 9] * _areas(rows[:, 3:9], blur), 1e-35)
    total = np.bincount(cell_of, weights)

    def mean(values: npt.NDArray[np.floating]) -> Array:
        return np.bincount(cell_of, weights * values) / total

    result = np.empty((len(cells), rows.shape[1]), np.float32)
    means = np.stack([mean(rows[:, axis]) for axis in range(3)], axis=1)
    result[:, :3] = means
    away = rows[:, :3] - means[cell_of]
    covariances = np.stack(
        [
            mean(rows[:, 3 + k] + away[:, i] * away[:, j])
            for k, (i, j) in enumerate(zip(*_UPPER, strict=True))
        ],
        axis=1,
    )
    result[:, 3:9] = covariances.clip(-_LARGEST, _LARGEST)
    result[:, 9] = total / _areas(covariances, blur)
    for column in range(10, rows.shape[1]):
        result[:, column] = mean(rows[:, column])
    return result


def _areas(covariances: npt.NDArray[np.floating], blur: float) -> Array:
    """Return the mean area [N] of projections of covariances [N, 6] with a variance added, without pi."""
    xx, xy, xz, yy, yz, zz = covariances.T.astype(np.float64)
    xx, yy, zz = xx + blur, yy + blur, zz + blur
    minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    return np.sqrt(np.maximum(minors, 1e-60) / 3)


def shown(rows: Rows, comments: list[str]) -> Gaussians:
    """Return moments [N, 10 + 3 K] as Gaussians; covers above 1 make them wider and opaque."""
    matrices = torch.from_numpy(rows[:, 3:9]).double()[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    variances, axes = torch.linalg.eigh(matrices)
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
    cover = torch.from_numpy(rows[:, 9]).double()
    scales = variances.clamp(min=1e-30).log() / 2 + cover.sqrt().clamp(1, _WIDEST).log()[:, None]
    return Gaussians(
        means=torch.from_numpy(rows[:, :3]),
        quats=quaternions(axes).float(),
        scales=scales.float(),
        opacities=cover.clamp(1e-30, _MOST_OPAQUE).logit().float(),
        sh=torch.from_numpy(rows[:, 10:]).reshape(len(rows), -1, 3),
        comments=comments,
    )
