# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs render`: render views of a model to pictures, or a path to a film."""

from __future__ import annotations

import argparse
import io
import itertools
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import camera_centres
from blitzgs.capture.pictures import encode_image, to_uint8
from blitzgs.capture.usable import read_cameras
from blitzgs.cli import arguments
from blitzgs.cli.arguments import chosen_views
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.cameras import RunCameras, input_files, load_cameras
from blitzgs.runs.evaluation import render_view
from blitzgs.table.table import GaussianTable
from blitzgs.training.inputs import check_capture, open_capture
from blitzgs.util.output import OutputFolder
from blitzgs.util.progress import image_progress
from blitzgs.view.draw import Drawer
from blitzgs.view.look import MAX_PIXELS, Look, Mode
from blitzgs.view.views import CameraLike, ViewSet, viewmat
from blitzgs.view.visible import Subject, VisibleFinder
from blitzgs.viewer.film import SUFFIX, Film, check_film, new_film, read_film
from blitzgs.viewer.studio import box_of, open_model

# What may be written beside the colours.
MEASURED: tuple[Mode, ...] = ("depth", "alpha")

_DEPTH = (
    "depth in the capture's unit = value * scale; 0: nothing is there; 65535: this far or farther. The depth "
    "is along the axis of view, the mean of what a pixel shows."
)
_POSITIVE = arguments.number(float, lambda value: 0 < value < 1e6, "a positive number")

HELP = """\
Render views of a model to pictures, or a camera path to a film:

  blitzgs render RUN --out PICTURES                       # the held-out views of a run
  blitzgs render RUN --cameras FILE --out PICTURES        # views of a transforms.json or a COLMAP model
  blitzgs render RUN --path PATH.json --out FILM.mp4      # a path of `blitzgs view` or of nerfstudio
  blitzgs render RUN --path orbit --out FILM.mp4          # also flight and spline
  blitzgs render RUN --path orbit --depth --out PICTURES  # each frame as a picture, with its depth

MODEL is the folder of a run, a checkpoint in it, or a file of Gaussians of any
program (PLY, compressed PLY, SPZ, SOG, .splat). Films need the package av: pip install "blitzgs[film]".
"""


FLAGS = """
--cameras FILE  render the cameras of this transforms file or folder of a COLMAP model, in the capture's
    coordinates; no photographs are needed
--path NAME|FILE  render the frames of a camera path: a file, or orbit (around the scene), flight (across it)
    or spline (along the run's cameras)
--size WxH  with --path: pixels (default: the file's, else 1920x1080)
--fps N  with --path: frames a second (default: the file's, else 30)
--seconds S  with --path: duration (default: the file's, else 10)
--dataparser FILE  with --path: dataparser_transforms.json of the nerfstudio training that the path was made
    for
--exposure  show training views with the exposure of their photographs (model.exposure), not with the mean
--depth  also write NAME.depth.png, 16 bits; depth.json says how to convert it to the capture's unit
--alpha  also write NAME.alpha.png, 16 bits
--raw  write float32 arrays as .npy, colours [H, W, 3] not clamped, instead of PNG
"""


