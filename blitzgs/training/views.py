# SPDX-License-Identifier: Apache-2.0
"""A capture as training sees it: in a unit of length of its own, with views ready for the kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.pipeline import RenderOptions, Views
from blitzgs.training.config import Config


class CameraLike(Protocol):
    """What training reads of a camera (`blitzgs.scene.cameras.Camera`)."""

    @property
    def name(self) -> str:
        """Of the image."""

    @property
    def width(self) -> int:
        """Pixels."""

    @property
    def height(self) -> int:
        """Pixels."""

    @property
    def K(self) -> npt.NDArray[np.float64]:  # noqa: N802
        """Intrinsics [3, 3]."""

    @property
    def world_to_camera(self) -> npt.NDArray[np.float64]:
        """Pose [4, 4]."""


@dataclass(frozen=True)
class Space:
    """How the trained world lies in the capture's: x_capture = x_trained * unit + offset.

    The unit is the power of two that brings the scene's extent into [1, 2). Scaling by powers of two rounds
    nothing, so a capture scaled by one trains to the same bits.

    Attributes:
        offset: origin of the trained world in the capture's coordinates.
        unit: length of one trained unit in the capture's.
        extent: of the scene, in trained units.
    """

    offset: tuple[float, float, float]
    unit: float
    extent: float

    @classmethod
    def of(cls, offset: npt.NDArray[np.float64], extent: float) -> Space:
        """Choose the unit for a scene of this extent (in the capture's unit).

        Raises:
            ValueError: the extent is not positive: there are fewer than two different camera positions.
        """
        if not (math.isfinite(extent) and extent > 0):
            raise ValueError(
                f"the extent of the scene (1.1 x the largest distance of a camera from their centre) is "
                f"{extent}: training needs cameras at different positions"
            )
        unit = 2.0 ** math.floor(math.log2(extent))
        x, y, z = (float(value) for value in offset)
        return cls((x, y, z), unit, extent / unit)


def viewmat(camera: CameraLike, space: Space) -> npt.NDArray[np.float64]:
    """Return the pose [4, 4] of a camera of the re-centred capture in the trained world."""
    pose = np.array(camera.world_to_camera, dtype=np.float64)
    pose[:3, 3] /= space.unit
    return pose


class ViewSet:
    """The cameras of a capture on the device, ready to be picked into batches."""

    def __init__(self, cameras: list[CameraLike], space: Space, device: torch.device) -> None:
        """Upload all poses and intrinsics; they are small."""
        poses = np.stack([viewmat(camera, space) for camera in cameras])
        self._viewmats = torch.from_numpy(poses).float().to(device)
        self._Ks = torch.from_numpy(np.stack([camera.K for camera in cameras])).float().to(device)
        self._sizes = [(camera.width, camera.height) for camera in cameras]

    def pick(self, indices: list[int]) -> Views:
        """Return the views of same-size cameras as one batch.

        Raises:
            ValueError: the cameras differ in size.
        """
        sizes = {self._sizes[index] for index in indices}
        if len(sizes) != 1:
            raise ValueError(f"the views of a batch must share one image size, got {sorted(sizes)}")
        width, height = sizes.pop()
        viewmats = torch.stack([self._viewmats[index] for index in indices])
        return Views(viewmats, torch.stack([self._Ks[index] for index in indices]), width, height)


def render_options(config: Config, space: Space, sh_degree: int) -> RenderOptions:
    """Return the render options of a run at a spherical-harmonics degree."""
    model = config.model
    return RenderOptions(
        sh_degree=sh_degree,
        near_plane=model.near * space.extent,
        far_plane=model.far * space.extent,
        eps2d=model.eps2d,
        antialiased=model.antialiased,
        background=model.background,
        deterministic=model.deterministic,
    )


def camera_centres(cameras: list[CameraLike], space: Space) -> Tensor:
    """Positions of the cameras in the trained world, float64 [V, 3]."""
    poses = np.stack([viewmat(camera, space) for camera in cameras])
    return torch.from_numpy(-np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3]))
