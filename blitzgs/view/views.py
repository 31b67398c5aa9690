# SPDX-License-Identifier: Apache-2.0
"""Scales a capture so that its extent is in [1, 2), and turns its cameras into viewmats and Ks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import camera_centres
from blitzgs.config.fields import BLACK, Config
from blitzgs.frame.render import RenderOptions
from blitzgs.ops.projection_types import Views
from blitzgs.view.gate import LodGate, centres_of

# The z axis is up if it is nearer to the cameras' up than this; many captures are georeferenced.
_NEAR_Z = math.cos(math.radians(40))


class CameraLike(Protocol):
    """The fields of a camera that training reads (`blitzgs.capture.cameras.Camera`)."""

    @property
    def name(self) -> str:
        """Name of the image."""

    @property
    def width(self) -> int:
        """Image width in pixels."""

    @property
    def height(self) -> int:
        """Image height in pixels."""

    @property
    def K(self) -> npt.NDArray[np.float64]:  # noqa: N802
        """Intrinsics in pixels, [3, 3]."""

    @property
    def world_to_camera(self) -> npt.NDArray[np.float64]:
        """Pose, world to camera, [4, 4]."""


@dataclass(frozen=True)
class Space:
    """Maps between the trained world and the capture's: x_capture = x_trained * unit + offset.

    The unit is the power of two for which the scene's extent is in [1, 2). Scaling by a power of two is
    exact, so a capture that is scaled by one trains to the same bits.
    """

    offset: tuple[float, float, float]  # origin of the trained world in the capture's coordinates
    unit: float  # length of one trained unit in the capture's
    extent: float  # extent of the scene, in trained units

    @classmethod
    def of(cls, offset: npt.NDArray[np.float64], extent: float) -> Space:
        """Choose the unit for an extent in the capture's unit (ValueError: it is not positive)."""
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


# A view as numbers: viewmat [4, 4], then K [3, 3].
VIEW_NUMBERS = 16 + 9


def unpack_views(numbers: Tensor, width: int, height: int) -> Views:
    """Return views that `ViewSet.write` wrote; they share the memory of `numbers`, float32 [B * 25]."""
    viewmats, Ks = numbers.split_with_sizes(
        [16 * (len(numbers) // VIEW_NUMBERS), 9 * (len(numbers) // VIEW_NUMBERS)]
    )
    return Views(viewmats.view(-1, 4, 4), Ks.view(-1, 3, 3), width, height)


class ViewSet:
    """The cameras of a capture, from which batches of views are made."""

    def __init__(self, cameras: Sequence[CameraLike], space: Space, device: torch.device) -> None:
        """Transform all poses into the trained world; `device` is the device of the views of `pick`."""
        poses = np.stack([viewmat(camera, space) for camera in cameras])
        self._viewmats = poses.astype(np.float32)
        self._Ks = np.stack([camera.K for camera in cameras]).astype(np.float32)
        self._sizes = [(camera.width, camera.height) for camera in cameras]
        self._device = device

    def size(self, indices: list[int], factor: int = 1) -> tuple[int, int]:
        """Return the size that cameras share, divided by `factor`, rounded down (ValueError: they differ)."""
        sizes = {self._sizes[index] for index in indices}
        if len(sizes) != 1:
            raise ValueError(f"the views of a batch must share one image size, got {sorted(sizes)}")
        width, height = sizes.pop()
        return width // factor, height // factor

    def write(self, indices: list[int], numbers: npt.NDArray[np.float32], factor: int = 1) -> None:
        """Write B views into `numbers` [B * 25], for `unpack_views`; each pixel is `factor` squared ones."""
        count = 16 * len(indices)
        # `take` needs half the time of an index: this thread holds Python's lock meanwhile.
        numbers[:count] = self._viewmats.take(indices, axis=0).ravel()
        Ks = self._Ks.take(indices, axis=0)
        if factor > 1:
            Ks[:, :2] /= factor
        numbers[count:] = Ks.ravel()

    def columns(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return viewmats [V, 4, 4], Ks [V, 3, 3] and sizes (int32 [V, 2]) of all cameras, on the device."""
        columns = self._viewmats, self._Ks, np.array(self._sizes, dtype=np.int32)
        viewmats, Ks, sizes = (torch.from_numpy(column).to(self._device) for column in columns)
        return viewmats, Ks, sizes

    def centres(self, indices: list[int]) -> Tensor:
        """Return the positions of cameras in the trained world, float64 [V, 3], on the CPU."""
        return centres_of(torch.from_numpy(self._viewmats[indices]))

    def pick(self, indices: list[int]) -> Views:
        """Return the views of cameras as one batch on the device (ValueError: they differ in size)."""
        numbers = np.empty(VIEW_NUMBERS * len(indices), dtype=np.float32)
        self.write(indices, numbers)
        return unpack_views(torch.from_numpy(numbers).to(self._device), *self.size(indices))


# The far plane, relative to the scene's extent: nothing is cut off.
FAR = 1e6
# The near plane of a configuration that leaves it to the capture, where no capture has decided on it.
_NEAR = 0.01


def render_options(config: Config, space: Space, sh_degree: int, lod: LodGate | None = None) -> RenderOptions:
    """Return the render options of a run at a spherical-harmonics degree, with the fading of its LOD gate."""
    model = config.model
    return RenderOptions(
        sh_degree=sh_degree,
        near_plane=(model.near or _NEAR) * space.extent,
        far_plane=FAR * space.extent,
        antialiased=model.antialiased,
        background=model.background or BLACK,
        deterministic=model.deterministic,
        fade=() if lod is None else lod.fade(),
    )


def trained_centres(cameras: Sequence[CameraLike], space: Space) -> Tensor:
    """Return the positions of cameras in the trained world, float64 [V, 3]."""
    return torch.from_numpy(camera_centres(np.stack([viewmat(camera, space) for camera in cameras])))


def up_direction(poses: Sequence[npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    """Guess which direction is up from the cameras' poses, each world to camera [4, 4].

    Cameras that look around stand upright, so the mean of their up vectors is up. Cameras that look down from
    above turn about their view, so its mean is down, even where most fly in one direction. Taken is the mean
    in which they agree more, or the z axis if it is near either, or if nothing is known.
    """
    z = np.array([0.0, 0.0, 1.0])
    if not poses:
        return z
    upright = -np.mean([pose[1, :3] for pose in poses], axis=0)
    backward = -np.mean([pose[2, :3] for pose in poses], axis=0)
    for guess in (upright, backward):
        length = float(np.linalg.norm(guess))
        if length > 0.3 and guess @ z / length > _NEAR_Z:
            return z
    best = max(upright, backward, key=np.linalg.norm)
    length = float(np.linalg.norm(best))
    return best / length if length > 1e-3 else z
