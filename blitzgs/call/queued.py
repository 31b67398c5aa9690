# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._torch import hooks_on_saved_tensors
from blitzgs.call.arguments import Gaussians
from blitzgs.call.channels import ImageOptions, channels_of
from blitzgs.frame.run import run
from blitzgs.frame.transport.local import LocalExchange, LocalTransport
from blitzgs.frame.transport.protocol import Exchange
from blitzgs.ops.project import TableRows
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectedSplats, ProjectionInputs, first_rows

_EXACT = LocalTransport(exact=True)
# What the op `render` returns before the colours and rows.
_LISTS, _IMAGES = 2, 8


class Rendered(NamedTuple):
    """The outputs of the ops; see each op for its fields.

    Attributes:
        splats: the splats.
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
    gaussians: Gaussians,
    image: ImageOptions,
    plain: bool,
    tables: ShTables | None = None,
) -> Rendered:
    """Render without gradients; the differentiable ops take this result instead of computing it again.

    If earlier calls had the same size, the host queues all work first and reads the number of splats while
    the GPU works.

    Args:
        inputs: inputs of `project_splats`.
        gaussians: the Gaussians and views.
        image: options of compositing.
        plain: whether the colours that the projection computes are all channels.
        tables: the SH, if they are not part of `inputs`.
    """
    options, means, signals = inputs.options, inputs.gaussians[0], gaussians.signals
    rows_of, sh = ((), ()) if tables is None else (inputs.gaussians, tables.parts)
    # Hooks on saved tensors (checkpointing) need the same shapes each time, without spare capacity.
    exact = not means.is_cuda or hooks_on_saved_tensors(True) is not None
    transport = _EXACT if exact else _transport(means.device, means.shape[0], inputs.n_views)
    read = [*inputs.gaussians, *inputs.cameras, gaussians.colors, *sh, signals and signals.values]
    needed = [t for t in read if t is not None and t.requires_grad] if torch.is_grad_enabled() else []
    backward_follows = len(needed) > 0 and not image.absgrad

    def composite(exchange: Exchange) -> tuple[LocalExchange, list[Tensor]]:
        assert isinstance(exchange, LocalExchange)
        _, n_splats, n_isects = exchange.arrived
        splats, totals = exchange.projected.splats, None if n_splats is None else exchange.projected.totals
        if tables is not None:
            # The low half of the first total, the number of visible Gaussians.
            tables.before(splats.visible_ids, None if totals is None else totals.view(torch.int32)[:1])
        channels = None
        if not sh:
            channels = splats.colors if plain else channels_of(splats, gaussians, image, not exact)
        return exchange, torch.ops.blitzgs.render(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids,
            splats.visible_ids, splats.splat_offsets, splats.radii, splats.tiles_touched,
            channels, image.render_mode != "RGB", rows_of, sh, *inputs.cameras, *options,
            image.backgrounds, n_isects, backward_follows, totals,
        )  # fmt: skip

    result, (exchange, outputs) = run(transport, inputs, None, composite)
    assert exchange.totals is not None
    splats, (visible, count, isects, *rest) = result.projected, exchange.totals
    isect_splats, tile_offsets, *images = outputs[: _LISTS + _IMAGES]
    of_rows = outputs[_LISTS + _IMAGES :]
    if isect_splats.shape[0] > isects or (of_rows and of_rows[1].shape[0] > visible):
        # Cut spare capacity off, in one operation.
        lengths = [isects, *([count, *[visible] * (len(of_rows) - 1)] if of_rows else [])]
        isect_splats, *of_rows = first_rows([isect_splats, *of_rows], lengths)
    rows = None
    if tables is not None:
        colors, numbers, indices, *found = of_rows
        splats = splats._replace(colors=colors)
        rows = TableRows(inputs._replace(gaussians=found), numbers, indices, sh)
    has_blank_view = 0 in rest[VIEW_TOTALS - 3 :]
    return Rendered(splats, isect_splats, tile_offsets, images, rows, has_blank_view)


@lru_cache(maxsize=16)
def _transport(_device: torch.device, _gaussians: int, _views: int) -> LocalTransport:
    """Return the transport, with its estimate of sizes, of all calls of this size."""
    return LocalTransport()
