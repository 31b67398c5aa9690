# SPDX-License-Identifier: Apache-2.0
"""The lens of a frame of transforms.json: every field that describes it is used, refused or named.

A frame's fields stand before those of the root, and both focal lengths come from one of the two: the length
of one level and the length of the other belong to different lenses.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

from blitzgs.capture.colmap import camera_models
from blitzgs.capture.fields import Fields, number
from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens

_FISHEYE = "OPENCV_FISHEYE"
# What these names mean differs between programs by which coefficients are zero only: nerfstudio's converters
# write any of them, and it undistorts by the coefficients that are there. The others are COLMAP's.
_GENERAL = {
    **dict.fromkeys(
        ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"), "FULL_OPENCV"
    ),
    **dict.fromkeys(("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), _FISHEYE),
    "SIMPLE_DIVISION": "DIVISION",
}
# Fields of a lens whatever its model; another one that is not zero is refused, as it would have no effect.
_COEFFICIENT = re.compile(r"(?i)k\d*|p\d+|s\d+|sx\d+|sy\d+|b\d+|xi|omega|skew|ftheta_p\d+")
# nerfstudio's list, in its order.
_LIST = ("k1", "k2", "k3", "k4", "p1", "p2")
# Fields that say that the image is no perspective or fisheye image.
_OTHER_PROJECTIONS = ("ortho", "orthographic", "is_ortho", "equirectangular", "is_equirectangular", "latlong")
# Fields that are read from a lens' level, for the list of those that are not.
FIELDS = frozenset(
    ("w", "h", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "cx", "cy")
    + ("camera_model", "is_fisheye", "distortion_params", "camera_type", *_OTHER_PROJECTIONS)
)


def read_lens(root: Fields, frame: Fields, path: Path, notes: dict[str, None]) -> Lens:
    """Return the lens of a frame; its image's size is used if the fields have none.

    `notes` gets, as its keys, what was decided between fields that say different things. ValueError: a field
    is missing, makes no sense or would have no effect; names it.
    """
    merged = {**root, **frame}
    _refuse_other_projections(merged)
    width, height = _size(merged, path)
    _check_levels(root, frame, (width, height))
    focal = _focal_lengths(frame, width, height, notes) or _focal_lengths(root, width, height, notes)
    if focal is None:
        raise ValueError("neither fl_x nor camera_angle_x is given")
    centre = number(merged, "cx", width / 2), number(merged, "cy", height / 2)
    name = _model_name(root, frame)
    model = _GENERAL.get(name, name)
    return Lens(model, width, height, (*focal, *centre, *_coefficients(merged, name, model, notes)))


def _size(fields: Fields, path: Path) -> tuple[int, int]:
    given = {key: number(fields, key) for key in ("w", "h") if key in fields}
    for key, value in given.items():
        if value != int(value) or value < 1:
            raise ValueError(
                f"the image's size must be at least 1 x 1 in whole pixels, got {key} = {value:g}"
            )
    if len(given) == 2:
        return int(given["w"]), int(given["h"])
    if not path.is_file():
        raise ValueError(f"the image {path} does not exist, and its size is not given by w and h")
    header = read_header(path)
    for key, value in given.items():
        other, own = ("h", header.width) if key == "w" else ("w", header.height)
        if value != own:
            raise ValueError(f"{key} = {value:g} without {other}, and the image {path} has {key} = {own}")
    return header.width, header.height


def _check_levels(root: Fields, frame: Fields, size: tuple[int, int]) -> None:
    """Refuse pixels of the root's image size for a frame of another size."""
    if not ("w" in root and "h" in root and {"w", "h"} & frame.keys()):
        return
    whole = int(number(root, "w")), int(number(root, "h"))
    if size == whole:
        return
    lost = [key for key in ("cx", "cy") if key in root and key not in frame]
    if size != whole[::-1] and not {"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"} & frame.keys():
        lost += [key for key in ("fl_x", "fl_y") if key in root]
    if lost:
        raise ValueError(
            f"w and h of the frame are {size[0]} x {size[1]}, but {' and '.join(lost)} of the root belong to "
            f"{whole[0]} x {whole[1]}: give the frame its own {' and '.join(lost)}"
        )


def _focal_lengths(
    fields: Fields, width: int, height: int, notes: dict[str, None]
) -> tuple[float, float] | None:
    """Return fx and fy by one level's fields; pixels are square if they name one axis. None: no field."""
    fx, fy = _focal_length(fields, "x", width, notes), _focal_length(fields, "y", height, notes)
    if fx is None:
        return None if fy is None else (fy, fy)
    return fx, fx if fy is None else fy


def _focal_length(fields: Fields, axis: str, size: int, notes: dict[str, None]) -> float | None:
    length, angle, degrees = f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"
    by_angle = None
    if angle in fields:
        radians = number(fields, angle)
        if not 0 < 0.5 * radians < 0.5 * math.pi:
            hint = f": as degrees it would be {math.radians(radians):.6g}" if radians > 0 else ""
            raise ValueError(
                f"{angle} must be an angle of view in radians, above 0 and below pi, got {radians:g}{hint}"
            )
        by_angle = 0.5 * size / math.tan(0.5 * radians)
    elif degrees in fields:  # instant-ngp's
        value = number(fields, degrees)
        if not 0 < 0.5 * math.radians(value) < 0.5 * math.pi:
            raise ValueError(f"{degrees} must be an angle of view in degrees, above 0 and below 180")
        by_angle = 0.5 * size / math.tan(0.5 * math.radians(value))
    if length not in fields:
        return by_angle
    focal = number(fields, length)
    if focal <= 0:
        raise ValueError(f"{length} must be a positive focal length in pixels, got {focal:g}")
    if by_angle is not None and abs(by_angle / focal - 1) > 0.01:
        name = angle if angle in fields else degrees
        notes[f"{length} = {focal:g} is used, although {name} means {by_angle:.6g} pixels"] = None
    return focal


