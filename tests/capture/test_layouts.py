# SPDX-License-Identifier: Apache-2.0
"""Captures are found in each layout on disk, cameras without photographs too."""

import math
import shutil

import cv2
import numpy as np
import pytest

from blitzgs.capture.capture import MissingImagesError, load_capture
from blitzgs.capture.images import ImageStore
from blitzgs.capture.usable import read_cameras
from tests.capture.helpers import (
    at,
    edit_model,
    frame,
    smooth_image,
    warned,
    write_capture,
    write_image,
    write_ply,
    write_transforms,
)
from tests.helpers import refused
from tests.training.tiny import tiny_scene, write_tiny_capture

pytestmark = [
    pytest.mark.filterwarnings("ignore:overflow encountered"),
    pytest.mark.filterwarnings("ignore:all training cameras are in one place"),
    pytest.mark.filterwarnings("ignore:.* see none of the points"),
]
NAMES = [f"v{i:02d}.png" for i in range(9)]


def test_nothing_to_load_is_said_clearly(tmp_path):
    refused(FileNotFoundError, "holds no capture: expected a COLMAP model", load_capture, tmp_path)
    refused(FileNotFoundError, "is not a folder", load_capture, tmp_path / "nowhere")
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "DJI_0001.DNG").touch()
    (tmp_path / "photographs" / "DJI_0002.MP4").touch()
    refused(FileNotFoundError, r"\.dng, \.mp4 cannot be read: convert", load_capture, tmp_path)
    (tmp_path / "photographs" / "DJI_0001.JPG").touch()
    (tmp_path / "photographs" / "cameras.json").touch()  # a run has such a file, and it is no model
    refused(FileNotFoundError, "has images but not their cameras: blitzgs sfm", load_capture, tmp_path)
    (tmp_path / "sparse" / "1").mkdir(parents=True)
    (tmp_path / "sparse" / "1" / "cameras.bin").touch()
    refused(FileNotFoundError, "a COLMAP model in .*sparse/1: .* to .*sparse/0", load_capture, tmp_path)
    shutil.rmtree(tmp_path / "sparse")
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(ValueError, match=f"{tmp_path}: its COLMAP model or transforms.json lists no images"):
        load_capture(tmp_path)
    write_transforms(tmp_path, [frame("gone.png", camera_angle_x=1.0)])
    refused(ValueError, "transforms.json: frame 0: .*gone.png does not exist", load_capture, tmp_path)
    (tmp_path / "transforms.json").unlink()
    write_capture(tmp_path, NAMES[:2])
    refused(ValueError, "downscale must be at least 1, got 0.5", load_capture, tmp_path, downscale=0.5)
    refused(ValueError, "undistort .* of crop, mask, got 'none'", load_capture, tmp_path, undistort="none")
    with pytest.raises(FileNotFoundError, match="2 of 2 images .* with --data.images=FOLDER") as caught:
        load_capture(tmp_path, images="elsewhere", allow_missing=True)
    assert not isinstance(caught.value, MissingImagesError)  # leaving out all views is no remedy
    edit_model(tmp_path, lambda m: m.images.camera_ids.fill(7))
    refused(ValueError, f"the cameras of 2 images .first: {NAMES[0]}. are not there", load_capture, tmp_path)
    points = next((tmp_path / "sparse" / "0").glob("points3D.*"))
    points.unlink()
    refused(FileNotFoundError, f"{points.name} is missing: .* not a complete COLMAP", load_capture, tmp_path)


def test_mega_nerf_layout_with_mappings_and_with_two_models(tmp_path):
    one = write_capture(tmp_path / "one", NAMES)
    lines = []
    for i, name in enumerate(NAMES):
        part = "val" if i in (2, 5) else "train"
        target = one / part / "rgbs" / f"{i:06d}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        (one / "images" / name).rename(target)
        lines.append(f"{name},{i:06d}.pt\n")
    (one / "mappings.txt").write_text("".join(lines))
    assert load_capture(one).test == [2, 5]
    assert load_capture(one, split=4).test == [0, 4, 8]

    two = tmp_path / "two"
    write_capture(two / "train", NAMES[:6])
    write_capture(two / "val", NAMES[6:8])
    for part in ("train", "val"):
        (two / part / "images").rename(two / part / "rgbs")
    capture = load_capture(two, split="val")
    assert [capture.cameras[i].name for i in capture.test] == [f"val/{name}" for name in NAMES[6:8]]
    assert len(capture.train) == 6 and len(capture.points) == 20


