# SPDX-License-Identifier: Apache-2.0
"""The synthetic city: a seed gives the same files, geometry is right, and no image is empty."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool

import cv2
import numpy as np
import pytest

from blitzgs.capture.colmap import read_model, world_to_camera
from blitzgs.cli import main
from blitzgs_synth import generate_city
from blitzgs_synth.city import tower_height
from blitzgs_synth.flight import CLIMB, flight_height, plan_flight
from blitzgs_synth.materials import Noise, cell_random, inside, stripes
from blitzgs_synth.photographs import each
from blitzgs_synth.plan import PRESETS, CityOptions, Plan
from blitzgs_synth.render import RayCaster
from blitzgs_synth.tracks import ball, may_see
from tests.helpers import refused

pytest.importorskip("embreex")

SMALL = {"extent": 100.0, "views": 9, "width": 192, "height": 128, "points_per_view": 150}


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return generate_city(tmp_path_factory.mktemp("synth") / "city", **SMALL)


def digests(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_same_bytes_by_seed_for_any_number_of_processes(city, tmp_path):
    assert digests(generate_city(tmp_path / "again", **SMALL, processes=1)) == digests(city)
    other = digests(generate_city(tmp_path / "other", **SMALL, seed=1))
    images = [name for name in other if name.endswith(".jpg")]
    assert len(images) == 9
    assert not set(other[n] for n in images) & set(digests(city).values())


def test_every_image_shows_something(city):
    model = read_model(city / "sparse" / "0")
    assert sorted(p.name for p in (city / "images").iterdir()) == sorted(model.images.names)
    for name in model.images.names:
        image = cv2.imread(str(city / "images" / name))
        assert image.shape == (128, 192, 3)
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        assert 60 < gray.mean() < 190 and gray.std() > 20
        assert (gray > 250).mean() < 0.1 and (gray < 5).mean() < 0.1
        assert np.unique(image.reshape(-1, 3) // 8, axis=0).shape[0] > 300


def test_points_project_onto_their_observations(city):
    model = read_model(city / "sparse" / "0", points2d=True, tracks=True)
    focal, _, cx, cy = model.cameras[0].params
    images, points = model.images, model.points
    assert len(points.ids) > 300
    assert points.track_lengths.min() >= 3
    rotations = world_to_camera(images)[:, :3, :3]
    errors = []
    for i in range(len(images.ids)):
        rows = slice(int(images.point2d_offsets[i]), int(images.point2d_offsets[i + 1]))
        ids = images.point3d_ids[rows]
        xyz = points.positions[ids[ids > 0] - 1]
        camera = xyz @ rotations[i].T + images.translations[i]
        assert (camera[:, 2] > 1).all()
        pixels = camera[:, :2] / camera[:, 2:] * focal + (cx, cy)
        errors.append(np.linalg.norm(pixels - images.points2d[rows][ids > 0], axis=1))
    errors = np.concatenate(errors)
    assert len(errors) == points.track_lengths.sum()
    assert 0.1 < np.median(errors) < 1.0
    assert (errors > 4).mean() < 0.02
    assert abs(np.average(points.errors, weights=points.track_lengths) - errors.mean()) < 1e-6


def test_views_of_the_same_point_look_alike(city):
    """Poses, images and points agree: around a point's observations the images have the same brightness."""
    model = read_model(city / "sparse" / "0", points2d=True)
    images = model.images
    brightness, ids = [], []
    for i, name in enumerate(images.names):
        image = cv2.blur(cv2.imread(str(city / "images" / name), cv2.IMREAD_GRAYSCALE), (5, 5)).astype(float)
        rows = slice(int(images.point2d_offsets[i]), int(images.point2d_offsets[i + 1]))
        matched = images.point3d_ids[rows] > 0
        x, y = images.points2d[rows][matched].astype(int).T
        brightness.append(image[np.clip(y, 0, 127), np.clip(x, 0, 191)])
        ids.append(images.point3d_ids[rows][matched])
    brightness, ids = np.concatenate(brightness), np.concatenate(ids)

    def spread(values):
        order = np.argsort(ids, kind="stable")
        same = ids[order][1:] == ids[order][:-1]
        return np.median(np.abs(np.diff(values[order]))[same])

    assert spread(brightness) < 0.4 * spread(np.random.default_rng(0).permutation(brightness))


