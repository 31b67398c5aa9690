# SPDX-License-Identifier: Apache-2.0
"""Renders checked Gaussians: projects them in groups, arranges the splats, lists them by tile, composites.

A group is what one launch can project. A call of one group is queued as a whole: projection, lists and
compositing, without waiting for the device in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs._torch import hooks_on_saved_tensors
from blitzgs.call.arguments import Gaussians, Scene
from blitzgs.call.bad_values import CamerasOnHost, check_intrinsics, watch_for_non_finite
from blitzgs.call.channels import ImageOptions, channels_of, images_of_caller
from blitzgs.call.covariances import Decomposed, shaped_by
from blitzgs.call.layout import Layout, Lists, lists_of
from blitzgs.call.meta import make_meta
from blitzgs.call.ranks import send_splats
from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import run_attempts
from blitzgs.frame.transport.protocol import Exchange, LocalTransport
from blitzgs.ops.derivatives import rows_of_tables
from blitzgs.ops.intersect import TILE_SIZE, TileGrid
from blitzgs.ops.project import differentiable_splats, project_splats
from blitzgs.ops.projection_types import (
    MAX_VIEWS,
    VIEW_TOTALS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
    first_rows,
)
from blitzgs.ops.rasterize import rasterize
from blitzgs.ops.unscented import Lenses, project_unscented
from blitzgs.util.errors import explain_memory

_CHANNELS_AT_A_TIME = 64
_EXACT = LocalTransport(exact=True)
# What the op `render` returns before the colours and rows.
_LISTS, _IMAGES = 2, 8


class _Group(NamedTuple):
    """Views of one scene that are projected together."""

    inputs: ProjectionInputs
    first_image: int  # number of its first view among the images of the call
    covariances: Decomposed | None  # given by the caller instead of quats and scales; None: none
    lenses: Lenses | None  # lenses and shutters of the views; None: pinhole cameras
    ids: Tensor | None = None  # int32 [A], the rows of the caller's tables in `inputs`; None: all


class ShTables(NamedTuple):
    """SH of which only the rows of visible Gaussians are read."""

    parts: Sequence[Tensor]  # the SH of all Gaussians in parts, [N, L, 3] each; empty: no SH are rendered
    # Called before rows are read, with the rows, int32 [A], and the number of those that are valid, int32 [1]
    # on the device, or None if all are.
    before: Callable[[Tensor, Tensor | None], object]


def render(
    gaussians: Gaussians,
    projection: ProjectionOptions,
    image: ImageOptions,
    ranks: Ranks | None = None,  # among which Gaussians and views are divided; None: all here
    tables: ShTables | None = None,  # the SH, if only the rows of visible Gaussians are read
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render images; return the results of `blitzgs.rasterization`. NotEnoughMemoryError: they do not fit."""
    try:
        return _rendered(gaussians, projection, image, ranks, tables)
    except (RuntimeError, MemoryError) as error:
        size = gaussians.images, projection.width, projection.height, gaussians.n_gaussians
        explain_memory(error, *size, gaussians.scenes[0].means.device)
        raise


