# SPDX-License-Identifier: Apache-2.0
"""Projects Gaussians into pinhole views, with gradients: a splat for each Gaussian that a view sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.derivatives import first_only, full_gradients
from blitzgs.ops.host import to_host
from blitzgs.ops.projection_types import (
    N_OPTIONS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
    splats_of,
)
from blitzgs.ops.splat_gradients import gradient_table_of
from blitzgs.util.errors import check_tensors


class TableRows(NamedTuple):
    """The visible rows of tables, gathered for the colours and the backward pass."""

    inputs: ProjectionInputs  # the inputs of the projection with these Gaussians alone, and their SH
    numbers: Tensor  # int32 [U], the rows of `inputs` that are visible
    indices: Tensor  # int64 [U], their numbers in the tables, as the indices of sparse gradients
    # The SH of all Gaussians in parts, from which the rows' SH were joined; empty: without SH.
    sh: Sequence[Tensor]


def _save(ctx: Any, inputs: ProjectionInputs, splats: ProjectedSplats, rows: TableRows | None = None) -> None:
    """Save what `_gradients` needs: the rows that were projected, their splats, and the shapes of tables."""
    ctx.set_materialize_grads(False)
    read, visible_ids, ids, ctx.tables, ctx.parts = inputs, splats.visible_ids, None, None, []
    if rows is not None:
        read, visible_ids, ids = rows[:3]
        # The tables are not saved: the gradient does not depend on their values, which may change.
        ctx.tables, ctx.parts = (*inputs.gaussians, *rows.sh), [part.shape[1] for part in rows.sh]
    index = splats.camera_ids, visible_ids, splats.splat_offsets
    ctx.save_for_backward(*read.gaussians, *read.cameras, *index, inputs.level, ids)
    ctx.options = inputs.options


class _Differentiable(NamedTuple):
    """The columns of `ProjectedSplats` that have gradients; or these gradients, None for zero."""

    means2d: Any
    conics: Any
    depths: Any
    opacities: Any
    colors: Any

    @classmethod
    def of(cls, splats: ProjectedSplats) -> _Differentiable:
        """Take the columns from all columns."""
        return cls(splats.means2d, splats.conics, splats.depths, splats.opacities, splats.colors)


class _Saved(NamedTuple):
    """The tensors that `_save` saved, in its groups."""

    # The rows that were projected: whole tables, or rows that were gathered from tables.
    gaussians: Sequence[Tensor]
    cameras: Sequence[Tensor]  # viewmats, Ks
    splats: Sequence[Tensor]  # camera_ids, visible_ids, splat_offsets
    level: Tensor | None  # octree levels, if opacities fade with them; else None
    ids: Tensor | None  # for gathered rows, their numbers in the tables; else None

    @classmethod
    def of(cls, ctx: Any) -> _Saved:
        """Read them. Call this once: checkpointing recomputes saved tensors at each reading."""
        *tensors, viewmats, Ks, camera_ids, visible_ids, splat_offsets, level, ids = ctx.saved_tensors
        return cls(tensors, (viewmats, Ks), (camera_ids, visible_ids, splat_offsets), level, ids)


def _gradients(
    ctx: Any, needed: Sequence[bool], need_viewmats: bool, sparse: Sequence[bool], v: _Differentiable
) -> Sequence[Tensor | None]:
    """Return the gradients of viewmats and of all gaussians, or of the tables, if they are needed.

    `needed`: which of means, quats, scales, opacities and the given parts of SH need a gradient; `sparse`:
    which of these are to be sparse. `v`: gradients of the splats; None: zero.
    """
    saved = _Saved.of(ctx)

    def compute() -> Sequence[Tensor | None]:
        _, visible_ids, _ = saved.splats
        gathered = ctx.tables is not None
        all_dense = not gathered and not any(sparse)
        # If all Gaussians are visible, the rows of these are all rows. While torch traces the backward pass,
        # the number of rows is unknown, and tensors are of another type.
        complete = (
            all_dense and type(visible_ids) is Tensor and visible_ids.shape[0] == saved.gaussians[0].shape[0]
        )
        # The kernel writes dense gradients only if all are needed; an unneeded one would cost memory.
        dense = all_dense and not complete and all(needed)
        *gradients, v_viewmats = torch.ops.blitzgs.project_bwd(
            saved.gaussians, *saved.cameras, None, None, *saved.splats, saved.level, *ctx.options,
            _splat_gradients(saved, v), v.depths, need_viewmats, dense,
        )  # fmt: skip
        found: list[Tensor | None] = gradients[: len(saved.gaussians)]
        if len(ctx.parts) > 1:
            # Autograd would copy a gradient that is not contiguous, and its indices with it. Torch adds to an
            # empty sparse gradient in place, so parts share no memory.
            found[4:] = [
                part.clone(memory_format=torch.contiguous_format)
                for part in gradients[4].split_with_sizes(ctx.parts, 1)
            ]
        if not dense:
            found = [gradient if wanted else None for gradient, wanted in zip(found, needed, strict=True)]
        if not dense and not complete:
            ids = visible_ids if saved.ids is None else saved.ids
            shapes = [table.shape for table in ctx.tables or saved.gaussians]
            found = full_gradients(ids, found, shapes, sparse)
        return (v_viewmats if need_viewmats else None, *found)

    return first_only("project", compute, (*(ctx.tables or saved.gaussians), saved.cameras[0], *v))


def _splat_gradients(saved: _Saved, v: _Differentiable) -> list[Tensor]:
    """Return the gradients of means2d, conics, opacities and colors as `project_bwd` takes them."""
    columns = [v.means2d, v.conics, v.opacities] + ([v.colors] if len(saved.gaussians) > 4 else [])
    if v.depths is None and len(columns) == 4 and (table := gradient_table_of(columns)) is not None:
        return [table]
    if all(column is not None for column in columns):
        return columns
    zeros = saved.gaussians[0].new_zeros(saved.splats[0].shape[0], 3)
    parts = (zeros[:, :2], zeros, zeros[:, 0], zeros)
    return [part if column is None else column for column, part in zip(columns, parts, strict=False)]


class _ProjectCall(NamedTuple):
    """The arguments of `_Project` that have no gradient; see `blitzgs.ops.project.differentiable_splats`."""

    inputs: ProjectionInputs
    sparse_grad: bool
    splats: ProjectedSplats
    rows: TableRows | None


class _Project(torch.autograd.Function):
    """Makes the splats of `project_splats` differentiable, as the op `project_fwd` is (see below).

    It is for calls outside of `torch.compile`. Calling an op with a registered formula through torch takes
    0.2 ms of the host's time. Each argument and each result adds to it, so all arguments without a gradient
    are passed as one, and only the columns that have gradients pass through.
    """

    @staticmethod
    def forward(ctx: Any, _viewmats: Tensor, call: _ProjectCall, *tables: Tensor) -> Any:
        """Return the columns of the splats that have gradients; `tables` are the inputs that may need one."""
        _save(ctx, call.inputs, call.splats, call.rows)
        # Means, quats and scales are leaves, or come from operations that accept a sparse gradient.
        ctx.sparse = [
            call.sparse_grad and (i < 3 or call.rows is not None or (len(tables) > 4 and table.is_leaf))
            for i, table in enumerate(tables)
        ]
        return tuple(_Differentiable.of(call.splats))

    @staticmethod
    def backward(ctx: Any, *v_output: Tensor | None) -> Any:
        """Return the gradients of viewmats and of the tables, from those of the columns."""
        need_viewmats, _, *needed = ctx.needs_input_grad
        v = _Differentiable(*v_output)
        v_viewmats, *gradients = _gradients(ctx, needed, need_viewmats, ctx.sparse, v)
        return (v_viewmats, None, *gradients)


def _setup_context(ctx: Any, inputs: Any, output: Any) -> None:
    gaussians, viewmats, Ks, *others = inputs
    options = ProjectionOptions(*others[6 : 6 + N_OPTIONS])
    # To torch an empty list of numbers is one of tensors, which has an empty list of gradients.
    ctx.no_gradients = [[] if isinstance(x, (list, tuple)) and not x else None for x in (Ks, *others)]
    *columns, _, _ = output
    inputs = ProjectionInputs(gaussians, (viewmats, Ks), options, level=others[5])
    _save(ctx, inputs, ProjectedSplats._make((*columns, None)))


def _backward(ctx: Any, *v_output: Tensor | None) -> Any:
    needed, need_viewmats, *_ = ctx.needs_input_grad
    *v_columns, _, _ = v_output
    v = _Differentiable.of(ProjectedSplats._make((*v_columns, None)))
    v_viewmats, *gradients = _gradients(ctx, needed, need_viewmats, [False] * len(needed), v)
    return gradients, v_viewmats, *ctx.no_gradients


torch.library.register_autograd("blitzgs::project_fwd", _backward, setup_context=_setup_context)


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
) -> ProjectedSplats:
    """Project Gaussians into B views (EWA splatting; the image's definition).

    A Gaussian has a splat in a view if it can reach alpha = 1/255 in the image at a depth in (near, far]. A
    Gaussian with NaN or infinite values has no splat; if only its colour is not finite, it has a splat whose
    opacity, colour, radii and tiles are 0. The function is differentiable in means, quats, scales, opacities,
    sh and viewmats. Gradients are dense; the gradient of a pose treats its 12 entries as free. Culling has no
    gradient.

    Args:
        means: [N, 3] in world units, float32 or (CPU) float64; the other tensors share its dtype and device.
        quats: [N, 4] (w, x, y, z), of any length; zero counts as the identity.
        scales: [N, 3] log standard deviations, or standard deviations when not `raw`.
        opacities: [N] logits, or opacities in [0, 1] when not `raw`.
        sh: [N, K, 3] SH coefficients with K >= (sh_degree + 1)^2, coefficient 0 the DC, or None.
        viewmats: [B, 4, 4] world to camera, a rotation and a translation; B <= 32.
        Ks: [B, 3, 3] pinhole intrinsics in px; a view with a skew, or another last row than 0, 0, 1, sees
            nothing.
        width: image width in px.
        height: image height in px.
        active_ids: int32 [A], the rows to consider, ascending; None: all rows.
        active_views: int32 [A], the views to consider for each of these rows, as bits; None: all views.
        tile_size: edge of a tile in px (only for `tiles_touched`).
        sh_degree: degree to evaluate, 0 to 3.
        near_plane: splats have z > near_plane, world units.
        far_plane: splats have z <= far_plane, world units.
        eps2d: variance added to both screen axes, px^2.
        radius_clip: drop splats whose radius is at most this, px.
        antialiased: multiply opacities by sqrt(det / det'), the determinants before and after adding eps2d.
        raw: whether scales and opacities are before their activation.
        sparse_grad: return gradients as sparse tensors of the visible Gaussians, so that no pass over all N
            Gaussians is needed. This holds for means, quats and scales. With `sh`, it also holds for
            opacities and sh if these are leaves; operations that computed them might not accept a sparse
            gradient.

    Returns:
        ProjectedSplats. The bits of a Gaussian's splat in a view do not depend on the other Gaussians and
        views of the call.

    Raises:
        TypeError: an argument is not a tensor.
        RuntimeError: an argument has a wrong shape, dtype or value; the message names it.
        ValueError: `sparse_grad` under `torch.compile`.
    """
    check_tensors(means=means, quats=quats, scales=scales, opacities=opacities, viewmats=viewmats, Ks=Ks)
    if active_views is not None and active_ids is None:
        active_ids = torch.arange(len(means), dtype=torch.int32, device=means.device)
    options = ProjectionOptions(
        width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw
    )
    gaussians = gaussian_tensors(means, quats, scales, opacities, sh)
    inputs = ProjectionInputs(gaussians, (viewmats, Ks), options, (active_ids, active_views))
    return differentiable_splats(inputs, sparse_grad)


def gaussian_tensors(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor | None
) -> list[Tensor]:
    """Return `ProjectionInputs.gaussians`."""
    return [means, quats, scales, opacities, *([] if sh is None else [sh])]


def project_splats(inputs: ProjectionInputs) -> ProjectedSplats:
    """Project as `project` does, with grouped arguments, without gradients. Wait for the number of splats."""
    with below_autograd():
        projected = inputs.project(None)
        return splats_of(projected.splats, Sizes(*to_host(projected.totals)[:3].tolist()))


def differentiable_splats(
    inputs: ProjectionInputs,
    sparse_grad: bool,
    splats: ProjectedSplats | None = None,
    rows: TableRows | None = None,
) -> ProjectedSplats:
    """Project as `project` does, with grouped arguments.

    `sparse_grad`: see `project`. `splats`: the result of `project_splats` for these inputs, if it is already
    known. `rows`: the visible rows of these inputs, if `splats` got their colours from them.
    """
    viewmats, Ks = inputs.cameras
    if not torch.compiler.is_compiling():
        splats = project_splats(inputs) if splats is None else splats
        tables = inputs.gaussians if rows is None else [*inputs.gaussians, *rows.sh]
        call = _ProjectCall(inputs, sparse_grad, splats, rows)
        columns = _Project.apply(viewmats, call, *tables)  # type: ignore[no-untyped-call]
        means2d, conics, depths, opacities, colors = columns
        return splats._replace(
            means2d=means2d, conics=conics, depths=depths, opacities=opacities, colors=colors
        )
    if sparse_grad:
        raise ValueError("sparse_grad is not supported under torch.compile")
    *columns, _, totals = torch.ops.blitzgs.project_fwd(
        list(inputs.gaussians), viewmats, Ks, *inputs.active_arguments, None, inputs.level, *inputs.options,
        [], None, None,
    )  # fmt: skip
    return ProjectedSplats._make((*columns, totals.cpu()[:3]))
