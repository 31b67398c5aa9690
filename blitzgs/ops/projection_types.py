# SPDX-License-Identifier: Apache-2.0
"""The arguments of the projection's ops in groups, and the splats that these ops return.

`blitzgs.ops.project` has the functions that project.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.intersect import TILE_SIZE

# Largest number of views of one launch (kMaxViews of csrc/common/kernel.h): an int32 has a bit for each.
MAX_VIEWS = 32
# Where the splats of the views begin in `ProjectionOutputs.totals` (kTotalViews of csrc/project/project.h).
VIEW_TOTALS = 4


@dataclass(frozen=True)
class Views:
    """B pinhole views of one image size, rendered together."""

    viewmats: Tensor  # world to camera, float32 [B, 4, 4]
    Ks: Tensor  # intrinsics in pixels, float32 [B, 3, 3]
    width: int  # pixels
    height: int  # pixels

    def __len__(self) -> int:
        return self.viewmats.shape[0]


class Sizes(NamedTuple):
    """Numbers of Gaussians, splats, tile entries and blocks that a frame needs, or has memory for."""

    visible: int  # Gaussians seen by at least one view
    splats: int  # pairs of a Gaussian and a view that sees it
    isects: int  # entries of the tiles' lists
    blocks: int = 0  # of rows of the table, of which some view may see a part

    def holds(self, needed: Sequence[int]) -> bool:
        """Tell whether these sizes suffice for `needed`, which has the first of these fields in order."""
        return all(n <= size for n, size in zip(needed, self, strict=False))


class ProjectedSplats(NamedTuple):
    """P splats of U different Gaussians, ordered by (Gaussian, view)."""

    gaussian_ids: Tensor  # int32 [P]
    camera_ids: Tensor  # int32 [P]
    visible_ids: Tensor  # int32 [U], ascending
    splat_offsets: Tensor  # int32 [U + 1]: visible_ids[u] has the splats from splat_offsets[u] on
    means2d: Tensor  # [P, 2], px; the centre of pixel (i, j) is (i + 0.5, j + 0.5)
    conics: Tensor  # [P, 3]: a, b, c of the inverse 2D covariance, 1/px^2
    depths: Tensor  # [P]: camera-space z
    opacities: Tensor  # [P]: compensated in antialiased mode
    colors: Tensor  # [P, 3]; [0, 3] without SH
    radii: Tensor  # int32 [P, 2]: half width and height of the box around alpha >= 1/255, rounded up
    tiles_touched: Tensor  # int32 [P]
    rank_masks: Tensor  # int64 [P]: bit m is set if rank m composites the splat; [0] without `rank_tiles`
    counts: Tensor  # int64 [3] on the CPU: U, P, and at least the sum of tiles_touched


def splats_of(allocated: Sequence[Tensor], sizes: Sizes, counts: Tensor | None = None) -> ProjectedSplats:
    """Return the valid splats of columns with more capacity; `counts`: of `sizes`, if there is a tensor."""
    if allocated[0].shape[0] > sizes.splats or allocated[2].shape[0] > sizes.visible:
        visible, splats = sizes[:2]
        allocated = first_rows(allocated[:12], [splats, splats, visible, visible + 1, *[splats] * 8])
    if counts is None:
        counts = torch.tensor(sizes[:3], device="cpu")
    return ProjectedSplats._make((*allocated[:12], counts))


def first_rows(columns: Sequence[Tensor], lengths: Sequence[int]) -> list[Tensor]:
    """Return the first rows of columns, as views that autograd does not know: callers may change them."""
    return torch.ops.blitzgs.first_rows(columns, lengths)


class Splats(NamedTuple):
    """P splats with the columns that compositing reads."""

    means2d: Tensor  # [P, 2] pixels
    conics: Tensor  # [P, 3], inverse 2D covariance (a, b, c)
    opacities: Tensor  # [P]
    colors: Tensor  # [P, D]
    depths: Tensor  # [P]
    camera_ids: Tensor  # int32 [P]
    ids: Tensor  # int64 [P], persistent ids of the Gaussians, which order splats of equal depth

    def first(self, count: int) -> Splats:
        """Return the first `count` splats."""
        return Splats(*first_rows(self, [count] * len(self)))


class ProjectionOptions(NamedTuple):
    """How Gaussians are projected: the arguments of `project` of these names, in the order of the ops."""

    width: int
    height: int
    tile_size: int = TILE_SIZE
    sh_degree: int = 0
    near_plane: float = 0.01
    far_plane: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0
    antialiased: bool = False
    raw: bool = True
    fade: tuple[float, ...] = ()  # `blitzgs.view.gate.LodGate.fade`; empty: opacities do not fade


N_OPTIONS = len(ProjectionOptions._fields)


class ProjectionInputs(NamedTuple):
    """The inputs of a projection."""

    gaussians: Sequence[Tensor]  # means, quats, scales, opacities and, if given, sh
    cameras: Sequence[Tensor]  # viewmats, Ks
    options: ProjectionOptions  # all other options
    # The Gaussians to consider: the fields of `ActiveRows` (ids, views, length, blocks), of which only ids
    # are required. Empty: all Gaussians in all views.
    active: Sequence[Tensor | None] = ()
    ids: Tensor | None = None  # int64 [N], persistent; None: the splats get no ids
    level: Tensor | None = None  # uint8 [N], octree levels, if opacities fade with them (`fade`)

    @property
    def n_views(self) -> int:
        """The number of views B."""
        return self.cameras[0].shape[0]

    @property
    def active_arguments(self) -> Sequence[Tensor | None]:
        """The four arguments of the op that tell which Gaussians to consider."""
        return (*self.active, *[None] * 4)[:4]


class ProjectionOutputs(NamedTuple):
    """What `blitzgs.ops.project.queue_projection` returns."""

    # as long as the given capacity, if any, without `counts`; undefined if the capacity was too small
    splats: ProjectedSplats
    ids: Tensor  # int64 [P], persistent ids of the splats' Gaussians; [0] if `ProjectionInputs.ids` is None
    # int64 [VIEW_TOTALS + B + 2 M], on the device, right even if the capacity was too small: `Sizes` (with an
    # upper bound of the entries); the number of splats of each view; and for each rank the number of its
    # splats and of the tiles that these touch there.
    totals: Tensor

    @property
    def n_splats(self) -> Tensor:
        """Return the number of splats, int64 [1], on the device."""
        return self.totals[1:2]

    @property
    def n_visible(self) -> Tensor:
        """Return the number of visible Gaussians, int32 [1], on the device: the low half of its total."""
        return self.totals.view(torch.int32)[:1]

    @property
    def for_compositing(self) -> Splats:
        """Return the columns that compositing reads; without SH, the conics stand in for the colours.

        A transport sends every column, so each needs a row for every splat.
        """
        s = self.splats
        colors = s.colors if s.colors.shape[0] == s.conics.shape[0] else s.conics
        return Splats(s.means2d, s.conics, s.opacities, colors, s.depths, s.camera_ids, self.ids)

    def first(self, sizes: Sizes, counts: Tensor | None = None) -> ProjectionOutputs:
        """Return only the valid splats, with their `counts`; `sizes` has the numbers in `totals`."""
        ids = self.ids if self.ids.shape[0] <= sizes.splats else self.ids[: sizes.splats]
        return ProjectionOutputs(splats_of(self.splats, sizes, counts), ids, self.totals)
