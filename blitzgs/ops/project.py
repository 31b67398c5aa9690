# SPDX-License-Identifier: Apache-2.0
"""Projection: Gaussians and pinhole views to screen-space rows, one for each Gaussian that a view sees."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)
from blitzgs.ops.derivatives import first_only
from blitzgs.ops.host import tell_host


class Rows(NamedTuple):
    """What the views see, ordered by (Gaussian, view): P rows of U different Gaussians."""

    gaussian_ids: Tensor  # int32 [P]
    camera_ids: Tensor  # int32 [P]
    visible_ids: Tensor  # int32 [U], ascending
    row_offsets: Tensor  # int32 [U + 1]: rows row_offsets[u] to row_offsets[u + 1] are of visible_ids[u]
    means2d: Tensor  # [P, 2], px; the centre of pixel (i, j) is (i + 0.5, j + 0.5)
    conics: Tensor  # [P, 3]: a, b, c of the inverse 2D covariance, 1/px^2
    depths: Tensor  # [P]: camera-space z
    opacities: Tensor  # [P]: compensated in antialiased mode
    colors: Tensor  # [P, 3]; [0, 3] without SH
    radii: Tensor  # int32 [P, 2]: half width and height of the box around alpha >= 1/255, rounded up
    tiles_touched: Tensor  # int32 [P]
    rank_masks: Tensor  # int64 [P]: bit m set where rank m wants the row; [0] where no rank asked
    counts: Tensor  # int64 [3] on the CPU: U, P, and at least the sum of tiles_touched


def rows_of(columns: Sequence[Tensor], counts: Tensor) -> Rows:
    """Return the rows that lie in columns with room behind them.

    Args:
        columns: those of `Rows` but the last, and perhaps more.
        counts: `Rows.counts`.
    """
    visible, rows = counts[:2].tolist()
    lengths = (rows, rows, visible, visible + 1, *(rows,) * 8)
    # No views to autograd: a Function may return those, but nobody might change them in place.
    with torch._C._AutoDispatchBelowADInplaceOrView():
        return Rows._make((*(c[:n] for c, n in zip(columns, lengths, strict=False)), counts))


# Visible Gaussians, rows and row-tile intersections.
Sizes = tuple[int, int, int]


class RowRoom:
    """Room for the rows of a frame and for what is listed of them, by what the frames before needed.

    CUDA then works before the host knows how much there is; where there is too little room it works once
    more.

    Attributes:
        sizes: how much there is room for; zeros: the host waits. Threads may share a room: take its sizes
            once a frame.
    """

    def __init__(self) -> None:
        self.sizes: Sizes = (0, 0, 0)

    def learn(self, needed: Sequence[int]) -> None:
        """Take note of what a frame needed, as `sizes`."""
        # Views differ: what the largest one of late needed, and some more.
        visible, rows, isects = (
            max(n * 9 // 8, size - size // 256) for n, size in zip(needed, self.sizes, strict=True)
        )
        self.sizes = (visible, rows, isects)


def holds(sizes: Sizes, needed: Sequence[int]) -> bool:
    """Tell whether there is room for so many of the first of `sizes`."""
    return all(n <= size for n, size in zip(needed, sizes, strict=False))


def queue_rows(
    arguments: Sequence[Any], sizes: Sizes, ids: Tensor | None = None
) -> tuple[tuple[Tensor, Tensor], Tensor, list[Tensor]]:
    """Have rows written into the room there is for them, without waiting for their number.

    Args:
        arguments: of the op `project_count`, from means to active_count.
        sizes: how much there is room for.
        ids: int64 [N], see `emit_rows`.

    Returns:
        What `emit_rows` takes; the totals of `project_count`, on the device; the columns of `Rows` but
        counts, and the rows' ids, with room behind them and without colours, or nothing: there was no room.
    """
    plan, carry, totals, columns = torch.ops.blitzgs.project_count(*arguments, *sizes[:2], ids)
    return (plan, carry), totals, columns


def color_rows(arguments: Sequence[Any], totals: Tensor, columns: list[Tensor]) -> None:
    """Give the rows of `queue_rows` their colours, as far as there was room for rows."""
    if columns:
        width, height, _, sh_degree = arguments[9:13]
        torch.ops.blitzgs.project_colors_(*arguments[:7], width, height, sh_degree, totals, columns)


def emit_rows(
    arguments: Sequence[Any], planned: tuple[Tensor, Tensor], counts: Tensor, ids: Tensor | None = None
) -> list[Tensor]:
    """Write all rows of a projection, once their number is known.

    Args:
        arguments: as for `queue_rows`.
        planned: from `queue_rows`.
        counts: the totals, on the CPU.
        ids: int64 [N], persistent, of the Gaussians; None: the rows' are not wanted.

    Returns:
        The columns of `Rows` but counts, and the rows' ids.
    """
    return list(torch.ops.blitzgs.project_emit(*arguments, *planned, counts, ids))


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    active_ids: Tensor | None = None,
    active_views: Tensor | None = None,
    tile_size: int = 16,
    sh_degree: int = 0,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    radius_clip: float = 0.0,
    antialiased: bool = False,
    raw: bool = True,
    sparse_grad: bool = False,
) -> Rows:
    """Project Gaussians into B views (EWA splatting; the image's definition).

    A row exists where a Gaussian can reach alpha = 1/255 in the image at a depth in (near, far]. Anything
    NaN or infinite hides its Gaussian: there is no row, or, where only the colour is not finite, one whose
    opacity, colour, radii and tiles are 0. Differentiable in means, quats, scales, opacities, sh and viewmats
    (dense gradients; the pose's as 12 free entries); the culling itself has no gradient.

    Args:
        means: [N, 3] in world units, float32 or (CPU) float64; the other tensors share its dtype and device.
        quats: [N, 4] (w, x, y, z), of any length; zero counts as the identity.
        scales: [N, 3] log standard deviations, or standard deviations when not `raw`.
        opacities: [N] logits, or opacities in [0, 1] when not `raw`.
        sh: [N, K, 3] SH coefficients with K >= (sh_degree + 1)^2, coefficient 0 the DC, or None.
        viewmats: [B, 4, 4] world to camera, a rotation and a translation; B <= 32.
        Ks: [B, 3, 3] pinhole intrinsics in px (no skew).
        width: image width in px.
        height: image height in px.
        active_ids: int32 [A] ascending rows to consider; None for all.
        active_views: int32 [A] bit masks of the views to consider for each; None for all.
        tile_size: edge of a tile in px (only for `tiles_touched`).
        sh_degree: degree to evaluate, 0 to 3.
        near_plane: rows have z > near_plane, world units.
        far_plane: rows have z <= far_plane, world units.
        eps2d: variance added to both screen axes, px^2.
        radius_clip: drop rows that reach no further than this, px.
        antialiased: scale opacities by sqrt(det before / det after) of that addition.
        raw: whether scales and opacities are before their activation.
        sparse_grad: whether gradients of Gaussians are sparse tensors of the visible ones, without a pass
            over all N: those of means, quats and scales, and with `sh` also of opacities and sh where these
            are leaves (what made others of them might not take a sparse gradient).

    Returns:
        Rows, bit-identical for a Gaussian and a view whatever else is projected with them.

    Raises:
        RuntimeError: a wrong shape, dtype or value, by name.
        ValueError: `sparse_grad` under `torch.compile`.
    """
    arguments = (
        means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width, height, tile_size,
        sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
    )  # fmt: skip
    return differentiable_rows(arguments, sparse_grad)


def differentiable_rows(arguments: tuple[Any, ...], sparse_grad: bool, rows: Rows | None = None) -> Rows:
    """`project`, by position.

    Args:
        arguments: from means to raw, in the order of the op.
        sparse_grad: see `project`.
        rows: what `project_rows` returned or would return, if they are there already.
    """
    if not torch.compiler.is_compiling():
        return Rows._make(_Project.apply(*arguments[:6], arguments[6:], sparse_grad, rows))  # type: ignore[no-untyped-call]
    if sparse_grad:
        raise ValueError("sparse_grad is not supported under torch.compile")
    plan, carry, totals, _ = torch.ops.blitzgs.project_count(*arguments, [], [])
    counts = totals.cpu()[:3]
    *emitted, _ = torch.ops.blitzgs.project_emit(*arguments, [], [], None, plan, carry, counts)
    return Rows._make((*emitted, counts))


def project_rows(*arguments: Any) -> Rows:
    """`project` without gradients, with the positional arguments of its ops, from means to raw."""
    room = room_for(*arguments)
    sizes = room.sizes
    arguments = (*arguments, [], [], None)
    with torch._C._AutoDispatchBelowAutograd():
        planned, totals, columns = queue_rows(arguments, sizes)
        with tell_host(totals) as told:
            color_rows(arguments, totals, columns)
            counts = told()[:3]
        needed = counts.tolist()
        if not columns or not holds(sizes, needed[:2]):
            columns = emit_rows(arguments, planned, counts)
    room.learn(needed)
    return rows_of(columns, counts)


def room_for(*arguments: Any) -> RowRoom:
    """Return the room that is kept for calls of `project_rows` of a size."""
    means, viewmats = arguments[0], arguments[5]
    return _room(means.device, len(means), len(viewmats))


@lru_cache(maxsize=16)
def _room(_device: torch.device, _gaussians: int, _views: int) -> RowRoom:
    """Return the room that is kept for calls of a size."""
    return RowRoom()


@torch.library.register_fake("blitzgs::project_count")
def _(means: Tensor, *rest: Any) -> Any:
    context = torch.library.get_ctx()
    viewmats, tile_begins = rest[4], rest[18]
    return (
        means.new_empty(context.new_dynamic_size(), dtype=torch.int64),
        means.new_empty(context.new_dynamic_size(), dtype=torch.uint8),
        means.new_empty(3 + viewmats.shape[0] + 2 * len(tile_begins), dtype=torch.int64),
        [],
    )


@torch.library.register_fake("blitzgs::project_emit")
def _(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor | None, *rest: Any) -> Any:
    context = torch.library.get_ctx()
    U, P = context.new_dynamic_size(), context.new_dynamic_size()
    tile_begins = rest[14]

    def ints(*shape: Any) -> Tensor:
        return means.new_empty(shape, dtype=torch.int32)

    return (
        ints(P),
        ints(P),
        ints(U),
        ints(U + 1),
        means.new_empty(P, 2),
        means.new_empty(P, 3),
        means.new_empty(P),
        means.new_empty(P),
        means.new_empty(0 if sh is None else P, 3),
        ints(P, 2),
        ints(P),
        means.new_empty(P if tile_begins else 0, dtype=torch.int64),
        means.new_empty(P if any(ids is not None for ids in rest[20:]) else 0, dtype=torch.int64),
    )


@torch.library.register_fake("blitzgs::project_bwd")
def _(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    camera_ids: Tensor,
    visible_ids: Tensor,
    *rest: Any,
) -> Any:
    dense = any(rest[19:])
    length = (means if dense else visible_ids).shape[0]
    return (
        means.new_empty(length, 3),
        means.new_empty(length, 4),
        means.new_empty(length, 3),
        means.new_empty(length),
        means.new_empty(length, 0 if sh is None else sh.shape[1], 3),
        means.new_empty(viewmats.shape[0] if rest[13] else 0, 4, 4),
    )


def _setup_context(ctx: Any, inputs: Any, output: Any) -> None:
    means, quats, scales, opacities, sh, viewmats, Ks = inputs[:7]
    width, height, _, sh_degree = inputs[9:13]
    eps2d, _, antialiased, raw = inputs[15:19]
    rows = Rows._make((*output[:12], None))
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(
        means, quats, scales, opacities, sh, viewmats, Ks, rows.camera_ids, rows.visible_ids, rows.row_offsets
    )
    ctx.options = (width, height, sh_degree, eps2d, antialiased, raw)
    ctx.sparse = (False,) * 5


def _backward(ctx: Any, *v_output: Tensor | None) -> Any:
    return (*_gradients(ctx, v_output[:12]), *(None,) * 20)


def _gradients(ctx: Any, v_output: tuple[Tensor | None, ...]) -> tuple[Tensor | None, ...]:
    """Return the gradients of means, quats, scales, opacities, sh and viewmats, where they are needed."""
    saved = ctx.saved_tensors  # read once: checkpointing recomputes them for each reading
    with torch.no_grad():
        gradients = _first_gradients(ctx, saved, v_output)
    return first_only("project", gradients, (*saved[:6], *v_output))


def _first_gradients(
    ctx: Any, saved: tuple[Any, ...], v_output: tuple[Tensor | None, ...]
) -> tuple[Tensor | None, ...]:
    parameters, (viewmats, Ks, *rows) = saved[:5], saved[5:]
    means, *_, sh = parameters
    *needed, need_viewmats = ctx.needs_input_grad[:6]
    # Where all are to be dense, the kernel writes them so; a dense one that nobody needs would cost memory.
    dense = not any(ctx.sparse) and all(needed if sh is not None else needed[:4])
    *gradients, v_viewmats = torch.ops.blitzgs.project_bwd(
        *parameters, viewmats, Ks, *rows, *ctx.options, *_row_gradients(means, sh, rows[0], v_output), None,
        need_viewmats, dense=dense,
    )  # fmt: skip
    if not dense:
        ids = rows[1].long()
        columns = zip(parameters, gradients, ctx.sparse, needed, strict=True)
        gradients = [_of_all(ids, *column) if wanted else None for *column, wanted in columns]
    elif sh is None:
        gradients[4] = None
    return (*gradients, v_viewmats if need_viewmats else None)


def _of_all(ids: Tensor, parameter: Tensor, gradient: Tensor, sparse: bool) -> Tensor:
    """Return the gradient of a whole parameter, from that of its rows `ids`."""
    if sparse:
        return torch.sparse_coo_tensor(
            ids[None], gradient, parameter.shape, is_coalesced=True, check_invariants=False
        )
    return torch.zeros_like(parameter).index_copy_(0, ids, gradient)


def _row_gradients(
    means: Tensor, sh: Tensor | None, camera_ids: Tensor, v_output: tuple[Tensor | None, ...]
) -> tuple[Tensor | None, ...]:
    """Return the gradients of means2d, conics, depths, opacities and colors as `project_bwd` takes them."""
    v = Rows._make((*v_output, None))
    needed = [v.means2d, v.conics, v.opacities] + ([] if sh is None else [v.colors])
    if any(gradient is None for gradient in needed):
        zeros = means.new_zeros(len(camera_ids), 3)
        v = v._replace(
            means2d=zeros[:, :2] if v.means2d is None else v.means2d,
            conics=zeros if v.conics is None else v.conics,
            opacities=zeros[:, 0] if v.opacities is None else v.opacities,
            colors=zeros if v.colors is None and sh is not None else v.colors,
        )
    return v.means2d, v.conics, v.depths, v.opacities, v.colors


class _Project(torch.autograd.Function):
    """`project_rows` with the formula registered below, outside of `torch.compile`.

    The way through torch to a registered formula takes 0.2 ms of the host's time, and each argument some:
    those without a gradient are one. Counts are no output of the op.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        *parameters, options, sparse_grad, rows = arguments
        inputs = (*parameters, *options)
        if rows is None:
            rows = project_rows(*inputs)
        _setup_context(ctx, inputs, rows[:-1])
        ctx.mark_non_differentiable(rows.counts)
        if sparse_grad:
            opacities, sh = parameters[3:5]
            ctx.sparse = (True, True, True, *(sh is not None and t.is_leaf for t in (opacities, sh)))
        return tuple(rows)

    @staticmethod
    def backward(ctx: Any, *v_output: Tensor | None) -> Any:
        return (*_gradients(ctx, v_output[:-1]), None, None, None)


torch.library.register_autograd("blitzgs::project_emit", _backward, setup_context=_setup_context)
