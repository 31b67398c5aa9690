# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs eval`: measure the held-out views of a run, or a file against a capture."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from blitzgs.cli.arguments import (
    DATA,
    DEVICES,
    MODEL,
    POOL,
    SPLIT,
    Commands,
    Types,
    add_command,
    chosen_views,
    number,
)
from blitzgs.config.files import changed
from blitzgs.distributed.group import Ranks
from blitzgs.formats.models import read_gaussians
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.cameras import input_files, warn_of_changes
from blitzgs.runs.evaluation import evaluate, load_lpips, worst_views
from blitzgs.runs.world import check_seen, config_of_file, subject_of_file
from blitzgs.training.inputs import check_capture, open_capture
from blitzgs.training.understood import largest_size
from blitzgs.util.errors import located, printable, warn
from blitzgs.util.progress import image_progress
from blitzgs.view.views import Space, ViewSet

HELP = """\
Compare renders of a run's held-out views with their photographs, or those of a model of another program:

  blitzgs eval RUN
  blitzgs eval FILE --data CAPTURE     # PLY, compressed PLY, SPZ, SOG or .splat, in the capture's coordinates

Prints the mean PSNR and SSIM as JSON, and
writes the figures of each view (metrics.json) and some pictures to --out. Held-out views are those that the
model was not trained on. psnr_corrected is the PSNR after the colours of each render were fitted to its
photograph.
"""


ARGUMENTS = f"""{MODEL}{DATA}{DEVICES}{POOL}{SPLIT}
--downscale N  with FILE: reduce both sides of the photographs by this factor, as data.downscale
--out DIR  folder for the results (default: RUN/evaluation/SPLIT, or FILE.evaluation/SPLIT)
--pictures N  number of pictures that show a render, its photograph and its error (default: %(default)s)
--lpips FILE  also measure LPIPS, with this TorchScript module; it takes a render and its photograph,
    [1, 3, H, W] in [-1, 1], and returns their distance
--allow-missing  leave out views whose photograph is missing
"""
TYPES: Types = {
    "--downscale": number(int, lambda value: value >= 1, "a whole number from 1 on"),
    "--pictures": number(int, lambda value: value >= 0, "0 or more"),
    "--lpips": str,
}


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    add_command(
        commands, "eval", run, summary, HELP, ARGUMENTS, TYPES, device="auto", split="test", pictures=8
    )


def run(args: argparse.Namespace) -> None:
    """Measure the views of a run."""
    with Ranks.from_environment(args.device, share_gpus=args.share_gpus) as ranks:
        path: Path = args.model
        if path.is_file():
            found = read_gaussians(path)
            if args.data is None:
                raise ValueError("a file is compared with a capture: add --data CAPTURE")
            data = {"path": str(args.data), "downscale": args.downscale or 1}
            config = changed(config_of_file(found), "data", **data)
            if path.suffix in (".spz", ".splat") and ranks.rank == 0:
                warn(
                    f"{path} cannot state a background: all is measured over black, which costs a model that "
                    "was trained over another colour; measure its run, or export it as PLY or SOG"
                )
        else:
            if args.downscale is not None:
                raise ValueError("--downscale is for a file: a run is measured at the size it was trained at")
            run_folder, checkpoint = run_files.run_and_checkpoint(path)
            model = trained_model.open_model(run_folder, ranks, args.data, args.resident_gb, checkpoint)
            config = model.config
        if args.allow_missing:
            config = changed(config, "data", allow_missing=True)
        capture, images = open_capture(config, ranks, "--allow-missing")
        if path.is_file():
            check_seen(found, path, capture)
            space = Space.of(capture.offset, capture.extent)
            config = changed(config, "model", near=capture.near / (space.unit * space.extent))
            with located(str(path)):
                subject = subject_of_file(found, config, space, ranks)
            folder = args.out or path.with_name(f"{path.name}.evaluation") / args.split
        else:
            check_capture(model.space, capture, run_folder)
            if ranks.rank == 0:
                warn_of_changes(run_folder, capture)
            subject = model.subject(ranks)
            folder = args.out or run_folder / run_files.EVALUATION / args.split
        indices = chosen_views(args.split, capture, path)
        with image_progress("Comparing", ranks.rank == 0) as report:
            result = evaluate(
                subject,
                ViewSet(list(capture.cameras), subject.space, ranks.device),
                capture.cameras,
                images,
                indices,
                folder,
                TileOwners(ranks),
                pictures=args.pictures,
                lpips=load_lpips(args.lpips),
                report=report,
                inputs=input_files(capture),
            )
        if ranks.rank == 0:
            print(json.dumps({name: value for name, value in result.items() if name != "views"}, indent=1))
            # Standard output has nothing but the JSON.
            for view, psnr in worst_views(result["views"]):
                print(printable(f"among the worst views: {view} {psnr:.2f} dB"), file=sys.stderr)
            what = f"metrics.json and pictures; {len(indices)} views, {largest_size(capture)} pixels"
            print(f"{folder}: {what}", file=sys.stderr)