def test_blender_transforms(tmp_path):
    frames = []
    for i in range(3):
        alpha = np.zeros((20, 30, 4), dtype=np.uint8)
        alpha[5:10, 5:10] = (10, 20, 30, 255)
        (tmp_path / "train").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "train" / f"r_{i}.png"), alpha)
        frames.append(frame(f"./train/r_{i}", at(i, 0, 4)))
    for part, own in (("train", frames[:2]), ("test", frames[2:])):
        write_transforms(tmp_path, own, f"transforms_{part}.json", camera_angle_x=0.8)
    capture = warned("no points", load_capture, tmp_path)
    assert (capture.train, capture.test, capture.has_alpha) == ([0, 1], [2], True)
    camera = capture.cameras[0]
    assert camera.K[0, 0] == pytest.approx(15 / np.tan(0.4)) and camera.K[0, 2] == 15
    # The camera at z = 4 looks down its own -z, so the origin is 4 in front of it, and world up is image up.
    origin = camera.world_to_camera @ np.append(-capture.offset, 1)
    np.testing.assert_allclose(origin[:3], [0, 0, 4], atol=1e-12)
    above = camera.world_to_camera @ np.append(np.array([0, 1, 0]) - capture.offset, 1)
    assert above[1] < 0
    image = ImageStore(capture, background=(1.0, 0.5, 0.0)).get(0)
    assert image[0, 0].tolist() == [255, 128, 0] and image[6, 6].tolist() == [30, 20, 10]
    assert len(capture.points) == 100_000


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"w": math.inf, "h": 48}, "frame 0: w must be a finite number, got inf"),
        ({"w": 0, "h": 0}, "frame 0: the image's size must be at least 1 x 1 in whole pixels, got w = 0"),
        ({"fl_x": 10**400}, "frame 0: fl_x must be a finite number, got 10000"),
        ({"file_path": ""}, "frame 0: file_path must name a file, got ''"),
        ({"file_path": None}, "frame 0: file_path must name a file, got None"),
        ({"ply_file_path": None}, "ply_file_path must name a file, got None"),
        ({"ply_file_path": ""}, "ply_file_path must name a file, got ''"),
        ({"mask_path": 3}, "frame 0: mask_path must name a file, got 3"),
        ({"mask_path": ""}, "frame 0: mask_path must name a file, got ''"),
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "frame 0: is_fisheye is true but camera_model is"),
        ({"k1": 1e300}, "a.png: the lens does not see along its own axis"),
    ],
)
def test_transforms_that_make_no_sense_are_named(tmp_path, fields, message):
    write_image(tmp_path / "a.png", smooth_image(48, 64))
    write_transforms(tmp_path, [frame("a.png", fl_x=60.0) | fields], **fields)
    refused(ValueError, f"{tmp_path}.*{message}", load_capture, tmp_path)


@pytest.mark.parametrize("again", ["a.png", "./a.png", "a"])
def test_an_image_of_two_frames_is_refused(tmp_path, again):
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, smooth_image(48, 64))
    write_transforms(tmp_path, [frame(name, fl_x=60.0) for name in ("a.png", "b.png", again)])
    refused(ValueError, "s.json: images of more than one frame: a[^b]*; keep one", load_capture, tmp_path)


def test_missing_images_of_transforms_are_named_by_their_paths(tmp_path):
    """The folder `images` and the flag data.images have no meaning for them."""
    frames = [frame("photos/a.png"), frame("photos/b.png", np.diag([-1.0, -1.0, 1.0, 1.0]))]
    write_transforms(tmp_path, frames, w=64, h=48, fl_x=50.0)
    message = f"2 of 2 images are not in {tmp_path}: photos/a.png, photos/b.png;.*correct file_path in its"
    refused(FileNotFoundError, message, load_capture, tmp_path)
    write_image(tmp_path / "photos" / "a.png", smooth_image(48, 64))
    with pytest.raises(MissingImagesError, match=f"1 of 2 images are not in {tmp_path}: photos/b.png;"):
        load_capture(tmp_path, split=0)


