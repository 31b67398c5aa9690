# SPDX-License-Identifier: Apache-2.0
"""What is drawn of a table, and which of its blocks and rows are visible."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.ops.blocks import BLOCK_ROWS
from blitzgs.ops.projection_types import Views
from blitzgs.population.initialisation import _seen_by_more
from blitzgs.runs.folder import open_run
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.draw import LAYER_ROWS, Drawer, intrinsics
from blitzgs.view.gate import LodGate, ModelGate
from blitzgs.view.levels import BLOCK_POINTS, PointBlocks, measure_levels
from blitzgs.view.look import MODES, Look
from blitzgs.view.views import render_options, viewmat
from blitzgs.view.visible import Subject, VisibleFinder
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, allowed, make_table, make_views, seen


def subject_of(model, part=slice(None)):
    columns = {name: getattr(model, name)[part] for name in (*PARAMETERS, "level")}
    columns["id"] = torch.arange(len(model), device=model.means.device)[part]
    options = render_options(model.config, model.space, model.sh_degree)
    return Subject(GaussianTable.of_parameters(columns), options, model.space, model.lod)


def look_of(model, camera, **choices):
    return Look(viewmat(camera, model.space), camera.K, camera.width, camera.height, **choices)


@pytest.fixture(scope="module")
def scene(trained):
    run = open_run(trained[1])
    return run.model(), run.cameras().cameras[0]


@pytest.fixture
def drawer(scene):
    return Drawer(subject_of(scene[0]), TileOwners(Ranks()))


def test_colours_are_those_of_the_model(scene, drawer):
    model, camera = scene
    picture = drawer.draw(look_of(model, camera))
    wanted = (model.render(camera).clamp(0, 1) * 255).numpy()
    assert picture.values.dtype == np.uint8
    assert np.abs(picture.values - wanted).max() <= 1
    assert 0 < picture.gaussians <= len(model)


def test_depth_and_alpha_are_those_of_the_model(scene, drawer):
    model, camera = scene
    wanted = model.render(camera, "ED", alpha=True).numpy()
    alpha = drawer.draw(look_of(model, camera, mode="alpha")).values
    depth = drawer.draw(look_of(model, camera, mode="depth")).values
    np.testing.assert_allclose(alpha, wanted[..., 1], atol=1e-5)
    seen = alpha > 0.1
    np.testing.assert_allclose(depth[seen], wanted[..., 0][seen], rtol=1e-3)


def test_counts_grow_with_what_a_pixel_goes_through(scene, drawer):
    model, camera = scene
    count = drawer.draw(look_of(model, camera, mode="count")).values
    alpha = drawer.draw(look_of(model, camera, mode="alpha")).values
    assert count.max() > 5
    assert ((count > 0) == (alpha > 0)).all()


def test_levels_have_colours_of_their_own(scene, drawer):
    model, camera = scene
    plain = drawer.draw(look_of(model, camera)).values
    levels = drawer.draw(look_of(model, camera, mode="level")).values
    assert levels.shape == plain.shape
    assert np.abs(levels.astype(int) - plain).mean() > 5


def test_layers_of_depth_are_one_picture(scene, trained, device, monkeypatch):
    model = open_run(trained[1]).model(device)
    subject, owners = subject_of(model), TileOwners(Ranks(device=torch.device(device)))
    drawer, in_one = Drawer(subject, owners), Drawer(subject, owners, in_layers=False)
    looks = {mode: look_of(*scene, mode=mode, background=(0.9, 0.2, 0.4)) for mode in MODES}
    whole = {mode: drawer.draw(look) for mode, look in looks.items()}
    monkeypatch.setitem(LAYER_ROWS, device, BLOCK_ROWS)
    for mode, picture in whole.items():
        layered = drawer.draw(looks[mode])
        assert layered.gaussians == picture.gaussians
        assert (in_one.draw(looks[mode]).values == picture.values).all()
        if mode == "count":  # each layer counts up to the last splat that touches the pixel
            assert (layered.values <= picture.values).all()
            assert ((layered.values > 0) == (picture.values > 0)).all()
            continue
        # Pixels that one layer has ended go on in the next, with at most 1 % of the light.
        tolerance = {"RGB": 3, "level": 3, "alpha": 0.01, "depth": 0.5}[mode]
        assert np.abs(layered.values.astype(float) - picture.values).max() <= tolerance


def test_depths_divide_what_a_view_sees(scene):
    model, camera = scene
    finder = VisibleFinder(subject_of(model).gaussians)
    views = Views(
        *(torch.from_numpy(m).float()[None] for m in (viewmat(camera, model.space), camera.K)),
        camera.width,
        camera.height,
    )
    near, *inner, far = finder.depths(views, [0.01, 100.0], 2)
    assert (near, far) == (0.01, 100.0)
    layers = [near, *inner, far]
    counts = [int(finder.find(views, (*planes, 0.3)).active.length) for planes in pairwise(layers)]
    assert len(counts) >= 3
    assert max(counts) < 6 * BLOCK_ROWS


def test_background_degree_planes_and_crop_change_the_picture(scene, drawer):
    model, camera = scene
    plain = drawer.draw(look_of(model, camera))
    white = drawer.draw(look_of(model, camera, background=(1.0, 1.0, 1.0)))
    assert white.values.mean() > plain.values.mean()
    assert (drawer.draw(look_of(model, camera, sh_degree=0)).values != plain.values).any()
    depth = drawer.draw(look_of(model, camera, mode="depth")).values
    middle = float(np.median(depth[depth > 0])) / model.space.unit
    near = drawer.draw(look_of(model, camera, near=middle))
    far = drawer.draw(look_of(model, camera, far=middle))
    assert near.gaussians + far.gaussians == pytest.approx(plain.gaussians, abs=plain.gaussians * 0.2)
    low, high = model.means.min(0).values.tolist(), model.means.max(0).values.tolist()
    half = (*high[:2], (low[2] + high[2]) / 2)
    cropped = drawer.draw(look_of(model, camera, crop=(tuple(low), half)))
    assert 0 < cropped.gaussians < plain.gaussians
    everything = drawer.draw(look_of(model, camera, crop=(tuple(low), tuple(high))))
    assert (everything.values == plain.values).all()


def _draw_part(ranks, folder, modes):
    run = open_run(folder)
    model, camera = run.model(), run.cameras().cameras[0]
    drawer = Drawer(subject_of(model, slice(ranks.rank, None, ranks.world_size)), TileOwners(ranks))
    pictures = [drawer.draw(look_of(model, camera, mode=mode)) for mode in modes]
    return [None if picture is None else picture.values for picture in pictures]


def test_ranks_draw_together(trained, drawer, scene):
    modes = ("RGB", "depth", "alpha", "level")
    first, second = run_ranks(_draw_part, 2, trained[1], modes)
    assert second == [None] * len(modes)
    for mode, values in zip(modes, first, strict=True):
        np.testing.assert_array_equal(values, drawer.draw(look_of(*scene, mode=mode)).values)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"mode": "heat"}, "mode"),
        ({"width": 0}, "width"),
        ({"near": 2.0, "far": 1.0}, "near plane"),
        ({"viewmat": np.full((4, 4), np.nan)}, "viewmat"),
        ({"K": np.zeros((3, 3))}, "focal"),
    ],
)
def test_impossible_looks_are_refused(change, what):
    np.testing.assert_allclose(intrinsics(200, 100, np.pi / 2), [[50, 0, 100], [0, 50, 50], [0, 0, 1]])
    fields = {"viewmat": np.eye(4), "K": intrinsics(8, 8, 1.0), "width": 8, "height": 8}
    refused(ValueError, what, Look, **fields | change)


def flat_scene(points, cameras, seed=0):
    """Points of a wide, flat scene, a third of them at one place, and cameras above it."""
    g = torch.Generator().manual_seed(seed)
    cloud = (
        torch.randn(points, 3, generator=g, dtype=torch.float64) * torch.tensor([50.0, 80.0, 3.0]).double()
    )
    cloud[: points // 3] = cloud[:1]
    centres = torch.randn(cameras, 3, generator=g, dtype=torch.float64) * 60
    centres[:, 2] = 40.0
    return cloud, centres


@pytest.mark.parametrize("count", [1, 2, BLOCK_POINTS, BLOCK_POINTS + 1, 3000])
def test_every_point_is_between_the_bounds_of_its_block(count):
    points, centres = flat_scene(count, 9)
    blocks = PointBlocks.of(points)
    assert sorted(blocks.order.tolist()) == list(range(count))
    distances = (points[blocks.order] - centres[:, None]).norm(dim=2)
    parts = list(blocks.distances(centres))
    assert torch.equal(torch.cat([some for some, _, _ in parts]), centres)
    for bounds, tightest in ((1, torch.amin), (2, torch.amax)):
        bound = torch.cat([part[bounds] for part in parts])
        for block, own in enumerate(distances.split(BLOCK_POINTS, dim=1)):
            edge = tightest(own, dim=1)
            assert (bound[:, block] <= edge).all() if bounds == 1 else (bound[:, block] >= edge).all()
    chosen = torch.arange(len(blocks)).expand(len(centres), -1)
    own = blocks.distances_of(centres, chosen, math.inf).flatten(1)
    assert torch.equal(own[:, :count], distances) and own[:, count:].isinf().all()


@pytest.mark.parametrize("pairs", [1, 200, 1 << 20])
@pytest.mark.parametrize(("count", "cameras"), [(700, 1), (6000, 150), (40, 300)])
def test_levels_and_visible_voxels_are_those_of_all_distances(monkeypatch, pairs, count, cameras):
    monkeypatch.setattr("blitzgs.view.levels._PAIRS", pairs)
    points, centres = flat_scene(count, cameras, seed=count)
    distances = np.linalg.norm(points.numpy()[None] - centres.numpy()[:, None], axis=2)
    levels = measure_levels(points, centres, 2.0)
    d_max = np.quantile(np.quantile(distances, 0.999, axis=1), 0.999)
    assert levels.reference_distance == pytest.approx(d_max, rel=1e-12)
    d_min = np.quantile(np.quantile(distances, 0.001, axis=1), 0.001)
    assert levels.count == round(np.log2(d_max / d_min)) + 1
    for share in (0.0, 0.3, 0.9, 1.0):
        for farthest in (5.0, 45.0, 90.0, 300.0):
            seen = (distances <= farthest).sum(axis=0) / cameras > share
            assert _seen_by_more(points, centres, farthest, share).tolist() == seen.tolist()


LIMITS = (NEAR, FAR, 0.3)
OPTIONS = RenderOptions(sh_degree=0, near_plane=NEAR, far_plane=FAR)


def test_rows_outside_the_views_are_left_out_and_the_image_stays_the_same(device):
    table, views = make_table(device=device), Views(*make_views(device=device), WIDTH, HEIGHT)
    found = VisibleFinder(table).find(views, LIMITS)
    ids, bits = found.active.listed()
    assert found.table is table and torch.equal(found.rows_of(ids), ids)
    assert seen(table, views.viewmats, views.Ks) <= allowed((ids, bits))
    assert len(ids) < 0.8 * len(table)
    whole = render_frame(table, views, OPTIONS).renders
    assert whole.any() and torch.equal(render_frame(table, views, OPTIONS, found.active).renders, whole)


def test_the_gate_leaves_out_the_rows_that_it_leaves_out_of_the_whole_table(device):
    table, views = make_table(device=device), Views(*make_views(device=device), WIDTH, HEIGHT)
    table["level"] = (torch.arange(len(table), device=device) % 6).to(torch.uint8)
    lod = ModelGate(LodGate(20.0, 2.0, 6, 4), 1.0, table, Ranks(device=torch.device(device)))
    gated = lod.active(table, views.viewmats)
    found = VisibleFinder(table, lod).find(views, LIMITS).active
    image, expected = (render_frame(table, views, OPTIONS, rows).renders for rows in (found, gated))
    assert torch.equal(image, expected)
    assert not torch.equal(image, render_frame(table, views, OPTIONS).renders)
    assert int(found.considered()) < int(gated.considered()) < len(table)


def test_a_table_without_rows_is_found_empty(device):
    table = make_table(device=device)
    table.keep(torch.zeros(len(table), dtype=torch.bool, device=device))
    views = Views(*make_views(device=device), WIDTH, HEIGHT)
    found = VisibleFinder(GaussianTable(table.columns)).find(views, LIMITS)
    assert len(found.active.listed()[0]) == 0
    assert not render_frame(found.table, views, OPTIONS, found.active).renders.any()
