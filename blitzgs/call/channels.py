# SPDX-License-Identifier: Apache-2.0
"""The channels that an image composites, and the images that a caller gets of them.

Channels are colours, extra signals, normals and depth, in this order.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding

from blitzgs.call.arguments import Gaussians
from blitzgs.call.extras import NORMAL_CHANNELS, Pixels
from blitzgs.call.layout import Lists
from blitzgs.ops.harmonics import spherical_harmonics
from blitzgs.ops.importance import pixel_splats
from blitzgs.ops.projection_types import ProjectedSplats


class ImageOptions(NamedTuple):
    """The options of compositing and of `meta`; see `blitzgs.rasterization`."""

    render_mode: str  # which channels are rendered
    backgrounds: Tensor | None  # [I, channels] or None
    packed: bool  # whether `meta` has only the visible splats, or else an entry for every Gaussian and view
    sparse_grad: bool  # whether gradients are sparse
    absgrad: bool  # whether the backward pass also returns absolute gradients
    normals: bool = False  # whether normals are rendered
    median: bool = False  # whether the median depth is
    pixels: Pixels | None = None  # the pixels that are rendered; None: all


def background_rows(
    backgrounds: Tensor | None, gaussians: Gaussians, render_mode: str, normals: bool = False
) -> Tensor | None:
    """Return the background of each image, [I, channels], from [..., C, D] or [..., C, D + E]."""
    if backgrounds is None or "RGB" not in render_mode:
        return None
    assert gaussians.colors is not None
    channels = given = gaussians.colors.shape[-1]
    if gaussians.signals is not None:
        channels += gaussians.signals.channels
        given = channels if backgrounds.shape[-1:] == (channels,) else given
    wanted = (*gaussians.lead, given)
    if backgrounds.shape != wanted:
        raise ValueError(f"backgrounds must be [..., C, D] = {[*wanted]}, got {[*backgrounds.shape]}")
    rows = backgrounds.reshape(gaussians.images, given)
    dark = channels - given + (NORMAL_CHANNELS if normals else 0) + (render_mode != "RGB")
    return torch.cat([rows, rows.new_zeros(len(rows), dark)], dim=1) if dark else rows


def channels_of(
    splats: ProjectedSplats, gaussians: Gaussians, image: ImageOptions, with_spare: bool = False
) -> Tensor:
    """Return the channels to composite, [P, channels].

    `with_spare`: whether the last splats may be spare capacity, whose ids are undefined.
    """
    parts = []
    if gaussians.sh_degree is not None:
        parts.append(splats.colors)
    elif gaussians.colors is not None:
        values = gaussians.colors.reshape(-1, gaussians.colors.shape[-1])
        parts.append(values.index_select(0, _rows(splats, gaussians, gaussians.per_view, with_spare)))
    if gaussians.signals is not None:
        parts.append(_signals(splats, gaussians, with_spare))
    if image.normals:
        parts.append(_normals(splats, gaussians, image.sparse_grad, with_spare))
    if image.render_mode != "RGB":
        parts.append(splats.depths[:, None])
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def _split_channels(
    renders: Tensor, gaussians: Gaussians, image: ImageOptions
) -> tuple[Tensor, dict[str, Tensor]]:
    """Divide an image into colours with depth, and what `meta` has: extra signals and normals, by key."""
    widths = {
        "render_extra_signals": 0 if gaussians.signals is None else gaussians.signals.channels,
        "normals": NORMAL_CHANNELS if image.normals else 0,
    }
    begin = 0 if gaussians.colors is None else gaussians.colors.shape[-1]
    colours, beside = renders[..., :begin], {}
    for key, width in widths.items():
        if width:
            beside[key] = renders[..., begin : begin + width].contiguous()
        begin += width
    # A copy: the caller may change one image in place, and view it in any shape.
    return torch.cat([colours, renders[..., begin:]], dim=-1), beside


def images_of_caller(
    renders: Tensor,  # all channels, [I, H, W, channels]
    alphas: Tensor,  # [I, H, W]
    gaussians: Gaussians,
    image: ImageOptions,
    lead: tuple[int, ...],  # batch dimensions, and the number of views that are rendered here
    splats: ProjectedSplats,  # that were composited
    lists: Lists,  # by which they were
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Return images and alphas as the caller asked for them, and the further images of `meta` by key."""
    alphas = alphas.unsqueeze(-1)
    if image.pixels is not None:
        renders, alphas = (t.flatten(0, 2).index_select(0, image.pixels.numbers) for t in (renders, alphas))
    others: dict[str, Tensor] = {}
    if gaussians.signals is not None or image.normals:
        renders, others = _split_channels(renders, gaussians, image)
    if image.median:
        others["render_median"] = _median_depths(splats, lists, image.pixels)
    if image.render_mode.endswith("ED"):
        # Autograd saves the divisor. It is a copy, so that the caller may change alphas in place.
        covered = alphas.clone().clamp_(min=1e-10)
        renders = torch.cat([renders[..., :-1], renders[..., -1:] / covered], dim=-1)
    if len(lead) > 1 and image.pixels is None:
        shape = (*lead, *renders.shape[1:3])
        renders, alphas = renders.view(*shape, renders.shape[-1]), alphas.view(*shape, 1)
        others = {key: values.view(*shape, values.shape[-1]) for key, values in others.items()}
    return renders, alphas, others


