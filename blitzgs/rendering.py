# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization`: gsplat's call for pinhole 3DGS, over the ops of BlitzGS."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from blitzgs.lazy_dict import Later, LazyDict
from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import Rows, differentiable_rows
from blitzgs.ops.rasterize import rasterize
from blitzgs.ops.render import render_queued

# What the CUDA kernels composite; for any other size, meta's lists are of the tiles asked for alone.
CUDA_TILE_SIZES = (8, 16, 32)
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    **unsupported: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole views; the argument names, shapes and meta keys are gsplat's.

    The image differs from gsplat's where BlitzGS defines it otherwise: alpha is capped at 0.99 (there: 0.999)
    and no splat is cut at a number of standard deviations, only where alpha falls below 1/255.
    Differentiable, once, in means, quats, scales, opacities, colors, viewmats and backgrounds.

    Args:
        means: [N, 3] in world units, float32, or float64 on the CPU.
        quats: [N, 4] (w, x, y, z), need not be normalised.
        scales: [N, 3] standard deviations (after the exponential).
        opacities: [N] in [0, 1] (after the sigmoid).
        colors: with `sh_degree`, SH coefficients [N, K, 3]; otherwise values of any channel count, [N, D] or
            per view [C, N, D].
        viewmats: [C, 4, 4] world to camera, a rotation and a translation; C <= 32.
        Ks: [C, 3, 3] intrinsics in px.
        width: image width in px.
        height: image height in px.
        near_plane: Gaussians have z > near_plane, world units.
        far_plane: Gaussians have z <= far_plane, world units.
        radius_clip: drop splats that reach no further than this, px.
        eps2d: variance added to both screen axes, px^2.
        sh_degree: degree to evaluate, 0 to 3; None when `colors` holds values.
        packed: whether meta's per-splat tensors hold only what is visible ([nnz, ...]) or all ([C, N, ...],
            zero where invisible). The image is the same.
        tile_size: edge of a tile in px, 1 to 64. The image is the same, on CUDA to rounding; 8, 16 and 32 are
            fastest there.
        backgrounds: [C, D] behind everything; None for zero. Depth channels have none.
        render_mode: "RGB", "D" (accumulated z), "ED" (expected z), "RGB+D" or "RGB+ED".
        sparse_grad: whether means, quats and scales, and with `sh_degree` opacities and colors that are
            leaves, get sparse gradients, over the visible Gaussians alone. Dense ones cost a pass over all N.
        absgrad: whether backward also sets `meta["means2d"].absgrad`, the sums of absolute pixel gradients.
        rasterize_mode: "classic" or "antialiased".
        channel_chunk: accepted and not needed: any channel count is rendered in one pass.
        distributed: only False is supported.
        camera_model: only "pinhole" is supported.
        segmented: accepted and not needed: it selects a sort in gsplat, never the result.
        covars: only None is supported.
        unsupported: any further argument of gsplat; only None, False and "pinhole" pass.

    Returns:
        Images [C, H, W, D] (depth last), alphas [C, H, W, 1], and meta: camera_ids, gaussian_ids (None unless
        packed; ordered by Gaussian, then view), radii, means2d, depths, conics, opacities, tile_width,
        tile_height, tiles_per_gauss, isect_ids, flatten_ids, isect_offsets (int64), width, height, tile_size,
        n_cameras. `meta["means2d"]` takes `retain_grad()`. Meta is a `LazyDict`: what the image does not need
        is worked out when it is first read.

    Raises:
        TypeError: an array of another library where a tensor is needed.
        ValueError: an argument that is not supported or does not fit, by name.
        RuntimeError: a wrong shape or dtype that a kernel found.
    """
    _reject_unsupported(
        {
            "distributed": distributed,
            "covars": covars,
            "camera_model": camera_model,
            **unsupported,
        }
    )
    _require_tensors(
        {
            "means": means,
            "quats": quats,
            "scales": scales,
            "opacities": opacities,
            "colors": colors,
            "viewmats": viewmats,
            "Ks": Ks,
        }
    )
    _check(means, opacities, colors, viewmats, sh_degree, render_mode, rasterize_mode, backgrounds)
    shaded = "RGB" in render_mode
    sh = colors if sh_degree is not None and shaded else None
    if sh_degree is None and shaded:
        opacities = _hide_non_finite(opacities, colors)
    arguments = (
        means, quats, scales, opacities, sh, viewmats, Ks, None, None, width, height, tile_size,
        sh_degree or 0, near_plane, far_plane, eps2d, radius_clip, rasterize_mode == "antialiased", False,
    )  # fmt: skip
    background = _background_channels(backgrounds, render_mode)
    ready = None
    # What is composited comes from the rows alone, however many there are.
    from_rows = packed and (sh_degree is not None or not shaded)
    if means.is_cuda and from_rows and tile_size in CUDA_TILE_SIZES and not torch.compiler.is_compiling():
        differentiable = any(x.requires_grad for x in (means, quats, scales, opacities, colors, viewmats))
        ready = render_queued(
            arguments,
            lambda rows: _channels(_Seen(rows, len(viewmats), len(means)), colors, render_mode, sh_degree),
            background,
            torch.is_grad_enabled() and differentiable and not absgrad,
        )
    rows = differentiable_rows(arguments, sparse_grad, None if ready is None else ready.rows)
    n_cameras = viewmats.shape[0]
    seen = _Seen(rows, n_cameras, len(means))
    means2d = rows.means2d if packed else seen.of_all(rows.means2d)
    splats = (means2d if packed else seen.of_rows(means2d), rows.conics, rows.opacities)
    grid: dict[str, Any] = {
        "n_cameras": n_cameras,
        "width": width,
        "height": height,
        "tile_size": tile_size,
    }
    if ready is None:
        n_isects = rows.counts.tolist()[2]
        lists = intersect(*splats, rows.depths, rows.camera_ids, n_isects=n_isects, **grid)
    else:
        lists = ready.isect_rows, ready.tile_offsets
    listed = lists
    if means.is_cuda and tile_size not in CUDA_TILE_SIZES:
        grid["tile_size"] = CUDA_TILE_SIZES[1]
        listed = intersect(*splats, rows.depths, rows.camera_ids, **grid)

    def tell_absgrad(gradient: Tensor) -> None:
        means2d.absgrad = gradient if packed else seen.of_all(gradient)  # type: ignore[attr-defined]

    renders, alphas = rasterize(
        *splats,
        _channels(seen, colors, render_mode, sh_degree),
        *listed,
        backgrounds=background,
        tell_absgrad=tell_absgrad if absgrad else None,
        composited=None if ready is None else ready.composited,
        **grid,
    )
    alphas = alphas[..., None]
    if render_mode.endswith("ED"):
        renders = torch.cat([renders[..., :-1], renders[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    return renders, alphas, _meta(seen, means2d, *lists, packed, width, height, tile_size)


class _Seen:
    """The rows, and where they stand among the Gaussians of each view; int64, made when first asked for."""

    def __init__(self, rows: Rows, n_cameras: int, n: int) -> None:
        self.rows, self.n_cameras, self.n = rows, n_cameras, n

    @cached_property
    def cameras(self) -> Tensor:
        return self.rows.camera_ids.long()

    @cached_property
    def gaussians(self) -> Tensor:
        return self.rows.gaussian_ids.long()

    @cached_property
    def places(self) -> Tensor:
        """[P] places in [C * N]."""
        return self.gaussians if self.n_cameras == 1 else self.cameras * self.n + self.gaussians

    def of_all(self, values: Tensor) -> Tensor:
        """Return rows' values [P, ...] as [C, N, ...], zero where a view does not see a Gaussian."""
        zeros = values.new_zeros(self.n_cameras * self.n, *values.shape[1:])
        dense = zeros.index_copy(0, self.places, values)
        return dense.view(self.n_cameras, self.n, *values.shape[1:])

    def of_rows(self, dense: Tensor) -> Tensor:
        """Return what rows have of [C, N, ...]: [P, ...]."""
        return dense.flatten(0, 1).index_select(0, self.places)


