# SPDX-License-Identifier: Apache-2.0
"""Renders checked Gaussians: projects them in groups, arranges the splats, lists them by tile, composites."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians, Scene
from blitzgs.call.finite import watch_for_non_finite
from blitzgs.call.groups import Group, groups_may_be_queued, groups_of, project_groups
from blitzgs.call.intrinsics import CamerasOnHost, check_intrinsics
from blitzgs.call.layout import Layout
from blitzgs.call.lists import lists_of
from blitzgs.call.meta import make_meta
from blitzgs.call.queued import ImageOptions, ShTables, channels_of, queued
from blitzgs.call.ranks import Job, send_splats
from blitzgs.ops.projection_types import ProjectionOptions
from blitzgs.ops.rasterize import Through, rasterize

_CHANNELS_AT_A_TIME = 64


def render(
    function: str,
    gaussians: Gaussians,
    project: ProjectionOptions,
    image: ImageOptions,
    tables: ShTables | None = None,
    job: Job | None = None,
    groups: Sequence[Group] | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render images; return the results of `blitzgs.rasterization`.

    Args:
        function: name of the public function, for warnings.
        gaussians: the Gaussians and views.
        project: options of the projection.
        image: options of compositing.
        tables: the SH, if only the rows of visible Gaussians are read; only where `groups_may_be_queued`.
        job: the ranks among which the Gaussians and views are divided; None: this process has all of them.
        groups: `groups_of` the Gaussians, which have SH, if they are already known.
    """
    compiling = torch.compiler.is_compiling()
    colours: list[Tensor] = []
    if groups is None:
        shown = gaussians
        if gaussians.colors is not None and gaussians.sh_degree is None:
            colours = [_nan_or_zero(scene) for scene in gaussians.scenes]
            shown = _without_non_finite(gaussians, colours)
        groups = groups_of(shown, project)
    ready, cameras = None, None
    if job is None and not compiling and groups_may_be_queued(groups):
        ready = queued(groups[0].inputs, gaussians, image, tables)
    elif not compiling:
        cameras = CamerasOnHost(gaussians)
    splats = project_groups(groups, image.sparse_grad, ready)
    layout = Layout(splats, gaussians.lead, gaussians.count, image.packed)
    # As in gsplat, Gaussians without a splat have their own opacity.
    over_all = not (image.packed or project.antialiased or image.sparse_grad)
    arranged = layout.rendered_columns(gaussians.opacities if over_all else None)
    rendered, through = splats, None
    if layout.places is not None:
        if compiling or job is not None:
            columns = layout.gather(*arranged.values())
            rendered = splats._replace(**dict(zip(arranged, columns, strict=True)))
        else:
            through = Through(layout.places, [arranged[name] for name in ("means2d", "conics", "opacities")])
            if image.render_mode != "RGB":
                rendered = splats._replace(depths=layout.gather(arranged["depths"])[0])
    channels, lead = channels_of(rendered, gaussians, image.render_mode), gaussians.lead
    if job is not None:
        (rendered, channels), lead = send_splats(rendered, channels, job), (job.views,)
    # The projection counts the tiles of the splats that it returns. Ranks exchange splats, and the conics of
    # covariances differ from the projection's by rounding, so their tiles have to be counted again.
    uncounted = compiling or job is not None or ready is not None or groups[0].covariances is not None
    count = -1 if uncounted else int(splats.counts[2])
    lists, composited_lists = lists_of(rendered, math.prod(lead), project, ready, count)
    renders, alphas = rasterize(
        rendered.means2d, rendered.conics, rendered.opacities, channels,
        composited_lists.splats, composited_lists.offsets, n_cameras=math.prod(lead), width=project.width,
        height=project.height, tile_size=composited_lists.tile_size, backgrounds=image.backgrounds,
        tell_absgrad=layout.absgrad_teller(arranged["means2d"]) if image.absgrad else None,
        composited=None if ready is None else ready.composited, through=through,
    )  # fmt: skip
    if not compiling:
        # A view with a bad camera sees no Gaussian. Reading `cameras` does not wait: the host has waited for
        # the projection, which was queued after their copy.
        suspects_cameras = not cameras.are_finite() if cameras is not None else False
        if ready is not None and ready.has_blank_view:
            check_intrinsics(gaussians.named["Ks"])
            suspects_cameras = True
        watch_for_non_finite(gaussians, layout, function, colours, suspects_cameras)
    size = (*lead, project.height, project.width)
    alphas = alphas.unsqueeze(-1)
    if image.render_mode.endswith("ED"):
        # Autograd saves the divisor. It is a copy, so that the caller may change alphas in place.
        covered = alphas.clone().clamp_(min=1e-10)
        renders = torch.cat([renders[..., :-1], renders[..., -1:] / covered], dim=-1)
    if len(lead) > 1:
        renders, alphas = renders.view(*size, renders.shape[-1]), alphas.view(*size, 1)
    meta = make_meta(gaussians, layout, arranged, lists, lead, None if job is None else rendered)
    return renders, alphas, meta


def _nan_or_zero(scene: Scene) -> Tensor:
    """Return [N]: NaN for a Gaussian with a colour, in some view, that is not finite, 0 for all others."""
    assert scene.colors is not None
    # Zero times a number is zero unless the number is NaN or infinite. The product of a few channels at a
    # time needs little memory.
    parts = [(part * 0).sum(dim=-1) for part in scene.colors.detach().split(_CHANNELS_AT_A_TIME, dim=-1)]
    total = parts[0] if len(parts) == 1 else torch.stack(parts).sum(dim=0)
    return total if total.dim() == 1 else total.sum(dim=0)


def _without_non_finite(gaussians: Gaussians, colours: Sequence[Tensor]) -> Gaussians:
    """Set the opacity of Gaussians to 0 whose `colours` (`_nan_or_zero`) are NaN: NaN reaches no pixel."""
    scenes = [
        scene._replace(opacities=scene.opacities.masked_fill(value.isnan(), 0))
        for scene, value in zip(gaussians.scenes, colours, strict=True)
    ]
    return replace(gaussians, scenes=tuple(scenes))
