# SPDX-License-Identifier: Apache-2.0
"""Opens what `blitzgs render` renders: the model and the cameras that the flags name."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.usable import read_cameras
from blitzgs.cli.arguments import chosen_views
from blitzgs.distributed.group import Ranks
from blitzgs.runs import files as run_files
from blitzgs.runs.cameras import CAMERAS, RunCameras, input_files, load_cameras
from blitzgs.runs.lod import lod_gate, scene_gate
from blitzgs.table.table import GaussianTable
from blitzgs.training.inputs import check_capture, open_capture
from blitzgs.view.draw import Subject
from blitzgs.view.views import CameraLike, Space, render_options
from blitzgs.viewer.film import Film
from blitzgs.viewer.studio import Opened, box_of, open_model

# About so many Gaussians decide on the box.
_SAMPLE = 50_000


@dataclass(frozen=True)
class Rendered:
    """A model and the views to render of it."""

    subject: Subject  # the model, with this rank's Gaussians
    space: Space  # maps the trained world to the capture's
    # Corners of a box that holds nearly all Gaussians, float64 [2, 3], trained units.
    box: npt.NDArray[np.float64]
    cameras: Sequence[CameraLike]  # all cameras; pictures are named by all of them
    indices: Sequence[int]  # those to render
    inputs: Sequence[Path]  # files that must not be overwritten
    exposures: dict[int, Tensor]  # gain and bias, float32 [2, 3], of cameras by their indices


def open_rendered(args: argparse.Namespace, film: Film | None, ranks: Ranks) -> Rendered:
    """Open the model, and choose the cameras. Collective."""
    if args.model.is_file():
        opened = _open_ply(args, ranks)
        subject, space, box = opened.subject, opened.exhibit.space, opened.exhibit.box
        stored, exposures = None, None
    else:
        folder, checkpoint = run_files.run_and_checkpoint(args.model)
        model = run_files.open_model(folder, ranks, args.data, args.resident_gb, checkpoint)
        space, exposures = model.space, model.exposures
        box = _shared_box(model.table, ranks)
        stored = _stored_cameras(args, folder, model, ranks)
        options = render_options(
            model.config, space, model.progress.sh_degree, lod_gate(model.config, model.progress)
        )
        lod = scene_gate(model.config, model.progress, model.table, ranks)
        subject = Subject(model.scene(ranks.device), options, space.unit, lod)
    cameras: Sequence[CameraLike]
    if args.cameras is not None:
        cameras = read_cameras(args.cameras, np.array(space.offset))
    elif film is not None:
        cameras = film.cameras(space, stored.cameras if stored else (), box)
    elif stored is not None:
        shown = _exposures(exposures, stored) if args.exposure else {}
        indices = chosen_views(args.split, stored, args.model)
        return Rendered(subject, space, box, stored.cameras, indices, stored.inputs, shown)
    else:
        raise ValueError(f"{args.model} has no cameras: use --path, --cameras or the folder of a run")
    inputs = stored.inputs if stored else []
    return Rendered(subject, space, box, cameras, range(len(cameras)), inputs, {})


def _open_ply(args: argparse.Namespace, ranks: Ranks) -> Opened:
    if ranks.world_size > 1:
        raise ValueError(f"{args.model}: one process renders a PLY file: run render without torchrun")
    if args.data is not None:
        raise ValueError("--data needs the folder of a run: for a PLY file, use --path or --cameras")
    return open_model(args.model, ranks)


def _shared_box(table: GaussianTable, ranks: Ranks) -> npt.NDArray[np.float64]:
    """Return the box of all ranks' Gaussians, the same for any number of ranks. Collective."""
    count = int(ranks.all_reduce(torch.tensor([len(table)], device=ranks.device)).item())
    chosen = table["id"] % max(1, count // _SAMPLE) == 0
    parts = ranks.all_gather_object(table["means"][chosen].cpu().numpy())
    return box_of(torch.from_numpy(np.concatenate(parts)))


def _exposures(found: Tensor | None, stored: RunCameras) -> dict[int, Tensor]:
    """Return gain and bias, float32 [2, 3], of each training view, by its index among the cameras."""
    if found is None:
        raise ValueError("--exposure: the run was trained without model.exposure")
    if len(found) != len(stored.train):
        raise ValueError(f"--exposure: the run has {len(found)} photographs, not {len(stored.train)}")
    return dict(zip(stored.train, found.float(), strict=True))


def _stored_cameras(
    args: argparse.Namespace, folder: Path, model: run_files.TrainedModel, ranks: Ranks
) -> RunCameras | None:
    """Return the cameras of the given capture; without one, those that the run stored, else its capture's.

    Frames and cameras of a file need neither, so None is returned if the run has not stored its cameras.
    """
    if args.data is None and (folder / CAMERAS).exists():
        return load_cameras(folder)
    if args.data is None and (args.path is not None or args.cameras is not None):
        return None
    capture, images = open_capture(model.config, ranks)
    images.close()
    check_capture(model.space, capture, folder)
    return RunCameras(capture.cameras, capture.train, capture.test, input_files(capture))
