# SPDX-License-Identifier: Apache-2.0
"""Orders views so that neighbours see the same places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from blitzgs.capture.cameras import Camera, Float64, camera_centres
from blitzgs.capture.lengths import depths_seen, sampled
from blitzgs.table.blocks import morton_order


def tour_of(cameras: Sequence[Camera], points: Float64) -> list[int]:
    """Return the cameras in the Morton order of the places that they show.

    The place is on the optical axis, at the median depth of the points that the camera sees; the camera's own
    place if it sees none. Points behind others count, as they do where Gaussians are loaded for a view.

    Args:
        cameras: the views.
        points: [M, 3], in the world of the cameras; may be empty.
    """
    sample = sampled(points, len(cameras))
    poses = np.stack([camera.world_to_camera for camera in cameras])
    depths = (depths_seen(camera, sample) for camera in cameras)
    middles = np.array([np.median(seen) if len(seen) else 0.0 for seen in depths])
    # Row 2 of a pose is the optical axis.
    places = camera_centres(poses) + middles[:, None] * poses[:, 2, :3]
    order: list[int] = morton_order(torch.from_numpy(places)).tolist()
    return order
