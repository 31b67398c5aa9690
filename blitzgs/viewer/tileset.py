# SPDX-License-Identifier: Apache-2.0
"""What tiles need besides the Gaussians: how they are shown, and where they lie on the globe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.world import GEO, GEOCENTRIC, WorldFrame, converted, pyproj_module, read_frame
from blitzgs.config.fields import Config, ModelConfig
from blitzgs.formats.gaussians import GaussianSource, is_antialiased
from blitzgs.formats.models import offset_of
from blitzgs.formats.ply import PlySource
from blitzgs.formats.tiles import upright
from blitzgs.formats.web_page import WebScene
from blitzgs.runs import run_files
from blitzgs.runs.cameras import CAMERAS, load_cameras
from blitzgs.runs.export import open_source
from blitzgs.view.views import CameraLike, Space, render_options
from blitzgs.viewer.studio import box_of
from blitzgs.viewer.web import web_scene
from blitzgs.viewer.world import World

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class City:
    """A model that need not fit into memory, with what its tiles say besides its Gaussians.

    Attributes:
        source: the Gaussians, in the capture's unit around `offset`.
        offset: origin of the source in the capture's coordinates, [3].
        frame: where the capture lies in the world; None: nobody says.
        scene: how the page shows the model, in the coordinates of the source.
        title: name of the run or the file.
    """

    source: GaussianSource
    offset: Array
    frame: WorldFrame | None
    scene: WebScene
    title: str

    def transform(self) -> Array:
        """Return the map [4, 4] from the source's coordinates to EPSG:4978, or to an upright local frame.

        Raises:
            ImportError: pyproj is missing.
            ValueError: pyproj does not know the reference system.
        """
        if self.frame is None or not self.frame.crs:
            return upright(self.scene.up)
        return to_globe(self.frame, self.offset)


def open_city(path: Path) -> City:
    """Open a run, a checkpoint in it or a PLY file, without reading its Gaussians into memory.

    Raises:
        FileNotFoundError: there is no such file, or no run or checkpoint in the folder.
        ValueError: the file is damaged, or holds no Gaussians.
    """
    cameras: Sequence[CameraLike] = ()
    run, frame = None, None
    if path.is_file():
        source: GaussianSource = PlySource(path)
        offset = np.array(offset_of(source.comments))
    else:
        folder, checkpoint = run_files.run_and_checkpoint(path)
        run = open_source(folder, checkpoint)
        source, offset = run, np.array(run.space.offset)
        if (folder / CAMERAS).exists():
            cameras = load_cameras(folder).cameras
        if (folder / GEO).is_file():
            frame = read_frame(folder / GEO)
    first = next(iter(source.blocks()), None)
    if first is None or len(first) == 0:
        raise ValueError(f"{path} holds no Gaussians")
    box = box_of(first.means)
    if run is None:
        extent = float(np.linalg.norm(box[1] - box[0])) / 2
        space = Space.of(offset, extent)
        config = Config(model=ModelConfig(antialiased=is_antialiased(source), near=1e-3))
    else:
        space, config = run.space, run.config
    return City(
        source,
        offset,
        frame,
        _scene(box.mean(axis=0), space, config, cameras, source.degree),
        path.resolve().stem,
    )


def _scene(
    middle: Array, space: Space, config: Config, cameras: Sequence[CameraLike], degree: int
) -> WebScene:
    world = World(space, cameras, middle / space.unit)
    return web_scene(world, render_options(config, space, degree), space.unit)


def to_globe(frame: WorldFrame, origin: Array) -> Array:
    """Return the affine map [4, 4] from capture coordinates around `origin` to EPSG:4978.

    It is the map of the reference system at the origin to first order, so it has the convergence and the
    scale of a map projection there; at a distance of 2 km, the earth's curvature departs from it by 0.3 m.
    Heights are taken as above the ellipsoid, unless the reference system says otherwise.

    Args:
        frame: of the capture; it has a reference system.
        origin: [3], capture coordinates.

    Raises:
        ImportError: pyproj is missing.
        ValueError: pyproj does not know the reference system, or the place is outside of it.
    """
    # Central differences over this length, in the unit of the capture.
    step = 10.0
    places = origin + step * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    pyproj = pyproj_module()
    try:
        system = pyproj.CRS.from_user_input(frame.crs).to_3d()
        globe = converted(frame.to_world(places), system, GEOCENTRIC)
    except (ValueError, pyproj.exceptions.CRSError) as error:
        raise ValueError(f"{frame.source}: {error}") from error
    matrix = np.eye(4)
    matrix[:3, :3] = (globe[1:4] - globe[4:]).T / (2 * step)
    matrix[:3, 3] = globe[0]
    return matrix