def test_nerfstudio_transforms_with_distortion_masks_points_and_split(tmp_path):
    frames = []
    for i in range(4):
        write_image(tmp_path / "images" / f"f{i}.png", smooth_image(48, 64, i))
        write_image(tmp_path / "own" / f"f{i}.png", np.zeros((48, 64), dtype=np.uint8))
        masks = [{}, {"mask_path": f"own/f{i}.png"}, {"mask_path": None}, {}][i]
        frames.append(frame(f"images/f{i}.png", at(i, 0, 0), **masks))
    write_ply(tmp_path / "p.ply", [[1, 2, 3], [4, 5, 6]], [[9, 8, 7], [1, 2, 3]])
    lens = {"fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "camera_model": "OPENCV"}
    lens |= {"k1": -0.1, "k2": 0.01, "p1": 0.001, "p2": 0.0}
    train, test = [f"images/f{i}.png" for i in (0, 1, 3)], ["./images/f2.png"]
    lists = {"train_filenames": train, "test_filenames": test}
    write_transforms(tmp_path, frames, ply_file_path="p.ply", **lens, **lists)
    assert all(camera.mask_path is None for camera in load_capture(tmp_path, masks=False).cameras)
    capture = load_capture(tmp_path)
    assert capture.test == [2] and not capture.has_alpha
    np.testing.assert_allclose(capture.points + capture.offset, [[1, 2, 3], [4, 5, 6]])
    assert capture.colors.tolist() == [[9, 8, 7], [1, 2, 3]] and capture.track_lengths is None
    lens = capture.cameras[0].rectification.lens
    assert lens.model == "FULL_OPENCV" and lens.distortion[:4] == (-0.1, 0.01, 0.001, 0.0)
    store = ImageStore(capture)
    assert store.mask(0) is None and not store.mask(1).any()


def test_a_transforms_file_of_any_name_needs_no_photographs(tmp_path):
    frames = [frame("view/b", at(10, 20, 30)), frame("view/a", fl_x=80)]
    file = write_transforms(tmp_path, frames, "mine.json", w=64, h=48, fl_x=50, cx=30, cy=20)
    first, second = read_cameras(file, np.array([10.0, 20.0, 30.0]))
    assert (first.name, second.name, second.width, second.height) == ("view/a", "view/b", 64, 48)
    np.testing.assert_allclose(second.K, [[50, 0, 30], [0, 50, 20], [0, 0, 1]])
    assert first.K[0, 0] == 80
    np.testing.assert_allclose(second.world_to_camera, np.diag([1, -1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(first.world_to_camera)[:3, 3], [-10, -20, -30], atol=1e-12)


def test_a_colmap_model_needs_no_photographs(tmp_path):
    write_tiny_capture(tmp_path)
    shutil.rmtree(tmp_path / "images")
    found, known = read_cameras(tmp_path / "sparse" / "0", np.zeros(3)), tiny_scene()[0].cameras
    assert [camera.name for camera in found] == [camera.name for camera in known]
    for camera, own in zip(found, known, strict=True):
        np.testing.assert_allclose(camera.K, own.K)
        np.testing.assert_allclose(camera.world_to_camera, own.world_to_camera, atol=1e-6)


def test_errors_name_the_file(tmp_path):
    refused(FileNotFoundError, "nowhere", read_cameras, tmp_path / "nowhere", np.zeros(3))
    refused(FileNotFoundError, "holds no capture", read_cameras, tmp_path, np.zeros(3))
    file = tmp_path / "c.json"
    without_pose = '{"w": 4, "h": 4, "fl_x": 3, "frames": [{"file_path": "a"}]}'
    for text, reason in (
        ("{", "no JSON"),
        ('{"frames": []}', "has no cameras"),
        (without_pose, "frame 0: the field transform_matrix"),
    ):
        file.write_text(text)
        refused(ValueError, f"{file}.*{reason}", read_cameras, file, np.zeros(3))
