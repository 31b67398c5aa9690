# SPDX-License-Identifier: Apache-2.0
"""Rows gathered for visible Gaussians have the colours of a projection with SH, bit for bit."""

import pytest
import torch

from blitzgs.ops.intersect import TileGrid
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions, Sizes, splats_of
from tests.helpers import BACKENDS, needs_cuda, random_scene


def scene_of(device="cpu", dtype=torch.float32, cameras=4):
    scene = random_scene(n=90, cameras=cameras, width=24, height=20, dtype=dtype, device=device)
    scene.opacities[::3] = 0  # seen by no view
    scene.colors[1::7] = torch.nan
    geometry = [scene.means, scene.quats, scene.scales, scene.opacities]
    return geometry, scene.colors, (scene.viewmats, scene.Ks)


def render_rows(splats, tables, parts, totals=None, with_depth=False):
    """The outputs of the op `render` for splats without colours, whose rows are gathered from tables."""
    shown = (splats.radii, splats.tiles_touched)
    geometry = (splats.means2d, splats.conics, splats.opacities, splats.depths)
    ids = (splats.camera_ids, splats.visible_ids, splats.splat_offsets)
    channels = None if parts else splats.depths[:, None].contiguous()
    valid = slice(None) if totals is None else slice(int(totals[1]))  # the others are not initialised
    return torch.ops.blitzgs.render(
        *geometry, *ids, *shown, channels, with_depth, tables.gaussians, parts, *tables.cameras,
        *tables.options, None, int(splats.tiles_touched[valid].sum()), False, totals,
    )  # fmt: skip


def colored_rows(splats, tables, parts, totals=None):
    colors, numbers, indices, *rows = render_rows(splats, tables, parts, totals)[10:]
    return splats._replace(colors=colors), (rows, numbers, indices)


def require_equal(found, expected):
    for name, column in expected._asdict().items():
        if name != "counts":
            assert torch.equal(getattr(found, name), column), name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("lengths", [(16,), (1, 15)])
def test_splats_are_those_of_a_projection_with_sh(backend, cameras, degree, lengths):
    geometry, sh, views = scene_of(*backend, cameras)
    options = ProjectionOptions(24, 20, sh_degree=degree or 0, raw=False)
    parts = () if degree is None else sh.split(lengths, dim=1)
    tables = ProjectionInputs(geometry, views, options)
    found, (rows, numbers, indices) = colored_rows(project_splats(tables), tables, parts)
    expected = project_splats(tables._replace(gaussians=[*geometry, *([sh] if parts else [])]))
    assert 0 < len(expected.visible_ids) < 90 and (degree is None or not expected.opacities.all())
    require_equal(found, expected)
    assert torch.equal(indices, expected.visible_ids.long())
    assert torch.equal(numbers, torch.arange(len(expected.visible_ids), device=backend[0]))
    wanted = [*geometry, *([sh] if parts else [])]
    for own, table in zip(rows, wanted, strict=True):
        gathered = table[expected.visible_ids.long()]
        assert torch.equal(own.nan_to_num(), gathered.nan_to_num()) and own.is_contiguous()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("with_depth", [False, True])
def test_images_are_those_of_lists_and_compositing(backend, with_depth):
    geometry, sh, views = scene_of(*backend)
    tables = ProjectionInputs(geometry, views, ProjectionOptions(24, 20, sh_degree=3, raw=False))
    found = render_rows(project_splats(tables), tables, (sh,), with_depth=with_depth)
    splats = project_splats(tables._replace(gaussians=[*geometry, sh]))
    columns, grid = (splats.means2d, splats.conics, splats.opacities), TileGrid(4, 24, 20)
    lists = torch.ops.blitzgs.intersect(*columns, splats.depths, splats.camera_ids, None, *grid, -1)
    channels = torch.cat([splats.colors, splats.depths[:, None]], 1) if with_depth else splats.colors
    expected = torch.ops.blitzgs.rasterize_fwd(*columns, channels, None, *lists, *grid)
    for i, column in enumerate((*lists, *expected[:3])):
        assert torch.equal(found[i][: len(column)], column), i
    assert torch.equal(found[9], 1 - expected[1])


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("spare", [0, 1, 5000])
def test_spare_capacity_changes_nothing(cameras, spare):
    geometry, sh, views = scene_of("cuda", cameras=cameras)
    options = ProjectionOptions(24, 20, sh_degree=3, raw=False)
    tables = ProjectionInputs(geometry, views, options)
    expected = project_splats(tables._replace(gaussians=[*geometry, sh]))
    sizes = tables.run(None).totals.cpu()[:3]
    capacity = Sizes(*(int(n) + spare for n in sizes))
    projected = tables.run(capacity)
    found, (rows, *_) = colored_rows(projected.splats, tables, (sh,), projected.totals)
    require_equal(splats_of(found, Sizes(*sizes.tolist())), expected)
    visible = expected.visible_ids.long()
    assert torch.equal(rows[0][: len(visible)], geometry[0][visible])


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("missing", [(1, 0), (0, 1), (10, 10)])
def test_too_little_capacity_writes_nothing_beyond_it(missing):
    geometry, sh, views = scene_of("cuda")
    tables = ProjectionInputs(geometry, views, ProjectionOptions(24, 20, sh_degree=3, raw=False))
    visible, splats, isects = tables.run(None).totals.cpu()[:3].tolist()
    projected = tables.run(Sizes(visible - missing[0], splats - missing[1], isects))
    colored_rows(projected.splats, tables, (sh,), projected.totals)
    torch.cuda.synchronize()
    assert projected.totals[:2].tolist() == [visible, splats]


def test_errors_name_the_argument():
    geometry, sh, views = scene_of()
    tables = ProjectionInputs(geometry, views, ProjectionOptions(24, 20, sh_degree=3, raw=False))
    splats = project_splats(tables)
    with pytest.raises(RuntimeError, match="render: camera_ids must be Int, got Long"):
        colored_rows(splats._replace(camera_ids=splats.camera_ids.long()), tables, (sh,))
    with pytest.raises(RuntimeError, match=r"render: radii must have shape"):
        colored_rows(splats._replace(radii=splats.radii[:-1]), tables, (sh,))
    with pytest.raises(RuntimeError, match="on the CPU splats have no spare capacity"):
        colored_rows(splats, tables, (sh,), torch.zeros(4, dtype=torch.int64))
