# SPDX-License-Identifier: Apache-2.0
"""Ray casting with Embree, through the `embreex` package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from blitzgs_synth.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Hits:
    """First intersection of R rays."""

    triangle: Ints  # [R] index of the triangle, -1 for a ray that leaves the scene
    distance: Floats  # [R] metres along the unit direction; large where nothing is hit


class RayCaster:
    """A triangle mesh that several threads may cast rays at."""

    def __init__(self, triangles: Floats) -> None:
        """Build the acceleration structure of `triangles` [T, 3, 3] (metres).

        Raises:
            ModuleNotFoundError: `embreex` is not installed.
        """
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "generating a synthetic city casts rays with Embree: install it with "
                "`pip install embreex` (or `pip install 'blitzgs[synth]'`)"
            ) from error
        # Watertight intersection (`robust`) would take a sixth longer and changes a few rays in a million.
        self._scene: Any = EmbreeScene(robust=False)
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(triangles, dtype=np.float32))
        # The first query commits the scene; later ones only read it and may run concurrently.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, -1]], np.float32))

    def hit(self, origins: Floats, directions: Floats) -> Hits:
        """Return what R rays hit first; origins [R, 3] in metres, unit directions [R, 3]."""
        result = self._scene.run(origins, directions, output=True)
        return Hits(result["primID"], result["tfar"])

    def occluded(self, origins: Floats, directions: Floats) -> Bools:
        """Return whether anything lies on R rays, at any distance: bool [R]."""
        if len(origins) == 0:
            return np.zeros(0, bool)
        found: Ints = self._scene.run(origins, directions, query="OCCLUDED")
        return found >= 0
