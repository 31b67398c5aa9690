# SPDX-License-Identifier: Apache-2.0
"""Camera models: map directions to pixels, for every camera model of COLMAP, and Brown's in full.

A lens maps normalised coordinates (u, v) = (x/z, y/z) of a point in front of the camera to pixels:
(fx u' + cx, fy v' + cy) with (u', v') = distort(u, v). The formulas are those that COLMAP documents for its
camera models; parameters keep COLMAP's order. BROWN, which photogrammetry programs have and COLMAP has not,
is OPENCV with k3 and k4 and, after all, u' + skew v' in the place of u'. Pixel (i, j) has its centre at
(i + 0.5, j + 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from blitzgs.capture.colmap import ColmapCamera, camera_models
from blitzgs.util.errors import located

Array = npt.NDArray[np.float64]
_Distort = Callable[[Array, Array, Sequence[float]], tuple[Array, Array]]


@cache
def lens_models() -> dict[str, list[str]]:
    """Return the names of the parameters, in order, of every camera model."""
    brown = ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "skew"]
    return camera_models() | {"BROWN": brown}


@dataclass(frozen=True)
class Lens:
    """A camera model with its image size (pixels) and parameters in COLMAP's order, or BROWN's."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        names = lens_models().get(self.model)
        if names is None:
            raise ValueError(f"unknown camera model {self.model!r}; known: {', '.join(lens_models())}")
        if self.model == "EQUIRECTANGULAR":
            raise ValueError(
                "EQUIRECTANGULAR images show all directions and cannot be made into one perspective image; "
                "cut them into perspective views first"
            )
        if len(names) != len(self.params):
            raise ValueError(f"{self.model} has the parameters {names}, got {len(self.params)} values")
        if not np.isfinite(self.params).all() or min(self.intrinsics[:2]) <= 0:
            raise ValueError(
                f"{self.model} needs finite parameters and a positive focal length, got {self.params}"
            )

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy in pixels."""
        fx, fy, cx, cy = (self.params[0], *self.params[:3]) if self.model in _TWO_FOCALS else self.params[:4]
        return fx, fy, cx, cy

    @property
    def distortion(self) -> tuple[float, ...]:
        """Return the parameters after the intrinsics."""
        return self.params[3 if self.model in _TWO_FOCALS else 4 :]

    @property
    def is_pinhole(self) -> bool:
        """Whether straight lines stay straight: the model is a pinhole, or its distortion is zero."""
        return _DISTORT[self.model] in _STRAIGHT_AT_ZERO and not any(self.distortion)

    @property
    def matrix(self) -> Array:
        """Return the matrix K [3, 3] of the intrinsics."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def scaled(self, width: int, height: int) -> Lens:
        """Return this lens for an image resized to width x height (each axis by its own ratio)."""
        if (width, height) == (self.width, self.height):
            return self
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        model = _TWO_FOCALS.get(self.model, self.model)
        params = (fx * sx, fy * sy, cx * sx, cy * sy, *self.distortion)
        missing = len(lens_models()[model]) - len(params)
        return Lens(model, width, height, (*params, *[0.0] * missing))

    def distort(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Map normalised coordinates to distorted ones; NaN if the model does not see the direction."""
        with np.errstate(all="ignore"):
            return _DISTORT[self.model](u, v, self.distortion)

    def project(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Map normalised coordinates to pixels."""
        fx, fy, cx, cy = self.intrinsics
        u, v = self.distort(u, v)
        return fx * u + cx, fy * v + cy


def lenses_of(cameras: Sequence[ColmapCamera]) -> dict[int, Lens]:
    """Return the lenses of a COLMAP model by id (ValueError: one makes no sense, or two have one id)."""
    lenses: dict[int, Lens] = {}
    for camera in cameras:
        if camera.id in lenses:
            raise ValueError(f"there are two cameras {camera.id}")
        with located(f"camera {camera.id}"):
            lenses[camera.id] = Lens(camera.model, camera.width, camera.height, tuple(camera.params.tolist()))
    return lenses


# By how much of the image's sides the principal point may be off its middle. It is farther off if the image
# has become 1.4 times smaller or two times larger and the lens is still that of before.
_OFF_CENTRE = 0.2


def check_lens(lens: Lens) -> str:
    """Return what is unusual about a lens, or an empty text.

    The limits are far from what is built: from a fisheye of 250 degrees to a telescope, pixels four times as
    long as wide (anamorphic lenses have two), and a tile cut from a picture ten times as long. ValueError: no
    camera has such a lens; names the values.
    """
    fx, fy, cx, cy = lens.intrinsics
    side = max(lens.width, lens.height)
    where = f"for an image of {lens.width} x {lens.height} pixels"
    if not 0.25 <= fx / fy <= 4:
        raise ValueError(
            f"the focal lengths {fx:g} and {fy:g} differ by more than a factor of 4: check fx and fy"
        )
    if not 0.02 * side <= max(fx, fy) <= 1000 * side:
        raise ValueError(f"the focal lengths {fx:g} and {fy:g} pixels are no camera's {where}")
    if not (abs(cx - lens.width / 2) <= 10 * side and abs(cy - lens.height / 2) <= 10 * side):
        raise ValueError(f"the principal point {cx:g}, {cy:g} is far outside the image, {where}")
    if not 1 / 1.5 <= fx / fy <= 1.5:
        return f"focal lengths {fx:g} and {fy:g} {where}"
    if max(abs(cx), abs(cy)) <= 1 and min(lens.width, lens.height) > 8:
        return f"principal point {cx:g}, {cy:g} at the corner {where} (it is given in pixels)"
    if not (0 <= cx <= lens.width and 0 <= cy <= lens.height):
        return f"principal point {cx:g}, {cy:g} outside an image of {lens.width} x {lens.height} pixels"
    if max(abs(cx / lens.width - 0.5), abs(cy / lens.height - 0.5)) > _OFF_CENTRE:
        return f"principal point {cx:g}, {cy:g} far from the middle {where}: was the image resized?"
    return ""


def _polynomial(r2: Array, coefficients: Sequence[float]) -> Array:
    """Return 1 + c0 r2 + c1 r2^2 + ..."""
    value = np.zeros_like(r2)
    for c in reversed(coefficients):
        value = (value + c) * r2
    return 1 + value


def _tangential(u: Array, v: Array, scale: Array | float, p1: float, p2: float) -> tuple[Array, Array]:
    """Return scaled directions with the shift of a lens whose parts are not on one axis."""
    r2 = u * u + v * v
    du, dv = 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    return u * scale + du, v * scale + dv


def _radial(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    scale = _polynomial(u * u + v * v, k)
    return u * scale, v * scale


def _opencv(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    return _tangential(u, v, _polynomial(u * u + v * v, k[:2]), k[2], k[3])


def _brown(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    u, v = _tangential(u, v, _polynomial(u * u + v * v, k[:4]), k[4], k[5])
    return u + k[6] * v, v


def _full_opencv(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    r2 = u * u + v * v
    scale = _polynomial(r2, (k[0], k[1], k[4])) / _polynomial(r2, k[5:8])
    return _tangential(u, v, scale, k[2], k[3])


def _fov(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    omega = k[0]
    r = np.hypot(u, v)
    if omega * omega < 1e-8:
        return u, v
    scale = np.where(
        r > 1e-8, np.arctan(2 * r * np.tan(omega / 2)) / (r * omega), 2 * np.tan(omega / 2) / omega
    )
    return u * scale, v * scale


def _equidistant(u: Array, v: Array) -> tuple[Array, Array]:
    """Map directions to the plane in which the distance from the centre is the angle to the axis."""
    r = np.hypot(u, v)
    scale = np.where(r > 1e-8, np.arctan(r) / np.maximum(r, 1e-8), 1.0)
    return u * scale, v * scale


def _fisheye(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    return _radial(*_equidistant(u, v), k)


def _thin_prism_fisheye(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = k
    u, v = _equidistant(u, v)
    r2 = u * u + v * v
    u, v = _tangential(u, v, _polynomial(r2, (k1, k2, k3, k4)), p1, p2)
    return u + sx1 * r2, v + sy1 * r2


def _rad_tan_thin_prism_fisheye(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    u, v = _radial(*_equidistant(u, v), k[:6])
    p0, p1, s0, s1, s2, s3 = k[6:]
    r2 = u * u + v * v
    u, v = _tangential(u, v, 1.0, p1, p0)
    return u + r2 * (s0 + s1 * r2), v + r2 * (s2 + s3 * r2)


def _division(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    scale = 2 / (1 + np.sqrt(1 - 4 * k[0] * (u * u + v * v)))
    return u * scale, v * scale


def _eucm(u: Array, v: Array, k: Sequence[float]) -> tuple[Array, Array]:
    alpha, beta = k
    scale = 1 / (alpha * np.sqrt(beta * (u * u + v * v) + 1) + 1 - alpha)
    return u * scale, v * scale


_DISTORT: dict[str, _Distort] = {
    "SIMPLE_PINHOLE": _radial,
    "PINHOLE": _radial,
    "SIMPLE_RADIAL": _radial,
    "RADIAL": _radial,
    "OPENCV": _opencv,
    "FULL_OPENCV": _full_opencv,
    "BROWN": _brown,
    "FOV": _fov,
    "OPENCV_FISHEYE": _fisheye,
    "SIMPLE_RADIAL_FISHEYE": _fisheye,
    "RADIAL_FISHEYE": _fisheye,
    "SIMPLE_FISHEYE": _fisheye,
    "FISHEYE": _fisheye,
    "THIN_PRISM_FISHEYE": _thin_prism_fisheye,
    "RAD_TAN_THIN_PRISM_FISHEYE": _rad_tan_thin_prism_fisheye,
    "SIMPLE_DIVISION": _division,
    "DIVISION": _division,
    "EUCM": _eucm,
}
_STRAIGHT_AT_ZERO = (_radial, _opencv, _full_opencv, _brown, _fov, _division)
# Models with one focal length, and the one that holds their distortion with two (zeros appended).
_TWO_FOCALS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_FISHEYE": "FISHEYE",
    "SIMPLE_DIVISION": "DIVISION",
}
