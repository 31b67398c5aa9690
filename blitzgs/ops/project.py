# SPDX-License-Identifier: Apache-2.0
"""Projects Gaussians into pinhole views, with gradients: a splat for each Gaussian that a view sees."""

from __future__ import annotations

import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.ops.host import to_host
from blitzgs.ops.project_gradient import Project, ProjectCall, TableRows
from blitzgs.ops.projection_types import (
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
    splats_of,
)


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
        RuntimeError: an argument has a wrong shape, dtype or value; the message names it.
        ValueError: `sparse_grad` under `torch.compile`.
    """
    if active_views is not None and active_ids is None:
        active_ids = torch.arange(len(means), dtype=torch.int32, device=means.device)
    inputs = ProjectionInputs(
        gaussian_tensors(means, quats, scales, opacities, sh),
        (viewmats, Ks),
        ProjectionOptions(
            width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw
        ),
        [tensor for tensor in (active_ids, active_views) if tensor is not None],
    )
    return differentiable_splats(inputs, sparse_grad)


def gaussian_tensors(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor | None
) -> list[Tensor]:
    """Return `ProjectionInputs.gaussians`."""
    return [means, quats, scales, opacities, *([] if sh is None else [sh])]


def project_splats(inputs: ProjectionInputs) -> ProjectedSplats:
    """Project as `project` does, with grouped arguments, without gradients. Wait for the number of splats.

    Args:
        inputs: the inputs of the projection.
    """
    with below_autograd():
        projected = inputs.run(None)
        return splats_of(projected.splats, Sizes(*to_host(projected.totals)[:3].tolist()))


def differentiable_splats(
    inputs: ProjectionInputs,
    sparse_grad: bool,
    splats: ProjectedSplats | None = None,
    rows: TableRows | None = None,
) -> ProjectedSplats:
    """Project as `project` does, with grouped arguments.

    Args:
        inputs: the inputs of the projection.
        sparse_grad: see `project`.
        splats: the result of `project_splats` for these inputs, if it is already known.
        rows: the visible rows of these inputs, if `splats` got their colours from them.
    """
    viewmats, Ks = inputs.cameras  # noqa: N806
    if not torch.compiler.is_compiling():
        splats = project_splats(inputs) if splats is None else splats
        tables = inputs.gaussians if rows is None else [*inputs.gaussians, *rows.sh]
        call = ProjectCall(inputs, sparse_grad, splats, rows)
        columns = Project.apply(viewmats, call, *tables)  # type: ignore[no-untyped-call]
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
