# SPDX-License-Identifier: Apache-2.0
"""A capture with a lens that is nearly right gets the right one, and poses that fit it."""

import json
import shutil
from unittest.mock import Mock

import numpy as np
import pytest

from blitzgs.capture.colmap import FILES, read_model
from blitzgs.capture.lens import Lens
from blitzgs.cli import main
from blitzgs.sfm import engine
from blitzgs.sfm.pycolmap_stage import _centre_lenses
from blitzgs.sfm.refine import fit_of, refine
from blitzgs.sfm.report import misses
from tests.capture.helpers import warned
from tests.helpers import refused
from tests.training.tiny import write_tiny_capture

pycolmap = pytest.importorskip("pycolmap")
LENS = [600.0, 603.0, 340.0, 230.0, -0.08, 0.02, 0.001, 0.002]


@pytest.fixture
def scene(tmp_path):
    """Return a function that writes a capture with a wrong lens, and returns the true centres by name."""

    def make(count, lens=LENS, taken="PINHOLE"):
        pycolmap.set_random_seed(0)
        made = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=count, num_points3D=400)
        made.camera_width, made.camera_height = 640, 480
        made.camera_model_id, made.camera_params = pycolmap.CameraModelId.OPENCV, lens
        model = pycolmap.synthesize_dataset(made)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.1), model)
        truth = {image.name: image.projection_center() for image in model.images.values()}
        if taken == "PINHOLE":
            model.cameras[1].model = pycolmap.CameraModelId.PINHOLE
            model.cameras[1].params = [600, 600, 320, 240]
            pycolmap.bundle_adjustment(model)
        folder = tmp_path / "capture" / "sparse" / "0"
        folder.mkdir(parents=True)
        model.write(folder)
        (tmp_path / "capture" / "images").mkdir()
        (tmp_path / "capture" / "geo.json").write_text("{}")
        return tmp_path / "capture", truth

    return make


