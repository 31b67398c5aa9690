# SPDX-License-Identifier: Apache-2.0
"""Queues projection, intersection and compositing of one call without waiting for the device in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._torch import saved_tensors_are_hooked
from blitzgs.call.arguments import Gaussians
from blitzgs.call.channels import ImageOptions, channels_of
from blitzgs.frame.capacity import NoEstimate
from blitzgs.frame.run import run
from blitzgs.frame.transport.local import LocalExchange, LocalTransport
from blitzgs.frame.transport.protocol import Exchange
from blitzgs.ops.project_gradient import TableRows
from blitzgs.ops.projection_types import VIEW_TOTALS, ProjectedSplats, ProjectionInputs, first_rows

_EXACT = LocalTransport(NoEstimate())
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
    channels: Callable[[ProjectedSplats], Tensor],
    with_depth: bool,
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
            splats, and `counts` of these splats is None. Not called if `tables` have SH.
        with_depth: whether depths are composited beside the colours of `tables`.
        backgrounds: [B, D] or None.
        backward_follows: see the op `rasterize_fwd`.
        exact: wait for the number of splats, so that no column has spare capacity meanwhile.
        tables: the SH, if they are not part of `inputs`.
    """
    options, means = inputs.options, inputs.gaussians[0]
    gaussians, sh = ((), ()) if tables is None else (inputs.gaussians, tables.parts)
    transport = _EXACT if exact else _transport(means.device, means.shape[0], inputs.n_views)

    def composite(exchange: Exchange) -> tuple[LocalExchange, list[Tensor]]:
        assert isinstance(exchange, LocalExchange)
        _, n_splats, n_isects = exchange.arrived
        splats, totals = exchange.projected.splats, None if n_splats is None else exchange.projected.totals
        if tables is not None:
            # The low half of the first total, the number of visible Gaussians.
            tables.before(splats.visible_ids, None if totals is None else totals.view(torch.int32)[:1])
        return exchange, torch.ops.blitzgs.render(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids,
            splats.visible_ids, splats.splat_offsets, splats.radii, splats.tiles_touched,
            None if sh else channels(splats), with_depth, gaussians, sh, *inputs.cameras, *options,
            backgrounds, n_isects, backward_follows, totals,
        )  # fmt: skip

    result, (exchange, outputs) = run(transport, lambda _: inputs, None, composite)
    splats, (visible, count, isects, *rest) = result.projected, exchange.totals()
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


def queued(
    inputs: ProjectionInputs, gaussians: Gaussians, image: ImageOptions, tables: ShTables | None
) -> Rendered:
    """Queue all work, on CUDA before the host knows the number of splats."""
    # Hooks on saved tensors (checkpointing) need the same shapes each time, without spare capacity.
    hooked = saved_tensors_are_hooked()
    exact = hooked or not inputs.gaussians[0].is_cuda
    signals = None if gaussians.signals is None else gaussians.signals.values
    read = [*inputs.gaussians, *inputs.cameras, gaussians.colors, signals]
    read += () if tables is None else tables.parts
    differentiable = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in read)
    return render_queued(
        inputs,
        lambda splats: channels_of(splats, gaussians, image, with_spare=not exact),
        image.render_mode != "RGB",
        image.backgrounds,
        differentiable and not image.absgrad,
        exact,
        tables,
    )


@lru_cache(maxsize=16)
def _transport(_device: torch.device, _gaussians: int, _views: int) -> LocalTransport:
    """Return the transport, with its estimate of sizes, of all calls of this size."""
    return LocalTransport()


@torch.library.register_fake("blitzgs::render")
def _(
    means2d: Tensor,
    conics: Tensor,
    splat_opacities: Tensor,
    depths: Tensor,
    camera_ids: Tensor,
    visible_ids: Tensor,
    splat_offsets: Tensor,
    radii: Tensor,
    tiles_touched: Tensor,
    channels: Tensor | None,
    with_depth: bool,
    gaussians: Sequence[Tensor],
    sh: Sequence[Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    tile_size: int,
    *others: object,
) -> list[Tensor]:
    *_, n_isects, backward_follows, _totals = others
    splats, count = (means2d, conics, splat_opacities), len(camera_ids)
    rows = []
    if gaussians:
        found = [table.new_empty((len(visible_ids), *table.shape[1:])) for table in gaussians]
        if sh:
            length = sum(part.shape[1] for part in sh)
            found.append(sh[0].new_empty((len(visible_ids), length, 3)))
        indices = visible_ids.new_empty(len(visible_ids), dtype=torch.int64)
        rows = [means2d.new_empty(count if sh else 0, 3), torch.empty_like(visible_ids), indices, *found]
    if channels is None:
        channels = means2d.new_empty(count, 3 + with_depth)
    grid = (viewmats.shape[0], width, height, tile_size, 0, -1)
    lists = torch.ops.blitzgs.intersect(*splats, depths, camera_ids, None, *grid, n_isects, None, True)
    outputs = torch.ops.blitzgs.rasterize_fwd(*splats, channels, None, *lists, *grid, True, backward_follows)
    return [*lists, *outputs, torch.empty_like(outputs[1]), *rows]
