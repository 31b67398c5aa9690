# SPDX-License-Identifier: Apache-2.0
"""Renders checked Gaussians: projects them in groups, arranges the splats, lists them by tile, composites."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians
from blitzgs.call.bad_values import CamerasOnHost, check_intrinsics, watch_for_non_finite
from blitzgs.call.channels import ImageOptions, channels_of, split_channels
from blitzgs.call.extras import Pixels
from blitzgs.call.groups import (
    Group,
    ShTables,
    groups_may_be_queued,
    groups_of,
    project_groups,
    render_queued,
)
from blitzgs.call.layout import Layout, Lists, lists_of
from blitzgs.call.meta import make_meta
from blitzgs.call.ranks import CallRanks, send_splats
from blitzgs.ops.importance import pixel_splats
from blitzgs.ops.project import differentiable_splats
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions
from blitzgs.ops.rasterize import rasterize

_CHANNELS_AT_A_TIME = 64


def render(
    gaussians: Gaussians,
    projection: ProjectionOptions,
    image: ImageOptions,
    tables: ShTables | None = None,
    job: CallRanks | None = None,
    groups: Sequence[Group] | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render images; return the results of `blitzgs.rasterization`.

    `tables`: the SH, if only the rows of visible Gaussians are read; only where `groups_may_be_queued`.
    `job`: the ranks among which the Gaussians and views are divided; None: this process has all of them.
    `groups`: `groups_of` the Gaussians, which have SH, if they are already known.
    """
    compiling = torch.compiler.is_compiling()
    nan_marks: list[Tensor] = []
    if groups is None:
        shown, nan_marks = _without_non_finite(gaussians)
        groups = groups_of(shown, projection)
    with_others = gaussians.signals is not None or image.normals
    only_colors = gaussians.sh_degree is not None and not with_others and image.render_mode == "RGB"
    queued, cameras = None, None
    if job is None and not compiling and image.pixels is None and groups_may_be_queued(groups):
        queued = render_queued(groups[0].inputs, gaussians, image, only_colors, tables)
        splats = differentiable_splats(groups[0].inputs, image.sparse_grad, queued.splats, queued.rows)
    else:
        cameras = None if compiling else CamerasOnHost(gaussians)
        splats = project_groups(groups, image.sparse_grad)
    # As in gsplat, Gaussians without a splat have their own opacity.
    over_all = not (image.packed or projection.antialiased or image.sparse_grad)
    under = gaussians.opacities if over_all else None
    layout = Layout(splats, (*gaussians.lead, gaussians.n_gaussians), image.packed, under)
    rendered, meta_geometry = layout.splats_to_composite(
        gathered=compiling or job is not None, depths=image.render_mode != "RGB" or image.median
    )
    channels = rendered.colors if only_colors else channels_of(rendered, gaussians, image)
    lead = gaussians.lead
    if job is not None:
        (rendered, channels), lead = send_splats(rendered, channels, job), (job.views,)
    images = math.prod(lead)
    if queued is not None:
        lists = composited_lists = queued.lists
    else:
        # The projection counts the tiles of the splats that it returns. Ranks exchange splats, and the conics
        # of covariances differ from the projection's by rounding: their tiles have to be counted again.
        uncounted = compiling or job is not None or groups[0].covariances is not None
        count = -1 if uncounted else int(splats.counts[2])
        lists, composited_lists = lists_of(rendered, images, projection, count, image.pixels)
    renders, alphas = rasterize(
        rendered.means2d, rendered.conics, rendered.opacities, channels,
        composited_lists.splats, composited_lists.offsets, n_cameras=images, width=projection.width,
        height=projection.height, tile_size=composited_lists.grid.tile_size, backgrounds=image.backgrounds,
        store_absgrad=layout.absgrad_store() if image.absgrad else None,
        composited=None if queued is None else queued.composited, meta_geometry=meta_geometry,
    )  # fmt: skip
    if not compiling:
        # A view with a bad camera sees no Gaussian. Reading `cameras` does not wait: the host has waited for
        # the projection, which was queued after their copy.
        suspects_cameras = cameras is not None and not cameras.are_finite()
        if queued is not None and queued.has_blank_view:
            check_intrinsics(gaussians.named["Ks"])
            suspects_cameras = True
        watch_for_non_finite(gaussians, layout, nan_marks, suspects_cameras)
    median = _median_depths(rendered, composited_lists, image.pixels) if image.median else None
    renders, alphas, others = _images_of_caller(renders, alphas, median, gaussians, image, lead)
    arrived = None if job is None else rendered
    return renders, alphas, make_meta(gaussians, layout, others, lists, lead, arrived)


def _images_of_caller(
    renders: Tensor,
    alphas: Tensor,
    median: Tensor | None,
    gaussians: Gaussians,
    image: ImageOptions,
    lead: tuple[int, ...],
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Return images and alphas as the caller asked for them, and the further images of `meta` by key.

    `renders`: all channels, [I, H, W, channels]. `alphas`: [I, H, W]. `median`: median depths, [I, H, W, 1]
    or of M pixels [M, 1]. `lead`: batch dimensions, and the number of views that are rendered here.
    """
    alphas = alphas.unsqueeze(-1)
    if image.pixels is not None:
        renders, alphas = (t.flatten(0, 2).index_select(0, image.pixels.numbers) for t in (renders, alphas))
    others: dict[str, Tensor] = {}
    if gaussians.signals is not None or image.normals:
        renders, others = split_channels(renders, gaussians, image)
    if median is not None:
        others["render_median"] = median
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


def _nan_or_zero(table: Tensor) -> Tensor:
    """Return [N] for a table [N, D] or [C, N, D]: NaN for a row with a value that is not finite, else 0."""
    # Zero times a number is zero unless the number is NaN or infinite. The product of a few channels at a
    # time needs little memory.
    parts = [(part * 0).sum(dim=-1) for part in table.detach().split(_CHANNELS_AT_A_TIME, dim=-1)]
    total = parts[0] if len(parts) == 1 else torch.stack(parts).sum(dim=0)
    return total if total.dim() == 1 else total.sum(dim=0)


def _without_non_finite(gaussians: Gaussians) -> tuple[Gaussians, list[Tensor]]:
    """Set the opacity of Gaussians to 0 whose colours or signals are not finite: NaN reaches no pixel.

    SH colours are left to the projection. Also returns for each scene [N], NaN for these Gaussians and 0 for
    others; or an empty list.
    """
    columns, signals = [], gaussians.signals
    if gaussians.colors is not None and gaussians.sh_degree is None:
        columns.append(gaussians.named["colors"])
    if signals is not None:
        values = gaussians.named["extra_signals"]
        if signals.sh_degree is not None:
            values = tuple(own[:, : (signals.sh_degree + 1) ** 2].flatten(1) for own in values)
        columns.append(values)
    if not columns:
        return gaussians, []
    nan_marks = [reduce(torch.add, map(_nan_or_zero, tables)) for tables in zip(*columns, strict=True)]
    scenes = tuple(
        scene._replace(opacities=scene.opacities.masked_fill(value.isnan(), 0))
        for scene, value in zip(gaussians.scenes, nan_marks, strict=True)
    )
    return gaussians._replace(scenes=scenes), nan_marks
