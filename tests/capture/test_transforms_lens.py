# SPDX-License-Identifier: Apache-2.0
"""Every lens field of transforms.json against one formula: it is used, refused, or named."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blitzgs.capture.lens import Lens, check_lens
from blitzgs.capture.transforms import read_transforms
from blitzgs.capture.transforms_lens import model_names, read_lens
from tests.capture.helpers import at, frame, smooth_image, write_image, write_transforms
from tests.helpers import refused

W, H = 64, 48
SIZE = {"w": W, "h": H}
LENS = {**SIZE, "fl_x": 60.0, "fl_y": 61.0, "cx": 30.0, "cy": 25.0}


def lens_of(root, frame=None, path=None, notes=None):
    return read_lens(root, frame or {}, path or Path("/nowhere.png"), {} if notes is None else notes)


def by_angle(angle, size):
    return 0.5 * size / math.tan(0.5 * angle)


def expected_focal(root, frame):
    """The formula: the first level with a focal field decides on both axes; pixels are square by default."""
    for level in (frame, root):
        axes = []
        for axis, size in (("x", W), ("y", H)):
            if f"fl_{axis}" in level:
                axes.append(level[f"fl_{axis}"])
            elif f"camera_angle_{axis}" in level:
                axes.append(by_angle(level[f"camera_angle_{axis}"], size))
            elif f"{axis}_fov" in level:
                axes.append(by_angle(math.radians(level[f"{axis}_fov"]), size))
            else:
                axes.append(None)
        if axes != [None, None]:
            return axes[0] or axes[1], axes[1] or axes[0]
    return None


LENGTH, ANGLE, DEGREES = st.floats(10, 300), st.floats(0.1, 3.0), st.floats(5, 170)
FOCAL = st.fixed_dictionaries(
    {},
    optional={
        **{"fl_x": LENGTH, "fl_y": LENGTH, "camera_angle_x": ANGLE, "camera_angle_y": ANGLE},
        **{"x_fov": DEGREES, "y_fov": DEGREES},
    },
)
CENTRE = st.fixed_dictionaries({}, optional={"cx": st.floats(0, W), "cy": st.floats(0, H)})
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
SMALL = st.floats(-0.1, 0.1)
RADIAL = st.fixed_dictionaries({}, optional=dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), SMALL))
LEVEL = st.tuples(FOCAL, CENTRE, RADIAL).map(lambda parts: {**parts[0], **parts[1], **parts[2]})


@settings(max_examples=300, deadline=None, derandomize=True)
@given(LEVEL, LEVEL, st.sampled_from(["OPENCV", "RADIAL", "PINHOLE", "SIMPLE_RADIAL", "simple_pinhole"]))
def test_a_frame_wins_and_both_focal_lengths_are_of_one_level(root, frame, model):
    focal = expected_focal(root, frame)
    if focal is None:
        refused(ValueError, "neither fl_x nor camera_angle_x", lens_of, {**SIZE, **root}, frame)
        return
    lens = lens_of({**SIZE, **root, "camera_model": model}, frame)
    merged = {**root, **frame}
    centre = merged.get("cx", W / 2), merged.get("cy", H / 2)
    assert lens.intrinsics == pytest.approx((*focal, *centre))
    given_values = [merged.get(key, 0.0) for key in COEFFICIENTS]
    assert list(lens.distortion) == given_values or (lens.model == "PINHOLE" and not any(given_values))


@pytest.mark.parametrize("place", ["root", "frame"])
@pytest.mark.parametrize("model", [None, *model_names()])
def test_every_camera_name_and_coefficient_is_used_or_refused_by_name(model, place):
    named = {} if model is None else {"camera_model": model}
    others = {"EUCM": {"alpha": 0.5, "beta": 1.0}}.get(model, {})
    fields = ("k", "k0", *COEFFICIENTS, "p0", "sx1", "sy1", "s0", "s1", "s2", "s3", "omega", "alpha", "beta")
    for field in (*fields, "skew", "b1", "xi", "ftheta_p0"):
        extra = {**named, **others, field: 0.01, **({"k5": 0.0} if field == "k4" else {})}
        root, frame = (LENS | extra, {}) if place == "root" else (LENS, extra)
        try:
            lens = lens_of(root, frame)
        except ValueError as error:
            assert f"{field} = 0.01" in str(error)
            continue
        if field in ("alpha", "beta") and model != "EUCM":
            continue  # words that a file may use for something else
        assert 0.01 in lens.distortion, (model, field)


@pytest.mark.parametrize(
    ("name", "same", "fields"),
    [
        ("SIMPLE_RADIAL", "OPENCV", {"k1": 0.1}),
        ("RADIAL", "OPENCV", {"k1": 0.1, "k2": 0.02}),
        ("FULL_OPENCV", "OPENCV", {"k1": 0.1, "k4": 0.01, "k5": 0.02, "k6": 0.03}),
        ("RADIAL_FISHEYE", "OPENCV_FISHEYE", {"k1": 0.1, "k2": 0.02}),
        ("SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE", {"k1": 0.1}),
        ("FISHEYE", "OPENCV_FISHEYE", {}),
    ],
)
def test_names_of_colmap_project_as_colmap_does(name, same, fields):
    lens = lens_of(LENS | fields | {"camera_model": name})
    assert lens == lens_of(LENS | fields | {"camera_model": same})
    u, v = np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 5))
    # COLMAP's own formula of this name, at one focal length.
    own = {"SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"), "FULL_OPENCV": COEFFICIENTS, "FISHEYE": ()}
    own |= {"RADIAL_FISHEYE": ("k1", "k2"), "SIMPLE_RADIAL_FISHEYE": ("k1",)}
    shared = name not in ("FULL_OPENCV", "FISHEYE")
    focal = (60.0,) if shared else (60.0, 61.0)
    colmap = Lens(name, W, H, (*focal, 30.0, 25.0, *(fields.get(k, 0.0) for k in own[name])))
    square = lens_of(LENS | fields | {"camera_model": name} | ({"fl_y": 60.0} if shared else {}))
    np.testing.assert_allclose(square.project(u, v), colmap.project(u, v), rtol=1e-12)


REFUSED = [
    ({"camera_angle_x": 45.0}, "camera_angle_x must be .* radians, .* 45: as degrees it would be 0.785398"),
    ({"camera_angle_y": 180}, "camera_angle_y must be .* as degrees it would be 3.14159"),
    ({"camera_angle_x": math.pi}, "camera_angle_x must be"),
    ({"camera_angle_x": 0}, "camera_angle_x must be .* got 0"),
    ({"camera_angle_x": -0.5}, "camera_angle_x must be .* got -0.5"),
    ({"x_fov": 180}, "x_fov must be an angle of view in degrees"),
    ({"fl_x": 0}, "fl_x must be a positive focal length"),
    ({"fl_y": -3.0}, "fl_y must be a positive focal length"),
    ({"fl_x": True}, "fl_x must be a finite number, got True"),
    ({"fl_x": "wide"}, "fl_x must be a finite number, got 'wide'"),
    ({"cx": math.nan}, "cx must be a finite number, got nan"),
    ({"cy": [1]}, r"cy must be a finite number, got \[1\]"),
    ({"k1": None}, "k1 must be a finite number, got null"),
    ({"k1": "x"}, "k1 must be a finite number, got 'x'"),
    ({"w": 63.5}, "whole pixels, got w = 63.5"),
    ({"h": -1}, "whole pixels, got h = -1"),
    ({"camera_model": "ORTHOPHOTO"}, "camera_model 'ORTHOPHOTO' is not supported; known: SIMPLE_PINHOLE"),
    ({"camera_model": "EQUIRECTANGULAR"}, "cut them into perspective views first"),
    ({"camera_model": None}, "camera_model None is not supported"),
    ({"camera_model": "EUCM"}, "camera_model EUCM needs alpha and beta"),
    ({"camera_type": "ORTHO"}, "camera_type 'ORTHO': only perspective images"),
    ({"ortho": True}, "ortho: only perspective images"),
    ({"latlong": True}, "latlong: only perspective images"),
    ({"is_fisheye": 1}, "is_fisheye must be true or false, got 1"),
    ({"is_fisheye": False, "camera_model": "OPENCV_FISHEYE"}, "is_fisheye is false but camera_model is"),
    ({"distortion_params": [0.1, 0.2]}, "distortion_params must be a list of k1, k2, k3, k4, p1, p2"),
    ({"distortion_params": [0.1] + [0] * 5, "k1": 0.3}, "k1 is 0.3, but 0.1 in distortion_params"),
    ({"distortion_params": ["a"] + [0] * 5}, "k1 must be a finite number, got 'a'"),
    ({"k4": 0.1}, "k4 is 0.1, without k5 and k6"),
]  # fmt: skip


@pytest.mark.parametrize("place", ["root", "frame"])
@pytest.mark.parametrize(("fields", "message"), REFUSED)
def test_what_makes_no_sense_is_refused_by_name(fields, message, place):
    size = {key: value for key, value in SIZE.items() if key not in fields}
    base = size | {"w": W, "h": H} | ({} if {"fl_x", "camera_angle_x"} & fields.keys() else {"fl_x": 60.0})
    root, frame = (base | fields, {}) if place == "root" else (base, fields)
    refused(ValueError, message, lens_of, root, frame)


def test_levels_of_another_size_are_not_mixed():
    half = {"w": W // 2, "h": H // 2}
    refused(ValueError, "cx and cy and fl_x and fl_y of the root belong to 64 x 48", lens_of, LENS, half)
    own = half | {"fl_x": 30.0, "cx": 15.0, "cy": 12.0}
    assert lens_of(LENS, own).intrinsics == (30.0, 30.0, 15.0, 12.0)
    upright = {"w": H, "h": W}  # the same camera, turned: its focal length in pixels is the same
    assert lens_of({**SIZE, "fl_x": 60.0}, upright).intrinsics == (60.0, 60.0, H / 2, W / 2)
    refused(ValueError, "cx and cy of the root belong to", lens_of, LENS, upright)


def test_a_frames_kind_of_lens_wins():
    fisheye, plain = {"is_fisheye": True}, {"camera_model": "OPENCV"}
    assert lens_of(LENS | plain, fisheye).model == "OPENCV_FISHEYE"
    assert lens_of(LENS | fisheye, plain).model == "FULL_OPENCV"
    assert lens_of(LENS | {"is_fisheye": True}, {"is_fisheye": False}).model == "FULL_OPENCV"


def test_a_list_of_coefficients_is_used():
    values = [0.1, 0.02, 0.003, 0.0, 0.005, 0.006]
    named = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), values, strict=True))
    assert lens_of(LENS | {"distortion_params": values}) == lens_of(LENS | named)
    fisheye = LENS | {"camera_model": "OPENCV_FISHEYE"}
    assert lens_of(fisheye | {"distortion_params": [0.1, 0.2, 0.3, 0.4]}).distortion == (0.1, 0.2, 0.3, 0.4)
    refused(ValueError, "p1 = 0.005, p2 = 0.006: .* only", lens_of, fisheye | {"distortion_params": values})


def test_a_size_without_its_other_side_is_that_of_the_image(tmp_path):
    write_image(tmp_path / "a.png", smooth_image(H, W))
    assert lens_of({"w": W, "fl_x": 60.0}, {}, tmp_path / "a.png").height == H
    with pytest.raises(ValueError, match="w = 32 without h, and the image .* has w = 64"):
        lens_of({"w": 32, "fl_x": 60.0}, {}, tmp_path / "a.png")


def test_what_is_decided_between_fields_is_named(tmp_path):
    notes = {}
    assert lens_of(LENS | {"camera_angle_x": 1.0}, notes=notes).intrinsics[0] == 60
    assert list(notes) == ["fl_x = 60 is used, although camera_angle_x means 58.5756 pixels"]
    write_image(tmp_path / "a.png", smooth_image(H, W))
    root = LENS | {"K1": 0.0, "aabb_scale": 2, "camera_model": "PINHOLE", "k1": 0.1}
    write_transforms(tmp_path, [frame("a.png", weather="fair")], **root)
    read = read_transforms(tmp_path)
    assert any("its coefficients are not 0 and are used" in note for note in read.notes)
    assert "fields without effect: weather, K1" in read.notes


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((4, 4)), "zeros only: leave out frames without a pose"),
        (np.diag([1.0, 1, 1, 0]), "the last row of transform_matrix must be 0, 0, 0, 1"),
        (np.vstack([np.eye(4)[:3], [1.0, 2, 3, 4]]), r"last row .* got \[1.0, 2.0, 3.0, 4.0\]"),
        (np.diag([1.0, 1, 2, 1]), "not a rotation and a translation: its axes have the lengths 1, 1, 2"),
        (np.array([[1.0, 0.5, 0, 0], [0, 0.75**0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a rotation"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors the scene"),
        (np.eye(3), r"must be 4 x 4, got the shape \(3, 3\)"),
        ([["a"] * 4] * 4, "must be 4 x 4 numbers"),
        (None, "the field transform_matrix is missing"),
    ],
)
def test_matrices_that_are_no_rigid_motion_are_refused(tmp_path, matrix, message):
    write_image(tmp_path / "a.png", smooth_image(H, W))
    matrix = matrix.tolist() if isinstance(matrix, np.ndarray) else matrix
    write_transforms(tmp_path, [{"file_path": "a.png", "transform_matrix": matrix}], **LENS)
    refused(ValueError, f"frame 0: .*{message}", read_transforms, tmp_path)


def test_a_uniform_scale_of_the_rig_is_removed(tmp_path):
    write_image(tmp_path / "a.png", smooth_image(H, W))
    write_transforms(tmp_path, [frame("a.png", at(1, 2, 3) @ np.diag([2.5, 2.5, 2.5, 1]))], **LENS)
    read = read_transforms(tmp_path).frames[0].world_to_camera
    np.testing.assert_allclose(read[:3, :3], np.diag([1, -1, -1]), atol=1e-15)
    np.testing.assert_allclose(read[:3, 3], [-1, 2, 3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((text, "the field frames is missing") for text in ("[]", "null", "3", "{}", '{"frames": null}')),
        ('{"frames": 3}', "the field frames is 3"), ("{", "no JSON"),
        ('{"frames": ' + "[" * 100_000, "not a transforms file"),
        ('{"frames": [3]}', "frame 0: must be an object with file_path and transform_matrix, got 3"),
        ('{"frames": [null]}', "frame 0: must be an object"),
    ],
)  # fmt: skip
def test_files_of_another_form_are_named(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text)
    refused(ValueError, f"transforms.json: .*{message}", read_transforms, tmp_path)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ((5.0, 133.0, 32.0, 24.0), "5 and 133 differ by more than a factor of 4"),
        ((0.5, 0.5, 32.0, 24.0), "no camera's for an image of 64 x 48"),
        ((1e6, 1e6, 32.0, 24.0), "no camera's"),
        ((60.0, 60.0, 1e6, 24.0), "principal point 1e.06, 24 is far outside"),
    ],
)
def test_a_lens_that_no_camera_has_is_refused(params, message):
    refused(ValueError, message, check_lens, Lens("PINHOLE", W, H, params))


def test_an_unusual_lens_is_named():
    assert check_lens(Lens("PINHOLE", W, H, (60.0, 60.0, 32.0, 24.0))) == ""
    assert "focal lengths 60 and 120" in check_lens(Lens("PINHOLE", W, H, (60.0, 120.0, 32.0, 24.0)))
    assert "0.5, 0.5 at the corner" in check_lens(Lens("PINHOLE", W, H, (60.0, 60.0, 0.5, 0.5)))
    assert "principal point -3, 24 outside" in check_lens(Lens("PINHOLE", W, H, (60.0, 60.0, -3.0, 24.0)))
    for scale in (0.5, 2):  # of a photograph that was resized, whose lens was not
        centre = (W / 2 / scale, H / 2 / scale)
        assert "far from the middle" in check_lens(Lens("PINHOLE", W, H, (60.0, 60.0, *centre)))
    assert check_lens(Lens("PINHOLE", W, H, (60.0, 60.0, 0.62 * W, 0.4 * H))) == ""
