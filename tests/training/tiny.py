# SPDX-License-Identifier: Apache-2.0
"""A tiny capture rendered from random Gaussians by our own kernels: 8 views of 48 x 32 pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from blitzgs.capture.image_files import reduced, reduced_mask
from blitzgs.capture.images import ImageMemory
from blitzgs.capture.lengths import Sight
from blitzgs.config.fields import Config
from blitzgs.config.files import load_config
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.table.table import GaussianTable

WIDTH, HEIGHT, COUNT = 48, 32, 400

OVERRIDES = (
    "population.pixels_per_gaussian=0",
    "schedule.iterations=100",
    "schedule.densify_from=20",
    "schedule.densify_until=90",
    "schedule.densify_every=20",
    "schedule.size_prune_after=50",
    "schedule.sh_every=30",
    "population.grad_threshold=2e-4",
    "population.prune_screen_radius=0",
    "log.every=20",
    "log.tensorboard=false",
    "log.pictures=2",
)


@dataclass
class Camera:
    name: str
    width: int
    height: int
    K: np.ndarray
    world_to_camera: np.ndarray
    image_path: Path = Path("/nowhere")
    mask_path: Path | None = None
    rectification: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(has_invalid=False))


@dataclass
class Capture:
    cameras: list[Camera]
    points: np.ndarray
    colors: np.ndarray
    train: list[int]
    test: list[int]
    extent: float
    offset: np.ndarray = field(default_factory=lambda: np.array([10.0, 20.0, 30.0]))
    root: Path = Path("/nowhere")
    about: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(source=SimpleNamespace(frame=None), random_points=False)
    )
    apart: list[int] = field(default_factory=list)

    @property
    def near(self) -> float:
        return Sight.of(self.cameras, self.points).near(self.train, self.extent)


class Images:
    def __init__(self, images, masks=None):
        self.images, self.masks = images, masks

    def get(self, index, factor=1):
        if factor == 1:
            return self.images[index]
        mask = self.mask(index)
        mask = None if mask is None else mask.numpy()
        return torch.from_numpy(reduced(self.images[index].numpy(), mask, factor))

    def mask(self, index, factor=1):
        mask = None if self.masks is None else self.masks[index]
        return mask if mask is None or factor == 1 else torch.from_numpy(reduced_mask(mask.numpy(), factor))

    def prefetch(self, indices, masks=(), factor=1):
        pass

    def memory(self):
        return ImageMemory(0, 0, 0, 0, 0)


def as_flags(*overrides: str) -> list[str]:
    """Return overrides as flags of a command, which takes none twice: of equal fields the last one counts."""
    fields = dict(text.split("=", 1) for text in overrides)
    return [f"--{name}={value}" for name, value in fields.items()]


def tiny_config(*overrides: str) -> Config:
    return load_config(None, [*OVERRIDES, *overrides])


def look_at_origin(position) -> np.ndarray:
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def tiny_cameras(scale: float) -> list[Camera]:
    K = np.array([[40.0, 0.0, 24.5], [0.0, 41.0, 15.0], [0.0, 0.0, 1.0]])
    positions = [
        np.array([3 * np.cos(a), 3 * np.sin(a), 2.5]) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]
    cameras = [Camera(f"{i:02}.png", WIDTH, HEIGHT, K, look_at_origin(p)) for i, p in enumerate(positions)]
    for camera in cameras:
        camera.world_to_camera[:3, 3] *= scale
    return cameras


def random_gaussians(count: int = COUNT) -> GaussianTable:
    g = torch.Generator().manual_seed(4)
    means = torch.rand(count, 3, generator=g) * torch.tensor([2.4, 2.4, 0.6]) - torch.tensor([1.2, 1.2, 0.3])
    return GaussianTable.create(
        {
            "means": means,
            "quats": torch.randn(count, 4, generator=g),
            "scales": torch.rand(count, 3, generator=g) - 3.0,
            "opacities": torch.rand(count, generator=g) * 4,
            "sh": torch.randn(count, 1, 3, generator=g) * 0.8,
        }
    )


def photographed(
    truth: GaussianTable, cameras: list[Camera], test: int, extent: float
) -> tuple[Capture, Images]:
    """Return a capture of Gaussians: renders from the cameras, and the centres as points.

    Args:
        truth: the Gaussians.
        cameras: cameras of the views.
        test: the view that is held out.
        extent: radius of the cameras' positions.
    """
    images = []
    for camera in cameras:
        views = Views(
            torch.from_numpy(camera.world_to_camera).float()[None],
            torch.from_numpy(camera.K).float()[None],
            camera.width,
            camera.height,
        )
        render = pipeline.forward(truth, views, RenderOptions(0, 0.01, 1e6)).renders[0]
        images.append((render.clamp(0, 1) * 255 + 0.5).byte())
    colors = (0.5 + 0.28209479 * truth["sh"][:, 0]).clamp(0, 1).mul(255).byte().numpy()
    train = [i for i in range(len(cameras)) if i != test]
    return Capture(cameras, truth["means"].double().numpy(), colors, train, [test], extent), Images(images)


def tiny_scene(scale: float = 1.0) -> tuple[Capture, Images]:
    """Capture and images; `scale` scales the capture's world, not the images."""
    capture, images = photographed(random_gaussians(), tiny_cameras(1.0), test=3, extent=1.1 * 3.0 * scale)
    capture.cameras, capture.points = tiny_cameras(scale), scale * capture.points
    return capture, images


def write_tiny_capture(folder: Path) -> None:
    """Write the capture as transforms.json with PNG images and a point cloud."""

    import cv2

    from blitzgs.capture.colmap import ColmapCamera, ColmapImages, ColmapModel, ColmapPoints, write_model

    capture, images = tiny_scene()
    (folder / "images").mkdir(parents=True)
    for camera, image in zip(capture.cameras, images.images, strict=True):
        cv2.imwrite(str(folder / "images" / camera.name), image.numpy()[..., ::-1])
    K = capture.cameras[0].K
    poses = np.stack([camera.world_to_camera for camera in capture.cameras])
    count = len(capture.points)
    model = ColmapModel(
        [ColmapCamera(1, "PINHOLE", WIDTH, HEIGHT, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))],
        ColmapImages(
            ids=np.arange(1, 9, dtype=np.uint32),
            camera_ids=np.ones(8, dtype=np.uint32),
            quats=np.stack([quaternion(pose[:3, :3]) for pose in poses]),
            translations=poses[:, :3, 3],
            names=[camera.name for camera in capture.cameras],
            point2d_offsets=np.zeros(9, dtype=np.uint64),
        ),
        ColmapPoints(
            ids=np.arange(1, count + 1, dtype=np.int64),
            positions=capture.points,
            colors=capture.colors,
            errors=np.ones(count),
            track_offsets=np.zeros(count + 1, dtype=np.uint64),
        ),
    )
    write_model(folder / "sparse" / "0", model)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix: the dominant eigenvector of Bar-Itzhack's symmetric matrix."""
    m = rotation
    matrix = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(matrix, UPLO="L")[1][:, -1]