def _median_depths(splats: ProjectedSplats, lists: Lists, pixels: Pixels | None) -> Tensor:
    """Return the depth of the splat at which half the light of each pixel is gone, [I, H, W, 1] or [M, 1]."""
    n_cameras, width, height, tile_size, *_ = lists.grid
    found = pixel_splats(
        splats.means2d, splats.conics, splats.opacities, lists.splats, lists.offsets, n_cameras=n_cameras,
        width=width, height=height, tile_size=tile_size, pixels=None if pixels is None else pixels.numbers,
    )  # fmt: skip
    # Before the first splat stands the depth of a pixel without splats.
    table = torch.cat([splats.depths.new_zeros(1), splats.depths])
    depths = table.index_select(0, found.medians + 1)
    return depths.view(-1, 1) if pixels is not None else depths.view(n_cameras, height, width, 1)


def _signals(splats: ProjectedSplats, gaussians: Gaussians, with_spare: bool) -> Tensor:
    """Return the extra signals of P splats, [P, E]; SH are evaluated as for colours, but not clamped."""
    signals = gaussians.signals
    assert signals is not None
    rows = _rows(splats, gaussians, signals.per_view, with_spare)
    if signals.sh_degree is None:
        return signals.values.reshape(-1, signals.channels).index_select(0, rows)
    used = (signals.sh_degree + 1) ** 2
    table = signals.values.reshape(-1, *signals.values.shape[-2:])[:, :used]
    means = _joined([scene.means for scene in gaussians.scenes]).index_select(0, rows)
    directions = means - _centres(splats, gaussians, with_spare)
    return spherical_harmonics(signals.sh_degree, directions, table.index_select(0, rows)) + 0.5


def _normals(splats: ProjectedSplats, gaussians: Gaussians, sparse_grad: bool, with_spare: bool) -> Tensor:
    """Return the normals of P splats, [P, 3], unit vectors in world coordinates.

    The normal is gsplat's: the third axis of the Gaussian, turned so that it faces the camera centre.
    Differentiable in quats.
    """
    rows = _rows(splats, gaussians, False, with_spare)
    quats = embedding(rows, _joined([scene.quats for scene in gaussians.scenes]), sparse=sparse_grad)
    largest = quats.detach().abs().amax(dim=1, keepdim=True)
    zero = largest == 0  # the identity, with the gradient zero
    # Scaled first, so that no square overflows. No tensor is made of numbers: the device would wait for it.
    w, x, y, z = (quats / largest.masked_fill(zero, 1)).masked_fill(zero, 0).unbind(dim=1)
    w = w + zero[:, 0]
    axes = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], dim=1)
    axes = axes / (w * w + x * x + y * y + z * z)[:, None]
    with torch.no_grad():
        means = _joined([scene.means for scene in gaussians.scenes]).index_select(0, rows)
        rays = means - _centres(splats, gaussians, with_spare)
        signs = torch.where((axes * rays).sum(dim=1, keepdim=True) > 0, -1.0, 1.0).to(axes.dtype)
    return axes * signs


def _rows(splats: ProjectedSplats, gaussians: Gaussians, per_view: bool, with_spare: bool) -> Tensor:
    """Return the row of each splat in a table of all scenes, [S N, ...] or per view [S C N, ...]."""
    rows = splats.gaussian_ids
    if len(gaussians.scenes) > 1 or per_view:
        images = splats.camera_ids.long()
        rows = (images if per_view else images // gaussians.views) * gaussians.n_gaussians + rows
    if with_spare:
        length = len(gaussians.scenes) * gaussians.n_gaussians * (gaussians.views if per_view else 1)
        rows = rows.clamp(0, length - 1)
    return rows


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _centres(splats: ProjectedSplats, gaussians: Gaussians, with_spare: bool) -> Tensor:
    """Return the camera centre of each splat's view, -R^T t, [P, 3]."""
    viewmats = _joined([scene.viewmats for scene in gaussians.scenes])
    centres = -(viewmats[:, :3, :3] * viewmats[:, :3, 3:]).sum(dim=1)
    images = splats.camera_ids
    return centres.index_select(0, images.clamp(0, len(viewmats) - 1) if with_spare else images)