def add_to(commands: arguments.Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = arguments.add_command(commands, "render", run, summary, HELP)
    arguments.add_model(parser)
    text = "--data DIR  read the cameras anew from this capture, that of the run (of others: --cameras)"
    arguments.add_flags(parser, text)
    arguments.add_device(parser, shares_gpus=True)
    arguments.add_pool(parser)
    arguments.add_split(parser, "render")
    arguments.add_path(parser, "--out", "DIR|FILE", f"folder for pictures, or FILE{SUFFIX}", required=True)
    arguments.add_flags(parser, FLAGS, {"--size": _size, "--fps": _POSITIVE, "--seconds": _POSITIVE})


_OTHER_FILES = (".gif", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".webp", ".png", ".jpg", ".jpeg")


def run(args: argparse.Namespace) -> None:
    """Render views."""
    film = _film(args)
    is_film = args.out.suffix.lower() == SUFFIX
    if film is not None and is_film:
        check_film(args.out, film.width, film.height)
    with Ranks.from_environment(args.device, share_gpus=args.share_gpus) as ranks:
        opened = open_rendered(args, film, ranks)
        if is_film and film is not None:
            _render_film(args.out, opened, film, ranks)
        else:
            _render_pictures(args, opened, ranks)
        if ranks.rank == 0:
            count, what = len(opened.indices), "frames" if is_film else "images"
            print(f"{args.out}: {count} {what}")


def _film(args: argparse.Namespace) -> Film | None:
    """Return what --path asks for; None: the command has no --path."""
    is_film = args.out.suffix.lower() == SUFFIX
    if args.out.suffix.lower() in _OTHER_FILES:
        raise ValueError(f"{args.out}: a film's name ends in {SUFFIX}, and pictures need a folder")
    if args.path is None:
        for name in ("size", "fps", "seconds", "dataparser"):
            if getattr(args, name) is not None:
                raise ValueError(f"--{name} needs --path")
        if args.exposure and args.cameras is not None:
            raise ValueError("--exposure is for the run's own views, not for --cameras")
        if is_film:
            raise ValueError(f"{args.out}: a film needs --path; pictures of views need a folder as --out")
        return None
    for name, given in (("cameras", args.cameras), ("exposure", args.exposure)):
        if given:
            raise ValueError(f"--{name} and --path exclude each other")
    if is_film and (args.depth or args.alpha or args.raw):
        raise ValueError("a film has only colours: for --depth, --alpha and --raw, give a folder as --out")
    return read_film(args.path, args.size, args.fps, args.seconds, args.dataparser)


def _renders(
    opened: Rendered, ranks: Ranks, destination: Callable[[int], int]
) -> Iterator[tuple[int, Tensor | None]]:
    """Render the views, and yield each index and its colours, float32 [H, W, 3], on the rank `destination`.

    Every rank goes through all views; `destination` depends on the position, and other ranks get None.
    """
    views, subject = ViewSet(list(opened.cameras), opened.subject.space, ranks.device), opened.subject
    finder, owners = VisibleFinder(subject.gaussians, subject.lod), TileOwners(ranks)
    for position, index in enumerate(opened.indices):
        yield index, render_view(finder, views, index, subject.options, owners, destination(position))


def _render_film(path: Path, opened: Rendered, film: Film, ranks: Ranks) -> None:
    """Render all frames; rank 0 writes them."""
    writes = ranks.rank == 0
    if writes:
        path.parent.mkdir(parents=True, exist_ok=True)
    with (
        new_film(path, film.width, film.height, film.fps) if writes else nullcontext() as append,
        image_progress("Rendering", writes) as report,
    ):
        for position, (_, render) in enumerate(_renders(opened, ranks, lambda _: 0), 1):
            if append is not None and render is not None:
                append(to_uint8(render))
            report(position, len(opened.indices))


def _render_pictures(args: argparse.Namespace, opened: Rendered, ranks: Ranks) -> None:
    """Render all views; the ranks take turns at writing colours, and rank 0 writes depth and alpha."""
    suffix = ".npy" if args.raw else ".png"
    output = OutputFolder(args.out, opened.inputs)
    # Names for all views, so that a view's file has the same name whichever split is rendered.
    names = [camera.name for camera in opened.cameras]
    modes: list[Mode] = [mode for mode in MEASURED if getattr(args, mode)]
    paths = {mode: output.paths(names, f".{mode}{suffix}") for mode in modes}
    colours = output.paths(names, suffix)
    args.out.mkdir(parents=True, exist_ok=True)
    step = _depth_step(opened)
    if "depth" in modes and not args.raw and ranks.rank == 0:
        scale = json.dumps({"scale": step, "meaning": _DEPTH}, indent=1) + "\n"
        output.write(args.out / "depth.json", scale.encode())
    drawer = Drawer(opened.subject, TileOwners(ranks), in_layers=False) if modes else None
    with image_progress("Rendering", ranks.rank == 0) as report:
        turns = _renders(opened, ranks, lambda position: position % ranks.world_size)
        for position, (index, render) in enumerate(turns, 1):
            if render is not None:
                if index in opened.exposures:
                    gain, bias = opened.exposures[index].to(render.device)
                    render = render * gain + bias
                content = _npy(render.cpu().numpy()) if args.raw else encode_image(render, ".png")
                output.write(colours[index], content)
            for mode in modes:
                camera = opened.cameras[index]
                pose = viewmat(camera, opened.subject.space)
                look = Look(pose, np.asarray(camera.K), camera.width, camera.height, mode)
                picture = drawer.draw(look) if drawer else None
                if picture is not None:
                    values = picture.values.astype(np.float32)
                    full = 65535.0 if mode == "alpha" else 1 / step
                    output.write(paths[mode][index], _npy(values) if args.raw else _png16(values * full))
            report(position, len(opened.indices))


def _depth_step(opened: Rendered) -> float:
    """Return the depth of one step of a 16-bit picture, for which the farthest corner of the box fits."""
    corners = np.array(list(itertools.product(*opened.box.T)))
    space = opened.subject.space
    centres = camera_centres(np.stack([viewmat(opened.cameras[i], space) for i in opened.indices]))
    farthest = max(float(np.linalg.norm(corners - centre, axis=1).max()) for centre in centres)
    return farthest * space.unit / 65534


def _png16(values: npt.NDArray[np.float32]) -> bytes:
    written, data = cv2.imencode(".png", np.rint(values).clip(0, 65535).astype(np.uint16))
    assert written
    return bytes(data)


def _npy(values: npt.NDArray[np.float32]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    sides = tuple(int(side) for side in found.groups()) if found else (0, 0)
    if not all(1 <= side <= MAX_PIXELS for side in sides):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, each 1 to {MAX_PIXELS}, got {text}")
    return sides[0], sides[1]


# About so many Gaussians decide on the box.
_SAMPLE = 50_000


@dataclass(frozen=True)
class Rendered:
    """A model and the views to render of it."""

    subject: Subject  # the model, with this rank's Gaussians
    # Corners of a box that holds nearly all Gaussians, float64 [2, 3], trained units.
    box: npt.NDArray[np.float64]
    cameras: Sequence[CameraLike]  # all cameras; pictures are named by all of them
    indices: Sequence[int]  # those to render
    inputs: Sequence[Path]  # files that must not be overwritten
    exposures: dict[int, Tensor]  # gain and bias, float32 [2, 3], of cameras by their indices


def open_rendered(args: argparse.Namespace, film: Film | None, ranks: Ranks) -> Rendered:
    """Open the model, and choose the cameras. Collective."""
    if args.model.is_file():
        if ranks.world_size > 1:
            raise ValueError(f"{args.model}: one process renders a file: run render without torchrun")
        if args.data is not None:
            raise ValueError("--data needs the folder of a run: for a file, use --path or --cameras")
        opened = open_model(args.model, ranks)
        subject, box, up = opened.subject, opened.exhibit.box, opened.exhibit.up
        stored, exposures = None, None
    else:
        folder, checkpoint = run_files.run_and_checkpoint(args.model)
        model = trained_model.open_model(folder, ranks, args.data, args.resident_gb, checkpoint)
        exposures = model.exposures
        box, up = _shared_box(model.table, ranks), None
        stored = _stored_cameras(args, folder, model, ranks)
        subject = model.subject(ranks)
    cameras: Sequence[CameraLike]
    if args.cameras is not None:
        cameras = read_cameras(args.cameras, np.array(subject.space.offset))
    elif film is not None:
        cameras = film.cameras(subject.space, stored.cameras if stored else (), box, up)
    elif stored is not None:
        shown = _exposures(exposures, stored) if args.exposure else {}
        indices = chosen_views(args.split, stored, args.model)
        return Rendered(subject, box, stored.cameras, indices, stored.inputs, shown)
    else:
        raise ValueError(f"{args.model} has no cameras: use --path, --cameras or the folder of a run")
    inputs = stored.inputs if stored else []
    return Rendered(subject, box, cameras, range(len(cameras)), inputs, {})


def _shared_box(table: GaussianTable, ranks: Ranks) -> npt.NDArray[np.float64]:
    """Return the box of all ranks' Gaussians, the same for any number of ranks. Collective."""
    count = int(ranks.all_reduce(torch.tensor([len(table)], device=ranks.device)).item())
    chosen = table["id"] % max(1, count // _SAMPLE) == 0
    parts = ranks.all_gather_object(table["means"][chosen].cpu().numpy())
    return box_of(torch.from_numpy(np.concatenate(parts)))


def _exposures(found: Tensor | None, stored: RunCameras) -> dict[int, Tensor]:
    """Return gain and bias, float32 [2, 3], of each training view, by its index among the cameras."""
    if found is None:
        raise ValueError(
            "--exposure: the run has no exposures: it was trained without model.exposure, or its photographs "
            "have the same"
        )
    if len(found) != len(stored.train):
        raise ValueError(f"--exposure: the run has {len(found)} photographs, not {len(stored.train)}")
    return dict(zip(stored.train, found.float(), strict=True))


def _stored_cameras(
    args: argparse.Namespace, folder: Path, model: trained_model.TrainedModel, ranks: Ranks
) -> RunCameras | None:
    """Return the cameras of the given capture; without one, those that the run stored, else its capture's.

    Frames and cameras of a file need neither, so None is returned if the run has not stored its cameras.
    """
    if args.data is None and (folder / run_files.CAMERAS).exists():
        return load_cameras(folder)
    if args.data is None and (args.path is not None or args.cameras is not None):
        return None
    capture, images = open_capture(model.config, ranks)
    images.close()
    check_capture(model.space, capture, folder)
    return RunCameras(capture.cameras, capture.train, capture.test, input_files(capture))
