# SPDX-License-Identifier: Apache-2.0
"""Films, and `blitzgs render` along paths and from cameras of one's own."""

import json
import resource
import sys

import cv2
import numpy as np
import pytest

pytest.importorskip("av", reason="the extra film is not installed")

import av

from blitzgs.cli import main
from blitzgs.runs.folder import open_run
from blitzgs.viewer.film import check_film, new_film
from blitzgs.viewer.paths import CameraPath, Keyframe, to_json
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused


def test_a_film_has_its_frames(tmp_path):
    file = tmp_path / "a.mp4"
    colours = np.array([[200, 30, 90], [20, 180, 60], [250, 250, 250], [0, 0, 0]], np.uint8)
    with new_film(file, 64, 48, 29.97) as append:
        for colour in colours:
            append(np.broadcast_to(colour, (48, 64, 3)))
    with av.open(str(file)) as film:
        stream = film.streams.video[0]
        assert (stream.width, stream.height) == (64, 48)
        assert float(stream.average_rate) == pytest.approx(29.97, abs=1e-3)
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
    assert len(frames) == 4
    for frame, colour in zip(frames, colours.astype(int), strict=True):
        assert np.abs(frame.reshape(-1, 3).mean(axis=0) - colour).max() < 3


def test_an_interrupted_film_leaves_no_file(tmp_path):
    file = tmp_path / "a.mp4"
    with pytest.raises(KeyboardInterrupt), new_film(file, 64, 48, 30) as append:
        append(np.zeros((48, 64, 3), np.uint8))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    file.write_bytes(b"\0\0\0\x20ftypisom the film of before")
    with pytest.raises(ValueError), new_film(file, 64, 48, 30) as append:
        append(np.zeros((48, 64), np.uint8))
    assert file.read_bytes().endswith(b"before") and list(tmp_path.iterdir()) == [file]


def test_a_full_disk_is_named_and_leaves_no_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).integers(0, 255, (20, 48, 64, 3), dtype=np.uint8)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        with (
            pytest.raises(OSError, match="File too large") as raised,
            new_film(tmp_path / "a.mp4", 64, 48, 30) as append,
        ):
            for picture in noise:
                append(picture)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert raised.value.filename == str(tmp_path / "a.mp4") and list(tmp_path.iterdir()) == []


def test_what_is_no_film_is_kept(tmp_path):
    file = tmp_path / "a.mp4"
    check_film(file, 64, 48)
    refused(ValueError, "even sides, got 63x48", check_film, file, 63, 48)
    file.write_text("notes on the film")
    refused(FileExistsError, "is no film", check_film, file, 64, 48)


def test_without_the_package_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    refused(ImportError, r'pip install "blitzgs\[film\]"', check_film, tmp_path / "a.mp4", 64, 48)


def test_a_film_of_a_path_shows_its_views(trained, tmp_path, capsys):
    run, file, film = open_run(trained[1]), tmp_path / "p.json", tmp_path / "new" / "p.mp4"
    model, cameras = run.model(), run.cameras().cameras
    keys, views = [], []
    grey = np.array([0.2126, 0.7152, 0.0722])  # colours have half the resolution in a film
    for camera in cameras[:3]:
        pose = np.linalg.inv(camera.world_to_camera)
        pose[:3, 3] += model.space.offset
        keys.append(Keyframe(pose, float(np.degrees(2 * np.arctan(16 / 41))), 1.5))
        centred = model.camera([[41, 0, 24], [0, 41, 16], [0, 0, 1]], np.linalg.inv(pose), 48, 32)
        views.append(model.render(centred).clamp(0, 1).numpy() * 255 @ grey)
    file.write_text(to_json(CameraPath(keys, width=48, height=32, fps=5, seconds=1)))
    assert main(["render", str(trained[1]), "--path", str(file), "--out", str(film)]) == 0
    assert f"{film}: 5 frames" in capsys.readouterr().out
    with av.open(str(film)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, float(stream.average_rate)) == (48, 32, 5)
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(stream)]
    assert len(frames) == 5
    for place, key in ((0, 0), (2, 1), (4, 2)):
        errors = [np.abs(frames[place] @ grey - view).mean() for view in views]
        assert errors[key] < 3 and all(errors[key] < 0.3 * errors[other] for other in {0, 1, 2} - {key})
    assert sorted(path.name for path in film.parent.iterdir()) == ["p.mp4"]


