# SPDX-License-Identifier: Apache-2.0
"""Photographs of a textured ground with raised slabs, drawn by homographies, with exact poses."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.capture import load_capture
from blitzgs.capture.world import fit_similarity
from tests.capture.helpers import write_image

WIDTH, HEIGHT, FOCAL = 400, 300, 380.0
# Height, and the square [x0, y0, x1, y1] that a slab covers.
_SLABS = [(0.0, (-12, -12, 12, 12)), (0.8, (-5, -4, -2, 0)), (1.4, (0, 0, 3, 2)), (1.0, (3, -5, 6, -2))]
_SLABS += [(1.8, (-4, 2, -1, 5)), (0.5, (-1, -6, 1, -2))]
_PIXELS = 40  # of a texture, per unit


def poses(count: int = 8) -> np.ndarray:
    """World to camera, [count, 4, 4]: two strips at a height of 8 that look down, tilted a little."""
    out = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        strip, along = index % 2, index // 2
        centre = np.array([-3.3 + 2.2 * along, -1.2 + 2.4 * strip, 8.0 + 0.6 * (index % 3)])
        tilt, turn = np.array([0.12, -0.1, 0.05])[index % 3], 0.1 * (index % 2)
        down = np.diag([1.0, -1.0, -1.0])
        about_x = cv2.Rodrigues(np.array([tilt, 0, 0]))[0] @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
        out[index, :3, :3] = about_x @ down
        out[index, :3, 3] = -out[index, :3, :3] @ centre
    return out


def photograph(pose: np.ndarray) -> np.ndarray:
    """BGR uint8 [HEIGHT, WIDTH, 3]; higher slabs hide lower ones, as for a camera above all of them."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for number, (height, (x0, y0, x1, y1)) in sorted(enumerate(_SLABS), key=lambda slab: slab[1][0]):
        texture = _texture(number, (y1 - y0) * _PIXELS, (x1 - x0) * _PIXELS)
        # Pixel centres are at halves in the world's and COLMAP's coordinates, at whole numbers in OpenCV's.
        to_world = np.array([[1 / _PIXELS, 0, x0], [0, 1 / _PIXELS, y0], [0, 0, height], [0, 0, 1]])
        to_world = to_world @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        to_pixel = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ K @ pose[:3] @ to_world
        size = (WIDTH, HEIGHT)
        shown = cv2.warpPerspective(texture, to_pixel, size, flags=cv2.INTER_AREA)
        covered = cv2.warpPerspective(np.full(texture.shape[:2], 255, np.uint8), to_pixel, size)
        image[covered > 127] = shown[covered > 127]
    return image


def _texture(seed: int, rows: int, columns: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    total = np.zeros((rows, columns, 3), np.float32)
    for cell in (6, 14, 40):
        noise = random.random((rows // cell + 2, columns // cell + 2, 3), dtype=np.float32)
        total += cv2.resize(noise, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(total, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def write_photographs(folder: Path, count: int = 8) -> np.ndarray:
    """Write view_0.jpg, view_1.jpg, ... and return their poses."""
    placed = poses(count)
    for index, pose in enumerate(placed):
        write_image(folder / f"view_{index}.jpg", photograph(pose)[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, 95)
    return placed


def with_gps(folder: Path, placed: np.ndarray, altitude: bool = True) -> np.ndarray:
    """Add EXIF with a camera and places in a scene of 15 metres per unit; returns metres east, north, up."""
    metres = 15 * camera_centres(placed)
    for index, (east, north, up) in enumerate(metres):
        path = folder / f"view_{index}.jpg"
        photo = Image.open(path)
        exif = photo.getexif()
        exif[271], exif[272] = "DJI", "FC"
        exif.get_ifd(0x8769)[41989] = round(FOCAL * 43.27 / np.hypot(WIDTH, HEIGHT))  # of 35 mm film
        gps = exif.get_ifd(0x8825)
        gps |= {1: "N", 2: _dms(47 + north / 111_177), 3: "E", 4: _dms(8 + east / 76_057)}
        if altitude:
            gps |= {5: b"\0", 6: float(up + 400)}
        photo.save(path, exif=exif, quality=95)
    return metres


def _dms(degrees: float) -> tuple[float, float, float]:
    minutes = degrees % 1 * 60
    return float(int(degrees)), float(int(minutes)), round(minutes % 1 * 60, 6)


def aligned(found: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of camera centres and the angles in degrees between poses [N, 4, 4].

    The poses found are moved by the similarity that fits their centres best.
    """
    a, b = camera_centres(found), camera_centres(truth)
    moved = fit_similarity(a, b)
    between = np.einsum("nij,kj,nlk->nil", found[:, :3, :3], moved.rotation, truth[:, :3, :3])
    cosines = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(moved.to_world(a) - b, axis=1), np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def poses_of(capture, placed):
    """Return the poses of a capture's photographs, and the true ones of the same photographs."""
    views = [camera for camera in load_capture(capture).cameras if camera.name.startswith("view_")]
    found = np.stack([camera.world_to_camera for camera in views])
    return found, placed[[int(camera.name[5:-4]) for camera in views]]
