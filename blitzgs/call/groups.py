# SPDX-License-Identifier: Apache-2.0
"""Projects any number of scenes and views, in groups of what one launch can take.

A call of one group is queued as a whole: projection, lists and compositing, without waiting for the device in
between.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs._torch import hooks_on_saved_tensors
from blitzgs.call.arguments import Gaussians, Scene
from blitzgs.call.channels import ImageOptions, channels_of
from blitzgs.call.covariances import Decomposed, shaped_by
from blitzgs.call.layout import CUDA_TILE_SIZE, Lists
from blitzgs.frame.render import run_attempts
from blitzgs.frame.transport.protocol import Exchange, LocalTransport
from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.project import TableRows, differentiable_splats, gaussian_tensors, project_splats
from blitzgs.ops.projection_types import (
    MAX_VIEWS,
    VIEW_TOTALS,
    ProjectedSplats,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
    first_rows,
)
from blitzgs.ops.unscented import Lenses, project_unscented


class Group(NamedTuple):
    """Views of one scene that are projected together."""

    inputs: ProjectionInputs
    first_image: int  # number of its first view among the images of the call
    # The covariances that the caller gave instead of quats and scales; None: none.
    covariances: Decomposed | None
    # The rows that `inputs` were gathered from, as long as these; None: `inputs` are the tables.
    rows: Gathered | None = None
    lenses: Lenses | None = None  # lenses and shutters of the views; None: pinhole cameras


class Gathered(NamedTuple):
    """Rows of tables that some view sees."""

    ids: Tensor  # int32 [A], the rows
    tables: ProjectionInputs  # means, quats, scales and opacities
    sh: ShTables


def groups_of(gaussians: Gaussians, options: ProjectionOptions) -> list[Group]:
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
            own = gaussian_tensors(scene.means, scene.quats, scene.scales, scene.opacities, sh[part])
            inputs = ProjectionInputs(own, (viewmats, Ks), options)
            lenses = scene.lenses and scene.lenses.rows(part * most, (part + 1) * most)
            groups.append(Group(inputs, s * n_views + part * most, scene.covariances, lenses=lenses))
    return groups


@torch.no_grad()
def gathered_groups(groups: Sequence[Group], sh: ShTables) -> list[Group]:
    """Return groups of the Gaussians alone that a view of any group sees.

    `groups`: of one scene, without SH.
    """
    ids = torch.cat([project_splats(group.inputs).visible_ids for group in groups]).unique()
    sh.before(ids, None)
    rows = [table.index_select(0, ids) for table in groups[0].inputs.gaussians]
    if sh.parts:
        rows.append(torch.cat([part.index_select(0, ids) for part in sh.parts], dim=1))
    return [
        group._replace(inputs=group.inputs._replace(gaussians=rows), rows=Gathered(ids, group.inputs, sh))
        for group in groups
    ]


def _sh_of_views(gaussians: Gaussians, scene: Scene, parts: int) -> Sequence[Tensor | None]:
    """Return the SH that each part of a scene's views is rendered with."""
    if gaussians.sh_degree is None or scene.colors is None:
        return (None,) * parts
    if not gaussians.per_view:
        return (scene.colors,) * parts
    # Without views there is still one part, and the sum over no views is a zero for each coefficient.
    return scene.colors.unbind(0) if scene.colors.shape[0] else (scene.colors.sum(dim=0),)


def project_groups(groups: Sequence[Group], sparse_grad: bool) -> ProjectedSplats:
    """Return the splats of all images, those of a group after those of the groups before.

    `sparse_grad`: see `blitzgs.ops.project.project`. Returns splats whose camera_ids number all images of the
    call. Of several groups, visible_ids and splat_offsets have no meaning.
    """
    parts = []
    for group in groups:
        done = () if group.rows is None else _splats_of_rows(group)
        tables = group.inputs if group.rows is None else group.rows.tables
        if group.lenses is not None:
            splats = project_unscented(group.inputs, group.lenses)
        else:
            splats = differentiable_splats(tables, sparse_grad, *done)
        if group.covariances is not None:
            splats = shaped_by(splats, group.inputs, group.covariances)
        if len(groups) == 1:
            return splats
        parts.append(splats._replace(camera_ids=splats.camera_ids + group.first_image))
    *columns, counts = zip(*parts, strict=True)
    return ProjectedSplats._make((*map(torch.cat, columns), torch.stack(counts).sum(dim=0)))