def _reject_unsupported(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if value is not None and value is not False and value != "pinhole":
            raise ValueError(f"blitzgs.rasterization does not support {name}={value!r}; leave it out")


def _require_tensors(arguments: dict[str, Any]) -> None:
    for name, value in arguments.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")


def _check(
    means: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    sh_degree: int | None,
    render_mode: str,
    rasterize_mode: str,
    backgrounds: Tensor | None,
) -> None:
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be one of {', '.join(RENDER_MODES)}, got {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be 'classic' or 'antialiased', got {rasterize_mode!r}")
    if means.dim() != 2 or viewmats.dim() != 3:
        raise ValueError(
            f"means must be [N, 3] and viewmats [C, 4, 4] (leading batch dimensions are not supported), got "
            f"{list(means.shape)} and {list(viewmats.shape)}"
        )
    N, C = means.shape[0], viewmats.shape[0]
    if opacities.shape != (N,):  # any other might broadcast
        raise ValueError(f"opacities must be [N] = {[N]}, got {list(opacities.shape)}")
    if sh_degree is not None:
        if colors.dim() != 3 or colors.shape[0] != N or colors.shape[2] != 3:
            raise ValueError(
                f"colors must be SH coefficients [N, K, 3] with N = {N} when sh_degree is given (per-view "
                f"coefficients are not supported), got {list(colors.shape)}"
            )
    elif colors.shape[:-1] not in ((N,), (C, N)):
        raise ValueError(
            f"colors must be [N, D] or [C, N, D] with N = {N}, C = {C}, got {list(colors.shape)}"
        )
    if backgrounds is not None and "RGB" in render_mode and backgrounds.shape != (C, colors.shape[-1]):
        raise ValueError(
            f"backgrounds must be [C, D] = {[C, colors.shape[-1]]}, got {list(backgrounds.shape)}"
        )


def _hide_non_finite(opacities: Tensor, colors: Tensor) -> Tensor:
    """Zero the opacity of Gaussians with a NaN or infinite value, so that it spreads to no pixel."""
    finite = colors.detach().isfinite().all(dim=-1)
    if finite.dim() == 2:
        finite = finite.all(dim=0)
    return torch.where(finite, opacities, torch.zeros_like(opacities))


def _channels(seen: _Seen, colors: Tensor, render_mode: str, sh_degree: int | None) -> Tensor:
    """Return what is composited, per row [P, D]."""
    rows = seen.rows
    if "RGB" not in render_mode:
        return rows.depths[:, None]
    if sh_degree is not None:
        values = rows.colors
    elif colors.dim() == 2:
        values = colors.index_select(0, rows.gaussian_ids)
    else:
        values = colors[seen.cameras, seen.gaussians]
    return values if render_mode == "RGB" else torch.cat([values, rows.depths[:, None]], dim=1)


def _background_channels(backgrounds: Tensor | None, render_mode: str) -> Tensor | None:
    if backgrounds is None or "RGB" not in render_mode:
        return None
    if render_mode == "RGB":
        return backgrounds
    return torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], dim=1)


