# SPDX-License-Identifier: Apache-2.0
"""The arguments of the projection's ops in groups, and the splats that these ops return.

`blitzgs.ops.project` has the functions that project.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.capacity import Sizes

# Largest number of views of one launch (kMaxViews of csrc/common/kernel.h): an int32 has a bit for each.
MOST_VIEWS = 32
# Where the splats of the views begin in `ProjectionOutputs.totals` (kTotalViews of csrc/project/project.h).
VIEW_TOTALS = 4


class ProjectedSplats(NamedTuple):
    """P splats of U different Gaussians, ordered by (Gaussian, view)."""

    gaussian_ids: Tensor  # int32 [P]
    camera_ids: Tensor  # int32 [P]
    visible_ids: Tensor  # int32 [U], ascending
    splat_offsets: (
        Tensor  # int32 [U + 1]: splats splat_offsets[u] to splat_offsets[u + 1] are of visible_ids[u]
    )
    means2d: Tensor  # [P, 2], px; the centre of pixel (i, j) is (i + 0.5, j + 0.5)
    conics: Tensor  # [P, 3]: a, b, c of the inverse 2D covariance, 1/px^2
    depths: Tensor  # [P]: camera-space z
    opacities: Tensor  # [P]: compensated in antialiased mode
    colors: Tensor  # [P, 3]; [0, 3] without SH
    radii: Tensor  # int32 [P, 2]: half width and height of the box around alpha >= 1/255, rounded up
    tiles_touched: Tensor  # int32 [P]
    rank_masks: Tensor  # int64 [P]: bit m is set if rank m composites the splat; [0] without `rank_tiles`
    counts: Tensor  # int64 [3] on the CPU: U, P, and at least the sum of tiles_touched


def splats_of(allocated: Sequence[Tensor], sizes: Sizes) -> ProjectedSplats:
    """Return the valid splats of columns that were allocated with more capacity.

    Args:
        allocated: a `ProjectedSplats`; its `counts` are not read.
        sizes: numbers of valid Gaussians and splats; `blocks` is not read.
    """
    if allocated[0].shape[0] > sizes.splats or allocated[2].shape[0] > sizes.visible:
        allocated = first_rows(allocated[:12], lengths_of(sizes))
    return ProjectedSplats._make((*allocated[:12], torch.tensor(sizes[:3], device="cpu")))


def lengths_of(sizes: Sizes) -> list[int]:
    """Return the lengths of the columns of `ProjectedSplats` but for `counts`."""
    visible, splats = sizes[:2]
    return [splats, splats, visible, visible + 1, *[splats] * 8]


def first_rows(columns: Sequence[Tensor], lengths: Sequence[int]) -> list[Tensor]:
    """Return the first rows of columns, at most as many as they have.

    Autograd does not see that these are views: a Function may return views, but its caller could not change
    them in place.
    """
    found: list[Tensor] = torch.ops.blitzgs.first_rows(columns, lengths)
    return found


@torch.library.register_fake("blitzgs::first_rows")
def _(columns: Sequence[Tensor], lengths: Sequence[int]) -> list[Tensor]:
    return [column.new_empty(n, *column.shape[1:]) for column, n in zip(columns, lengths, strict=True)]


class Splats(NamedTuple):
    """P splats with the columns that compositing reads.

    Attributes:
        means2d: [P, 2] pixels.
        conics: [P, 3], inverse 2D covariance (a, b, c).
        opacities: [P].
        colors: [P, D].
        depths: [P].
        camera_ids: int32 [P].
        ids: int64 [P], persistent ids of the Gaussians, which order splats of equal depth.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    camera_ids: Tensor
    ids: Tensor

    def first(self, count: int) -> Splats:
        """Return the first `count` splats."""
        return Splats(*first_rows(self, [count] * len(self)))


class ProjectionOptions(NamedTuple):
    """How Gaussians are projected; each field is the argument of `project` of this name."""

    width: int
    height: int
    tile_size: int = 16
    sh_degree: int = 0
    near_plane: float = 0.01
    far_plane: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0
    antialiased: bool = False
    raw: bool = True
    fade: tuple[float, ...] = ()  # `blitzgs.view.gate.LodGate.fade`; empty: opacities do not fade

    @classmethod
    def of(cls, ints: Sequence[int], floats: Sequence[float]) -> ProjectionOptions:
        """Return the options from which `ints` and `floats` were made."""
        width, height, tile_size, sh_degree, antialiased, raw = ints
        near_plane, far_plane, eps2d, radius_clip, *fade = floats
        return cls(
            width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip,
            bool(antialiased), bool(raw), tuple(fade),
        )  # fmt: skip

    @property
    def ints(self) -> list[int]:
        """Return the integer options in the order in which the ops take them."""
        return [
            self.width, self.height, self.tile_size, self.sh_degree, int(self.antialiased), int(self.raw)
        ]  # fmt: skip

    @property
    def floats(self) -> list[float]:
        """Return the float options in the order in which the ops take them."""
        return [self.near_plane, self.far_plane, self.eps2d, self.radius_clip, *self.fade]