def _splats_of_rows(group: Group) -> tuple[ProjectedSplats, TableRows]:
    """Project rows that were gathered from tables; the splats have the numbers of the tables."""
    assert group.rows is not None
    splats, (ids, _, sh) = project_splats(group.inputs), group.rows
    indices = ids.long()[splats.visible_ids]
    rows = TableRows(group.inputs, splats.visible_ids, indices, sh.parts)
    return splats._replace(gaussian_ids=ids[splats.gaussian_ids], visible_ids=indices.int()), rows


def groups_may_be_queued(groups: Sequence[Group]) -> bool:
    """Tell whether the work of a call may be queued before the host knows the number of splats."""
    if len(groups) > 1 or groups[0].covariances is not None or groups[0].lenses is not None:
        return False
    means, options = groups[0].inputs.gaussians[0], groups[0].inputs.options
    return means.shape[0] > 0 and (not means.is_cuda or options.tile_size == CUDA_TILE_SIZE)


_EXACT = LocalTransport(exact=True)
# What the op `render` returns before the colours and rows.
_LISTS, _IMAGES = 2, 8


class Rendered(NamedTuple):
    """The outputs of the ops; see each op for its fields."""

    splats: ProjectedSplats
    lists: Lists
    composited: Sequence[Tensor]  # what `rasterize_fwd` returned, and alphas
    rows: TableRows | None  # the visible rows, if the SH are in tables of which only these are read
    has_blank_view: bool  # whether some view sees no Gaussian


class ShTables(NamedTuple):
    """SH of which only the rows of visible Gaussians are read."""

    parts: Sequence[Tensor]  # the SH of all Gaussians in parts, [N, L, 3] each; empty: no SH are rendered
    # Called before rows are read, with the rows, int32 [A], and the number of those that are valid, int32 [1]
    # on the device, or None if all are.
    before: Callable[[Tensor, Tensor | None], object]


def render_queued(
    inputs: ProjectionInputs,
    gaussians: Gaussians,
    image: ImageOptions,
    only_colors: bool,
    tables: ShTables | None = None,
) -> Rendered:
    """Render without gradients; the differentiable ops take this result instead of computing it again.

    If earlier calls had the same size, the host queues all work first and reads the number of splats while
    the GPU works.

    `only_colors`: whether the colours that the projection computes are all channels. `tables`: the SH, if
    they are not part of `inputs`.
    """
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
        _, n_splats, n_isects = exchange.arrived
        projected, has_spare = exchange.projected, n_splats is not None
        splats = projected.splats
        if tables is not None:
            tables.before(splats.visible_ids, projected.n_visible if has_spare else None)
        channels = None
        if not sh:
            channels = splats.colors if only_colors else channels_of(splats, gaussians, image, not exact)
        outputs = torch.ops.blitzgs.render(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids,
            splats.visible_ids, splats.splat_offsets, splats.radii, splats.tiles_touched,
            channels, image.render_mode != "RGB", rows_of, sh, *inputs.cameras, *options,
            image.backgrounds, n_isects, backward_follows, projected.totals if has_spare else None,
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
    rows = None
    if tables is not None:
        colors, numbers, indices, *found = of_rows
        splats = splats._replace(colors=colors)
        rows = TableRows(inputs._replace(gaussians=found), numbers, indices, sh)
    has_blank_view = 0 in rest[VIEW_TOTALS - 3 :]
    grid = TileGrid(inputs.n_views, options.width, options.height, options.tile_size)
    return Rendered(splats, Lists(isect_splats, tile_offsets, grid), images, rows, has_blank_view)


@lru_cache(maxsize=16)
def _transport(_device: torch.device, _gaussians: int, _views: int) -> LocalTransport:
    """Return the transport, with its estimate of sizes, of all calls of this size."""
    return LocalTransport()
