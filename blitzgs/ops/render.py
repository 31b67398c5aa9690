# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.capacity import CapacityEstimate, Sizes
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
    sizes: Sizes | None = None,
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
        sizes: the needed sizes, if an earlier projection of these Gaussians and views has returned them;
            None: estimate them from earlier calls of this size. Splats whose colour is not finite, which
            touch no tile, need fewer list entries than that projection counted; the others at the end of
            `isect_splats` are then undefined.
    """
    options = inputs.options
    grid = [inputs.n_views, options.width, options.height, options.tile_size, 0, -1]

    known = None if sizes is None else torch.tensor(sizes, device="cpu")
    estimate = capacity_for(inputs) if sizes is None else CapacityEstimate(sizes)
    with torch._C._AutoDispatchBelowAutograd():
        for attempt in estimate.attempts():
            projected, capacity = inputs.run(attempt.sizes), attempt.sizes
            splats, n_splats = projected.splats, None if capacity is None else projected.n_splats
            # Known sizes spare the host a wait.
            read = HostCopy(projected.totals).read if known is None else known.clone
            n_isects = int(read()[2]) if capacity is None else capacity.isects
            geometry = splats.means2d, splats.conics, splats.opacities
            isect_splats, tile_offsets = torch.ops.blitzgs.intersect(
                *geometry, splats.depths, splats.camera_ids, None, grid, n_isects, n_splats, True
            )
            composited = torch.ops.blitzgs.rasterize_fwd(
                *geometry, channels(splats), backgrounds, isect_splats, tile_offsets, grid, None, True,
                backward_follows, n_splats,
            )  # fmt: skip
            counts = read()[:3]
            needed = counts.tolist()
            attempt.end(needed, capacity is None or capacity.holds(needed))
        listed = isect_splats[: needed[2]]
        return Rendered(splats_of(splats, counts), listed, tile_offsets, composited)