def _meta(
    seen: _Seen,
    means2d: Tensor,
    isect_rows: Tensor,
    tile_offsets: Tensor,
    packed: bool,
    width: int,
    height: int,
    tile_size: int,
) -> LazyDict:
    rows, n_cameras = seen.rows, seen.n_cameras
    tile_width, tile_height = -(-width // tile_size), -(-height // tile_size)
    with_gradient = torch.is_grad_enabled()

    def of_all(values: Tensor) -> Tensor:
        with torch.set_grad_enabled(with_gradient):  # as when meta was made
            return seen.of_all(values)

    def listed() -> Tensor:
        """Leave out the entries of no tile, of which there are some where rows are hidden."""
        return isect_rows[: int(tile_offsets[-1])]

    def isect_ids() -> Tensor:
        depths = rows.depths.detach().index_select(0, listed())
        return _isect_ids(depths, tile_offsets, n_cameras, tile_width * tile_height)

    per_row = {
        "radii": rows.radii,
        "depths": rows.depths,
        "conics": rows.conics,
        "opacities": rows.opacities,
        "tiles_per_gauss": rows.tiles_touched,
    }
    return LazyDict(
        camera_ids=Later(lambda: seen.cameras) if packed else None,
        gaussian_ids=Later(lambda: seen.gaussians) if packed else None,
        means2d=means2d,
        **(per_row if packed else {k: Later(partial(of_all, v)) for k, v in per_row.items()}),
        tile_width=tile_width,
        tile_height=tile_height,
        isect_ids=Later(isect_ids),
        flatten_ids=Later(listed if packed else lambda: seen.places.index_select(0, listed()).int()),
        isect_offsets=Later(lambda: tile_offsets[:-1].reshape(n_cameras, tile_height, tile_width)),
        width=width,
        height=height,
        tile_size=tile_size,
        n_cameras=n_cameras,
        n_batches=1,
    )


def _isect_ids(depths: Tensor, tile_offsets: Tensor, n_cameras: int, n_tiles: int) -> Tensor:
    """Return gsplat's sort keys, int64 [I]: camera | tile | float32 depth bits, from high to low."""
    entries = torch.arange(len(depths), device=depths.device)
    keys = torch.searchsorted(tile_offsets[1:], entries, right=True)
    if n_cameras > 1:
        keys += keys // n_tiles * ((1 << n_tiles.bit_length()) - n_tiles)
    return keys.bitwise_left_shift_(32).bitwise_or_(depths.float().view(torch.int32))