def test_depth_and_alpha_come_back_from_16_bits(trained, tmp_path):
    flags = ["render", str(trained[1]), "--path", "orbit", "--size", "48x32", "--seconds", "1", "--fps", "3"]
    assert main([*flags, "--depth", "--alpha", "--out", str(tmp_path / "png")]) == 0
    assert main([*flags, "--depth", "--alpha", "--raw", "--out", str(tmp_path / "raw")]) == 0
    scale = json.loads((tmp_path / "png" / "depth.json").read_text())["scale"]
    names = sorted(path.name for path in (tmp_path / "raw").glob("*.npy"))
    assert names == [f"frame_0000{n}{kind}.npy" for n in (1, 2, 3) for kind in (".alpha", ".depth", "")]
    for number in (1, 2, 3):
        for kind, step in (("depth", scale), ("alpha", 1 / 65535)):
            stem = f"frame_0000{number}.{kind}"
            stored = cv2.imread(str(tmp_path / "png" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
            exact = np.load(tmp_path / "raw" / f"{stem}.npy")
            assert stored.dtype == np.uint16 and stored.shape == (32, 48) and exact.max() > 100 * step
            held = stored < 65535
            assert held.mean() > 0.5
            assert np.abs(stored * step - exact)[held].max() <= 0.51 * step
            assert (exact[~held] >= 65534 * step).all()


def test_depth_is_that_of_the_model(trained, tmp_path):
    flags = ["render", str(trained[1]), "--split", "all", "--depth", "--raw", "--out", str(tmp_path)]
    assert main(flags) == 0
    model = open_run(trained[1]).model()
    wanted = model.render(2, "ED", alpha=True).numpy()
    found, opaque = np.load(tmp_path / "02.depth.npy"), wanted[..., 1] > 0.06
    np.testing.assert_allclose(found[opaque], wanted[..., 0][opaque], rtol=1e-4)
    assert opaque.mean() > 0.3 and (found[wanted[..., 1] < 0.04] == 0).all()


def test_cameras_of_a_file_are_rendered(trained, tmp_path):
    run = open_run(trained[1])
    camera, space = run.cameras().cameras[3], run.model().space
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:3, 3] += space.offset
    frame = {"file_path": "view/mine", "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()}
    K = camera.K  # noqa: N806
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": 48, "h": 32}
    file = tmp_path / "my cameras.json"
    file.write_text(json.dumps(lens | {"frames": [frame]}))
    out = tmp_path / "out"
    assert main(["render", str(trained[1]), "--cameras", str(file), "--raw", "--out", str(out)]) == 0
    found = np.load(out / "view" / "mine.npy")
    np.testing.assert_allclose(found, run.model().render(3).numpy(), atol=1e-5)


def test_a_ply_file_has_no_cameras_of_its_own(trained, tmp_path, failure):
    ply, out = tmp_path / "m.ply", str(tmp_path / "out")
    assert main(["export", str(trained[1]), "--ply", str(ply)]) == 0
    assert "has no cameras: use --path, --cameras" in failure("render", ply, "--out", out)
    flags = ["--path", "orbit", "--size", "48x32", "--seconds", "1", "--fps", "2"]
    assert main(["render", str(ply), *flags, "--out", out]) == 0
    pictures = [cv2.imread(str(path)) for path in sorted((tmp_path / "out").glob("*.png"))]
    assert len(pictures) == 2 and all(picture.std() > 5 for picture in pictures)
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 3


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--out", "f.mp4"], "a film needs --path"),
        (["--fps", "3", "--out", "d"], "--fps needs --path"),
        (["--path", "orbit", "--depth", "--out", "f.mp4"], "give a folder as --out"),
        (["--path", "orbit", "--out", "f.gif"], "a film's name ends in .mp4"),
        (["--out", "f.png"], "pictures need a folder"),
        (["--path", "orbit", "--size", "31x20", "--out", "f.mp4"], "even sides, got 31x20"),
        (["--path", "orbit", "--exposure", "--out", "d"], "--exposure and --path exclude each other"),
        (["--path", "nowhere.json", "--out", "d"], "there is no such file; orbit, flight, spline need none"),
        (["--cameras", "nowhere", "--out", "d"], "nowhere: there is no such transforms file"),
        (["--cameras", "x", "--exposure", "--out", "d"], "not for --cameras"),
    ],
)
def test_wrong_flags_are_named(trained, tmp_path, monkeypatch, failure, flags, reason):
    monkeypatch.chdir(tmp_path)
    assert reason in failure("render", trained[1], *flags)
    assert list(tmp_path.iterdir()) == []


def _command(rank, arguments):
    return main(arguments)


@pytest.mark.slow
def test_several_ranks_make_the_same_film(trained, tmp_path):
    flags = ["render", str(trained[1]), "--path", "orbit", "--size", "64x48", "--seconds", "1", "--fps", "4"]
    films = []
    for world_size in (1, 2):
        film, out = tmp_path / f"{world_size}.mp4", tmp_path / str(world_size)
        assert run_ranks(_command, world_size, [*flags, "--out", str(film)], join=False) == [0] * world_size
        arguments = [*flags, "--depth", "--alpha", "--out", str(out)]
        assert run_ranks(_command, world_size, arguments, join=False) == [0] * world_size
        films.append([film, *sorted(out.rglob("*.*"))])
    assert len(films[0]) == len(films[1]) > 12
    for one, two in zip(*films, strict=True):
        assert one.read_bytes() == two.read_bytes(), two
