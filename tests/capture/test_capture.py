# SPDX-License-Identifier: Apache-2.0
import shutil
import struct
import warnings

import cv2
import numpy as np
import pytest
from PIL import Image

from blitzgs.capture import colmap
from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.capture import load_capture
from blitzgs.capture.image_files import ImageHeader, apply_orientation, read_header
from blitzgs.capture.images import ImageStore
from blitzgs.capture.lengths import NEAR_OF_EXTENT
from tests.capture.helpers import edit_model, shared_data, smooth_image, warned, write_capture, write_image
from tests.helpers import refused

pytestmark = [
    pytest.mark.filterwarnings("ignore:all training cameras are in one place"),
    pytest.mark.filterwarnings("ignore:.* see none of the points"),
]
NAMES = [f"v{i:02d}.png" for i in range(9)]


def test_recentred_world_projects_points_where_the_original_does(tmp_path):
    write_capture(tmp_path, NAMES)
    model = colmap.read_model(tmp_path / "sparse" / "0")
    far = np.array([4.5e5, 5.2e6, 120.0])  # a capture in UTM coordinates

    def move(m):
        rotations = colmap.world_to_camera(m.images)[:, :3, :3]
        m.images.translations = m.images.translations - np.einsum("nij,j->ni", rotations, far)
        m.points.positions = m.points.positions + far

    edit_model(tmp_path, move)
    capture = load_capture(tmp_path)
    centers = camera_centres(np.stack([c.world_to_camera for c in capture.cameras]))
    np.testing.assert_allclose(centers.mean(axis=0), 0, atol=1e-8)
    poses = colmap.world_to_camera(model.images)
    np.testing.assert_allclose(capture.offset, far + camera_centres(poses).mean(axis=0), atol=1e-8)
    for camera in capture.cameras:
        pose = poses[model.images.names.index(camera.name)]
        ours = capture.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        expected = model.points.positions @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(ours, expected, atol=1e-6)


def test_views_are_sorted_and_every_eighth_is_held_out(tmp_path):
    capture = load_capture(write_capture(tmp_path, NAMES[::-1]))
    assert [c.name for c in capture.cameras] == NAMES
    assert (capture.test, capture.train) == ([0, 8], list(range(1, 8)))
    train = camera_centres(np.stack([capture.cameras[i].world_to_camera for i in capture.train]))
    distances = np.linalg.norm(train - train.mean(axis=0), axis=1)
    assert capture.extent == pytest.approx(1.1 * distances.max())
    assert capture.near == NEAR_OF_EXTENT * capture.extent
    assert capture.track_lengths.tolist()[0] == 9 and (capture.errors == -1).all()


