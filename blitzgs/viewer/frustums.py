# SPDX-License-Identifier: Apache-2.0
"""The capture's cameras as frustums in the scene; a click on one stands there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from blitzgs.viewer.exhibit import Exhibit
from blitzgs.viewer.world import World

if TYPE_CHECKING:
    import viser

# More would slow the browser down; they are then evenly spaced among all.
MAX_FRUSTUMS = 400
TRAIN_COLOUR, TEST_COLOUR = (64, 170, 255), (255, 150, 40)


class Frustums:
    """The frustums of all visitors.

    Attributes:
        indices: cameras that have a frustum.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        world: World,
        exhibit: Exhibit,
        stand: Callable[[int | None, int], None],
    ) -> None:
        """Add the frustums; `stand` is called with the number of the visitor who clicks, and the camera."""
        cameras, test = exhibit.cameras, set(exhibit.test)
        step = max(1.0, len(cameras) / MAX_FRUSTUMS)
        self.indices = sorted(
            {int(k * step) for k in range(math.ceil(len(cameras) / step))} & set(range(len(cameras)))
        )
        self._handles: list[Any] = []
        size = frustum_size(world)
        for index in self.indices:
            camera = cameras[index]
            stance = world.stance(world.poses[index], 2 * math.atan(camera.height / (2 * camera.K[1, 1])))
            handle = server.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=stance.fov,
                aspect=camera.width / camera.height,
                scale=size,
                thickness=1.5,
                thickness_units="screen",
                color=TEST_COLOUR if index in test else TRAIN_COLOUR,
                wxyz=quaternion(stance.rotation),
                position=stance.position,
                cast_shadow=False,
                receive_shadow=False,
            )
            handle.on_click(_click(stand, index))
            self._handles.append(handle)

    def show(self, visible: bool) -> None:
        """Show or hide all frustums."""
        for handle in self._handles:
            handle.visible = visible

    def resize(self, factor: float, world: World) -> None:
        """Draw the frustums larger or smaller than usual."""
        for handle in self._handles:
            handle.scale = frustum_size(world) * factor


def _click(stand: Callable[[int | None, int], None], index: int) -> Callable[[Any], None]:
    return lambda event: stand(event.client_id, index)


def frustum_size(world: World) -> float:
    """Return a size at which neighbouring frustums hardly overlap, page units."""
    if len(world.poses) < 2:
        return 0.2
    centres = np.stack(
        [world.stance(pose, 1.0).position for pose in world.poses[:: max(1, len(world.poses) // 200)]]
    )
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    return float(np.clip(0.12 * nearest, 0.01, 0.2))


def quaternion(rotation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the unit quaternion (w, x, y, z) of a rotation [3, 3]."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    _, vectors = np.linalg.eigh(k + np.triu(k, 1).T)
    found: npt.NDArray[np.float64] = vectors[:, -1]
    return found if found[0] >= 0 else -found