def test_misses_are_those_of_pycolmap(scene):
    capture, _ = scene(4)
    model = pycolmap.Reconstruction(capture / "sparse/0")
    read = read_model(capture / "sparse/0", points2d=True)
    expected = []
    for name in read.images.names:
        image = model.find_image_with_name(name)
        for seen in image.points2D:
            known = seen.has_point3D()
            pixel = image.project_point(model.points3D[seen.point3D_id].xyz) if known else [np.nan] * 2
            expected.append(np.linalg.norm(pixel - seen.xy))
    assert np.linalg.norm(misses(read), axis=1) == pytest.approx(expected, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize(("taken", "advised"), [("PINHOLE", True), ("OPENCV", False)])
def test_a_check_says_how_well_the_lens_fits(scene, taken, advised):
    capture, _ = scene(20, taken=taken)
    told = fit_of(capture / "sparse/0")
    assert told.endswith("blitzgs refine may help") == advised
    by_chance, of_lens = (float(told.split(" by ")[part].split()[0]) for part in (1, 2))
    assert by_chance == pytest.approx(0.12, abs=0.01) and of_lens < 0.03 if not advised else of_lens > 0.1


@pytest.mark.parametrize("far", [[0.0, 0.0, 0.0], [512_345.0, 4_612_345.0, 431.0]])
def test_lens_and_poses_are_found(scene, tmp_path, capsys, far):
    capture, truth = scene(20)
    model = pycolmap.Reconstruction(capture / "sparse/0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(far)))
    model.write(capture / "sparse/0")
    assert main(["refine", str(capture), str(tmp_path / "new")]) == 0
    told = capsys.readouterr().out
    assert "\n               -> OPENCV " in told and f"\n  blitzgs train --data {tmp_path / 'new'}" in told
    (camera,) = read_model(tmp_path / "new/sparse/0").cameras
    assert camera.params[:4] == pytest.approx(LENS[:4], abs=1)
    known, found = (Lens("OPENCV", 640, 480, tuple(values)) for values in (LENS, camera.params.tolist()))
    within = np.linspace(-0.25, 0.25, 9), np.linspace(-0.2, 0.2, 9)
    assert np.abs(np.subtract(known.project(*within), found.project(*within))).max() < 1
    model = pycolmap.Reconstruction(tmp_path / "new/sparse/0")
    # The true places but for the world, which stays that of the capture: its own places are wrong ones.
    now = {image.name: image.projection_center() for image in model.images.values()}
    moved = pycolmap.estimate_sim3d(np.stack([now[name] for name in truth]), np.stack(list(truth.values())))
    away = {name: np.linalg.norm(moved * now[name] - place) for name, place in truth.items()}
    size = np.ptp(np.stack(list(truth.values())), axis=0).max()
    assert max(away.values()) < 2e-3 * size
    figures = json.loads((tmp_path / "new/sfm/refined.json").read_text())
    assert figures["adopted"] and figures["after"] == pytest.approx(0.1 * 1.177, rel=0.1)  # Rayleigh's median
    assert figures["before"] > 1.2 * figures["after"]
    # The mean place and spread of the photographs are those of the capture.
    old = pycolmap.Reconstruction(capture / "sparse/0")
    before = np.stack([old.find_image_with_name(name).projection_center() for name in now])
    after = np.stack(list(now.values()))
    assert after.mean(axis=0) == pytest.approx(before.mean(axis=0), abs=1e-3 * size)
    assert after.std(axis=0) == pytest.approx(before.std(axis=0), rel=0.02)
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert names == {"geo.json", "images", "sfm", "sparse"}
    assert (tmp_path / "new/images").resolve() == (capture / "images").resolve()


def test_a_lens_that_fits_stays(scene, tmp_path):
    capture, _ = scene(20, taken="OPENCV")
    found = refine(capture, tmp_path / "new")
    for name in ("cameras", "images", "points3D"):
        files = [folder / "sparse/0" / f"{name}.bin" for folder in (capture, tmp_path / "new")]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert not found.adopted
    assert "stay" in found.lines()[1]


def test_photographs_are_undistorted_only_where_it_pays(scene, tmp_path):
    """A pinhole with another axis stays a pinhole."""
    capture, _ = scene(20, lens=[600.0, 603.0, 340.0, 230.0, 0, 0, 0, 0])
    assert refine(capture, tmp_path / "new").adopted
    (camera,) = read_model(tmp_path / "new/sparse/0").cameras
    assert camera.model == "PINHOLE" and camera.params == pytest.approx([600, 603, 340, 230], abs=1)


def test_a_few_photographs_do_not_determine_a_lens(scene, tmp_path):
    capture, _ = scene(8)
    (capture / "sparse").rename(tmp_path / "elsewhere")  # a link is as good as a folder
    (capture / "sparse").symlink_to(tmp_path / "elsewhere")
    old, new = refine(capture, tmp_path / "new").lenses[0]
    assert old == new and old.startswith("PINHOLE")


def test_wrong_observations_are_left_out(scene, tmp_path):
    capture, _ = scene(20)
    folder = capture / "sparse/0"
    model = pycolmap.Reconstruction(folder)
    for image in model.images.values():
        image.points2D[3].xy = image.points2D[3].xy + [25, 0]
    model.write(folder)
    found = refine(capture, tmp_path / "new")
    assert found.adopted and found.left_out == pytest.approx(20, abs=3)
    (camera,) = read_model(tmp_path / "new/sparse/0").cameras
    assert camera.params[2:4] == pytest.approx(LENS[2:4], abs=3)


def test_what_cannot_be_refined_is_refused(scene, tmp_path, monkeypatch):
    capture, _ = scene(4)
    with pytest.raises(ValueError, match=r"is in .*capture, whose files are read: choose a folder outside"):
        refine(capture, capture / "new")
    message = "has no photographs beside its model: name the folder of the capture"
    refused(ValueError, message, refine, capture / "sparse/0", tmp_path / "new")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("")
    refused(FileExistsError, "full is not empty: choose another folder", refine, capture, tmp_path / "full")
    (tmp_path / "none").mkdir()
    refused(FileNotFoundError, "none has no COLMAP model", refine, tmp_path / "none", tmp_path / "new")
    model = pycolmap.Reconstruction(capture / "sparse/0")
    (capture / "sparse/0/points3D.bin").rename(capture / "sparse/0/points3D.ply")
    message = "does not say at which pixels photographs saw its points"
    refused(ValueError, message, refine, capture, tmp_path / "new")
    for number in list(model.points3D):
        model.delete_point3D(number)
    model.write(capture / "sparse/0")
    refused(ValueError, message, refine, capture, tmp_path / "new")
    monkeypatch.setattr("blitzgs.sfm.refine.has_pycolmap", lambda: False)
    refused(ImportError, r"pip install 'blitzgs\[sfm\]'", refine, capture, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_model_appears_whole_and_alone(scene, tmp_path, monkeypatch):
    """What an interrupted call left is used by the next; models that are left out are named."""
    capture, _ = scene(20)
    shutil.copytree(capture / "sparse/0", capture / "sparse/1")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt), pytest.warns(UserWarning):
        patch.setattr("blitzgs.sfm.refine.asdict", Mock(side_effect=KeyboardInterrupt))
        refine(capture, tmp_path / "new")
    assert not (tmp_path / "new/sparse").exists() and (tmp_path / "new/images").is_symlink()
    warned("of 2 COLMAP models, sparse/0 is refined, with 20 images", refine, capture, tmp_path / "new")
    names = {path.name for path in (tmp_path / "new/sparse").rglob("*")}
    assert names == {"0", *(f"{name}.bin" for name in FILES)}


@pytest.mark.parametrize(("count", "away", "found"), [(20, 40, 40), (10, 40, 0), (20, 1, 0)])
def test_many_photographs_determine_the_principal_point(tmp_path, count, away, found):
    """A few do not, and it stays in the middle if the error is hardly less elsewhere."""
    made = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=count, num_points3D=300)
    made.camera_width, made.camera_height = 640, 480
    made.camera_model_id, made.camera_params = pycolmap.CameraModelId.PINHOLE, [600, 600, 320 + away, 240]
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        model = pycolmap.synthesize_dataset(made, database)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), model, database)
    model.cameras[1].params = [600, 600, 320, 240]
    pycolmap.bundle_adjustment(model)  # as the mappers leave it
    model.update_point_3d_errors()
    (tmp_path / "0").mkdir()
    model.write(tmp_path / "0")
    _centre_lenses(str(tmp_path / "database.db"), tmp_path / "0", pycolmap.IncrementalPipelineOptions())
    params = pycolmap.Reconstruction(tmp_path / "0").cameras[1].params
    if found:
        assert params == pytest.approx([600, 600, 320 + found, 240], abs=1)
    else:
        assert params[2:].tolist() == [320, 240]
    assert [path.name for path in tmp_path.glob("*") if path.is_dir()] == ["0"]


def test_a_model_that_cannot_be_refined_is_kept(tmp_path, monkeypatch):
    write_tiny_capture(tmp_path / "tiny")
    program = tmp_path / "colmap"
    found = f"cp -r {tmp_path}/tiny/sparse/0 {tmp_path}/models/0"
    program.write_text(
        f'#!/bin/sh\ncase $1 in mapper) {found} ;; help) ;; *) echo "no CUDA"; exit 3 ;; esac\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(engine, "backend", lambda: str(program))
    monkeypatch.setattr(engine, "MANY", 8)
    names = [f"{i}.png" for i in range(8)]
    job = engine.Job(
        "d", "p", "", str(tmp_path / "models"), "", names, [(48, 32)] * 8, "auto", "exhaustive", "incremental"
    )
    with (tmp_path / "lock").open("w") as lock:
        stage = (job, tmp_path / "colmap.log", lock.fileno(), lambda done, total: None)
        warned("principal point stays .* status 3: no CUDA", engine.run_stage, "cameras", *stage)
        assert [path.name for path in (tmp_path / "models").iterdir()] == ["0"]
        refused(engine.StageError, "status 3: no CUDA", engine.run_stage, "pairs", *stage)
