# SPDX-License-Identifier: Apache-2.0
"""Gradients of projected splats, in the two layouts in which compositing hands them to the projection.

Also what the backward pass of compositing needs of the forward pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)

# Where the parts of a splat gradient begin in its floats (csrc/common/kernel.h), and how many these
# are.
_MEAN2D, _CONIC, _OPACITY, _COLOR, _MEAN2D_ABS, SPLAT_GRADIENT = torch.ops.blitzgs.splat_gradient_layout()

# The attribute by which a column carries the table that it is a part of, and its number among the columns.
_TABLE = "_blitzgs_gradient_table"


def gradient_columns(table: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """View a table of splat gradients as columns, from which `gradient_table_of` takes the table.

    `table`: [P, 12], as the op `rasterize_bwd` fills it. Returns gradients of means2d [P, 2], conics [P, 3],
    opacities [P] and colors [P, 3].
    """
    columns = (
        table[:, _MEAN2D : _MEAN2D + 2],
        table[:, _CONIC : _CONIC + 3],
        table[:, _OPACITY],
        table[:, _COLOR : _COLOR + 3],
    )
    for number, column in enumerate(columns):
        setattr(column, _TABLE, (table, number))
    return columns


def gradient_table_of(columns: Sequence[Tensor | None]) -> Tensor | None:
    """Return the table of which `columns` are the `gradient_columns`; None if they are not of one table.

    Autograd hands these columns on as they are, unless something else has a part in a gradient (a second use
    of the splats, a hook): it is then another tensor, which carries no table.
    """
    table, _ = getattr(columns[0], _TABLE, (None, 0))
    parts = (getattr(column, _TABLE, (None, 0)) for column in columns)
    return table if all(of is table and i == n for i, (of, n) in enumerate(parts)) else None


class SplatGradients(NamedTuple):
    """Gradients of P splats in one of two forms."""

    # Columns (v_means2d [P, 2], v_conics [P, 3], v_opacities [P], v_colors [P, 3]); or (CUDA) one table [P,
    # 12].
    parts: Sequence[Tensor]

    @property
    def means2d(self) -> Tensor:
        """The gradient of means2d, [P, 2] per pixel."""
        first = self.parts[0]
        return first[:, _MEAN2D : _MEAN2D + 2] if len(self.parts) == 1 else first

    def side_by_side(self) -> Tensor:
        """Return all columns as one [P, 9]."""
        flat = [column.reshape(len(column), math.prod(column.shape[1:])) for column in self._columns()]
        return torch.cat(flat, 1)

    def sum_returned(self, values: Sequence[Tensor], places: Tensor, splats: int) -> SplatGradients:
        """Return the gradients of P own splats, summed over the ranks in their order; zero if sent nowhere.

        `values`: [n, F] of each rank, the rows of its `side_by_side` for this rank's splats. `places`: from
        `blitzgs.ops.exchange.scatter_splats`.
        """
        columns = self._columns()
        widths = [math.prod(column.shape[1:]) for column in columns]
        sums = torch.ops.blitzgs.sum_splats(values, places, splats, widths)
        return SplatGradients(
            [total.reshape(-1, *like.shape[1:]) for total, like in zip(sums, columns, strict=True)]
        )

    def _columns(self) -> Sequence[Tensor]:
        """Return the four columns."""
        return gradient_columns(self.parts[0]) if len(self.parts) == 1 else self.parts


class RasterizeSaved(NamedTuple):
    """What a forward pass saves for the ops of the backward pass, in the groups that these take."""

    splats: list[Tensor]  # means2d [P, 2], conics [P, 3], splat_opacities [P], colors [P, D]
    backgrounds: Tensor | None  # [B, D]; None: black
    # isect_splats, int32 [I], the splats of each tile, front to back; tile_offsets, int64 [B * T + 1], where
    # each tile's list begins.
    lists: list[Tensor]
    # transmittances [B, H, W], the weight of the background in each pixel; last_ids, int32 [B, H, W], where
    # each pixel's list ended; packed_splats and tile_order, the splats and the order of the tiles in layouts
    # that only the kernels of the backend read.
    composited: list[Tensor]


@dataclass
class GradientBuffer:
    """Memory in which the CUDA backward pass sums the gradients of splats; the forward pass has zeroed it.

    It serves one backward pass; each later one gets other memory.
    """

    zeros: Tensor | None  # [P or more, 12], the last output of `rasterize_fwd`; [0, 12] or None: none
    # Returns zeroed memory for later backward passes. If it is None or returns None, memory is allocated
    # instead.
    others: Callable[[], Tensor | None] | None = None

    def take(self, means2d: Tensor) -> Tensor:
        """Return zeros [P, 12] for the P splats."""
        zeros, self.zeros = self.zeros, None
        count = means2d.shape[0]
        if zeros is not None and zeros.shape[0] >= count:
            return zeros if zeros.shape[0] == count else zeros[:count]
        others = None if self.others is None else self.others()
        return means2d.new_zeros(count, SPLAT_GRADIENT) if others is None else others