def model_names() -> list[str]:
    """Return the values of camera_model that can be read."""
    return [name for name in camera_models() if name != "EQUIRECTANGULAR"]


def _model_name(root: Fields, frame: Fields) -> str:
    """Return the camera model by COLMAP's name."""
    for level in (frame, root):  # the first that says something
        flag = level.get("is_fisheye")
        if "is_fisheye" in level and not isinstance(flag, bool):
            raise ValueError(f"is_fisheye must be true or false, got {flag!r}")
        if "camera_model" in level:
            given = level["camera_model"]
            name = given.upper() if isinstance(given, str) else ""
            if name == "EQUIRECTANGULAR":
                Lens(name, 1, 1, ())  # which says why it is refused
            if name not in model_names():
                raise ValueError(
                    f"camera_model {given!r:.40} is not supported; known: {', '.join(model_names())}"
                )
            if flag is not None and flag != ("FISHEYE" in name):
                raise ValueError(
                    f"is_fisheye is {str(flag).lower()} but camera_model is {name}: remove the one that is "
                    "wrong"
                )
            return name
        if flag is not None:
            return _FISHEYE if flag else "OPENCV"
    return "OPENCV"


def _coefficients(fields: Fields, name: str, model: str, notes: dict[str, None]) -> list[float]:
    """Return the coefficients of `model`, which holds those of the lens that the fields call `name`."""
    names = camera_models()[model][4:]
    fields = _with_listed(fields, model)
    given = {key: number(fields, key) for key in names if key in fields}
    others = (key for key in sorted(fields.keys() - set(names)) if _is_coefficient(key, fields[key]))
    if lost := {key: value for key in others if (value := number(fields, key)) != 0}:
        values = ", ".join(f"{key} = {value:g}" for key, value in lost.items())
        what = "a fisheye lens has only k1 to k4" if model == _FISHEYE else f"{name} has {', '.join(names)}"
        raise ValueError(f"{values}: {what}; set the others to 0, or name another camera_model")
    if model == "EUCM" and (unknown := sorted(set(names) - given.keys())):
        raise ValueError(f"camera_model {model} needs {' and '.join(unknown)}")
    if model == "FULL_OPENCV" and name != model:
        if given.get("k4", 0.0) != 0 and not {"k5", "k6"} & fields.keys():
            # nerfstudio multiplies by 1 + k1 r + k2 r^2 + k3 r^3 + k4 r^4 with r = x^2 + y^2.
            raise ValueError(
                f"k4 is {given['k4']:g}, without k5 and k6: a polynomial of four coefficients, as "
                "nerfstudio's, is no lens of this package; fit the lens again without k4 or undistort the "
                "images, or write k5 and k6 if k4 is of OpenCV's rational model"
            )
        if "PINHOLE" in name and any(given.values()):
            notes["camera_model is that of a pinhole, but its coefficients are not 0 and are used"] = None
    return [given.get(key, 0.0) for key in names]


def _with_listed(fields: Fields, model: str) -> Fields:
    """Return the fields with the coefficients of nerfstudio's `distortion_params` under their names."""
    if "distortion_params" not in fields:
        return fields
    values = fields["distortion_params"]
    # Four values are k1 to k4 of a fisheye lens, but k1, k2, p1, p2 to OpenCV.
    if not isinstance(values, list) or len(values) not in ((4, 6) if model == _FISHEYE else (6,)):
        raise ValueError(f"distortion_params must be a list of {', '.join(_LIST)}, got {values!r:.60}")
    listed = dict(zip(_LIST, values, strict=False))
    for key in listed:
        value = number(listed, key)
        if key in fields and number(fields, key) != value:
            raise ValueError(f"{key} is {fields[key]}, but {value:g} in distortion_params: keep one of them")
    return {**fields, **listed}


def _is_coefficient(key: str, value: object) -> bool:
    """Tell whether a field is a coefficient; only numbers are: a file may have fields of its own."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return bool(_COEFFICIENT.fullmatch(key)) and (is_number or key in camera_models()["FULL_OPENCV"])


def _refuse_other_projections(fields: Fields) -> None:
    said: Iterable[str] = (key for key in _OTHER_PROJECTIONS if fields.get(key))
    kind = fields.get("camera_type")
    allowed = ["perspective", "pinhole"] + ["fisheye"] * bool({"camera_model", "is_fisheye"} & fields.keys())
    if kind is not None and str(kind).lower() not in allowed:
        said = [f"camera_type {kind!r:.40}"]
    for key in said:
        raise ValueError(
            f"{key}: only perspective images, and those of a fisheye camera_model, can be read; make "
            "perspective views of the others first"
        )
