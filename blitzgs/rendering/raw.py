# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.raw_rasterization`: renders raw parameters, at a cost that follows the visible Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from blitzgs.lazy_dict import LazyDict
from blitzgs.ops.gather_rows import gather_rows, split_rows
from blitzgs.ops.projection import ProjectionOptions, project_splats
from blitzgs.ops.render import ShTables
from blitzgs.ops.sparse_rows import full_gradients
from blitzgs.rendering.arguments import (
    Gaussians,
    Scene,
    background_rows,
    check_options,
    check_tensors,
    gaussians_of,
)
from blitzgs.rendering.groups import groups_of
from blitzgs.rendering.images import ImageOptions, may_queue, render


class CatchesUp(Protocol):
    """An optimiser that may have pending steps, such as `blitzgs.optim.LazyAdam`."""

    def catch_up(
        self,
        params: Iterable[Tensor] | None = None,
        rows: Tensor | None = None,
        count: Tensor | None = None,
    ) -> None:
        """Apply the pending steps of rows of parameters, see `blitzgs.optim.LazyAdam.catch_up`."""


def raw_rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = True,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    optimizers: CatchesUp | Iterable[Any] | Mapping[str, Any] = (),
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians from the parameters that gsplat's trainer learns, before their activation.

    The result is that of `blitzgs.rasterization` with `exp(scales)`, `sigmoid(opacities)` and `cat([sh0,
    shN], 1)`, but none of these tensors is made: the function first finds the visible Gaussians, and only
    gathers, activates and renders these. Gradients are sparse and have only the visible Gaussians, so the
    parameters must be leaves.

    Args:
        means: [N, 3] in world units, float32, or float64 on the CPU.
        quats: [N, 4] (w, x, y, z), need not be normalised.
        scales: [N, 3] logarithms of standard deviations.
        opacities: [N] logits.
        sh0: [N, 1, 3], the first SH coefficient; or all of them, [N, K, 3], with shN None.
        shN: [N, K - 1, 3], the other SH coefficients.
        viewmats: [C, 4, 4] world to camera, a rotation and a translation.
        Ks: [C, 3, 3] intrinsics in px.
        width: image width in px.
        height: image height in px.
        near_plane: as for `blitzgs.rasterization`, like the next three.
        far_plane: likewise.
        radius_clip: likewise.
        eps2d: likewise.
        sh_degree: degree to evaluate, 0 to 3; None: the highest degree that the coefficients have.
        tile_size: as for `blitzgs.rasterization`, like the next two.
        backgrounds: likewise.
        render_mode: likewise.
        sparse_grad: False: dense gradients, for optimisers that take no others.
        absgrad: as for `blitzgs.rasterization`, like the next.
        rasterize_mode: likewise.
        optimizers: the parameters' optimisers, as a mapping or a sequence. Each `blitzgs.optim.LazyAdam`
            among them catches up the rows that this call reads: the geometry of all Gaussians, and the SH of
            the visible ones.

    Returns:
        As `blitzgs.rasterization(..., packed=True)`.

    Raises:
        TypeError: as `blitzgs.rasterization`, like the next two.
        ValueError: likewise.
        RuntimeError: likewise.
    """
    check_options(width, height, render_mode, rasterize_mode, "pinhole", tile_size)
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh0": sh0}
    check_tensors({**tensors, "viewmats": viewmats, "Ks": Ks}, {"shN": shN, "backgrounds": backgrounds})
    if means.dim() != 2:
        raise ValueError(f"means must be [N, 3], got {list(means.shape)}")
    harmonics = [sh0] if shN is None else [sh0, shN]
    sh_degree = _checked_degree(harmonics, len(means), sh_degree, "RGB" in render_mode)
    antialiased = rasterize_mode == "antialiased"
    project = ProjectionOptions(
        width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, True
    )
    geometry = (means, quats, scales, opacities)
    whole = gaussians_of(means, quats, scales, opacities, None, viewmats, Ks, None, False, raw=True)
    lazy = _lazy(optimizers)
    for optimizer in lazy:
        optimizer.catch_up(geometry)
    shaded = "RGB" in render_mode
    named = {name: (tensor,) for name, tensor in tensors.items()}
    named |= {"viewmats": (viewmats,), "Ks": (Ks,), **({} if shN is None else {"shN": (shN,)})}
    colors, degree = (sh0, sh_degree) if shaded else (None, None)
    gaussians = Gaussians(whole.scenes, colors, opacities, degree, False, whole.lead, True, named)
    image = ImageOptions(
        render_mode, background_rows(backgrounds, gaussians, render_mode), True, sparse_grad, absgrad
    )

    def before(rows: Tensor, count: Tensor | None) -> None:
        for optimizer in lazy:
            optimizer.catch_up(harmonics, rows, count)

    groups = groups_of(gaussians, project)
    if may_queue(groups):
        tables = ShTables(harmonics if shaded else (), before)
        return render("raw_rasterization", gaussians, project, image, tables=tables, groups=groups)
    # Several groups, or none of Gaussians: gather the rows that any of them sees, and render these.
    ids = torch.cat([project_splats(group.inputs).visible_ids for group in groups]).unique()
    before(ids, None)
    means, quats, scales, opacities, sh = _Visible.apply(  # type: ignore[no-untyped-call]
        ids, sparse_grad, *geometry, *(harmonics if shaded else ())
    )
    scene = Scene(means, quats, scales, opacities, sh, viewmats, Ks)
    gaussians = replace(gaussians, scenes=(scene,), colors=sh, opacities=opacities)
    renders, alphas, meta = render("raw_rasterization", gaussians, project, image._replace(sparse_grad=False))
    assert isinstance(meta, LazyDict)
    meta.change("gaussian_ids", lambda index_in_visible: ids.long()[index_in_visible])
    return renders, alphas, meta


def _lazy(optimizers: Any) -> list[CatchesUp]:
    """Return the optimisers that may have pending steps; those that step together are one."""
    given = optimizers.values() if isinstance(optimizers, Mapping) else optimizers
    if hasattr(optimizers, "catch_up"):
        given = [optimizers]
    found: list[CatchesUp] = []
    joints: list[Any] = []
    for optimizer in given:
        joint = getattr(optimizer, "joint", None)
        if joint is not None and any(joint is other for other in joints):
            continue
        if joint is not None and joint.is_current():
            joints.append(joint)
            found.append(joint)
        elif hasattr(optimizer, "catch_up"):
            found.append(optimizer)
    return found


def _checked_degree(harmonics: list[Tensor], count: int, degree: int | None, shaded: bool) -> int:
    """Check the SH and return the degree to evaluate."""
    for name, part in zip(("sh0", "shN"), harmonics, strict=False):
        if part.dim() != 3 or part.shape[0] != count or part.shape[2] != 3:
            raise ValueError(f"{name} must be [N, K, 3] with N = {count}, got {list(part.shape)}")
    given = sum(part.shape[1] for part in harmonics)
    if degree is None:
        return math.isqrt(given) - 1
    if shaded and (degree + 1) ** 2 > given:
        raise ValueError(f"sh_degree {degree} needs {(degree + 1) ** 2} SH coefficients, got {given}")
    return degree


class _Visible(torch.autograd.Function):
    """Gathers the rows `ids` of means, quats, scales and opacities, and of SH in any number of parts.

    The result has the SH in one tensor, or None without parts. The gradients of the tables are sparse, or
    dense if `sparse` is False.
    """

    @staticmethod
    def forward(ctx: Any, ids: Tensor, sparse: bool, *tables: Tensor) -> tuple[Tensor | None, ...]:
        ctx.save_for_backward(ids)
        ctx.sparse, ctx.shapes = sparse, [table.shape for table in tables]
        ctx.set_materialize_grads(False)
        parts = tables[4:]
        ctx.lengths = [part.shape[1] for part in parts]
        rows = gather_rows(tables[:4], parts, ids)
        return (*rows, *([] if parts else [None]))

    @staticmethod
    def backward(ctx: Any, *v_rows: Tensor | None) -> Any:
        (ids,) = ctx.saved_tensors
        *gradients, v_sh = v_rows
        if len(ctx.lengths) == 1 or v_sh is None:
            gradients += [v_sh] * len(ctx.lengths)
        else:
            gradients += split_rows(v_sh, ctx.lengths)
        sparse = [ctx.sparse] * len(gradients)
        return None, None, *full_gradients(ids, gradients, ctx.shapes, sparse)
