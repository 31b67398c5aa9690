# SPDX-License-Identifier: Apache-2.0
"""The gradient of the projection (`blitzgs.ops.project`): of whole tables, or of rows gathered from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.ops.derivatives import first_only
from blitzgs.ops.projection_types import N_OPTIONS, ProjectedSplats, ProjectionInputs, ProjectionOptions
from blitzgs.ops.sparse_rows import full_gradients
from blitzgs.ops.splat_gradients import packed_table


class TableRows(NamedTuple):
    """The visible rows of tables, gathered for the colours and the backward pass.

    Attributes:
        inputs: the inputs of the projection with these Gaussians alone, and their SH.
        numbers: int32 [U], the rows of `inputs` that are visible.
        indices: int64 [U], their numbers in the tables, as the indices of sparse gradients.
        sh: the SH of all Gaussians in parts, from which the rows' SH were joined; empty: without SH.
    """

    inputs: ProjectionInputs
    numbers: Tensor
    indices: Tensor
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
    """The tensors that `_save` saved, in its groups.

    Attributes:
        gaussians: the rows that were projected: whole tables, or rows that were gathered from tables.
        cameras: viewmats, Ks.
        splats: camera_ids, visible_ids, splat_offsets.
        level: octree levels, if opacities fade with them; else None.
        ids: for gathered rows, their numbers in the tables; else None.
    """

    gaussians: Sequence[Tensor]
    cameras: Sequence[Tensor]
    splats: Sequence[Tensor]
    level: Tensor | None
    ids: Tensor | None

    @classmethod
    def of(cls, ctx: Any) -> _Saved:
        """Read them. Call this once: checkpointing recomputes saved tensors at each reading."""
        *tensors, viewmats, Ks, camera_ids, visible_ids, splat_offsets, level, ids = ctx.saved_tensors  # noqa: N806
        return cls(tensors, (viewmats, Ks), (camera_ids, visible_ids, splat_offsets), level, ids)


def _gradients(
    ctx: Any, needed: Sequence[bool], need_viewmats: bool, sparse: Sequence[bool], v: _Differentiable
) -> Sequence[Tensor | None]:
    """Return the gradients of viewmats and of all gaussians, or of the tables, if they are needed.

    Args:
        ctx: from `_save`.
        needed: which of means, quats, scales, opacities and the given parts of SH need a gradient.
        need_viewmats: whether viewmats need a gradient.
        sparse: which of these gradients are to be sparse.
        v: gradients of the splats; None: zero.
    """
    saved = _Saved.of(ctx)
    return first_only(
        "project",
        lambda: _first_gradients(ctx, saved, needed, need_viewmats, sparse, v),
        (*(ctx.tables or saved.gaussians), saved.cameras[0], *v),
    )


def _first_gradients(
    ctx: Any,
    saved: _Saved,
    needed: Sequence[bool],
    need_viewmats: bool,
    sparse: Sequence[bool],
    v: _Differentiable,
) -> tuple[Tensor | None, ...]:
    """Compute what `_gradients` returns; `saved` has the tensors of `ctx`."""
    _, visible_ids, _ = saved.splats
    gathered = ctx.tables is not None
    all_dense = not gathered and not any(sparse)
    # If all Gaussians are visible, the rows of these are all rows. While torch traces the backward pass, the
    # number of rows is unknown, and tensors are of another type.
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


def _splat_gradients(saved: _Saved, v: _Differentiable) -> list[Tensor]:
    """Return the gradients of means2d, conics, opacities and colors as `project_bwd` takes them."""
    columns = [v.means2d, v.conics, v.opacities] + ([v.colors] if len(saved.gaussians) > 4 else [])
    if v.depths is None and len(columns) == 4 and (table := packed_table(columns)) is not None:
        return [table]
    if all(column is not None for column in columns):
        return columns
    zeros = saved.gaussians[0].new_zeros(saved.splats[0].shape[0], 3)
    parts = (zeros[:, :2], zeros, zeros[:, 0], zeros)
    return [part if column is None else column for column, part in zip(columns, parts, strict=False)]


class ProjectCall(NamedTuple):
    """The arguments of `Project` that have no gradient; see `blitzgs.ops.project.differentiable_splats`."""

    inputs: ProjectionInputs
    sparse_grad: bool
    splats: ProjectedSplats
    rows: TableRows | None


class Project(torch.autograd.Function):
    """Makes the splats of `project_splats` differentiable, as the op `project_fwd` is (see below).

    It is for calls outside of `torch.compile`. Calling an op with a registered formula through torch takes
    0.2 ms of the host's time. Each argument and each result adds to it, so all arguments without a gradient
    are passed as one, and only the columns that have gradients pass through.
    """

    @staticmethod
    def forward(ctx: Any, _viewmats: Tensor, call: ProjectCall, *tables: Tensor) -> Any:
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
    gaussians, viewmats, Ks, *others = inputs  # noqa: N806
    options = ProjectionOptions(*others[6 : 6 + N_OPTIONS])
    # To torch an empty list of numbers is one of tensors, which has an empty list of gradients.
    ctx.no_gradients = [[] if isinstance(x, (list, tuple)) and not x else None for x in (Ks, *others)]
    *columns, _, _ = output
    _save(
        ctx,
        ProjectionInputs(gaussians, (viewmats, Ks), options, level=others[5]),
        ProjectedSplats._make((*columns, None)),
    )


def _backward(ctx: Any, *v_output: Tensor | None) -> Any:
    needed, need_viewmats, *_ = ctx.needs_input_grad
    *v_columns, _, _ = v_output
    v = _Differentiable.of(ProjectedSplats._make((*v_columns, None)))
    v_viewmats, *gradients = _gradients(ctx, needed, need_viewmats, [False] * len(needed), v)
    return gradients, v_viewmats, *ctx.no_gradients


torch.library.register_autograd("blitzgs::project_fwd", _backward, setup_context=_setup_context)
