# SPDX-License-Identifier: Apache-2.0
"""The capture's cameras as frustums in the scene; a click on one stands there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from blitzgs.util.rotations import quaternions
from blitzgs.viewer.world import Exhibit, World

if TYPE_CHECKING:
    import viser

# More would slow the browser down.
MAX_FRUSTUMS = 400
TRAIN_COLOUR, TEST_COLOUR = (64, 170, 255), (255, 150, 40)


class Frustums:
    """The frustums of all visitors."""

    def __init__(
        self,
        server: viser.ViserServer,
        world: World,
        exhibit: Exhibit,
        stand: Callable[[int | None, int], None],
    ) -> None:
        """Add the frustums; `stand` is called with the number of the visitor who clicks, and the camera."""
        cameras, test = exhibit.cameras, set(exhibit.test)
        self.indices = shown_cameras(len(cameras), test)  # cameras that have a frustum
        self._handles: list[Any] = []
        self._size = frustum_size(world)
        for index in self.indices:
            camera = cameras[index]
            stance = world.stance(world.poses[index], world.fovs[index])
            handle = server.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=stance.fov,
                aspect=camera.width / camera.height,
                scale=self._size,
                thickness=1.5,
                thickness_units="screen",
                color=TEST_COLOUR if index in test else TRAIN_COLOUR,
                wxyz=quaternions(torch.from_numpy(stance.rotation)[None])[0].numpy(),
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

    def resize(self, factor: float) -> None:
        """Draw the frustums larger or smaller than usual."""
        for handle in self._handles:
            handle.scale = self._size * factor


def shown_cameras(count: int, test: set[int]) -> list[int]:
    """Return the cameras that get a frustum: all, or `MAX_FRUSTUMS`, evenly spaced.

    Held-out cameras, which are often every 8th, keep their share.
    """
    share = min(1.0, MAX_FRUSTUMS / max(1, count))
    held = sorted(test & set(range(count)))
    parts = held, [index for index in range(count) if index not in test]
    few = math.ceil(share * len(held))
    sizes = few, min(len(parts[1]), MAX_FRUSTUMS - few)
    return sorted(
        part[k * len(part) // size] for part, size in zip(parts, sizes, strict=True) for k in range(size)
    )


def _click(stand: Callable[[int | None, int], None], index: int) -> Callable[[Any], None]:
    return lambda event: stand(event.client_id, index)


def frustum_size(world: World) -> float:
    """Return a size at which neighbouring frustums hardly overlap, page units."""
    if len(world.centres) < 2:
        return 0.2
    centres = world.centres[:: max(1, len(world.centres) // 200)]
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    return float(np.clip(0.12 * nearest, 0.01, 0.2))
