# SPDX-License-Identifier: Apache-2.0
"""The interface of INRIA's `diff_gaussian_rasterization`, `simple_knn` and `fused_ssim` packages.

Names, arguments and results are those of the original 3DGS code (Kerbl et al. 2023), so most names here do
not follow this project's style. docs/guide/migration.md lists what differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.call.covariances import Decomposed, decompose, shaped_by
from blitzgs.call.losses import l1_ssim
from blitzgs.ops.derivatives import first_only, linear_map
from blitzgs.ops.intersect import intersect
from blitzgs.ops.knn_distances import knn_distances
from blitzgs.ops.project import differentiable_splats
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs, ProjectionOptions
from blitzgs.ops.rasterize import rasterize
from blitzgs.util.rotations import quaternion_matrices

NEAR = 0.2  # world units; INRIA's code has it as a constant
# Float32 matrices of a camera agree with each other to about 1e-6.
_CAMERA_TOLERANCE = 1e-3
# Rotations whose squared lengths are within this of 1 count as normalised: rounding of float32.
_UNIT_TOLERANCE = 1e-5


class GaussianRasterizationSettings(NamedTuple):
    """A view and how to render it; the fields of INRIA's class of this name, in its order.

    Attributes:
        image_height, image_width: px.
        tanfovx, tanfovy: tangents of half the horizontal and vertical field of view.
        bg: [C], the background.
        scale_modifier: factor of the scales; `cov3D_precomp` ignores it.
        viewmatrix: [4, 4] or [1, 4, 4], world to camera for row vectors: the transpose of the usual matrix. A
            rotation and a translation.
        projmatrix: [4, 4] or [1, 4, 4], world to clip space for row vectors. Its principal point counts; its
            focal lengths must be those of tanfovx and tanfovy.
        sh_degree: degree to evaluate, 0 to 3.
        campos: [3], the camera's centre; must fit `viewmatrix` if SH are rendered.
        prefiltered, debug: accepted, without effect.
        antialiasing: whether opacities are compensated for the blur. None is the class without this field:
            the rasteriser then returns no inverse depths.
    """

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool | None = None


class GaussianRasterizer(torch.nn.Module):
    """Renders Gaussians into one view, as INRIA's class of this name does."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor | None,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        *,
        dc: Tensor | None = None,
        means2D_densify: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Render; differentiable, once, in all tensors, in the background and in `viewmatrix`.

        Args:
            means3D: [N, 3] in world units, float32, or float64 on the CPU, as all tensors.
            means2D: [N, 2 or more]; its values are not read. Its gradient is that of the projected means in
                clip space (half images), in the first two columns.
            opacities: [N, 1] or [N], in [0, 1].
            shs: [N, K, 3], SH coefficients.
            colors_precomp: [N, C] instead of SH.
            scales: [N, 3], standard deviations.
            rotations: [N, 4] (w, x, y, z), not normalised: the polynomial of a unit quaternion's matrix is
                evaluated. If all are normalised, the gradient along the quaternion itself is zero.
            cov3D_precomp: [N, 6] instead of scales and rotations: xx, xy, xz, yy, yz, zz.
            dc: [N, 1, 3], the first SH coefficient; `shs` then has the others.
            means2D_densify: as `means2D`; its gradient is the sum of absolute gradients over pixels.

        Returns:
            The image [C, H, W]; radii int32 [N], 3 standard deviations in px, rounded up, 0 for Gaussians
            that are not seen. If the settings have `antialiasing`, also inverse depths [1, H, W], the sum of
            T alpha / z over the splats of a pixel.

        Raises:
            ValueError: both or none of two alternatives are given, or the settings contradict each other.
            RuntimeError: a tensor has a wrong shape, dtype or device; the message names it.
        """
        settings = self.raster_settings
        screen = {"means2D": means2D, "means2D_densify": means2D_densify}
        for name, tensor in screen.items():
            if tensor is not None and (tensor.shape[:-1] != means3D.shape[:-1] or tensor.shape[-1] < 2):
                raise RuntimeError(
                    f"{name} must be [N, 2 or more] with N = {len(means3D)}, got {list(tensor.shape)}"
                )
        if dc is not None:
            shs = dc if shs is None else torch.cat([dc, shs], dim=1)
        if (shs is None) == (colors_precomp is None):
            raise ValueError("give either shs (or dc and shs) or colors_precomp, and not both")
        if colors_precomp is not None:
            _check_shape("colors_precomp", colors_precomp, (len(means3D), colors_precomp.shape[-1]))
        splats = _project(settings, means3D, opacities, scales, rotations, cov3D_precomp, shs)
        height, width = int(settings.image_height), int(settings.image_width)
        absolute: list[Tensor] = []
        means2d = splats.means2d
        if means2D is not None or means2D_densify is not None:
            half = means3D.new_tensor([width / 2, height / 2])
            ids = splats.gaussian_ids.long()
            means2d = _with_gradients_of(means2d, list(screen.values()), ids, half, absolute)
        if colors_precomp is None:
            channels = splats.colors
        else:
            channels = colors_precomp.index_select(0, splats.gaussian_ids)
        background = settings.bg.to(channels).reshape(1, -1)
        _check_shape("bg", background[0], channels.shape[1:])
        of_depth = self._depth_channel(splats.depths)
        if of_depth is not None:
            channels = torch.cat([channels, of_depth[:, None]], dim=1)
            background = torch.cat([background, background.new_zeros(1, 1)], dim=1)
        lists = intersect(
            means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids,
            n_cameras=1, width=width, height=height,
        )  # fmt: skip
        renders, _ = rasterize(
            means2d, splats.conics, splats.opacities, channels, *lists,
            n_cameras=1, width=width, height=height, backgrounds=background,
            store_absgrad=None if means2D_densify is None else absolute.append,
        )  # fmt: skip
        image, radii = renders[0].permute(2, 0, 1), _radii(splats, len(means3D))
        if of_depth is None:
            return image.contiguous(), radii
        return image[:-1].contiguous(), radii, image[-1:].contiguous()

    def _depth_channel(self, depths: Tensor) -> Tensor | None:
        """Return what is composited beside the colours, [P], from the splats' depths; None: nothing is."""
        return None if self.raster_settings.antialiasing is None else depths.reciprocal()

    @torch.no_grad()
    def markVisible(self, positions: Tensor) -> Tensor:  # noqa: N802
        """Return which positions, [N, 3], are in front of the near plane: bool [N]."""
        depths = self.raster_settings.viewmatrix.to(positions).reshape(4, 4)[:, 2]
        return positions @ depths[:3] + depths[3] > NEAR

    @torch.no_grad()
    def visible_filter(
        self,
        means3D: Tensor,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> Tensor:
        """Return the radii of opaque Gaussians, int32 [N] as `forward` does (Scaffold-GS, Lu et al. 2024)."""
        opaque = means3D.new_ones(len(means3D))
        splats = _project(self.raster_settings, means3D, opaque, scales, rotations, cov3D_precomp, None)
        return _radii(splats, len(means3D))


class DepthGaussianRasterizer(GaussianRasterizer):
    """The rasteriser of the forks that return depths: image, radii and the sum of T alpha z, [1, H, W]."""

    def _depth_channel(self, depths: Tensor) -> Tensor:
        return depths


def distCUDA2(points: Tensor) -> Tensor:  # noqa: N802
    """Return the mean squared distance to the three nearest other points (`simple_knn._C.distCUDA2`).

    Args:
        points: [N, 3], float32 (CPU also float64).

    Returns:
        [N]; exact, and infinite with fewer than four points.
    """
    return knn_distances(points, 3).square().mean(dim=1)


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM, differentiable in `img1` (the package `fused_ssim`).

    Args:
        img1: [B, 3, H, W], float32 (CPU also float64).
        img2: of the same shape.
        padding: "same", zero padding, or "valid".
        train: accepted, without effect.

    Raises:
        ValueError: wrong shapes, or another padding.
    """
    if img1.dim() != 4 or img1.shape[1] != 3 or img2.shape != img1.shape:
        raise ValueError(f"img1 and img2 must be [B, 3, H, W], got {list(img1.shape)} and {list(img2.shape)}")
    x, y = (image.permute(0, 2, 3, 1).contiguous() for image in (img1, img2))
    return 1 - l1_ssim(x, y, ssim_weight=1.0, padding=padding)


def _project(
    settings: GaussianRasterizationSettings,
    means: Tensor,
    opacities: Tensor,
    scales: Tensor | None,
    rotations: Tensor | None,
    cov3D: Tensor | None,
    sh: Tensor | None,
) -> ProjectedSplats:
    """Return the splats of the view."""
    both = scales is not None and rotations is not None
    if both == (cov3D is not None) or (cov3D is not None and (scales is not None or rotations is not None)):
        raise ValueError("give either scales and rotations or cov3D_precomp, and not both")
    for name, tensor, length in (
        ("scales", scales, 3),
        ("rotations", rotations, 4),
        ("cov3D_precomp", cov3D, 6),
    ):
        if tensor is not None:
            _check_shape(name, tensor, (len(means), length))
    unit, K = _check_settings(settings, means, rotations, sh)
    decomposed: Decomposed | None = None
    if cov3D is not None:
        decomposed = decompose(cov3D[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3))
    elif scales is not None and rotations is not None:
        scales = scales * settings.scale_modifier if settings.scale_modifier != 1 else scales
        if not unit:
            # In double, because the decomposition of a thin Gaussian loses digits.
            shapes = quaternion_matrices(rotations.double()) * scales.double()[:, None]
            upper, *axes = decompose(shapes @ shapes.mT)
            decomposed = Decomposed(upper, *(t.to(means.dtype) for t in axes))
    if decomposed is not None:
        rotations, scales = decomposed.quats, decomposed.scales
    assert rotations is not None and scales is not None
    width, height, degree = map(int, (settings.image_width, settings.image_height, settings.sh_degree))
    options = ProjectionOptions(
        width, height, sh_degree=0 if sh is None else degree, near_plane=NEAR,
        antialiased=bool(settings.antialiasing), raw=False,
    )  # fmt: skip
    cameras = (settings.viewmatrix.to(means).reshape(1, 4, 4).mT.contiguous(), K)
    gaussians = [means, rotations, scales, opacities.reshape(-1), *([] if sh is None else [sh])]
    inputs = ProjectionInputs(gaussians, cameras, options)
    splats = differentiable_splats(inputs, sparse_grad=False)
    return splats if decomposed is None else shaped_by(splats, inputs, decomposed)


def _check_shape(name: str, tensor: Tensor, wanted: Sequence[int]) -> None:
    if tensor.shape != tuple(wanted):
        raise RuntimeError(f"{name} must be {[*wanted]}, got {[*tensor.shape]}")


@torch.no_grad()
def _check_settings(
    settings: GaussianRasterizationSettings, means: Tensor, rotations: Tensor | None, sh: Tensor | None
) -> tuple[bool, Tensor]:
    """Check the camera; return whether all rotations are normalised, and the intrinsics [1, 3, 3].

    The values are read in one transfer from the device.
    """
    off = means.new_zeros(1)
    if rotations is not None and len(rotations) > 0:
        off = (rotations.square().sum(dim=1) - 1).abs().amax().view(1)
    given = (settings.viewmatrix, settings.projmatrix, settings.campos, off)
    values = torch.cat([tensor.reshape(-1).to(means.device, torch.float64) for tensor in given]).cpu()
    view, full, centre = values[:16].view(4, 4), values[16:32].view(4, 4), values[32:35]
    fx, fy = settings.image_width / (2 * settings.tanfovx), settings.image_height / (2 * settings.tanfovy)
    # From camera to clip space, for row vectors; the columns of x, y and w decide where a point is seen.
    clip = torch.linalg.solve(view, full)[:3, [0, 1, 3]]
    cx, cy = ((clip[2, :2] + 1) / 2).tolist()
    expected = values.new_tensor(
        [[1 / settings.tanfovx, 0, 0], [0, 1 / settings.tanfovy, 0], [2 * cx - 1, 2 * cy - 1, 1]]
    )
    if not ((clip - expected).abs() <= _CAMERA_TOLERANCE * expected.abs().clamp(min=1)).all():
        raise ValueError(
            "projmatrix does not fit tanfovx, tanfovy and viewmatrix: expected viewmatrix @ P, with "
            f"P[0, 0] = 1 / tanfovx = {1 / settings.tanfovx:.6g}, P[1, 1] = 1 / tanfovy = "
            f"{1 / settings.tanfovy:.6g} and P[2, 3] = 1; its x, y and w columns of P are {clip.tolist()}"
        )
    origin = -view[:3, :3] @ view[3, :3]
    if sh is not None and (centre - origin).norm() > _CAMERA_TOLERANCE * (1 + origin.norm()):
        raise ValueError(
            f"campos is {centre.tolist()}, but the camera of viewmatrix is at {origin.tolist()}, from where "
            "SH are evaluated; pass that, or colors_precomp"
        )
    K = [[fx, 0, cx * settings.image_width], [0, fy, cy * settings.image_height], [0, 0, 1]]
    return float(values[35]) <= _UNIT_TOLERANCE, means.new_tensor([K])


@torch.no_grad()
def _radii(splats: ProjectedSplats, count: int) -> Tensor:
    """Return three standard deviations of each Gaussian's longer axis, px, as INRIA's code rounds them."""
    a, b, c = splats.conics.detach().double().unbind(dim=1)
    # As `three_sigma_radius` of csrc/population/density.h: what rounding left of a thin splat's determinant,
    # or took below zero, would make the longest splats tiny.
    rounding = torch.finfo(splats.conics.dtype).eps
    variance = 1 / torch.maximum(a * c - b * b, rounding * a * c)  # the determinant of the covariance
    middle = 0.5 * (a + c) * variance
    longest = middle + (middle.square() - variance).clamp(min=0.1).sqrt()
    radii = splats.gaussian_ids.new_zeros(count)
    # A conic of zeros, which touches no pixel, has no radius.
    values = (3 * longest.sqrt()).ceil().nan_to_num(nan=0, posinf=0).clamp(max=2**30).int()
    return radii.index_copy_(0, splats.gaussian_ids.long(), values)


def _with_gradients_of(
    means2d: Tensor, screen: Sequence[Tensor | None], ids: Tensor, half: Tensor, absolute: list[Tensor]
) -> Tensor:
    """Return projected means whose gradient is also that of the tensors `screen`, in half images.

    The first of `screen` gets the gradient; the second what the rasteriser's backward pass, which comes
    before, puts into `absolute`.
    """
    shapes = [None if tensor is None else tensor.shape for tensor in screen]

    def back(needed: Sequence[bool], v: Sequence[Tensor | None]) -> list[Tensor | None]:
        v_means2d = torch.zeros_like(means2d) if v[0] is None else v[0]
        found = (v_means2d, absolute.pop() if absolute else v_means2d.abs())

        def spread() -> list[Tensor | None]:
            gradients: list[Tensor | None] = [None, None]
            for i, (shape, gradient) in enumerate(zip(shapes, found, strict=True)):
                if shape is not None and needed[1 + i]:
                    whole = gradient.new_zeros(shape)
                    whole[:, :2].index_copy_(0, ids, gradient * half)
                    gradients[i] = whole
            return gradients

        return [v_means2d, *first_only("GaussianRasterizer", spread, [v_means2d])]

    (passed,) = linear_map(lambda means2d, *_: (means2d.clone(),), back, [means2d, *screen])
    return passed
