# SPDX-License-Identifier: Apache-2.0
"""Renders checked Gaussians: projects them in groups, arranges the splats, lists them by tile, composites."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians, Scene
from blitzgs.call.finite import find_bad_cameras, watch_for_non_finite
from blitzgs.call.groups import Group, groups_of, project_groups
from blitzgs.call.layout import Layout
from blitzgs.call.meta import Lists, make_meta
from blitzgs.call.queued import Rendered, ShTables, render_queued
from blitzgs.call.ranks import Job, send_splats
from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionOptions
from blitzgs.ops.rasterize import Through, rasterize

# The tile size of the CUDA kernels. If the caller asks for another one, only meta's lists have it.
CUDA_TILE_SIZE = 16
_CHANNELS_AT_A_TIME = 64


class ImageOptions(NamedTuple):
    """The options of compositing and of `meta`; see `blitzgs.rasterization`.

    Attributes:
        render_mode: which channels are rendered.
        backgrounds: [I, channels] or None.
        packed: whether `meta` has only the visible splats, or else an entry for every Gaussian and view.
        sparse_grad: whether gradients are sparse.
        absgrad: whether the backward pass also returns absolute gradients.
    """

    render_mode: str
    backgrounds: Tensor | None
    packed: bool
    sparse_grad: bool
    absgrad: bool


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
        tables: the SH, if only the rows of visible Gaussians are read; only where `may_queue`.
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
    ready, bad_cameras = None, None
    if job is None and not compiling and may_queue(groups):
        ready = _queued(groups[0], gaussians, image, tables)
    elif not compiling and gaussians.opacities.is_cuda:
        bad_cameras = find_bad_cameras(gaussians)
    splats = project_groups(groups, image.sparse_grad, ready)
    layout = Layout(splats, gaussians.lead, gaussians.count, image.packed)
    arranged = _arranged(layout, gaussians, project, image)
    rendered, through = splats, None
    if layout.places is not None:
        if compiling or job is not None:
            columns = layout.gather(*arranged.values())
            rendered = splats._replace(**dict(zip(arranged, columns, strict=True)))
        else:
            through = Through(layout.places, [arranged[name] for name in ("means2d", "conics", "opacities")])
            if image.render_mode != "RGB":
                rendered = splats._replace(depths=layout.gather(arranged["depths"])[0])
    channels, lead = _channels(rendered, gaussians, image.render_mode), gaussians.lead
    if job is not None:
        (rendered, channels), lead = send_splats(rendered, channels, job), (job.views,)
    # The projection counts the tiles of the splats that it returns. Ranks exchange splats, and the conics of
    # covariances differ from the projection's by rounding, so their tiles have to be counted again.
    uncounted = compiling or job is not None or ready is not None or groups[0].covariances is not None
    count = -1 if uncounted else int(splats.counts[2])
    lists, composited_lists = _lists(rendered, math.prod(lead), project, ready, count)
    renders, alphas = rasterize(
        rendered.means2d, rendered.conics, rendered.opacities, channels,
        composited_lists.splats, composited_lists.offsets, n_cameras=math.prod(lead), width=project.width,
        height=project.height, tile_size=composited_lists.tile_size, backgrounds=image.backgrounds,
        tell_absgrad=_absgrad_teller(layout, arranged["means2d"]) if image.absgrad else None,
        composited=None if ready is None else ready.composited, through=through,
    )  # fmt: skip
    if not compiling:
        # A view with a bad camera sees no Gaussian. Reading `bad_cameras` does not wait: the host has waited
        # for the projection, which was queued after the check of the cameras.
        suspects_cameras = ready is not None and ready.has_blank_view
        suspects_cameras |= bad_cameras is not None and bool(bad_cameras.read()[0])
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


def may_queue(groups: Sequence[Group]) -> bool:
    """Tell whether the work of a call may be queued before the host knows the number of splats."""
    if len(groups) > 1 or groups[0].covariances is not None:
        return False
    means, options = groups[0].inputs.gaussians[0], groups[0].inputs.options
    return means.shape[0] > 0 and (not means.is_cuda or options.tile_size == CUDA_TILE_SIZE)


def _queued(group: Group, gaussians: Gaussians, image: ImageOptions, tables: ShTables | None) -> Rendered:
    """Queue all work, on CUDA before the host knows the number of splats."""
    inputs = group.inputs
    # Hooks on saved tensors (checkpointing) need the same shapes each time, without spare capacity.
    hooked = torch._C._autograd._top_saved_tensors_default_hooks(True) is not None
    exact = hooked or not inputs.gaussians[0].is_cuda
    read = [*inputs.gaussians, *inputs.cameras, gaussians.colors, *(() if tables is None else tables.parts)]
    differentiable = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in read)
    return render_queued(
        inputs,
        lambda splats: _channels(splats, gaussians, image.render_mode, with_spare=not exact),
        image.render_mode != "RGB",
        image.backgrounds,
        differentiable and not image.absgrad,
        exact,
        tables,
    )


def _arranged(
    layout: Layout, gaussians: Gaussians, project: ProjectionOptions, image: ImageOptions
) -> dict[str, Tensor]:
    """Return the rendered columns of splats in the layout of `meta`."""
    splats = layout.splats
    # As in gsplat, Gaussians without a splat have their own opacity.
    over_all = not (image.packed or project.antialiased or image.sparse_grad)
    means2d, conics, depths, opacities = layout.arrange(
        splats.means2d, splats.conics, splats.depths, splats.opacities,
        under=gaussians.opacities if over_all else None,
    )  # fmt: skip
    return {"means2d": means2d, "conics": conics, "opacities": opacities, "depths": depths}


def _lists(
    splats: ProjectedSplats, images: int, project: ProjectionOptions, ready: Rendered | None, count: int
) -> tuple[Lists, Lists]:
    """Return the tile lists for meta, and those to composite.

    Args:
        splats: the splats of all images.
        images: number of images I.
        project: the size of the images, and the caller's tile size.
        ready: what `render_queued` returned, which has the lists; None: they must be made.
        count: number of entries of the lists for meta; -1: unknown.
    """
    width, height, tile_size = project.width, project.height, project.tile_size
    if ready is not None:
        lists = Lists(ready.isect_splats, ready.tile_offsets, width, height, tile_size)
        return lists, lists

    def lists_of(size: int, n_isects: int) -> Lists:
        isect_splats, offsets = torch.ops.blitzgs.intersect(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, None,
            *TileGrid(images, width, height, size), n_isects, None, True,
        )  # fmt: skip
        return Lists(isect_splats, offsets, width, height, size)

    lists = lists_of(tile_size, count)
    if not splats.means2d.is_cuda or tile_size == CUDA_TILE_SIZE:
        return lists, lists
    return lists, lists_of(CUDA_TILE_SIZE, -1)


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


def _channels(
    splats: ProjectedSplats, gaussians: Gaussians, render_mode: str, with_spare: bool = False
) -> Tensor:
    """Return the channels to composite, [P, D].

    Args:
        splats: the P splats.
        gaussians: the Gaussians, with colours.
        render_mode: which channels are rendered.
        with_spare: whether the last splats may be spare capacity, whose ids are undefined.
    """
    if gaussians.colors is None:
        return splats.depths[:, None]
    if gaussians.sh_degree is not None:
        return _with_depth(splats.colors, splats, render_mode)
    values = gaussians.colors.reshape(-1, gaussians.colors.shape[-1])
    rows = splats.gaussian_ids
    if len(gaussians.scenes) > 1 or gaussians.per_view:
        images = splats.camera_ids.long()
        rows = (images if gaussians.per_view else images // gaussians.views) * gaussians.count + rows
    if with_spare:
        rows = rows.clamp(0, len(values) - 1)
    return _with_depth(values.index_select(0, rows), splats, render_mode)


def _with_depth(values: Tensor, splats: ProjectedSplats, render_mode: str) -> Tensor:
    return values if render_mode == "RGB" else torch.cat([values, splats.depths[:, None]], dim=1)


def _absgrad_teller(layout: Layout, means2d: Tensor) -> Callable[[Tensor], None]:
    """Return a function that sets `means2d.absgrad` to the absolute gradient of the splats, [P, 2]."""

    def tell(gradient: Tensor) -> None:
        means2d.absgrad = layout.arrange(gradient)[0]  # type: ignore[attr-defined]

    return tell
