# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization`: gsplat's call, over the ops of BlitzGS."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from blitzgs.call.arguments import (
    CAMERA_MODELS,
    RENDER_MODES,
    Scene,
    check_choice,
    check_further,
    check_tensors,
    checked_options,
    gaussians_of,
)
from blitzgs.call.channels import ImageOptions, background_rows
from blitzgs.call.extras import check_without_ut, checked_pixels, with_covariances, with_lenses, with_signals
from blitzgs.call.ranks import gather_views
from blitzgs.call.render import render
from blitzgs.ops.intersect import TILE_SIZE

# Colours of networks under autocast, and of SH tables in half precision.
_HALF = (torch.float16, torch.bfloat16)


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
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
    tile_size: int | None = TILE_SIZE,
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
    *,
    return_normals: bool = False,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    return_median: bool = False,
    pixels: Tensor | None = None,
    image_ids: Tensor | None = None,
    with_ut: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    **further: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C views; the argument names, shapes and meta keys are gsplat's.

    docs/image.md defines the image (EWA splatting, Zwicker et al. 2001; 3DGS, Kerbl et al. 2023). It differs
    from gsplat 1.5.3's in the cap of alpha, which is 0.99 here and 0.999 there. Differentiable, once, in
    means, quats, scales, covars, opacities, colors, viewmats and backgrounds; a second derivative is an
    error. Works under `torch.compile(fullgraph=True)`, except with sparse_grad, absgrad or distributed.

    Leading dimensions `...`, the same for all, are a batch of independent scenes.

    Args:
        means: [..., N, 3] in world units, float32, or float64 on the CPU.
        quats: [..., N, 4] (w, x, y, z), of any length; zero is rendered as the identity (in gsplat it becomes
            NaN) and has the gradient zero. Not read, and may be None, with `covars`.
        scales: [..., N, 3] standard deviations (after the exponential); their signs do not matter. Not read,
            and may be None, with `covars`.
        opacities: [..., N] in [0, 1] (after the sigmoid).
        colors: with `sh_degree`, SH coefficients [..., N, K, D]; or [N, K, D] for all scenes of a batch; or
            per view [..., C, N, K, D], which is slower. Otherwise values [..., N, D] or per view [..., C, N,
            D]. 1 to 4096 channels D (a rendered depth counts). SH of degree 4, or of other than 3 channels,
            are evaluated for all Gaussians and count as colours per view. May be None for the render modes D
            and ED. float16 and bfloat16 are computed in the dtype of `means`.
        viewmats: [..., C, 4, 4] world to camera, a rotation and a translation.
        Ks: [..., C, 3, 3] intrinsics in px, without skew and with a last row 0, 0, 1. They get no
            gradient. Others are refused; under `torch.compile` nothing is rendered with them.
        width, height: size of the images in px.
        near_plane, far_plane: Gaussians have near_plane < z <= far_plane, world units.
        radius_clip: drop splats whose radii in meta are both at most this, px, at least 0.
        eps2d: variance added to both screen axes, px^2, at least 0.
        sh_degree: degree to evaluate, 0 to 4; None when `colors` holds values.
        packed: whether meta's per-splat tensors hold only what is visible ([nnz, ...]) or all
            ([..., C, N, ...], zero where invisible). The image is the same.
        tile_size: edge of a tile in px, 1 to 64; None: 16. The image is the same, on CUDA to rounding; 16 is
            fastest there.
        backgrounds: [..., C, D] behind everything, or [..., C, D + E] with extra signals; None for zero.
            Depth and normals have none.
        render_mode: "RGB", "D" (accumulated z), "ED" (expected z), "RGB+D" or "RGB+ED".
        sparse_grad: whether means, quats and scales, and with `sh_degree` also opacities and colors (not
            per view) that are leaves, get sparse gradients, which have only the visible Gaussians. Dense
            gradients cost a pass over all N. Not with covars or batch dimensions, nor in a module of torch's
            DistributedDataParallel, which takes dense gradients alone.
        absgrad: whether backward also fills `meta["means2d"].absgrad`, which is zero before, with the sums of
            absolute pixel gradients.
        rasterize_mode: "classic" or "antialiased". The factor on the opacity has no lower limit, as in gsplat
            1.5.3; gsplat's main branch limits it to 0.005, so that tiny Gaussians do not vanish.
        channel_chunk, segmented: accepted and not needed: all channels are rendered in one pass, and gsplat's
            sort never changes the result.
        distributed: whether Gaussians and views are divided among the ranks of the process group. Each rank
            passes its own Gaussians and views, the same number of views as the others, and gets the images of
            its own views, which show the Gaussians of all ranks. Every rank must make this call and run its
            backward pass. As in gsplat, meta's splats are those of this rank's Gaussians in the views of all
            ranks, and its tile lists belong to this rank's images.
        camera_model: "pinhole", or with `with_ut` OpenCV's "fisheye".
        covars: [..., N, 3, 3] covariances instead of quats and scales; only their upper triangles are read.
            They are decomposed, which costs more than the rest of the call; quats and scales are faster.
        return_normals: whether to render normals into `meta["normals"]`, [..., C, H, W, 3]: the sum of
            alpha T times the third axis of each Gaussian in world coordinates, turned to face the camera
            centre. gsplat turns it per pixel, and has it with `with_eval3d` alone. Not with covars.
        extra_signals: values to composite beside the colours, [..., N, E] or per view [..., C, N, E], into
            `meta["render_extra_signals"]`, [..., C, H, W, E].
        extra_signals_sh_degree: if given, 0 to 3, `extra_signals` are SH coefficients [N, K, E] or
            [..., N, K, E]; the value is that of colours, but not clamped at zero.
        return_median: whether to find the median depth, `meta["render_median"]`, [..., C, H, W, 1]: the z of
            the Gaussian that takes the transmittance to 0.5 or below, or of the last one where none does, or
            0 where there are none (as gsplat's 2DGS defines it). Its gradient is that of this z.
        pixels: integers [M, 2], (row, column): render only these pixels. The images are [M, D], alphas [M, 1]
            and other images [M, ...] too. The pixels have the bits of the whole image; only tiles that have
            one get lists and are composited, but buffers are as large as for the whole images.
        image_ids: integers [M], the image of each of the pixels, counted through all batch dimensions; None:
            there is one image.
        with_ut: project by the unscented transform (docs/design.md), as in gsplat's main branch: images
            are distorted as their lenses are. Every Gaussian is projected into every view. Not with covars,
            sparse_grad, distributed, torch.compile or gradients of viewmats.
        radial_coeffs, tangential_coeffs, thin_prism_coeffs: OpenCV's k1 to k6, [..., C, 6], p1 and p2, [...,
            C, 2], and s1 to s4, [..., C, 4]; or of a fisheye k1 to k4, [..., C, 4], alone. None: zeros.
            Lenses and viewmats_rs get no gradient.
        rolling_shutter: gsplat's `RollingShutterType`, or its name: which row or column is exposed first;
            None: "GLOBAL".
        viewmats_rs: poses at the end of a rolling shutter's frame, [..., C, 4, 4]; at its begin the camera is
            at viewmats, from where colours are seen.
        ut_params: gsplat's `UnscentedTransformParameters`, or an object with its attributes alpha (0.1), beta
            (2), kappa (0), in_image_margin_factor (0.1) and require_all_sigma_points_valid (False).
        further: gsplat's arguments that are not supported; only their default values are accepted.

    Returns:
        Images [..., C, H, W, D] (depth last), alphas [..., C, H, W, 1], and meta: batch_ids, camera_ids,
        gaussian_ids (None unless packed; ordered by image, then Gaussian), radii, means2d, depths, conics,
        opacities, tile_width, tile_height, tiles_per_gauss, isect_ids, flatten_ids, isect_offsets (int64),
        width, height, tile_size, n_batches, n_cameras. The image depends on means2d, conics, opacities and,
        where depth is rendered, depths, so `retain_grad()` works on them. Splats whose alpha is below 1/255
        at all pixels of the image are left out, though gsplat counts some of them as visible (0.1 % more).
        `meta["non_finite"]` is a mapping from the names of arguments to the indices of Gaussians or views
        that were not rendered because they are NaN or infinite; they are looked for when the mapping is first
        looked into. Meta is a `LazyDict`: entries that the image does not need are computed when they are
        first read.

    Warns:
        RuntimeWarning: an argument has values that are NaN or infinite. On CUDA every call looks for them in
            the cameras, and every 32nd call in the Gaussians. Or Ks requires a gradient (once).

    Raises:
        TypeError: an argument is not a tensor, or not the kind of number it should be, or gsplat has no such
            argument; or the tensors are neither float32 nor float64.
        ValueError: an argument is not supported, has a wrong shape or value, or another dtype or device than
            the others; the message names it.
        RuntimeError: float64 tensors are on a GPU, or the call is inside a transform of `torch.func`.
        NotEnoughMemoryError: the images or what they need do not fit into memory.
    """
    if further:
        check_further("rasterization", further)
    projection = checked_options(
        width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, tile_size, rasterize_mode
    )
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("camera_model", camera_model, CAMERA_MODELS)
    if isinstance(colors, Tensor) and colors.dtype in _HALF and isinstance(means, Tensor):
        colors = colors.to(means.dtype)
    if isinstance(extra_signals, Tensor) and extra_signals.dtype in _HALF and isinstance(means, Tensor):
        extra_signals = extra_signals.to(means.dtype)
    required: dict[str, object] = {"means": means, "opacities": opacities, "viewmats": viewmats, "Ks": Ks}
    if covars is None:
        required |= {"quats": quats, "scales": scales}
    lens = {"radial_coeffs": radial_coeffs, "tangential_coeffs": tangential_coeffs}
    lens |= {"thin_prism_coeffs": thin_prism_coeffs, "viewmats_rs": viewmats_rs}
    given = {"colors": colors, "backgrounds": backgrounds, "covars": covars, "extra_signals": extra_signals}
    check_tensors(required, given | lens)
    of_lenses = (rolling_shutter, ut_params, *lens.values())
    if not with_ut and (camera_model != "pinhole" or of_lenses != (None,) * 6):
        check_without_ut(camera_model, rolling_shutter, {**lens, "ut_params": ut_params})
    if covars is not None:
        # Placeholders, which the decomposition of the covariances replaces.
        quats, scales = (means.new_zeros(()).expand(*means.shape[:-1], length) for length in (4, 3))
    assert quats is not None and scales is not None
    scene = Scene(means, quats, scales, opacities, colors, viewmats, Ks)
    gaussians = gaussians_of("rasterization", scene, sh_degree, render_mode)
    if sparse_grad and len(gaussians.lead) > 1:
        raise ValueError("sparse_grad does not support batch dimensions; leave one of them out")
    if extra_signals is not None:
        gaussians = with_signals(gaussians, extra_signals, extra_signals_sh_degree)
    elif extra_signals_sh_degree is not None:
        raise ValueError("extra_signals_sh_degree needs extra_signals; give both")
    if covars is not None:
        gaussians = with_covariances(gaussians, covars, sparse_grad, return_normals)
    if with_ut:
        refused = {"covars": covars is not None, "sparse_grad": sparse_grad, "distributed": distributed}
        gaussians = with_lenses(gaussians, camera_model, rolling_shutter, ut_params, refused, lens)
    background = background_rows(backgrounds, gaussians, render_mode, return_normals)
    if pixels is not None and (distributed or torch.compiler.is_compiling()):
        raise ValueError("pixels support neither distributed=True nor torch.compile; leave one out")
    listed = checked_pixels(pixels, image_ids, gaussians.images, width, height)
    image = ImageOptions(
        render_mode, background, packed, sparse_grad, absgrad, return_normals, return_median, listed
    )
    ranks = None
    if distributed:
        same = (width, height, projection.tile_size, render_mode, return_normals)
        gaussians, ranks = gather_views(gaussians, absgrad, same)
    return render(gaussians, projection, image, ranks=ranks)