def test_pycolmap_reads_the_model(city):
    pycolmap = pytest.importorskip("pycolmap")
    reconstruction = pycolmap.Reconstruction(str(city / "sparse" / "0"))
    assert reconstruction.num_reg_images() == 9
    assert reconstruction.compute_mean_reprojection_error() < 1.5
    camera = next(iter(reconstruction.cameras.values()))
    assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (192, 128)
    for image in reconstruction.images.values():
        point = next(p for p in image.points2D if p.has_point3D())
        assert image.image_id in {
            e.image_id for e in reconstruction.points3D[point.point3D_id].track.elements
        }


def test_a_finished_city_is_reused_and_nothing_else_is_touched(city, tmp_path):
    before = (city / "city.json").stat().st_mtime_ns
    calls = []
    assert generate_city(city, **SMALL, progress=lambda *a: calls.append(a)) == city
    assert not calls and (city / "city.json").stat().st_mtime_ns == before
    refused(FileExistsError, r"another city \(seed 0, not 5\)", generate_city, city, **SMALL, seed=5)
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="has files but no generated city; choose another folder"):
        generate_city(tmp_path, **SMALL, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_overwriting_and_failing_leave_no_half_made_city(tmp_path):
    tiny = {"extent": 60.0, "views": 3, "width": 48, "height": 32, "points_per_view": 20}
    out = generate_city(tmp_path / "city", **tiny)
    (out / "run").mkdir()

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate_city(out, **tiny, seed=1, overwrite=True, progress=interrupt)
    assert json.loads((out / "city.json").read_text())["seed"] == 0
    for other in (out / "images" / "mine.jpg", out / "sparse" / "0" / "mine.txt"):
        other.write_text("mine")
        with pytest.raises(FileExistsError, match=f"{other} is no part of the city, and would be lost"):
            generate_city(out, **tiny, seed=1, overwrite=True)
        other.unlink()
    generate_city(out, **tiny, seed=1, overwrite=True)
    assert json.loads((out / "city.json").read_text())["seed"] == 1
    assert sorted(os.listdir(tmp_path)) == ["city"]
    assert sorted(os.listdir(out)) == ["city.json", "images", "run", "sparse"]


@pytest.mark.parametrize(("name", "value"), [("extent", 10.0), ("views", 2), ("width", 8), ("oblique", 1.5)])
def test_parameters_out_of_range_are_named(tmp_path, name, value):
    with pytest.raises(ValueError, match=f"{name} must be between .* got {value}"):
        generate_city(tmp_path / "x", **{name: value})
    assert not (tmp_path / "x").exists()


def test_the_command_generates_a_city(city, capsys):
    flags = [f"--{key.replace('_', '-')}={value}" for key, value in SMALL.items()]
    assert main(["synth", str(city), *flags]) == 0
    assert "9 images of 192 x 128" in capsys.readouterr().out
    assert main(["synth", str(city), "--preset", "town"]) == 1
    wanted = f"another city .*extent 100.0, not {PRESETS['town'].extent}"
    assert re.search(wanted, capsys.readouterr().err)


def test_a_killed_generation_continues_and_redoes_torn_photographs(city, tmp_path):
    """The system kills a generation; a picture of it is torn, and a record is lost."""
    out = tmp_path / "city"
    script = (
        "import os, sys, signal\nfrom blitzgs_synth import generate_city\n"
        "stop = lambda done, total: done == 5 and os.kill(os.getpid(), signal.SIGKILL)\n"
        f"generate_city(sys.argv[1], **{SMALL!r}, processes=2, progress=stop)\n"
    )
    killed = subprocess.run([sys.executable, "-c", script, str(out)], timeout=120, capture_output=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    partial = tmp_path / ".city.partial"
    assert not out.exists()
    pictures = sorted((partial / "images").glob("*.jpg"))
    assert len(pictures) >= 5
    torn = pictures[0].read_bytes()
    pictures[0].write_bytes(torn[: len(torn) // 2])
    (partial / "corners" / "00001.npz").write_bytes(b"PK")
    (partial / "images" / ".0123456789ab.partial").touch()
    untouched = pictures[2].stat().st_mtime_ns
    generate_city(out, **SMALL)
    assert digests(out) == digests(city)
    assert (out / "images" / pictures[2].name).stat().st_mtime_ns == untouched
    assert os.listdir(tmp_path) == ["city"]


def test_the_beginning_of_another_city_is_not_continued(city, tmp_path):
    def interrupt(done, total):
        raise KeyboardInterrupt

    out = tmp_path / "city"
    with pytest.raises(KeyboardInterrupt):
        generate_city(out, **SMALL | {"seed": 3}, progress=interrupt)
    assert digests(generate_city(out, **SMALL)) == digests(city)


def test_what_is_no_unfinished_city_stays(tmp_path):
    partial = tmp_path / ".city.partial"
    partial.mkdir()
    (partial / "precious.txt").write_text("mine")
    refused(FileExistsError, "holds no unfinished city", generate_city, tmp_path / "city", **SMALL)
    assert (partial / "precious.txt").read_text() == "mine"


def test_two_processes_do_not_make_the_same_city(tmp_path):
    tiny = {"extent": 60.0, "views": 3, "width": 48, "height": 32, "points_per_view": 20}

    def again(done, total):
        with pytest.raises(BlockingIOError, match="another process is making this city"):
            generate_city(tmp_path / "city", **tiny)

    generate_city(tmp_path / "city", **tiny, progress=again)


def test_a_process_that_the_system_ends_is_an_error():
    def die(index):
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(BrokenProcessPool):
        list(each(die, 4, 2))


def test_stripes_and_intervals_are_box_filtered():
    x = np.linspace(-5, 5, 20001, dtype=np.float32)
    sharp = ((x / 1.5) % 1 < 0.3).astype(np.float64)
    width = 0.4
    kernel = np.ones(round(width / (x[1] - x[0])))
    filtered = np.convolve(sharp, kernel / len(kernel), "same")[2000:-2000]
    got = stripes(x, 1.5, 0.0, 0.3, np.full_like(x, width))[2000:-2000]
    np.testing.assert_allclose(got, filtered, atol=4e-3)
    edge = inside(np.array([0.9, 1.0, 1.05, 1.2], np.float32), 0.0, 1.0, np.full(4, 0.2, np.float32))
    np.testing.assert_allclose(edge, [1.0, 0.5, 0.25, 0.0], atol=1e-6)


def test_noise_tiles_and_is_standardised():
    noise = Noise(3)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 64, (2, 50_000)).astype(np.float32)
    values = noise(x, y)
    assert abs(values.mean()) < 0.02 and abs(values.std() - 1) < 0.02
    np.testing.assert_allclose(noise(x - 64, y + 128), values, atol=0.05)
    assert np.abs(noise(x, y) - noise(x + np.float32(0.01), y)).max() < 0.2
    assert noise(x[:0], y[:0]).shape == (0,)


def test_cell_random_is_uniform_and_depends_on_every_argument():
    i, j = (a.ravel().astype(np.float32) for a in np.meshgrid(np.arange(-100, 100), np.arange(-100, 100)))
    value = cell_random(i, j, 7)
    assert value.min() >= 0 and value.max() < 1
    counts, _ = np.histogram(value, 20, (0, 1))
    assert np.abs(counts / len(value) - 0.05).max() < 0.006
    for other in (
        cell_random(i + 1, j, 7),
        cell_random(i, j + 1, 7),
        cell_random(i, j, 8),
        cell_random(j, i, 7),
    ):
        assert abs(np.corrcoef(value, other)[0, 1]) < 0.03


def test_bending_is_undone_exactly():
    plan = Plan(CityOptions(extent=300))
    points = np.random.default_rng(1).uniform(-200, 200, (1000, 3))
    bent = plan.bend(points)
    assert 1 < np.abs(bent - points)[:, :2].max() < 20
    x, y = plan.unbend(bent[:, 0].astype(np.float32), bent[:, 1].astype(np.float32))
    np.testing.assert_allclose(np.stack([x, y], 1), points[:, :2], atol=2e-3)


@pytest.mark.parametrize("name", PRESETS)
def test_flights_cover_the_city_above_its_towers(name):
    options = PRESETS[name]
    views = plan_flight(options)
    assert len(views) == options.views and len({v.name for v in views}) == options.views
    assert flight_height(options) > 1.3 * tower_height(Plan(options))
    levels = [round(np.log(view.centre[2] / flight_height(options)) / np.log(CLIMB)) for view in views]
    assert (np.diff(np.bincount(levels)) < 0).all() and max(levels) == options.altitudes - 1
    headings = set()
    # Without oblique views, the images end a little before the edge.
    line = np.linspace(-0.5, 0.5, 9) * (1 if options.oblique > 0 else 0.9) * options.extent
    spots = np.stack([a.ravel() for a in np.meshgrid(line, line)], 1)
    seen = np.zeros(len(spots), int)
    for view in views:
        np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rotation) > 0 and view.rotation[2, 2] < 0
        ahead = view.rotation.T @ np.array([0.3, -0.2, 1.0])
        pixel, _ = view.project((view.centre + 50 * ahead)[None])
        np.testing.assert_allclose(view.directions(pixel)[0], ahead / np.linalg.norm(ahead), atol=1e-9)
        tilted = view.rotation[2, :2]
        if np.linalg.norm(tilted) > 0.5:
            headings.add(round(np.degrees(np.arctan2(*tilted)) / 90) % 4)
        pixels, depth = view.project(np.pad(spots, ((0, 0), (0, 1))))
        seen += (depth > 0) & ((pixels > 0) & (pixels < (view.width, view.height))).all(1)
    assert headings == ({0, 1, 2, 3} if options.oblique > 0 else set())
    assert seen.min() >= (4 if options.oblique > 0 else 1)


def test_no_group_of_points_in_view_is_passed_over():
    rng = np.random.default_rng(0)
    views = plan_flight(CityOptions(extent=600, views=20))
    groups = [c + rng.normal(0, rng.uniform(1, 40), (30, 3)) for c in rng.uniform(-400, 400, (60, 3))]
    balls = np.stack([ball(g) for g in (*groups, np.zeros((0, 3)))])
    passed_over = 0
    for view in views:
        may = may_see(view, balls)
        assert not may[-1]
        for group, considered in zip(groups, may, strict=False):
            pixels, depth = view.project(group)
            inside = ((pixels > 0) & (pixels < (view.width, view.height))).all(1) & (depth > 0)
            assert considered or not inside.any()
        passed_over += (~may).sum()
    assert passed_over > 0.5 * len(views) * len(groups)


def test_rays_hit_what_they_should():
    square = np.array([[[0, 0, 1], [2, 0, 1], [2, 2, 1]], [[0, 0, 1], [2, 2, 1], [0, 2, 1]]], np.float32)
    caster = RayCaster(square)
    origins = np.array([[1.5, 0.5, 5], [0.5, 1.5, 5], [3, 3, 5], [1, 0.5, 0]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, -1], [0, 0, -1], [0, 0, 1]], np.float32)
    hits = caster.hit(origins, directions)
    assert hits.triangle.tolist() == [0, 1, -1, 0]
    np.testing.assert_allclose(hits.distance[[0, 1, 3]], [4, 4, 1], rtol=1e-6)
    assert caster.occluded(origins, directions).tolist() == [True, True, False, True]
    assert caster.occluded(origins[:0], directions[:0]).shape == (0,)


def test_missing_embree_is_explained(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "embreex.rtcore_scene", None)
    with pytest.raises(ImportError, match=r"embreex.*pip install \"blitzgs\[synth\]\""):
        RayCaster(np.zeros((1, 3, 3), np.float32))
