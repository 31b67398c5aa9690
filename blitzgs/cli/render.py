# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs render`: render the views of a run to files."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from blitzgs.capture.pictures import encode_image
from blitzgs.cli.arguments import (
    Commands,
    add_command,
    add_device,
    add_pool,
    add_run,
    add_split,
    chosen_views,
    named_path,
)
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import files as run_files
from blitzgs.runs.cameras import CAMERAS, RunCameras, input_files, load_cameras
from blitzgs.runs.evaluation import render_view
from blitzgs.runs.lod import lod_gate, scene_gate
from blitzgs.training.inputs import check_capture, open_capture
from blitzgs.util.output import OutputFolder
from blitzgs.util.progress import image_progress
from blitzgs.view.views import CameraLike, ViewSet, render_options
from blitzgs.view.visible import VisibleFinder


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "render", run, summary)
    add_run(parser)
    parser.add_argument(
        "--data", type=named_path, metavar="DIR", help="take the cameras from this capture, not from the run"
    )
    add_device(parser, shares_gpus=True)
    add_pool(parser)
    add_split(parser, "render")
    parser.add_argument("--out", type=named_path, required=True, metavar="DIR", help="folder for the images")
    parser.add_argument(
        "--exposure",
        action="store_true",
        help="show training views with the exposure of their photographs (model.exposure), not with the mean",
    )
    parser.add_argument(
        "--raw",
        action="store_true",
        help="write float32 arrays [H, W, 3] as .npy, not clamped, instead of PNG",
    )


def run(args: argparse.Namespace) -> int:
    """Render the views of a run; returns the exit status."""
    with Ranks.from_environment(args.device, share_gpus=args.share_gpus) as ranks:
        model = run_files.open_model(args.folder, ranks, args.data, args.resident_gb)
        stored = _cameras(args, model, ranks)
        cameras: Sequence[CameraLike] = stored.cameras
        indices = chosen_views(args, stored)
        exposures = _exposures(model, stored) if args.exposure else {}
        views = ViewSet(list(cameras), model.space, ranks.device)
        gate = lod_gate(model.config, model.progress)
        options = render_options(model.config, model.space, model.progress.sh_degree, gate)
        lod = scene_gate(model.config, model.progress, model.table, ranks)
        finder, owners = VisibleFinder(model.scene(ranks.device), lod), TileOwners(ranks)
        output = OutputFolder(args.out, stored.inputs)
        # Names for all views, so that a view's file has the same name whichever split is rendered.
        paths = output.paths([camera.name for camera in cameras], ".npy" if args.raw else ".png")
        args.out.mkdir(parents=True, exist_ok=True)
        with image_progress("Rendering", ranks.rank == 0) as report:
            for position, index in enumerate(indices):
                # The ranks take turns at writing.
                destination = position % ranks.world_size
                render = render_view(finder, views, index, options, owners, destination)
                report(position + 1, len(indices))
                if render is None:
                    continue
                if index in exposures:
                    gain, bias = exposures[index].to(render.device)
                    render = render * gain + bias
                output.write(paths[index], _npy(render) if args.raw else encode_image(render, ".png"))
        if ranks.rank == 0:
            print(f"{args.out}: {len(indices)} images")
    return 0


def _exposures(model: run_files.TrainedModel, stored: RunCameras) -> dict[int, Tensor]:
    """Return gain and bias, float32 [2, 3], of each training view, by its index among the cameras.

    Raises:
        ValueError: the run has no exposures, or those of other cameras.
    """
    if model.exposures is None:
        raise ValueError("--exposure: the run was trained without model.exposure")
    if len(model.exposures) != len(stored.train):
        raise ValueError(
            f"--exposure: the run has {len(model.exposures)} photographs, not {len(stored.train)}"
        )
    return dict(zip(stored.train, model.exposures.float(), strict=True))


def _cameras(args: argparse.Namespace, model: run_files.TrainedModel, ranks: Ranks) -> RunCameras:
    """Return the cameras of the given capture; without one, those that the run stored, else its capture's."""
    if args.data is None and (args.folder / CAMERAS).exists():
        return load_cameras(args.folder)
    capture, images = open_capture(model.config, ranks)
    images.close()
    check_capture(model.space, capture, args.folder)
    return RunCameras(capture.cameras, capture.train, capture.test, input_files(capture))


def _npy(render: Tensor) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, render.cpu().numpy())
    return buffer.getvalue()