@pytest.mark.parametrize(("downscale", "size"), [(2, (33, 24)), (3, (22, 16)), (1.7, (38, 28))])
def test_downscaling_averages_areas_and_scales_each_axis_by_its_own_ratio(tmp_path, downscale, size):
    capture = load_capture(write_capture(tmp_path, NAMES[:2], width=65, height=48), downscale=downscale)
    camera = capture.cameras[0]
    assert (camera.width, camera.height) == size
    full = load_capture(tmp_path).cameras[0].K
    np.testing.assert_allclose(camera.K[0], full[0] * size[0] / 65)
    np.testing.assert_allclose(camera.K[1], full[1] * size[1] / 48)
    source = cv2.imread(str(tmp_path / "images" / camera.name))[..., ::-1]
    expected = cv2.resize(source, size, interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(ImageStore(capture).get(0).numpy(), expected)


def test_prescaled_folder_is_used_when_it_fits_and_not_otherwise(tmp_path):
    write_capture(tmp_path, NAMES[:2], width=65, height=48)
    for name in NAMES[:2]:
        write_image(tmp_path / "images_2" / name, smooth_image(24, 32, seed=9))
    capture = load_capture(tmp_path, downscale=2)
    assert {c.image_path.parent.name for c in capture.cameras} == {"images_2"}
    assert (capture.cameras[0].width, capture.cameras[0].height) == (32, 24)
    full = load_capture(tmp_path).cameras[0].K
    np.testing.assert_allclose(capture.cameras[0].K[0], full[0] * 32 / 65)
    np.testing.assert_array_equal(ImageStore(capture).get(1).numpy(), smooth_image(24, 32, seed=9))

    write_image(tmp_path / "images_2" / NAMES[1], smooth_image(20, 20))
    with pytest.warns(UserWarning, match="is 20 x 20, not 1/2 of 65 x 48; downscaling images instead"):
        capture = load_capture(tmp_path, downscale=2)
    assert {c.image_path.parent.name for c in capture.cameras} == {"images"}
    (tmp_path / "images_2" / NAMES[1]).unlink()
    warned(f"lacks {NAMES[1]}", load_capture, tmp_path, downscale=2)


def test_images_smaller_than_their_camera_scale_its_matrix(tmp_path):
    write_capture(tmp_path, NAMES[:2], width=64, height=48)
    full = load_capture(tmp_path).cameras[0].K
    write_image(tmp_path / "images" / NAMES[0], smooth_image(24, 32))
    capture = load_capture(tmp_path)
    np.testing.assert_allclose(capture.cameras[0].K[:2], full[:2] / 2)
    assert (capture.cameras[0].width, capture.cameras[1].width) == (32, 64)  # mixed sizes


def test_images_that_do_not_fit_their_camera_are_refused(tmp_path):
    write_capture(tmp_path, NAMES[:2])
    write_image(tmp_path / "images" / NAMES[1], smooth_image(48, 90))
    with pytest.raises(ValueError, match=rf"{NAMES[1]} is 90 x 48, which does not fit its camera of 64 x 48"):
        load_capture(tmp_path)
    # A placeholder; the rounding of its sides allows every shape.
    write_image(tmp_path / "images" / NAMES[1], smooth_image(1, 1))
    with pytest.raises(ValueError, match=rf"{NAMES[1]} is 1 x 1, which does not fit its camera of 64 x 48"):
        load_capture(tmp_path)


@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((0, 0), "is 0 x 0, which does not fit its camera of 64 x 48"),
        (
            (64 << 15, 48 << 15),
            "is 2097152 x 1572864: no side may be longer than 1,048,576 pixels; put a smaller",
        ),
    ],
)
def test_sizes_that_no_image_has_are_refused(tmp_path, size, message):
    write_capture(tmp_path, NAMES[:2])
    path = tmp_path / "images" / NAMES[1]
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", *size)
    path.write_bytes(data)
    refused(ValueError, f"{path} {message}", load_capture, tmp_path)


def test_two_cameras_of_one_id_or_images_of_one_name_are_refused(tmp_path):
    write_capture(tmp_path, NAMES[:3])
    edit_model(tmp_path, lambda model: model.cameras.append(model.cameras[0]))
    refused(ValueError, f"{tmp_path}/sparse/0: there are two cameras 1", load_capture, tmp_path)

    def name_twice(model):
        model.cameras.pop()
        model.images.names[1] = model.images.names[0]

    edit_model(tmp_path, name_twice)
    with pytest.raises(ValueError, match=f"{tmp_path}/sparse/0: there are two images called {NAMES[0]}"):
        load_capture(tmp_path)


