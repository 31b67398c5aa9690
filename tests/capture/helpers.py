# SPDX-License-Identifier: Apache-2.0
"""Small captures on disk, and the folder of the real captures."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from blitzgs.capture import colmap

pycolmap = pytest.importorskip("pycolmap")

ROOT = Path(__file__).resolve().parents[2]


def shared_data() -> Path | None:
    """Folder of the real captures: BLITZGS_SHARED_DATA, or shared/data beside the repository."""
    candidates = [os.environ.get("BLITZGS_SHARED_DATA", ""), ROOT.parent / "shared" / "data"]
    return next((Path(p) for p in candidates if p and Path(p).is_dir()), None)


def smooth_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    """RGB uint8 noise without fine detail, so that JPEG keeps it."""
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8 + 2, width // 8 + 2, 3), dtype=np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def write_image(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., ::-1])


def reconstruction(
    names: list[str], width: int, height: int, model: str = "PINHOLE", params: list[float] | None = None
) -> pycolmap.Reconstruction:
    """Cameras on a circle of radius 4 that look at 20 points with tracks around the origin."""
    rec = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 0.8 * width, width, height)
    if params is not None:
        camera.params = params
    rec.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (20, 3))
    for index, name in enumerate(names, start=1):
        angle = 2 * np.pi * index / max(len(names), 1)
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.5])
        pose = pycolmap.Rigid3d(np.hstack([r := look_at(center), (-r @ center)[:, None]]))
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(random.uniform(0, 50, 2)) for _ in points])
        rec.add_image_with_trivial_frame(image, pose)
    for k, xyz in enumerate(points):
        elements = [pycolmap.TrackElement(i, k) for i in range(1, len(names) + 1) if (i + k) % 3 or k == 0]
        rec.add_point3D(xyz, pycolmap.Track(elements), random.integers(0, 256, 3).astype(np.uint8))
    return rec


def look_at(center: np.ndarray) -> np.ndarray:
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def write_capture(root: Path, names: list[str], width: int = 64, height: int = 48, **camera: object) -> Path:
    """A COLMAP capture with an image file for each name."""
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    reconstruction(names, width, height, **camera).write_binary(str(sparse))
    for seed, name in enumerate(names):
        write_image(root / "images" / name, smooth_image(height, width, seed))
    return root


def edit_model(root, change):
    """Read the COLMAP model of a capture, let `change` alter it, and write it back."""
    folder = root / "sparse" / "0"
    model = colmap.read_model(folder, points2d=True, tracks=True)
    change(model)
    colmap.write_model(folder, model)