class WeightedViews(NamedTuple):
    """B views as the backward ops take them: cameras, and weights of regularisers.

    Attributes:
        viewmats: [B, 4, 4], world to camera.
        Ks: [B, 3, 3], intrinsics in px.
        scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no such
            term.
        opacity_reg: the same of the opacity (without the compensation of antialiased splats).
    """

    viewmats: Tensor
    Ks: Tensor
    scale_reg: Tensor | None = None
    opacity_reg: Tensor | None = None


class ProjectionInputs(NamedTuple):
    """The inputs of a projection, in the groups of arguments that the ops take.

    Attributes:
        gaussians: means, quats, scales, opacities and, if given, sh.
        cameras: viewmats, Ks.
        options: all other options.
        active: the Gaussians to consider: the fields of `ActiveRows` (ids, views, length, blocks), of which
            only ids are required. Empty: all Gaussians in all views.
        ids: int64 [N], persistent ids of the Gaussians; None: do not return the splats' ids.
        level: uint8 [N], octree levels, if opacities fade with them (`ProjectionOptions.fade`); else None.
    """

    gaussians: Sequence[Tensor]
    cameras: Sequence[Tensor]
    options: ProjectionOptions
    active: Sequence[Tensor | None] = ()
    ids: Tensor | None = None
    level: Tensor | None = None

    @property
    def n_views(self) -> int:
        """The number of views B."""
        return self.cameras[0].shape[0]

    def run(self, capacity: Sizes | None, rank_tiles: Sequence[tuple[int, int]] = ()) -> ProjectionOutputs:
        """Project the Gaussians, without gradients.

        Args:
            capacity: numbers of visible Gaussians and splats to allocate; CUDA then does not wait for the
                true numbers. None: wait, and allocate exactly as many as there are.
            rank_tiles: for each rank the [begin, end) of the tiles that it composites, in ascending order.
        """
        *columns, splat_ids, totals = torch.ops.blitzgs.project_fwd(
            list(self.gaussians),
            list(self.cameras),
            [tensor for tensor in self.active if tensor is not None],
            self.options.ints,
            self.options.floats,
            [tile for tiles in rank_tiles for tile in tiles],
            [] if capacity is None else [capacity.visible, capacity.splats],
            self.ids,
            self.level,
        )
        return ProjectionOutputs(ProjectedSplats._make((*columns, None)), splat_ids, totals)


class ProjectionOutputs(NamedTuple):
    """What `ProjectionInputs.run` returns.

    Attributes:
        splats: columns as long as the given capacity, if there was one; `counts` is None. The contents are
            undefined if the capacity was too small.
        ids: int64 [P], persistent ids of the splats' Gaussians; [0] if `ProjectionInputs.ids` is None.
        totals: int64 [VIEW_TOTALS + B + 2 M], on the device, right even if the capacity was too small:
            `Sizes` (with an upper bound of the entries); the number of splats of each view; and for each rank
            the number of its splats and of the tiles that these touch there.
    """

    splats: ProjectedSplats
    ids: Tensor
    totals: Tensor

    @property
    def n_splats(self) -> Tensor:
        """Return the number of splats, int64 [1], on the device."""
        return self.totals[1:2]

    @property
    def for_compositing(self) -> Splats:
        """Return the columns that compositing reads; without SH, the conics stand in for the colours.

        A transport sends every column, so each needs a row for every splat.
        """
        s = self.splats
        colors = s.colors if s.colors.shape[0] == s.conics.shape[0] else s.conics
        return Splats(s.means2d, s.conics, s.opacities, colors, s.depths, s.camera_ids, self.ids)

    def first(self, sizes: Sizes) -> ProjectionOutputs:
        """Return only the valid splats, with their `counts`; `sizes` has the numbers in `totals`."""
        return ProjectionOutputs(splats_of(self.splats, sizes), self.ids[: sizes.splats], self.totals)
