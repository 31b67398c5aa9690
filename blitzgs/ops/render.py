# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.host import HostCopy
from blitzgs.ops.projection import ProjectedSplats, ProjectionInputs, capacity_for, splats_of


class Rendered(NamedTuple):
    """The outputs of the three ops; see each op for its fields."""

    splats: ProjectedSplats
    isect_splats: Tensor
    tile_offsets: Tensor
    composited: tuple[Tensor, ...]


def render_queued(
    inputs: ProjectionInputs,
    channels: Callable[[ProjectedSplats], Tensor],
    backgrounds: Tensor | None,
    backward_follows: bool,
    projected: ProjectedSplats | None = None,
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
        projected: the result of `project_splats` for these inputs, if it is already known.
    """
    options = inputs.options
    grid = [inputs.n_views, options.width, options.height, options.tile_size, 0, -1]

    def composite(
        splats: ProjectedSplats, n_isects: int, n_splats: Tensor | None
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        geometry = splats.means2d, splats.conics, splats.opacities
        isect_splats, tile_offsets = torch.ops.blitzgs.intersect(
            *geometry, splats.depths, splats.camera_ids, None, grid, n_isects, n_splats, True
        )
        composited = torch.ops.blitzgs.rasterize_fwd(
            *geometry, channels(splats), backgrounds, isect_splats, tile_offsets, grid, None, True,
            backward_follows, n_splats,
        )  # fmt: skip
        return isect_splats, tile_offsets, composited

    with torch._C._AutoDispatchBelowAutograd():
        if projected is not None:
            return Rendered(projected, *composite(projected, int(projected.counts[2]), None))
        for attempt in capacity_for(inputs).attempts():
            found, capacity = inputs.run(attempt.sizes), attempt.sizes
            read = HostCopy(found.totals).read
            if capacity is None:
                isect_splats, tile_offsets, composited = composite(found.splats, int(read()[2]), None)
            else:
                isect_splats, tile_offsets, composited = composite(
                    found.splats, capacity.isects, found.n_splats
                )
            counts = read()[:3]
            needed = counts.tolist()
            attempt.end(needed, capacity is None or capacity.holds(needed))
        return Rendered(splats_of(found.splats, counts), isect_splats[: needed[2]], tile_offsets, composited)