def _rendered(
    gaussians: Gaussians,
    projection: ProjectionOptions,
    image: ImageOptions,
    ranks: Ranks | None,
    tables: ShTables | None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    compiling = torch.compiler.is_compiling()
    shown, nan_marks = _without_non_finite(gaussians)
    groups = _groups_of(shown, projection)
    queued, cameras = None, None
    if ranks is None and not compiling and image.pixels is None and _may_be_queued(groups):
        queued = _render_queued(groups[0].inputs, gaussians, image, tables)
        splats = queued.splats
    else:
        cameras = None if compiling else CamerasOnHost(gaussians)
        splats = _project_groups(groups, image.sparse_grad, tables)
    # As in gsplat, Gaussians without a splat have their own opacity.
    over_all = not (image.packed or projection.antialiased or image.sparse_grad)
    under = gaussians.opacities if over_all else None
    layout = Layout(splats, (*gaussians.lead, gaussians.n_gaussians), image.packed, under)
    rendered, meta_geometry = layout.splats_to_composite(
        gathered=compiling or ranks is not None, depths=image.render_mode != "RGB" or image.median
    )
    store_absgrad = layout.absgrad_store() if image.absgrad else None
    channels = channels_of(rendered, gaussians, image)
    lead = gaussians.lead
    if ranks is not None:
        lead = (gaussians.views // ranks.world_size,)
        rendered, channels = send_splats(rendered, channels, ranks, *lead)
    images = math.prod(lead)
    if queued is not None:
        lists = composited_lists = queued.lists
    else:
        # The projection counts the tiles of the splats that it returns. Ranks exchange splats, and the conics
        # of covariances differ from the projection's by rounding: their tiles have to be counted again.
        uncounted = compiling or ranks is not None or groups[0].covariances is not None
        count = -1 if uncounted else int(splats.counts[2])
        lists, composited_lists = lists_of(rendered, images, projection, count, image.pixels)
    renders, alphas = rasterize(
        rendered.means2d, rendered.conics, rendered.opacities, channels,
        composited_lists.splats, composited_lists.offsets, n_cameras=images, width=projection.width,
        height=projection.height, tile_size=composited_lists.grid.tile_size, backgrounds=image.backgrounds,
        store_absgrad=store_absgrad, composited=None if queued is None else queued.composited,
        meta_geometry=meta_geometry,
    )  # fmt: skip
    if not compiling:
        # A view with a bad camera sees no Gaussian. Reading `cameras` does not wait: they were copied before.
        suspects_cameras = cameras is not None and not cameras.are_finite()
        if queued is not None and queued.has_blank_view:
            check_intrinsics(gaussians.named["Ks"])
            suspects_cameras = True
        watch_for_non_finite(gaussians, layout, nan_marks, suspects_cameras)
    renders, alphas, others = images_of_caller(
        renders, alphas, gaussians, image, lead, rendered, composited_lists
    )
    arrived = None if ranks is None else rendered
    return renders, alphas, make_meta(gaussians, layout, others, lists, lead, arrived)


class _Queued(NamedTuple):
    """What `_render_queued` returns."""

    splats: ProjectedSplats  # in autograd's graph
    lists: Lists
    composited: Sequence[Tensor]  # what `rasterize_fwd` returned, and alphas
    has_blank_view: bool  # whether some view sees no Gaussian


def _render_queued(
    inputs: ProjectionInputs,
    gaussians: Gaussians,
    image: ImageOptions,
    tables: ShTables | None,  # the SH, if they are not part of `inputs`
) -> _Queued:
    """Project, list and composite; the host queues all of it first if earlier calls had the same size."""
    options, means, signals = inputs.options, inputs.gaussians[0], gaussians.signals
    rows_of, sh = ((), ()) if tables is None else (inputs.gaussians, tables.parts)
    # Hooks on saved tensors (checkpointing) need the same shapes each time, without spare capacity.
    exact = not means.is_cuda or hooks_on_saved_tensors(True) is not None
    transport = _EXACT if exact else _transport(means.device, means.shape[0], inputs.n_views)
    read = [*inputs.gaussians, *inputs.cameras, gaussians.colors, *sh, signals and signals.values]
    needed = [t for t in read if t is not None and t.requires_grad] if torch.is_grad_enabled() else []
    backward_follows = len(needed) > 0 and not image.absgrad

    def attempt(capacity: Sizes | None) -> tuple[Exchange, list[Tensor]]:
        exchange = transport.project_and_send(inputs, None, capacity)
        projected, has_spare = exchange.projected, exchange.n_splats is not None
        splats = projected.splats
        if tables is not None:
            tables.before(splats.visible_ids, projected.n_visible if has_spare else None)
        channels = None if sh else channels_of(splats, gaussians, image, not exact)
        outputs = torch.ops.blitzgs.render(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids,
            splats.visible_ids, splats.splat_offsets, splats.radii, splats.tiles_touched,
            channels, image.render_mode != "RGB", rows_of, sh, *inputs.cameras, *options,
            image.backgrounds, exchange.n_isects, backward_follows, projected.totals if has_spare else None,
        )  # fmt: skip
        return exchange, outputs

    result, outputs = run_attempts(transport, attempt)
    splats, (visible, count, isects, *rest) = result.projected, result.totals
    isect_splats, tile_offsets, *images = outputs[: _LISTS + _IMAGES]
    of_rows = outputs[_LISTS + _IMAGES :]
    if isect_splats.shape[0] > isects or (of_rows and of_rows[1].shape[0] > visible):
        # Cut spare capacity off, in one operation.
        lengths = [isects, *([count, *[visible] * (len(of_rows) - 1)] if of_rows else [])]
        isect_splats, *of_rows = first_rows([isect_splats, *of_rows], lengths)
    if tables is not None:
        colors, numbers, ids, *found = of_rows
        splats = splats._replace(colors=colors, visible_ids=numbers)
        inputs = inputs._replace(gaussians=rows_of_tables([*rows_of, *sh], ids, image.sparse_grad, found))
    splats = differentiable_splats(inputs, image.sparse_grad and tables is None, splats)
    grid = TileGrid(inputs.n_views, options.width, options.height, options.tile_size)
    has_blank_view = 0 in rest[VIEW_TOTALS - 3 :]
    return _Queued(splats, Lists(isect_splats, tile_offsets, grid), images, has_blank_view)


@lru_cache(maxsize=16)
def _transport(_device: torch.device, _gaussians: int, _views: int) -> LocalTransport:
    """Return the transport, with its estimate of sizes, of all calls of this size."""
    return LocalTransport()


def _nan_or_zero(table: Tensor) -> Tensor:
    """Return [N] for a table [N, D] or [C, N, D]: NaN for a row with a value that is not finite, else 0."""
    # Zero times a number is NaN where it is not finite. The product of a few channels at a time is small.
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


def _groups_of(gaussians: Gaussians, options: ProjectionOptions) -> list[_Group]:
    """Divide the views into groups; one scene of up to 32 views with common colours is one group."""
    groups = []
    sh_per_view = gaussians.per_view and gaussians.sh_degree is not None
    most = 1 if sh_per_view else MAX_VIEWS
    for s, scene in enumerate(gaussians.scenes):
        # Do not split a single group: the split would add a node to autograd's graph.
        views, n_views = [(scene.viewmats, scene.Ks)], scene.viewmats.shape[0]
        if n_views > most:
            views = list(zip(scene.viewmats.split(most), scene.Ks.split(most), strict=True))
        sh = _sh_of_views(gaussians, scene, len(views))
        for part, (viewmats, Ks) in enumerate(views):
            own = [scene.means, scene.quats, scene.scales, scene.opacities, *sh[part]]
            inputs = ProjectionInputs(own, (viewmats, Ks), options)
            lenses = scene.lenses and scene.lenses.rows(part * most, (part + 1) * most)
            groups.append(_Group(inputs, s * n_views + part * most, scene.covariances, lenses))
    return groups


def _sh_of_views(gaussians: Gaussians, scene: Scene, parts: int) -> list[list[Tensor]]:
    """Return the SH that each part of a scene's views is rendered with; an empty list for none."""
    if gaussians.sh_degree is None or scene.colors is None:
        return [[]] * parts
    if not gaussians.per_view:
        return [[scene.colors]] * parts
    # Without views there is still one part, and the sum over no views is a zero for each coefficient.
    return [[sh] for sh in scene.colors.unbind(0)] if scene.colors.shape[0] else [[scene.colors.sum(dim=0)]]


def _of_visible_rows(groups: Sequence[_Group], sh: ShTables, sparse_grad: bool) -> list[_Group]:
    """Return groups, of one scene without SH, of the Gaussians alone that a view of any group sees."""
    tables = groups[0].inputs.gaussians
    with torch.no_grad():
        ids = torch.cat([project_splats(group.inputs).visible_ids for group in groups]).unique()
        sh.before(ids, None)
    rows = rows_of_tables([*tables, *sh.parts], ids.long(), sparse_grad)
    return [group._replace(inputs=group.inputs._replace(gaussians=rows), ids=ids) for group in groups]


def _project_groups(groups: Sequence[_Group], sparse_grad: bool, tables: ShTables | None) -> ProjectedSplats:
    """Return the splats of all images, group by group; their camera_ids number all images of the call.

    Of several groups, visible_ids and splat_offsets have no meaning.
    """
    if tables is not None:
        groups = _of_visible_rows(groups, tables, sparse_grad)
    parts = []
    for group in groups:
        if group.lenses is not None:
            splats = project_unscented(group.inputs, group.lenses)
        else:
            splats = differentiable_splats(group.inputs, sparse_grad and group.ids is None)
        if group.covariances is not None:
            splats = shaped_by(splats, group.inputs, group.covariances)
        if group.ids is not None:
            splats = splats._replace(gaussian_ids=group.ids[splats.gaussian_ids])
        if len(groups) == 1:
            return splats
        parts.append(splats._replace(camera_ids=splats.camera_ids + group.first_image))
    *columns, counts = zip(*parts, strict=True)
    return ProjectedSplats._make((*map(torch.cat, columns), torch.stack(counts).sum(dim=0)))


def _may_be_queued(groups: Sequence[_Group]) -> bool:
    """Tell whether the work of a call may be queued before the host knows the number of splats."""
    if len(groups) > 1 or groups[0].covariances is not None or groups[0].lenses is not None:
        return False
    means, options = groups[0].inputs.gaussians[0], groups[0].inputs.options
    return means.shape[0] > 0 and (not means.is_cuda or options.tile_size == TILE_SIZE)
