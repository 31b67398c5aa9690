# SPDX-License-Identifier: Apache-2.0
"""A projection's arguments in groups, as the ops take them, and the splats that it returns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.capacity import CapacityEstimate, Sizes
from blitzgs.ops.host import HostCopy

# Where the splats of the views begin in `Projected.totals` (kTotalViews of csrc/project/project.h).
VIEW_TOTALS = 4


class ProjectedSplats(NamedTuple):
    """What the views see, ordered by (Gaussian, view): P splats of U different Gaussians."""

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
    rank_masks: Tensor  # int64 [P]: bit m set where rank m wants the splat; [0] where no rank asked
    counts: Tensor  # int64 [3] on the CPU: U, P, and at least the sum of tiles_touched


def splats_of(columns: Sequence[Tensor], counts: Tensor) -> ProjectedSplats:
    """Return the splats that lie in columns with room behind them.

    Args:
        columns: those of `ProjectedSplats` but the last, and perhaps more.
        counts: `ProjectedSplats.counts`.
    """
    visible, splats = counts[:2].tolist()
    lengths = (splats, splats, visible, visible + 1, *(splats,) * 8)
    # No views to autograd: a Function may return those, but a caller could not change them in place.
    with torch._C._AutoDispatchBelowADInplaceOrView():
        return ProjectedSplats._make((*(c[:n] for c, n in zip(columns, lengths, strict=False)), counts))


class Splats(NamedTuple):
    """Splats as compositing sees them; P of them.

    Attributes:
        means2d: [P, 2] pixels.
        conics: [P, 3], inverse 2D covariance (a, b, c).
        opacities: [P].
        colors: [P, D].
        depths: [P].
        camera_ids: int32 [P].
        ids: int64 [P], persistent: what breaks ties of depth.
    """

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    camera_ids: Tensor
    ids: Tensor

    def first(self, count: int) -> Splats:
        """Return the first `count` of them."""
        return Splats(*(column[:count] for column in self))


class ProjectionOptions(NamedTuple):
    """How Gaussians are projected; the arguments of `project` of these names."""

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
        """Return what `ints` and `floats` were of."""
        width, height, tile_size, sh_degree, antialiased, raw = ints
        near_plane, far_plane, eps2d, radius_clip, *fade = floats
        return cls(
            width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip,
            bool(antialiased), bool(raw), tuple(fade),
        )  # fmt: skip

    @property
    def ints(self) -> list[int]:
        """As the ops take them, with `floats`."""
        return [
            self.width, self.height, self.tile_size, self.sh_degree, int(self.antialiased), int(self.raw)
        ]  # fmt: skip

    @property
    def floats(self) -> list[float]:
        """As the ops take them, with `ints`."""
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
    """What is projected, in the groups of arguments that the ops take.

    Attributes:
        gaussians: means, quats, scales, opacities and, unless there are none, sh.
        cameras: viewmats, Ks.
        options: the rest.
        active: which Gaussians to consider, `ActiveRows`: ids, the views of each, how many ids there are,
            of how many blocks; those behind the first may be left out. Empty: all Gaussians in all views.
        ids: int64 [N], persistent, of the Gaussians; None: the splats' are not wanted.
        level: uint8 [N], octree levels, where opacities fade by them (`ProjectionOptions.fade`); else None.
    """

    gaussians: Sequence[Tensor]
    cameras: Sequence[Tensor]
    options: ProjectionOptions
    active: Sequence[Tensor | None] = ()
    ids: Tensor | None = None
    level: Tensor | None = None

    @property
    def n_views(self) -> int:
        """B."""
        return len(self.cameras[0])

    def run(self, capacity: Sizes | None, rank_tiles: Sequence[tuple[int, int]] = ()) -> Projected:
        """Project.

        Args:
            capacity: how many visible Gaussians and splats to have room for: CUDA then does not wait for
                their number. None: as many as there are.
            rank_tiles: the [begin, end) of the tiles that each rank composites, begins ascending.
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
        return Projected(ProjectedSplats._make((*columns, None)), splat_ids, totals)


class Projected(NamedTuple):
    """What `ProjectionInputs.run` returns.

    Attributes:
        splats: with room behind them where a capacity was given; counts are None. Where the capacity was too
            small they mean nothing.
        ids: int64 [P], persistent, of the splats' Gaussians; [0] where none were given.
        totals: int64 [VIEW_TOTALS + B + 2 M], on the device, right in any case: `Sizes` (an upper bound of
            the entries); the splats of each view; and for each rank its splats and the tiles that these touch
            there.
    """

    splats: ProjectedSplats
    ids: Tensor
    totals: Tensor

    @property
    def composited(self) -> Splats:
        """What is composited of the splats."""
        s = self.splats
        return Splats(s.means2d, s.conics, s.opacities, s.colors, s.depths, s.camera_ids, self.ids)


def project_splats(inputs: ProjectionInputs) -> ProjectedSplats:
    """`project` of grouped arguments, without gradients."""
    with torch._C._AutoDispatchBelowAutograd():
        for attempt in capacity_for(inputs).attempts():
            projected = inputs.run(attempt.sizes)
            counts = HostCopy(projected.totals).read()[:3]
            needed = Sizes(*counts.tolist())
            attempt.end(needed, attempt.sizes is None or attempt.sizes.holds(needed[:2]))
        return splats_of(projected.splats[:12], counts)


def capacity_for(inputs: ProjectionInputs) -> CapacityEstimate:
    """Return the estimate that is kept for calls of a size."""
    means = inputs.gaussians[0]
    return _estimate(means.device, len(means), inputs.n_views)


@lru_cache(maxsize=16)
def _estimate(_device: torch.device, _gaussians: int, _views: int) -> CapacityEstimate:
    return CapacityEstimate()
