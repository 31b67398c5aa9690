# SPDX-License-Identifier: Apache-2.0
"""Projects Gaussians into pinhole views, with gradients: a splat for each Gaussian that a view sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.derivatives import first_only, full_gradients
from blitzgs.ops.host import to_host
from blitzgs.ops.intersect import TILE_SIZE
from blitzgs.ops.projection_types import (
    N_OPTIONS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    ProjectionOutputs,
    Sizes,
    splats_of,
)
from blitzgs.ops.rasterize import gradient_table_of
from blitzgs.util.errors import check_tensors

# The columns of `ProjectedSplats` that have gradients: means2d, conics, depths, opacities, colors.
_LEARNED = slice(4, 9)


def _save(ctx: Any, inputs: ProjectionInputs, splats: Sequence[Tensor]) -> None:
    """Save what `_gradients` needs; `splats`: the columns of `ProjectedSplats`."""
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs.gaussians, *inputs.cameras, *splats[1:4], inputs.level)
    ctx.options = inputs.options


def _gradients(
    ctx: Any,
    needed: Sequence[bool],  # which of means, quats, scales, opacities and, if given, SH need a gradient
    need_viewmats: bool,
    sparse: Sequence[bool],  # which of these gradients are to be sparse
    v: Sequence[Tensor | None],  # gradients of the columns `_LEARNED`; None: zero
) -> Sequence[Tensor | None]:
    """Return the gradients of viewmats and of all gaussians, if they are needed."""
    # Read once: checkpointing recomputes saved tensors at each reading.
    *gaussians, viewmats, Ks, camera_ids, visible_ids, splat_offsets, level = ctx.saved_tensors

    def compute() -> Sequence[Tensor | None]:
        all_dense, means = not any(sparse), gaussians[0]
        # If all Gaussians are visible, their rows are all rows. While torch traces, their number is unknown.
        complete = all_dense and type(visible_ids) is Tensor and visible_ids.shape[0] == means.shape[0]
        # The kernel writes dense gradients only if all are needed; an unneeded one would cost memory.
        dense = all_dense and not complete and all(needed)
        *gradients, v_viewmats = torch.ops.blitzgs.project_bwd(
            gaussians, viewmats, Ks, None, None, camera_ids, visible_ids, splat_offsets, level, *ctx.options,
            _splat_gradients(v, means, camera_ids.shape[0], len(gaussians) > 4), v[2], need_viewmats, dense,
        )  # fmt: skip
        found: list[Tensor | None] = gradients[: len(gaussians)]
        if not dense:
            found = [gradient if wanted else None for gradient, wanted in zip(found, needed, strict=True)]
            if not complete:
                found = full_gradients(visible_ids, found, [table.shape for table in gaussians], sparse)
        return (v_viewmats if need_viewmats else None, *found)

    return first_only("project", compute, (*gaussians, viewmats, *v))


def _splat_gradients(v: Sequence[Tensor | None], like: Tensor, count: int, with_sh: bool) -> list[Tensor]:
    """Return the gradients of means2d, conics, opacities and colors as `project_bwd` takes them."""
    v_means2d, v_conics, v_depths, v_opacities, v_colors = v
    columns = [v_means2d, v_conics, v_opacities] + ([v_colors] if with_sh else [])
    if v_depths is None and with_sh and (table := gradient_table_of(columns)) is not None:
        return [table]
    if any(column is None for column in columns):
        zeros = like.new_zeros(count, 3)
        parts = (zeros[:, :2], zeros, zeros[:, 0], zeros)
        columns = [part if column is None else column for column, part in zip(columns, parts, strict=False)]
    return columns  # type: ignore[return-value]


class _Project(torch.autograd.Function):
    """Makes the splats of `project_splats` differentiable, as the op `project_fwd` is (see below).

    It is for calls outside of `torch.compile`. Calling an op with a registered formula through torch takes
    0.2 ms of the host's time. Each argument and each result adds to it, so all arguments without a gradient
    are passed as one, and only the columns that have gradients pass through.
    """

    @staticmethod
    def forward(
        ctx: Any, _viewmats: Tensor, call: tuple[ProjectionInputs, bool, ProjectedSplats], *tables: Tensor
    ) -> Any:
        """Return the columns of the splats that have gradients; `tables` are the Gaussians of the inputs."""
        inputs, sparse_grad, splats = call
        _save(ctx, inputs, splats)
        # Means, quats and scales are leaves, or come from operations that accept a sparse gradient.
        ctx.sparse = [
            sparse_grad and (i < 3 or (len(tables) > 4 and table.is_leaf)) for i, table in enumerate(tables)
        ]
        return splats[_LEARNED]

    @staticmethod
    def backward(ctx: Any, *v_output: Tensor | None) -> Any:
        """Return the gradients of viewmats and of the tables, from those of the columns."""
        need_viewmats, _, *needed = ctx.needs_input_grad
        v_viewmats, *gradients = _gradients(ctx, needed, need_viewmats, ctx.sparse, v_output)
        return (v_viewmats, None, *gradients)


def _setup_context(ctx: Any, inputs: Any, output: Any) -> None:
    gaussians, viewmats, Ks, *others = inputs
    options = ProjectionOptions(*others[6 : 6 + N_OPTIONS])
    # To torch an empty list of numbers is one of tensors, which has an empty list of gradients.
    ctx.no_gradients = [[] if isinstance(x, (list, tuple)) and not x else None for x in (Ks, *others)]
    _save(ctx, ProjectionInputs(gaussians, (viewmats, Ks), options, level=others[5]), output)


def _backward(ctx: Any, *v_output: Tensor | None) -> Any:
    needed, need_viewmats, *_ = ctx.needs_input_grad
    v_viewmats, *gradients = _gradients(ctx, needed, need_viewmats, [False] * len(needed), v_output[_LEARNED])
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
    tile_size: int = TILE_SIZE,
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
        width, height, near_plane, far_plane, eps2d, radius_clip: as in `blitzgs.rasterization`.
        active_ids: int32 [A], the rows to consider, ascending, each once (the CPU checks it); None: all rows.
        active_views: int32 [A], the views to consider for each of these rows, as bits; None: all views.
        tile_size: edge of a tile in px (only for `tiles_touched`).
        sh_degree: degree to evaluate, 0 to 3.
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
    elif active_ids is not None and active_ids.is_cpu and not torch.compiler.is_compiling():
        edges = active_ids.new_tensor([-1]), active_ids.flatten(), active_ids.new_tensor([len(means)])
        if (torch.cat(edges).diff() <= 0).any():
            most = len(means) - 1
            raise RuntimeError(f"project: active_ids must be rows 0 to {most}, ascending, each once")
    options = ProjectionOptions(
        width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw
    )
    gaussians = [means, quats, scales, opacities, *([] if sh is None else [sh])]
    inputs = ProjectionInputs(gaussians, (viewmats, Ks), options, (active_ids, active_views))
    return differentiable_splats(inputs, sparse_grad)


def queue_projection(
    inputs: ProjectionInputs, capacity: Sizes | None, rank_tiles: Sequence[tuple[int, int]] = ()
) -> ProjectionOutputs:
    """Project as `project` does, with grouped arguments, without gradients.

    `capacity`: numbers of visible Gaussians and splats to allocate; CUDA then does not wait for the true
    numbers. None: wait, and allocate exactly as many as there are. `rank_tiles`: for each rank the [begin,
    end) of the tiles that it composites, in ascending order.
    """
    room = (None, None) if capacity is None else capacity[:2]
    *columns, splat_ids, totals = torch.ops.blitzgs.project_fwd(
        inputs.gaussians, *inputs.cameras, *inputs.active_arguments, inputs.ids, inputs.level,
        *inputs.options, [tile for tiles in rank_tiles for tile in tiles], *room,
    )  # fmt: skip
    return ProjectionOutputs(ProjectedSplats._make((*columns, None)), splat_ids, totals)


def project_splats(inputs: ProjectionInputs) -> ProjectedSplats:
    """Project as `queue_projection` does, and wait for the number of splats."""
    with below_autograd():
        projected = queue_projection(inputs, None)
        return splats_of(projected.splats, Sizes(*to_host(projected.totals)[:3].tolist()))


def differentiable_splats(
    inputs: ProjectionInputs,
    sparse_grad: bool,  # see `project`
    splats: ProjectedSplats | None = None,  # `project_splats` of these inputs, if it is already known
) -> ProjectedSplats:
    """Project as `project` does, with grouped arguments."""
    viewmats, Ks = inputs.cameras
    if not torch.compiler.is_compiling():
        splats = project_splats(inputs) if splats is None else splats
        columns = _Project.apply(viewmats, (inputs, sparse_grad, splats), *inputs.gaussians)  # type: ignore[no-untyped-call]
        return ProjectedSplats._make((*splats[: _LEARNED.start], *columns, *splats[_LEARNED.stop :]))
    if sparse_grad:
        raise ValueError("sparse_grad is not supported under torch.compile")
    *columns, _, totals = torch.ops.blitzgs.project_fwd(
        list(inputs.gaussians), viewmats, Ks, *inputs.active_arguments, None, inputs.level, *inputs.options,
        [], None, None,
    )  # fmt: skip
    return ProjectedSplats._make((*columns, totals.cpu()[:3]))