def test_cameras_without_photographs_may_be_of_any_kind(tmp_path):
    write_capture(tmp_path, NAMES[:3])
    panorama = colmap.ColmapCamera(7, "EQUIRECTANGULAR", 64, 32, np.array([64.0, 32.0]))
    unknown = colmap.ColmapCamera(4294967295, "PINHOLE", 64, 48, np.zeros(4))
    edit_model(tmp_path, lambda model: model.cameras.extend([panorama, unknown]))
    assert len(load_capture(tmp_path).cameras) == 3
    edit_model(tmp_path, lambda model: model.images.camera_ids.put(0, 7))
    refused(ValueError, "sparse/0: camera 7: EQUIRECTANGULAR images show all", load_capture, tmp_path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_turns_an_image_only_when_its_camera_is_upright(tmp_path, orientation):
    upright = smooth_image(80, 48)
    path = tmp_path / "probe.jpg"
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(upright).save(path, quality=98, exif=exif)
    assert read_header(path).orientation == orientation
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(apply_orientation(stored, orientation), cv2.imread(str(path)))

    for name, (width, height) in {"asstored": (48, 80), "turned": (80, 48)}.items():
        root = write_capture(tmp_path / name, ["a.jpg"], width=width, height=height)
        shutil.copy(path, root / "images" / "a.jpg")
        if name == "turned" and orientation < 5:
            refused(ValueError, "does not fit its camera", load_capture, root)
            continue
        shown = ImageStore(load_capture(root)).get(0).numpy()
        assert shown.shape == (height, width, 3)
        expected = stored if name == "asstored" else cv2.imread(str(path))
        np.testing.assert_array_equal(shown, expected[..., ::-1])
    if orientation < 5:
        applied = load_capture(tmp_path / "asstored", exif="apply")
        np.testing.assert_array_equal(ImageStore(applied).get(0).numpy(), cv2.imread(str(path))[..., ::-1])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("channels", [3, 4])
def test_the_orientation_of_a_tiff_is_that_of_exif(tmp_path, orientation, channels):
    stored = smooth_image(80, 48)
    pixels = np.dstack([stored, np.full((80, 48), 255, dtype=np.uint8)])[..., :channels]
    root = write_capture(tmp_path, ["a.tif"], width=48, height=80)
    path = root / "images" / "a.tif"
    Image.fromarray(pixels).save(path, exif={0x0112: orientation})
    assert read_header(path) == ImageHeader(48, 80, orientation, channels == 4)
    np.testing.assert_array_equal(ImageStore(load_capture(root)).get(0).numpy(), stored)
    if orientation < 5:
        turned = ImageStore(load_capture(root, exif="apply")).get(0).numpy()
        np.testing.assert_array_equal(turned, apply_orientation(stored, orientation))


def test_masks_are_found_turned_and_shrunk_so_that_mixed_pixels_are_excluded(tmp_path):
    write_capture(tmp_path, NAMES[:3], width=64, height=48)
    mask = np.full((48, 64), 255, dtype=np.uint8)
    mask[:, :17] = 0
    write_image(tmp_path / "masks" / f"{NAMES[0]}.png", mask)
    write_image(tmp_path / "masks" / "v01.png", mask)
    store = ImageStore(load_capture(tmp_path, downscale=2))
    for index in (0, 1):
        found = store.mask(index).numpy()
        assert found.shape == (24, 32) and found.dtype == np.uint8
        assert not found[:, :9].any() and found[:, 9:].all()
    assert store.mask(2) is None
    assert ImageStore(load_capture(tmp_path, masks=False)).mask(0) is None
    refused(FileNotFoundError, "other: no such folder of masks", load_capture, tmp_path, masks="other")


def test_a_mask_of_another_shape_is_refused(tmp_path):
    write_capture(tmp_path, NAMES[:1], width=64, height=48)
    for size, fits in (((24, 32), True), ((383, 512), True), ((48, 48), False)):
        write_image(tmp_path / "masks" / "v00.png", np.full(size, 255, dtype=np.uint8))
        if fits:
            capture = load_capture(tmp_path)
            assert ImageStore(capture).mask(0).all()
            continue
        message = r"masks/v00.png is 48 x 48, which does not fit .* 64 x 48 .*: make it from"
        refused(ValueError, message, load_capture, tmp_path)
        refused(ValueError, message, ImageStore(capture).mask, 0)  # the file has changed


def test_distorted_captures_become_pinhole_ones(tmp_path):
    params = [60.0, 60.0, 32.0, 24.0, -0.1, 0.02, 0, 0]
    write_capture(tmp_path, NAMES[:2], model="OPENCV", params=params)
    capture = load_capture(tmp_path)
    camera, store = capture.cameras[0], ImageStore(capture)
    assert store.get(0).shape == (camera.height, camera.width, 3) and store.mask(0) is None
    source = cv2.imread(str(tmp_path / "images" / camera.name))[..., ::-1]
    rays = cv2.initUndistortRectifyMap(
        np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.array(params[4:]), np.eye(3),
        camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), (camera.width, camera.height),
        cv2.CV_32FC1,
    )  # fmt: skip
    expected = cv2.remap(source, *rays, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    assert np.abs(store.get(0).numpy().astype(int) - expected).max() <= 2

    masked = load_capture(tmp_path, undistort="mask")
    assert masked.cameras[0].width * masked.cameras[0].height > camera.width * camera.height
    mask = ImageStore(masked).mask(0).numpy()
    assert 0.9 < mask.mean() < 1


def test_the_folder_of_the_model_is_no_capture(tmp_path):
    write_capture(tmp_path, NAMES)
    with pytest.raises(FileNotFoundError, match=f"the folder above: --data={tmp_path.resolve()}$"):
        load_capture(tmp_path / "sparse" / "0")


def test_missing_images_are_named_or_dropped(tmp_path):
    write_capture(tmp_path, NAMES)
    (tmp_path / "images" / NAMES[3]).unlink()
    refused(FileNotFoundError, f"1 of 9 images are not in .*images: {NAMES[3]}", load_capture, tmp_path)
    capture = warned("dropped", load_capture, tmp_path, allow_missing=True)
    assert [c.name for c in capture.cameras] == NAMES[:3] + NAMES[4:]


def test_views_and_points_that_are_not_finite_are_dropped_with_a_warning(tmp_path):
    write_capture(tmp_path, NAMES)

    def damage(model):
        model.images.quats[2] = 0
        model.images.translations[4, 1] = np.nan
        model.images.translations[6, 1] = 1e200
        model.points.positions[5, 0] = np.inf
        model.points.positions[7, 0] = -1e200

    edit_model(tmp_path, damage)
    with pytest.warns(UserWarning) as caught:
        capture = load_capture(tmp_path)
    messages = " ".join(str(w.message) for w in caught)
    assert "3 of 9 views have no finite pose" in messages and "2 of 20 points are not finite" in messages
    assert len(capture.cameras) == 6 and len(capture.points) == 18 and len(capture.track_lengths) == 18

    edit_model(tmp_path, lambda m: m.images.quats.fill(np.nan))
    refused(ValueError, "none of the 9 views has a pose", load_capture, tmp_path)


def test_unseen_points_cause_a_warning(tmp_path, recwarn):
    write_capture(tmp_path, [f"{i}.png" for i in range(4)])
    warnings.simplefilter("always")
    load_capture(tmp_path)
    assert not [w for w in recwarn.list if "see none" in str(w.message)]

    def move_away(model):
        model.points.positions += np.array([1e4, -1e4, 1e4])

    edit_model(tmp_path, move_away)
    warned(r"4 of 4 views \(first: 0.png\) see none of the points", load_capture, tmp_path)


def test_a_model_without_points_starts_from_random_ones_where_the_cameras_look(tmp_path):
    write_capture(tmp_path, NAMES)
    folder = tmp_path / "sparse" / "0"
    model = colmap.read_model(folder)
    colmap.write_model(folder, colmap.ColmapModel(model.cameras, model.images))
    capture = warned("no points; 100,000 random ones take their place", load_capture, tmp_path)
    points = capture.points + capture.offset  # the cameras look at the origin from a distance of 4
    assert np.abs(points.mean(axis=0)).max() < 0.05 and 1.2 < np.abs(points).max() < 1.6
    with pytest.warns(UserWarning, match="random"):
        again = load_capture(tmp_path).points
    np.testing.assert_array_equal(again, capture.points)


def test_one_camera_gets_an_extent_from_the_points(tmp_path):
    write_capture(tmp_path, NAMES[:1])
    capture = warned("all training cameras are in one place", load_capture, tmp_path)
    assert capture.extent == pytest.approx(np.median(np.linalg.norm(capture.points, axis=1)))
    assert (capture.train, capture.test) == ([0], [])


def test_a_rotating_camera_is_in_one_place_whatever_rounding_says(tmp_path):
    """Poses around one point leave camera centres that differ by rounding alone."""

    def rotate_only(model):
        rotations = colmap.world_to_camera(model.images)[:, :3, :3]
        model.images.translations = -rotations @ np.array([3.0, -2.0, 9.0]) + 1e-15

    folder = write_capture(tmp_path, NAMES)
    edit_model(folder, rotate_only)
    capture = warned("all training cameras are in one place", load_capture, folder)
    distances = np.linalg.norm(capture.points, axis=1)
    assert 0.5 * np.median(distances) < capture.extent < 2 * np.median(distances)


@pytest.mark.skipif(shared_data() is None, reason="the real captures are not here")
@pytest.mark.parametrize(
    ("name", "views", "test", "downscale"), [("sheffield", 172, 22, 2), ("caliterra", 75, 10, 4)]
)
def test_real_captures_load_and_decode(name, views, test, downscale):
    capture = load_capture(shared_data() / name, downscale=downscale)
    assert (len(capture.cameras), len(capture.test)) == (views, test)
    store = ImageStore(capture)
    camera = capture.cameras[3]
    assert store.get(3).shape == (camera.height, camera.width, 3)
    # Most of the points that lie in front of a camera within its image were seen by some camera.
    seen = capture.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (seen / seen[:, 2:]) @ camera.K.T
    inside = (seen[:, 2] > 0) & (pixels[:, :2] >= 0).all(axis=1)
    inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    assert inside.sum() > 1000


@pytest.mark.parametrize("name", ["mask_of_v00.png", "v00x.tif"])
def test_masks_that_belong_to_no_image_are_not_ignored(tmp_path, name):
    root = write_capture(tmp_path, NAMES)
    mask = np.zeros((48, 64), dtype=np.uint8)
    write_image(root / "masks" / name, mask)
    refused(ValueError, f"none of the 1 masks in .*{name}.*data.masks=false", load_capture, root)
    assert load_capture(root, masks=False).cameras[0].mask_path is None
    write_image(root / "masks" / f"{NAMES[1]}.png", mask)
    warned(f"1 of 2 masks in .* belong to no image .first: {name}", load_capture, root)
