# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs align`: find out where the model of a run lies in the world."""

from __future__ import annotations

import argparse
import dataclasses
from contextlib import suppress

import numpy as np

from blitzgs.capture.cameras import Float64, camera_centres
from blitzgs.capture.capture import Capture
from blitzgs.capture.control_points import ControlPoint, align, place, read_control_points
from blitzgs.capture.world import (
    GEOCENTRIC,
    WorldFrame,
    converted,
    fit_similarity,
    frame_in,
    gps_positions,
    reference_system,
    system_of_lengths,
)
from blitzgs.cli.arguments import DATA, RUN, Commands, add_arguments, add_command
from blitzgs.config.files import load_config
from blitzgs.runs import run_files
from blitzgs.runs.world import load_world_frame, save_world_frame
from blitzgs.training.inputs import load_configured
from blitzgs.util.errors import printable, warn

# -1 for photographs that look straight down, or level; -1.4 between the two.
_TURNED_OVER = 0.3
# Cameras are around the origin if it is nearer than so many times their spread.
_LOCAL = 5.0

HELP = """\
Find out where the model of a run lies in the world, and write that to RUN/geo.json, which `blitzgs view` and
`blitzgs export --coordinates world` use. The photographs must be there; the model is not changed.

  blitzgs align RUN --gcp POINTS.csv --crs EPSG:32633    ground control points
  blitzgs align RUN --gps --crs EPSG:32633               positions in the photographs' EXIF
  blitzgs align RUN --crs EPSG:32633                     convert what is known, or name what the capture has

POINTS.csv has the columns name,E,N,h,image,x,y, and a row for each mark of a point in a photograph: x and y
are pixels of the original photograph, from the corner of its first pixel. OpenDroneMap's gcp_list.txt is read
too.
"""


