# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.folder import open_run
from blitzgs.table.table import PARAMETERS
from blitzgs.view.draw import Drawer, Subject, intrinsics, table_of_parameters
from blitzgs.view.look import Look
from blitzgs.view.views import render_options, viewmat
from tests.distributed.rank_harness import run_ranks


def subject_of(model, part=slice(None)):
    columns = {name: getattr(model, name)[part] for name in (*PARAMETERS, "level")}
    columns["id"] = torch.arange(len(model))[part]
    options = render_options(model.config, model.space, model.sh_degree)
    return Subject(table_of_parameters(columns), options, model.space.unit, model.lod)


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
    fields = {"viewmat": np.eye(4), "K": intrinsics(8, 8, 1.0), "width": 8, "height": 8}
    with pytest.raises(ValueError, match=what):
        Look(**(fields | change))
