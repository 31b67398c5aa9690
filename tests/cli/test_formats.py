# SPDX-License-Identifier: Apache-2.0
"""Models of files and for files, and the place of a run in the world, from the command line."""

import dataclasses
import json
import os
import re
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from blitzgs.capture.capture import load_capture
from blitzgs.capture.world import geodetic
from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import triple_of
from blitzgs.formats.models import FORMATS, offset_of, read_gaussians
from blitzgs.formats.ply import write_ply
from blitzgs.runs.source import open_source
from blitzgs.runs.trained_model import open_model
from blitzgs.runs.world import load_world_frame
from blitzgs.viewer.panel import overlay
from blitzgs.viewer.studio import open_model as open_viewed
from blitzgs.viewer.web import open_city, web_file
from blitzgs.viewer.world import Stance, World
from tests.capture import helpers as files
from tests.helpers import glb_parts
from tests.training.tiny import OVERRIDES, as_flags

os.environ.setdefault("NUMBA_DISABLE_JIT", "1")


@pytest.fixture(scope="module")
def whole(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "whole.ply"
    assert main(["export", str(trained[1]), "--ply", str(path)]) == 0
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_and_a_file_are_exported(trained, whole, tmp_path, name, capsys):
    pytest.importorskip("gsply")
    expected = read_gaussians(whole)
    for source in (trained[1], whole):
        path = tmp_path / source.name / f"model{FORMATS[name].suffix}"
        assert main(["export", str(source), f"--{name}", str(path)]) == 0
        assert re.search(rf"{path}: {len(expected):,} Gaussians, \d", capsys.readouterr().out)
        if name != "glb":
            found = read_gaussians(path)
            assert len(found) == len(expected)
            assert (found.means.mean(dim=0) - expected.means.mean(dim=0)).abs().max() < 0.05


def test_a_file_is_measured_as_its_run(trained, whole, tmp_path, capsys, failure):
    assert main(["eval", str(trained[1]), "--out", str(tmp_path / "a"), "--pictures=0"]) == 0
    run = json.loads(capsys.readouterr().out)
    flags = ["--data", str(trained[0]), "--out", str(tmp_path / "b"), "--pictures=0"]
    assert main(["eval", str(whole), *flags]) == 0
    file = json.loads(capsys.readouterr().out)
    # The file's positions are rounded to float32 away from the origin.
    assert file["psnr"] == pytest.approx(run["psnr"], abs=0.02)
    assert main(["eval", str(whole), *flags, "--downscale=2"]) == 0
    assert "pictures; 1 views, 24 x 16 pixels" in capsys.readouterr().err
    assert "add --data CAPTURE" in failure("eval", whole)
    spz = tmp_path / "model.spz"
    assert main(["export", str(trained[1]), "--spz", str(spz)]) == 0
    with pytest.warns(UserWarning, match="model.spz cannot state a background: all is measured over black"):
        assert main(["eval", str(spz), *flags]) == 0
    far = read_gaussians(whole)
    write_ply(tmp_path / "far.ply", **vars(dataclasses.replace(far, means=far.means + 1e5)))
    unseen = f"sees one of its {len(far):,} Gaussians: the file must have the coordinates of that capture"
    assert unseen in failure("eval", tmp_path / "far.ply", "--data", trained[0])
    start = ("train", "--data", trained[0], "--out", tmp_path / "run", "--config=defaults", "--start")
    assert unseen in failure(*start, tmp_path / "far.ply")
    assert "is a folder and no file of Gaussians: blitzgs export" in failure(*start, trained[1])


def test_a_training_begins_with_a_file(trained, whole, tmp_path, failure):
    out = tmp_path / "run"
    flags = ["--config=defaults", "--schedule.iterations=4", "--log.tensorboard=false"]
    arguments = ["train", "--data", str(trained[0]), "--out", str(out), "--start", str(whole)]
    with warnings.catch_warnings(record=True) as told:
        assert main([*arguments, *flags]) == 0
        assert not any("antialiasing" in str(warning.message) for warning in told)
    first = read_gaussians(whole)
    table = open_model(out, Ranks()).table
    assert len(table) == len(first)
    summary, before = (json.loads((r / "summary.json").read_text()) for r in (out, trained[1]))
    assert summary["psnr"] > before["psnr"] - 1.0
    again = (*arguments[:-3], tmp_path / "b", "--start", whole, *flags)
    assert "population.max_gaussians is 3" in failure(*again, "--population.max_gaussians=3")
    # Levels of another run mean other distances.
    first.levels, first.comments = (
        torch.arange(len(first)) % 20.0,
        ["comment lod reference_distance 8.0 fork 1.19 levels 32 finest 31"],
    )
    write_ply(tmp_path / "levels.ply", **vars(first))
    arguments[-3:] = [str(tmp_path / "c"), "--start", str(tmp_path / "levels.ply")]
    with pytest.warns(UserWarning, match="is not marked as .*: --model.antialiased=false keeps"):
        assert main([*arguments, *flags, "--model.antialiased=true"]) == 0
    assert not open_model(tmp_path / "c", Ranks()).table["level"].any()


def test_selections_of_a_run(trained, whole, tmp_path):
    expected = read_gaussians(whole)
    path = tmp_path / "a.ply"
    run = ["export", str(trained[1]), "--ply", str(path)]
    middle = expected.means.median(dim=0).values
    box = [*(middle - 100).tolist(), middle[0].item(), *(middle[1:] + 100).tolist()]
    assert main([*run, "--crop", *map(repr, box), "--sh-degree", "0"]) == 0
    found = read_gaussians(path)
    assert found.degree == 0 and len(found) == int((expected.means[:, 0] <= middle[0]).sum())
    assert main([*run, "--most", "50", "--min-opacity", "0.05"]) == 0
    found = read_gaussians(path)
    assert len(found) == 50 and found.opacities.sigmoid().min() >= 0.05
    region = tmp_path / "region.txt"
    x, y, _ = (middle + 1e-5).tolist()  # no Gaussian is on the border
    region.write_text(f"{x - 100} {y - 100}\n{x - 100} {y}\n{x + 100} {y}\n{x + 100} {y - 100}\n")
    assert main([*run, "--crop-polygon", str(region)]) == 0
    assert len(read_gaussians(path)) == int((expected.means[:, 1] <= y).sum())


def test_files_keep_their_place_in_the_world(whole, tmp_path, capsys):
    model = read_gaussians(whole)
    far, near = torch.tensor([500_000.0, 4_600_000.0, 100.0]), tmp_path / "near.ply"
    rounded = (model.means + far).double()
    write_ply(tmp_path / "far.ply", **vars(dataclasses.replace(model, means=rounded.float(), comments=[])))
    comments = ["comment offset 500000.0 4600000.0 100.0"]
    write_ply(near, **vars(dataclasses.replace(model, comments=comments)))
    for kind in ("spz", "sog"):
        path = tmp_path / f"model.{kind}"
        for source, means in (("far.ply", rounded), ("near.ply", model.means + far.double())):
            assert main(["export", str(tmp_path / source), f"--{kind}", str(path)]) == 0
            assert "coordinates are relative to" in capsys.readouterr().out
            offset = json.loads((tmp_path / f"model.{kind}.offset.json").read_text())["offset"]
            found = read_gaussians(path)
            assert (
                found.means.double() + torch.tensor(offset, dtype=torch.float64) - means
            ).abs().max() < 0.02
            # The file is read with the offset beside it, so that another conversion keeps the place.
            assert offset_of(found.comments) == tuple(offset)
        assert main(["export", str(whole), f"--{kind}", str(path)]) == 0
        assert not (tmp_path / f"model.{kind}.offset.json").exists()
    assert main(["export", str(near), "--tiles", str(tmp_path / "tiles")]) == 0
    assert "the tiles lie around (500000.0, 4600000.0, 100.0); `blitzgs align" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "position", "axes"),
    [
        ("ply", "coordinates in the file", [1, 1, 1]),
        ("spz", "(x, -y, -z) of the coordinates in the file", [1, -1, -1]),
        ("glb", "coordinates in the file, without the turn of its node,", [1, 1, 1]),
    ],
)
def test_the_offset_beside_a_file_is_that_of_what_other_readers_find(whole, tmp_path, kind, position, axes):
    model, path = read_gaussians(whole), tmp_path / f"model.{kind}"
    write_ply(
        tmp_path / "m.ply", **vars(dataclasses.replace(model, comments=["comment offset 500000 4.6e6 9"]))
    )
    assert main(["export", str(tmp_path / "m.ply"), f"--{kind}", str(path)]) == 0
    stated = json.loads(path.with_name(f"model.{kind}.offset.json").read_text())
    assert stated["meaning"] == f"capture coordinates = {position} + offset"
    if kind == "glb":
        content, body = glb_parts(path)
        accessor = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
        begin = content["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
        raw = np.frombuffer(body, "<f4", 3 * len(model), begin).reshape(-1, 3)
    elif kind == "spz":
        read = pytest.importorskip("gaussforge").GaussForge().read(path.read_bytes(), "spz")
        raw = np.frombuffer(read["data"]["positions"], "<f4").reshape(-1, 3)
    else:
        raw = read_gaussians(path).means.numpy()
    expected = model.means.double().numpy() + [500_000.0, 4_600_000.0, 9.0]
    np.testing.assert_allclose(
        (raw * axes + stated["offset"]).mean(axis=0), expected.mean(axis=0), atol=0.001
    )


@pytest.mark.parametrize("name", ["ply", "compressed-ply", "sog"])
def test_files_state_background_and_up(whole, tmp_path, capsys, name):
    source, path = tmp_path / "source.ply", tmp_path / f"model{FORMATS[name].suffix}"
    stated = ["comment background 0.25 0.5 0.75", "comment up 1.0 0.0 0.0"]
    model = read_gaussians(whole)
    write_ply(source, **vars(dataclasses.replace(model, comments=stated)))
    assert main(["export", str(source), f"--{name}", str(path)]) == 0
    assert "over the background #4080bf: set this colour in viewers" in capsys.readouterr().out
    opened = open_viewed(path, Ranks())
    assert opened.exhibit.background == opened.subject.options.background == (0.25, 0.5, 0.75)
    city = open_city(path)
    assert city.scene.background == (0.25, 0.5, 0.75) and city.scene.up == (1, 0, 0)
    assert '"up": [1.0, 0.0, 0.0]' in web_file(opened, 10**7).text
    assert main(["export", str(path), "--glb", str(tmp_path / "a.glb")]) == 0
    content = (tmp_path / "a.glb").read_bytes()
    node = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["nodes"][0]
    np.testing.assert_allclose(Rotation.from_quat(node["rotation"]).apply([1, 0, 0]), [0, 1, 0], atol=1e-6)


def test_header_lines_of_others_state_nothing(whole, tmp_path):
    lines = ["comment background 2 0 0", "comment up 0 0 0", "comment offset a b c", "comment up nan 0 1"]
    write_ply(tmp_path / "a.ply", **vars(dataclasses.replace(read_gaussians(whole), comments=lines)))
    exhibit = open_viewed(tmp_path / "a.ply", Ranks()).exhibit
    assert exhibit.background == (0, 0, 0) and exhibit.up is None
    assert np.linalg.norm(exhibit.space.offset) < 1000


def test_bad_gaussians_are_left_out_by_choice_and_no_model_replaces_itself(whole, tmp_path, failure):
    table, path = bytearray(whole.read_bytes()), tmp_path / "nan.ply"
    start = table.index(b"end_header\n") + len(b"end_header\n")
    table[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(table)
    out = ["--ply", str(tmp_path / "out.ply")]
    error = failure("export", path, *out)
    assert "nan.ply" in error and "--min-opacity 0" in error and not (tmp_path / "out.ply").exists()
    assert main(["export", str(path), *out, "--min-opacity", "0"]) == 0
    assert len(read_gaussians(tmp_path / "out.ply")) == len(read_gaussians(whole)) - 1
    assert "choose another name" in failure("export", path, "--compressed-ply", path)
    assert path.read_bytes() == table


def test_clean_shows_and_measures_what_goes(trained, whole, tmp_path, capsys):
    path = tmp_path / "a.ply"
    run = ["export", str(trained[1]), "--ply", str(path)]
    assert main([*run, "--clean", "3"]) == 0
    out = capsys.readouterr().out
    found = re.search(r"--clean: ([\d,]+) of ([\d,]+)", out).groups()
    gone, count = (int(text.replace(",", "")) for text in found)
    assert 0 < gone < count == len(read_gaussians(whole))
    assert len(read_gaussians(path)) == count - gone
    assert re.search(r"held-out PSNR: \d+\.\d+ dB before, \d+\.\d+ dB after", out)
    picture = cv2.imread(str(tmp_path / "a.ply.clean.jpg"))
    assert picture is not None and picture.shape[1] > 3 * 40 and np.ptp(picture) > 50


def test_wrong_flags_are_named(trained, whole, tmp_path, failure):
    ply = ["--ply", str(tmp_path / "a.ply")]
    for model, flags, reason in (
        (trained[1], [*ply, "--crop", *"000100"], "--crop takes the least"),
        (trained[1], [*ply, "--crop-axes", "xz"], "is for --crop-polygon"),
        (trained[1], [*ply, "--levels", "0-1"], "no octree levels"),
        (trained[1], ["--spz", str(tmp_path / "a.ply")], "ends in .spz"),
        (whole, [*ply, "--clean"], "--clean needs the folder of a run"),
        (whole, [*ply, "--classic"], "--classic needs the folder of a run"),
    ):
        assert reason in failure("export", model, *flags)
    assert list(tmp_path.iterdir()) == []


TURN = Rotation.from_euler("z", 65, degrees=True).as_matrix()
SHIFT = np.array([465_000.0, 5_250_000.0, 430.0])


@pytest.fixture
def survey(trained):
    """The capture of a run, and rows of surveyed places and marks."""
    capture = load_capture(trained[0])
    points = capture.points[np.random.default_rng(5).permutation(len(capture.points))[:7]]
    rows = []
    for k, point in enumerate(points):
        e, n, h = 12.5 * TURN @ (point + capture.offset) + SHIFT
        for camera in capture.cameras:
            x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
            u, v = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
            if z > 0 and 0 <= u <= camera.width and 0 <= v <= camera.height:
                rows.append(
                    f"P{k},{float(e)!r},{float(n)!r},{float(h)!r},{camera.name},{float(u)!r},{float(v)!r}"
                )
    yield capture, rows
    (trained[1] / "geo.json").unlink(missing_ok=True)


def test_control_points_give_the_world(trained, survey, tmp_path, capsys):
    capture, rows = survey
    path = tmp_path / "gcp.csv"
    wrong = [row.replace("P6,46", "P6,56") for row in rows]  # a slip of the surveyor by 100 km
    path.write_text("\n".join(["name,E,N,h,image,x,y", *wrong]))
    assert main(["align", str(trained[1]), "--gcp", str(path), "--crs", "EPSG:32632"]) == 0
    out, err = capsys.readouterr()
    assert "6 of 7 points used; RMS 0.0000 horizontal, 0.0000 vertical" in out and "contradicts" in out
    assert "upside down" not in err
    frame = load_world_frame(trained[1])
    assert frame.crs == "EPSG:32632" and frame.scale == pytest.approx(12.5, rel=1e-9)
    np.testing.assert_allclose(frame.to_world(np.ones(3)), 12.5 * TURN @ np.ones(3) + SHIFT, atol=1e-6)
    assert main(["export", str(trained[1]), "--ply", str(tmp_path / "m.ply"), "--coordinates", "world"]) == 0
    offset = json.loads((tmp_path / "m.ply.offset.json").read_text())
    assert offset["crs"] == "EPSG:32632" and offset["meaning"].startswith("world coordinates = ")
    # Other files that are made of it are in the world, too.
    assert main(["export", str(tmp_path / "m.ply"), "--spz", str(tmp_path / "m.spz")]) == 0
    again = json.loads((tmp_path / "m.spz.offset.json").read_text())
    assert again["crs"] == "EPSG:32632" and again["meaning"].startswith("world coordinates = ")
    up = triple_of(open_source(trained[1]).comments, "up")
    there = triple_of(read_gaussians(tmp_path / "m.ply").comments, "up")
    np.testing.assert_allclose(there, TURN @ up, atol=1e-9)
    pytest.importorskip("pyproj")
    origin = open_city(trained[1]).transform()[:3, 3]
    np.testing.assert_allclose(open_city(tmp_path / "m.spz").transform()[:3, 3], origin, atol=1e-3)
    # Into the next zone, where grid north is elsewhere: a turn by the convergence of both.
    assert main(["align", str(trained[1]), "--crs", "EPSG:32633"]) == 0
    assert "is wrong by at most" in capsys.readouterr().out
    moved = load_world_frame(trained[1])
    assert moved.crs == "EPSG:32633" and moved.scale == pytest.approx(12.5, rel=0.01)
    assert abs(moved.translation[0] - frame.translation[0]) > 1e5


def test_a_world_of_exchanged_axes_is_named(trained, survey, tmp_path, capsys):
    path = tmp_path / "gcp.csv"
    path.write_text("\n".join(["name,N,E,h,image,x,y", *survey[1]]))
    with pytest.warns(UserWarning, match="upside down in this world: are E and N exchanged"):
        assert main(["align", str(trained[1]), "--gcp", str(path), "--crs", "EPSG:32632"]) == 0


def test_coordinates_around_the_origin_are_hardly_those_of_a_map(trained, survey):
    (trained[1] / "geo.json").unlink(missing_ok=True)
    with pytest.warns(UserWarning, match="the cameras lie around E .* of EPSG:32632: .* --gcp or --gps"):
        assert main(["align", str(trained[1]), "--crs", "EPSG:32632"]) == 0


def test_what_cannot_be_aligned_is_refused(trained, survey, tmp_path, failure):
    _, rows = survey
    path = tmp_path / "gcp.csv"
    path.write_text("\n".join(["name,E,N,h,image,x,y", *(row for row in rows if row[:2] in ("P0", "P1"))]))
    run = str(trained[1])
    assert "2 of 2 control points can be used, and 3 are needed" in failure("align", run, "--gcp", path)
    assert "0 of 8 photographs have a GPS position, and 3 are needed" in failure("align", run, "--gps")
    world = ("--ply", tmp_path / "a.ply", "--coordinates", "world")
    unknown = "has no geo.json, so its place in the world is unknown: use blitzgs align"
    assert unknown in failure("export", run, *world)
    pytest.importorskip("pyproj")
    assert "EPSG:4326 (WGS 84) has angles" in failure("align", run, "--crs", "EPSG:4326")
    assert "heights in another unit" in failure("align", run, "--gcp", path, "--crs", "EPSG:2227+5703")
    with pytest.raises(SystemExit):
        main(["align", run])
    assert load_world_frame(trained[1]) is None


def test_positions_in_exif_give_the_world(trained, survey, tmp_path, monkeypatch, capsys):
    pyproj = pytest.importorskip("pyproj")
    capture, _ = survey
    to_geodetic = pyproj.Transformer.from_crs(pyproj.CRS("EPSG:32632").to_3d(), "EPSG:4979", always_xy=True)
    data = tmp_path / "capture"
    (data / "images").mkdir(parents=True)
    (data / "sparse").symlink_to(trained[0] / "sparse")
    for k, camera in enumerate(capture.cameras):
        centre = -camera.world_to_camera[:3, :3].T @ camera.world_to_camera[:3, 3] + capture.offset
        world = 12.5 * TURN @ centre + SHIFT + ([40, 0, 0] if k == 2 else 0)
        longitude, latitude, height = to_geodetic.transform(*world)
        exif = Image.Exif()
        exif[0x8825] = {1: "N", 2: dms(latitude), 3: "E", 4: dms(longitude), 5: b"\x00", 6: height}
        with Image.open(camera.image_path) as image:
            image.save(data / "images" / camera.name, exif=exif)
    assert main(["align", str(trained[1]), "--gps", "--crs", "EPSG:32632", "--data", str(data)]) == 0
    out = capsys.readouterr().out
    assert "7 of 8 positions used" in out
    frame = load_world_frame(trained[1])
    assert frame.scale == pytest.approx(12.5, rel=1e-3)
    centre = capture.offset
    np.testing.assert_allclose(frame.to_world(centre), 12.5 * TURN @ centre + SHIFT, atol=0.05)


def test_a_training_of_a_project_knows_its_world_and_resuming_keeps_an_alignment(tmp_path, capsys):
    posed = files.Posed()
    files.opensfm(posed, posed.write_images(tmp_path / "site") / "reconstruction.json", (47.5, 8.25, 432.0))
    run = tmp_path / "run"
    flags = ["--out", str(run), "--schedule.scale=0.05", *as_flags("config=defaults", *OVERRIDES)]
    assert main(["train", "--data", str(tmp_path / "site" / "reconstruction.json"), *flags]) == 0
    frame = load_world_frame(run)
    assert frame.crs == "EPSG:4978" and frame.scale == 1
    place = frame.to_world(np.zeros(3))
    np.testing.assert_allclose(geodetic(place), [47.5, 8.25, 432.0], atol=1e-8)
    opened = open_viewed(run, Ranks())
    visitor = SimpleNamespace(
        world=World(opened.exhibit.space, opened.exhibit.cameras, opened.exhibit.box),
        exhibit=opened.exhibit, motion="orbit",
        client=SimpleNamespace(camera=SimpleNamespace(look_at=(0, 0, 1), position=(0, 0, 0), aspect=1.5)),
    )  # fmt: skip
    visitor.stance = Stance(visitor.world.page_position(np.zeros(3)), np.eye(3), 0.8)
    picture = SimpleNamespace(gaussians=1, milliseconds=1.0)
    ask = SimpleNamespace(look=SimpleNamespace(width=3, height=2, mode="RGB"), camera=None)
    shaded = SimpleNamespace(psnr=None, low=None, high=None)
    shown = SimpleNamespace(ask=ask, picture=picture, shaded=shaded)
    assert "47.5000000\N{DEGREE SIGN} 8.2500000\N{DEGREE SIGN} 432.00 m (WGS 84)" in overlay(
        visitor, shown, ""
    )
    pytest.importorskip("pyproj")
    assert main(["align", str(run), "--crs", "EPSG:32632"]) == 0
    assert main(["train", "--out", str(run), "--extend", "1.2"]) == 0
    assert load_world_frame(run).crs == "EPSG:32632"


def dms(degrees):
    minutes = degrees % 1 * 60
    return (float(int(degrees)), float(int(minutes)), minutes % 1 * 60)