GIVEN = """
--gcp FILE  ground control points and their marks
--gps  use the positions in the photographs' EXIF
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    text = f"{RUN}{DATA}--crs EPSG:N  reference system of the points, or wanted"
    parser = add_command(commands, "align", run, summary, HELP, text)
    add_arguments(parser.add_mutually_exclusive_group(), GIVEN)


def run(args: argparse.Namespace) -> None:
    """Align a run."""
    run_files.check_is_run(args.folder)
    if not (args.gcp or args.gps or args.crs):
        args.parser.error("one of the arguments --gcp, --gps, --crs is required")
    capture = _capture(args)
    if args.gcp is not None:
        frame = _by_points(args, capture)
    elif args.gps:
        frame = _by_gps(args, capture)
    else:
        frame = _converted(args, capture)
    _warn_if_turned_over(frame, capture)
    path = save_world_frame(args.folder, frame)
    print(f"{path}: {printable(frame.name)}, scale {frame.scale:.9g}")


def _capture(args: argparse.Namespace) -> Capture:
    """Load the capture of a run at the size of its photographs, to which marks refer."""
    data = load_config(args.folder / run_files.CONFIG).data
    if args.data is not None:
        data = dataclasses.replace(data, path=str(args.data))
    return load_configured(dataclasses.replace(data, masks=False, downscale=1))


def _by_points(args: argparse.Namespace, capture: Capture) -> WorldFrame:
    points, crs = read_control_points(args.gcp)
    crs = args.crs or crs
    if crs:
        _check_lengths(crs)
    points = place(points, capture.cameras, capture.offset)
    frame = align(points, capture.offset, crs, f"{len(points)} ground control points of {args.gcp.name}")
    _print_residuals(points)
    return frame


def _check_lengths(crs: str) -> None:
    """Refuse a reference system in which points make no similarity; unknown without pyproj."""
    with suppress(ImportError):
        system_of_lengths(crs)


def _warn_if_turned_over(frame: WorldFrame, capture: Capture) -> None:
    """Warn of a world in which the photographs are upside down, or look up at what they show from above."""
    poses = np.stack([camera.world_to_camera for camera in capture.cameras])
    down, forward = (poses[:, 1:3, :3] @ frame.rotation[2]).mean(axis=0)  # by how much they point up
    if frame.crs != GEOCENTRIC and down + forward > _TURNED_OVER:
        warn("the photographs are upside down in this world: are E and N exchanged, or are heights depths?")


def _print_residuals(points: list[ControlPoint]) -> None:
    width = max(5, *(len(p.name) for p in points))
    print(f"{'point':{width}} marks {'dE':>10} {'dN':>10} {'dh':>10} {'3D':>10} {'px':>8}")
    for p in points:
        values = "".join(f" {value:10.4f}" for value in [*p.offset, float(np.linalg.norm(p.offset))])
        note = f"  {p.problem}" if p.problem else ""
        print(printable(f"{p.name:{width}} {len(p.seen):5}{values} {p.reprojection:8.2f}{note}"))
    used = [p for p in points if not p.problem]
    offsets = np.stack([p.offset for p in used])
    flat, up = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in (offsets[:, :2], offsets[:, 2:]))
    print(f"{len(used)} of {len(points)} points used; RMS {flat:.4f} horizontal, {up:.4f} vertical")
    if len(used) == 3:
        print("three points leave no check of themselves: a fourth would show a mistake")


def _by_gps(args: argparse.Namespace, capture: Capture) -> WorldFrame:
    known = gps_positions([camera.image_path for camera in capture.cameras])
    some = [index for index, position in enumerate(known) if position is not None]
    if len(some) < 3:
        raise ValueError(f"{len(some)} of {len(known)} photographs have a GPS position, and 3 are needed")
    world = np.array([known[index] for index in some])
    centres = _centres(capture)[some]
    moved = converted(world, "EPSG:4979", GEOCENTRIC)
    frame = fit_similarity(centres, moved, GEOCENTRIC, f"EXIF GPS of {len(some)} photographs")
    apart = np.linalg.norm(frame.to_world(centres) - moved, axis=1)
    # A receiver errs by metres: those far beyond the others are left out once.
    good = apart <= 4 * np.median(apart) + 1e-9
    if good.sum() >= 3:
        source = f"EXIF GPS of {good.sum()} photographs"
        frame = fit_similarity(centres[good], moved[good], GEOCENTRIC, source)
    apart = np.linalg.norm(frame.to_world(centres[good]) - moved[good], axis=1)
    print(f"{good.sum()} of {len(known)} positions used; distances: median {np.median(apart):.2f} m, largest "
          f"{apart.max():.2f} m")  # fmt: skip
    return _in_system(frame, args.crs, capture) if args.crs else frame


def _centres(capture: Capture) -> Float64:
    poses = np.stack([camera.world_to_camera for camera in capture.cameras])
    return camera_centres(poses) + capture.offset


def _converted(args: argparse.Namespace, capture: Capture) -> WorldFrame:
    known = load_world_frame(args.folder) or capture.about.frame
    if known is None or not known.crs:
        _check_lengths(args.crs)
        frame = known or WorldFrame()
        _warn_if_local(frame.to_world(_centres(capture))[:, :2], args.crs)
        source = frame.source or "the capture's own coordinates"
        return dataclasses.replace(frame, crs=args.crs, source=source)
    return _in_system(known, args.crs, capture)


def _warn_if_local(places: Float64, crs: str) -> None:
    """Warn of cameras [N, 2] around the origin of a reference system, which is far from most sites."""
    middle = places.mean(axis=0)
    if np.linalg.norm(middle) < _LOCAL * np.ptp(places, axis=0).max():
        east, north = middle.tolist()
        warn(
            f"the cameras lie around E {east:.6g} N {north:.6g} of {crs}: if these are the capture's own "
            "coordinates, find the world by --gcp or --gps"
        )


def _in_system(frame: WorldFrame, crs: str, capture: Capture) -> WorldFrame:
    some = capture.points[:: max(1, len(capture.points) // 1000)] + capture.offset
    found, error = frame_in(frame, crs, np.concatenate([_centres(capture), some]))
    unit = reference_system(crs).axis_info[0].unit_name.replace("metre", "m")
    print(f"a similarity for the projection is wrong by at most {error:.3g} {unit} at the cameras and points")
    return found
