# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.capacity import Attempt, Sizes
from blitzgs.ops.color_rows import VisibleRows, colored_rows
from blitzgs.ops.host import HostCopy
from blitzgs.ops.project import capacity_for
from blitzgs.ops.project_gradient import TableRows
from blitzgs.ops.projection_types import (
    VIEW_TOTALS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOutputs,
    first_rows,
    lengths_of,
)


class Rendered(NamedTuple):
    """The outputs of the ops; see each op for its fields.

    Attributes:
        splats: the splats; their `counts` is None.
        isect_splats: the tiles' lists.
        tile_offsets: where they begin.
        composited: what `rasterize_fwd` returned, and alphas.
        rows: the visible rows, if the SH are in tables of which only these are read.
        has_blank_view: whether some view sees no Gaussian.
    """

    splats: ProjectedSplats
    isect_splats: Tensor
    tile_offsets: Tensor
    composited: Sequence[Tensor]
    rows: TableRows | None
    has_blank_view: bool


class ShTables(NamedTuple):
    """SH of which only the rows of visible Gaussians are read.

    Attributes:
        parts: the SH of all Gaussians in parts, [N, L, 3] each; empty: no SH are rendered.
        before: called before rows are read, with the rows, int32 [A], and the number of those that are
            valid, int32 [1] on the device, or None if all are.
    """

    parts: Sequence[Tensor]
    before: Callable[[Tensor, Tensor | None], object]


def render_queued(
    inputs: ProjectionInputs,
    channels: Callable[[ProjectedSplats], Tensor],
    backgrounds: Tensor | None,
    backward_follows: bool,
    exact: bool,
    tables: ShTables | None = None,
) -> Rendered:
    """Render without gradients; the differentiable ops take this result instead of computing it again.

    If earlier calls had the same size, the host queues all work first and reads the number of splats while
    the GPU works.

    Args:
        inputs: inputs of `project_splats`.
        channels: returns the values to composite, [P, D], from P splats. P may exceed the number of valid
            splats, and `counts` of these splats is None.
        backgrounds: [B, D] or None.
        backward_follows: see the op `rasterize_fwd`.
        exact: wait for the number of splats, so that no column has spare capacity meanwhile.
        tables: the SH, if they are not part of `inputs`.
    """
    options = inputs.options
    grid = [inputs.n_views, options.width, options.height, options.tile_size, 0, -1]
    with below_autograd():
        for attempt in (Attempt(None),) if exact else capacity_for(inputs).attempts():
            capacity = attempt.sizes
            projected = inputs.run(capacity)
            copy = HostCopy(projected.totals)
            splats, rows = projected.splats, None
            if tables is not None:
                splats, rows = _colored(projected, inputs, tables, spare=capacity is not None)
            if capacity is None:
                totals = copy.read().tolist()
                sizes, n_splats = Sizes(*totals[:3]), None
            else:
                sizes, n_splats = capacity, projected.n_splats
            isect_splats, tile_offsets, *composited = torch.ops.blitzgs.list_and_rasterize(
                [splats.means2d, splats.conics, splats.opacities, channels(splats)], splats.depths,
                splats.camera_ids, backgrounds, grid, sizes.isects, backward_follows, n_splats,
            )  # fmt: skip
            if capacity is not None:
                totals = copy.read().tolist()
                sizes = Sizes(*totals[:3])
            attempt.end(sizes[:3], capacity is None or capacity.holds(sizes))
        if capacity is not None:
            splats, isect_splats, rows = _without_spare(splats, isect_splats, rows, sizes)
        of_tables = None if tables is None or rows is None else TableRows(rows, tables.parts)
        in_views = totals[VIEW_TOTALS : VIEW_TOTALS + inputs.n_views]
        return Rendered(splats, isect_splats, tile_offsets, composited, of_tables, 0 in in_views)


def _colored(
    projected: ProjectionOutputs, inputs: ProjectionInputs, tables: ShTables, spare: bool
) -> tuple[ProjectedSplats, VisibleRows]:
    """Colour splats from the tables' rows; spare: whether the splats may have spare capacity."""
    splats, totals = projected.splats, projected.totals if spare else None
    # The low half of the first total, the number of visible Gaussians.
    count = None if totals is None else totals.view(torch.int32)[:1]
    tables.before(splats.visible_ids, count)
    return colored_rows(splats, inputs, tables.parts, totals)


def _without_spare(
    splats: ProjectedSplats, isect_splats: Tensor, rows: VisibleRows | None, needed: Sizes
) -> tuple[ProjectedSplats, Tensor, VisibleRows | None]:
    """Cut spare capacity off all columns, in one operation."""
    own: list[Tensor] = [] if rows is None else [*rows.inputs.gaussians, rows.numbers, rows.indices]
    lengths = [*lengths_of(needed), needed.isects, *[needed.visible] * len(own)]
    found = first_rows([*splats[:12], isect_splats, *own], lengths)
    splats = ProjectedSplats._make((*found[:12], splats.counts))
    if rows is not None:
        *gaussians, numbers, indices = found[13:]
        rows = VisibleRows(rows.inputs._replace(gaussians=gaussians), numbers, indices)
    return splats, found[12], rows
