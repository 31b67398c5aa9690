# SPDX-License-Identifier: Apache-2.0
"""Photographs with known poses become a capture with these poses, also before a training."""

import json
import math
import os
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from blitzgs.capture.capture import load_capture
from blitzgs.capture.world import frame_beside, geodetic
from blitzgs.cli import main
from blitzgs.sfm import engine, reconstruct
from blitzgs.sfm.photographs import Photographs, estimate, judge_positions
from blitzgs.sfm.pycolmap_stage import features, pairs
from blitzgs.sfm.reconstruct import Settings
from blitzgs.sfm.report import Reconstruction, _reason, examine
from tests.capture.helpers import write_image
from tests.sfm.scene import FOCAL, aligned, poses_of, with_gps, write_photographs

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture of eight photographs beside a damaged and an empty one; and the true poses."""
    root = tmp_path_factory.mktemp("sfm")
    placed = write_photographs(root / "photos")
    whole = (root / "photos" / "view_0.jpg").read_bytes()
    (root / "photos" / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    write_image(root / "photos" / "wall.jpg", np.full((300, 400, 3), 128, np.uint8))
    mask = np.full((150, 200), 255, np.uint8)
    mask[:, :20] = 0
    write_image(root / "photos" / "masks" / "view_3.jpg.png", mask)  # a mask is no photograph
    with pytest.warns(UserWarning, match="2 of 10 photographs have no camera"):
        assert main(["sfm", str(root / "photos"), str(root / "capture")]) == 0
        assert len(load_capture(root / "capture").cameras) == 8
    return root, placed


@pytest.mark.filterwarnings("ignore:2 of 10 photographs")
def test_poses_and_lens_are_found(made):
    root, placed = made
    found, truth = poses_of(root / "capture", placed)
    away, angles = aligned(found, truth)
    assert len(found) == 8
    assert away.max() < 0.03  # of a height of 8
    assert angles.max() < 0.3
    with sqlite3.connect(root / "capture/sfm/database.db") as database:
        assert len(database.execute("SELECT DISTINCT camera_id FROM images").fetchall()) == 1
    camera = next(iter(pycolmap.Reconstruction(root / "capture/sparse/0").cameras.values()))
    assert camera.focal_length == pytest.approx(FOCAL, rel=0.01)


@pytest.mark.parametrize(
    ("part", "remedy"), [(4, "photographs from in between would connect"), (0, "; another")]
)
def test_the_remedy_for_photographs_without_a_pose(part, remedy):
    why = _reason(engine.Found(900, 50, 3), part)
    left = dict.fromkeys("abcd", why)
    found = Reconstruction(Path("c"), {"e": 0.5}, {"e": 100}, left, {}, 100, {"pairs": "all"})
    assert remedy in found.lines()[-1] and "--camera-model or --pairs exhaustive" in found.lines()[-1]


def test_unused_photographs_are_named_with_the_reason(made):
    root, _ = made
    told = json.loads((root / "capture/sfm/report.json").read_text())
    assert set(told["no_pose"]) == {"cut.jpg", "wall.jpg"}
    assert "cut.jpg" in told["no_pose"]["cut.jpg"] and "features" not in told["no_pose"]["cut.jpg"]
    assert told["no_pose"]["wall.jpg"].startswith("0 features")
    assert told["doubtful"] == {}
    model = pycolmap.Reconstruction(root / "capture/sparse/0")
    away = [
        np.linalg.norm(image.project_point(model.points3D[seen.point3D_id].xyz) - seen.xy)
        for image in model.images.values()
        for seen in image.points2D
        if seen.has_point3D()
    ]
    assert told["error"] == pytest.approx(np.mean(away), rel=1e-6)
    plan = cv2.imread(str(root / "capture/sfm/cameras.png"))
    assert (plan[:, :900] != 255).any(axis=2).sum() > 8 * 60  # eight cameras of ten pixels, and points


def test_masks_keep_features_away(made):
    root, _ = made
    with pycolmap.Database.open(root / "capture/sfm/database.db") as database:
        places = database.read_keypoints(database.read_image_with_name("view_3.jpg").image_id)[:, 0]
        others = database.read_keypoints(database.read_image_with_name("view_2.jpg").image_id)[:, 0]
    assert places.min() >= 39 and others.min() < 30
    assert (root / "capture/masks").samefile(root / "photos/masks")


def test_finished_stages_are_left_out_and_what_changed_is_done(made, monkeypatch):
    root, _ = made
    done = []
    monkeypatch.setattr(reconstruct, "run_stage", lambda stage, *_: done.append(stage))
    photographs, capture = Photographs.of(root / "photos"), root / "capture"
    reconstruct.reconstruct(photographs, capture, Settings())
    assert done == []
    shutil.copytree(capture, root / "again", symlinks=True)
    with pytest.raises(engine.StageError, match="no poses were found for the 9 photographs"):
        reconstruct.reconstruct(photographs, root / "again", Settings(mapper="global"))
    assert done == ["cameras"]


def test_wrong_poses_are_doubtful(made, tmp_path):
    root, _ = made
    model = pycolmap.Reconstruction(root / "capture/sparse/0")
    image = next(image for image in model.images.values() if image.name == "view_5.jpg")
    pose = image.cam_from_world()
    wrong = pycolmap.Rigid3d(pose.rotation, pose.translation + [0, 1e3, 0])
    image.frame.set_cam_from_world(image.camera_id, wrong)
    (tmp_path / "0").mkdir()
    model.write(tmp_path / "0")
    photographs = Photographs.of(root / "photos")
    job = engine.Job(
        str(root / "capture/sfm/database.db"), *([""] * 4), names=photographs.names, sizes=photographs.sizes,
        camera_model="auto", pairs="exhaustive", mapper="incremental",
    )  # fmt: skip
    found = examine(root / "capture", tmp_path, photographs, job, [tmp_path / "0"])
    assert list(found.doubtful) == ["view_5.jpg"] and "from the middle" in found.doubtful["view_5.jpg"]
    assert any("doubtful:      view_5.jpg" in line for line in found.lines())


def test_interrupted_work_goes_on_and_is_placed_by_gps(tmp_path, monkeypatch):
    placed = write_photographs(tmp_path / "images")
    metres = with_gps(tmp_path / "images", placed)
    photographs = Photographs.of(tmp_path / "images")
    usual = reconstruct.run_stage

    def interrupted(stage, job, log, lock, report):
        def stop(done, total):
            if done == 3:
                raise KeyboardInterrupt

        usual(stage, job, log, lock, stop)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(reconstruct, "run_stage", interrupted)
        reconstruct.reconstruct(photographs, tmp_path, Settings())
    with sqlite3.connect(tmp_path / "sfm/database.db") as database:
        before = dict(database.execute("SELECT image_id, rowid FROM descriptors"))
    assert 2 <= len(before) < 8
    found = reconstruct.reconstruct(photographs, tmp_path, Settings())
    assert found.decisions == {"pairs": "pairs: gps", "mapper": "mapper: incremental", "gps": "GPS"}
    # The camera of the interrupted stage is that of all photographs.
    assert len(pycolmap.Reconstruction(tmp_path / "sparse/0").cameras) == 1
    # In metres, east, north and up of the first photograph.
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    for image in model.images.values():
        expected = metres[int(image.name[5])] - metres[0]
        assert image.projection_center() == pytest.approx(expected, abs=1.0)
    frame = frame_beside(tmp_path)
    latitude, longitude, height = geodetic(frame.to_world(metres[1] - metres[0]))
    assert (latitude, longitude) == pytest.approx(
        (47 + metres[1][1] / 111_177, 8 + metres[1][0] / 76_057), abs=1e-7
    )
    assert height == pytest.approx(metres[1][2] + 400, abs=0.01)
    assert not (tmp_path / "images").is_symlink()


@pytest.mark.parametrize("altitude", [True, False])
def test_a_receiver_without_a_fix_says_no_place(tmp_path, altitude):
    placed = write_photographs(tmp_path / "images", 3)
    with_gps(tmp_path / "images", placed, altitude)
    path = tmp_path / "images/view_0.jpg"
    with Image.open(path) as photo:
        exif = photo.getexif()
        exif.get_ifd(0x8825).update({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)})
        photo.save(path, exif=exif)
    job = {"photos": str(tmp_path / "images"), "names": [f"view_{i}.jpg" for i in range(3)], "masks": ""}
    database = tmp_path / "database.db"
    features({**job, "database": str(database), "camera_model": "auto"})
    assert sorted(engine.read_positions(database)) == ["view_1.jpg", "view_2.jpg"]
    features({**job, "database": str(database), "camera_model": "auto"})  # as later photographs are added
    assert sorted(engine.read_positions(database)) == ["view_1.jpg", "view_2.jpg"]
    assert engine.lack_places(str(database), job["names"])
    assert not engine.lack_places(str(database), job["names"][1:])
    origin = tmp_path / "georeference.json"
    by_gps = {"pairs": "gps", "gps": True, "use_altitude": altitude, "georeference": str(origin)}
    pairs({**job, **by_gps, "database": str(database)})
    # It has no neighbours by GPS, but by name, and is not the origin of the world.
    assert engine.read_found(database)["view_0.jpg"].neighbours == 2
    assert json.loads(origin.read_text())["latitude"] == pytest.approx(47.0, abs=0.01)
    with pycolmap.Database.open(database) as opened:
        assert len({prior.coordinate_system for prior in opened.read_all_pose_priors()}) == 1


def test_a_camera_of_exif_is_another_camera(tmp_path):
    """Features alone: cameras are made of EXIF, and without it of size and folder."""
    placed = write_photographs(tmp_path / "photos", 4)
    with_gps(tmp_path / "photos", placed[:2], altitude=False)
    (tmp_path / "photos/b").mkdir()
    (tmp_path / "photos/view_3.jpg").rename(tmp_path / "photos/b/view_3.jpg")
    names = ["view_0.jpg", "view_1.jpg", "view_2.jpg", "b/view_3.jpg"]
    job = {"database": str(tmp_path / "database.db"), "photos": str(tmp_path / "photos"), "names": names}
    features(job | {"masks": "", "camera_model": "auto"})
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        cameras = {image.name: image.camera_id for image in database.read_all_images()}
        known = [prior for prior in database.read_all_pose_priors() if prior.has_position()]
    assert cameras[names[0]] == cameras[names[1]]
    assert len({cameras[name] for name in names}) == 3
    # COLMAP alone leaves out places without an altitude.
    assert sorted(round(float(prior.position[0]), 3) for prior in known) == [47.0, 47.0]


PLACES = np.array([[47.0, 8.0, 500.0], [47.001, 8.0, 510.0], [47.0, 8.001, 505.0], [47.001, 8.001, 507.0]])


@pytest.mark.parametrize(
    ("places", "photographs", "expected"),
    [
        (PLACES, 4, (True, True)),
        (PLACES, 8, (False, False)),  # half of them without a place
        (PLACES * [1, 1, 0] + [0, 0, 120], 4, (True, False)),  # all altitudes are equal
        (PLACES * [1, 1, 0], 4, (True, False)),  # no altitudes
        (PLACES + np.array([0, 0, 400.0]) * [[0], [0], [1], [1]], 4, (True, False)),  # two references
        ((PLACES - PLACES[0]) * 0.01 + PLACES[0], 4, (False, True)),  # a desk
    ],
)
def test_positions_are_used_where_they_say_something(places, photographs, expected):
    enough, altitude = judge_positions(places, photographs)
    assert (enough, altitude and enough) == (expected[0], expected[1] and expected[0])


@pytest.mark.parametrize(("cores", "told"), [(2, "8 minutes on 2 CPU"), (32, "3 minutes on 32 CPU")])
def test_poses_take_their_time_on_many_cores(monkeypatch, cores, told):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)))
    assert estimate([(1593, 1197)] * 75).startswith(told)


def test_photographs_of_nothing_have_no_poses(tmp_path, capsys):
    for number in range(3):
        write_image(tmp_path / f"photos/{number}.png", np.full((90, 120, 3), 100 + number, np.uint8))
    for _ in range(2):
        assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "capture")]) == 1
        error = capsys.readouterr().err
        assert "no poses were found for the 3 photographs" in error
        assert "they have 0 features (median), and 0 of them" in error
    assert not (tmp_path / "capture/sparse").exists()
    assert not reconstruct.is_finished(tmp_path / "capture")


@pytest.mark.parametrize(
    ("count", "gps", "pairs", "mapper"),
    [
        (300, False, "exhaustive", "incremental"),
        (301, False, "sequence", "incremental"),
        (301, True, "gps", "incremental"),
        (501, True, "gps", "global"),
    ],
)
def test_pairs_and_mapper_follow_the_photographs(count, gps, pairs, mapper):
    names = [f"{number}.jpg" for number in range(count)]
    job = engine.Job("", "", "", "", "", names, [(1, 1)] * count, "auto", "auto", "auto")
    found = engine.decided(job, gps, True)
    assert (found.pairs, found.mapper, found.gps, found.use_altitude) == (pairs, mapper, gps, gps)
    if not gps:
        with pytest.raises(ValueError, match="--pairs gps: fewer than 9 of 10 photographs"):
            engine.decided(replace(job, pairs="gps"), gps, True)


def test_what_cannot_work_is_said(tmp_path, monkeypatch, capsys):
    write_photographs(tmp_path / "photos", 3)

    def message(photos, capture):
        assert main(["sfm", str(tmp_path / photos), str(tmp_path / capture)]) == 1
        return capsys.readouterr().err

    assert "is no folder of photographs" in message("nothing", "capture")
    assert "is no folder of photographs" in message(next((tmp_path / "photos").iterdir()), "capture")
    assert "whose files are read: choose a folder outside it" in message("photos", "photos/capture")
    (tmp_path / "other/sparse").mkdir(parents=True)
    assert "has a model that blitzgs sfm did not make" in message("photos", "other")
    (tmp_path / "other/sfm").mkdir()  # as `blitzgs refine` leaves it
    assert "has a model that blitzgs sfm did not make" in message("photos", "other")
    (tmp_path / "others/images").mkdir(parents=True)
    assert "photos: choose another folder for the capture" in message("photos", "others")
    assert not (tmp_path / "others/sfm").exists()
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None)
        patch.setenv("PATH", "")
        assert "pip install 'blitzgs[sfm]'" in message("photos", "capture")
    with monkeypatch.context() as patch:

        def refuse(link, *args, **kwargs):
            raise PermissionError(1, "Operation not permitted", link)

        patch.setattr(Path, "symlink_to", refuse)
        assert "photos (Operation not permitted): choose a capture on a disk" in message("photos", "exfat")
        assert not (tmp_path / "exfat/sfm/database.db").exists()
    (tmp_path / "photos/view_1.jpg").write_bytes(b"hello")
    assert "3 photographs are needed, 2 can be used" in message("photos", "capture")


def test_a_failing_stage_shows_colmaps_last_words(tmp_path, monkeypatch):
    log = tmp_path / "log.txt"
    with log.open("w") as lock, pytest.raises(engine.StageError, match="status 3: it is dark") as error:
        engine._run(
            ["sh", "-c", "echo start; echo it is dark; exit 3"], log, lock.fileno(), lambda done, total: None
        )
    assert str(log) in str(error.value) and log.read_text() == "start\nit is dark\n"
    monkeypatch.setattr(engine, "_LEAST_SPACE", math.inf)
    with log.open("w") as lock, pytest.raises(engine.StageError, match="the disk is nearly full"):
        engine._run(["false"], log, lock.fileno(), lambda done, total: None)
