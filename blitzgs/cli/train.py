# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs train`: train a model of a capture."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from blitzgs.capture.colmap import find_models
from blitzgs.cli.arguments import DEVICES, Commands, Types, add_command, number
from blitzgs.cli.report import write_final_report
from blitzgs.cli.sfm import understood_alone, with_poses
from blitzgs.config.fields import Config
from blitzgs.config.files import (
    REMOVED,
    ConfigError,
    changed,
    flat,
    load_config,
    recipe_path,
    to_dict,
)
from blitzgs.config.ranges import describe, describe_all, describe_page
from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files
from blitzgs.runs.folder_checks import check_unclaimed, locked
from blitzgs.runs.resume import check_before_capture
from blitzgs.sfm.refine import fit_of
from blitzgs.spawn.gate import RANDOM, SpawnGate, gate_file
from blitzgs.training.budget import LEAST_IMAGES
from blitzgs.training.inputs import open_capture, read_ahead
from blitzgs.training.state import TrainingState
from blitzgs.training.trainer import Trainer
from blitzgs.training.understood import check_worlds, estimate, understood
from blitzgs.util.errors import kept_warnings, printable
from blitzgs.util.output import check_outside
from blitzgs.util.progress import Laps

if TYPE_CHECKING:
    from blitzgs.viewer.live import Live

# See `blitzgs.training.budget.extended`.
_EXTENSION = number(
    float,
    lambda value: 1 < value < LEAST_IMAGES or (value.is_integer() and value >= LEAST_IMAGES),
    f"a number of images from {LEAST_IMAGES} on, or a factor above 1",
)

HELP = """\
Train a model of a capture, which is a folder DIR with photographs and their cameras: a COLMAP model
(DIR/sparse/0 and DIR/images) or a transforms.json. For photographs alone the cameras are found first, as by
blitzgs sfm. Every 8th view is held out, unless the capture has its own split: the model is not trained on
these views, and its quality is measured on them at the end.

  blitzgs train --data DIR --out RUN

A GPU trains with the recipe aerial, a CPU with aerial_cpu. --config takes another recipe (compact: fewer
Gaussians; smoke: a first model in minutes; density: the paper's density control; city: thousands of
photographs; paper: the paper's values), a YAML file of yours, or "defaults" (the defaults of all fields).
Every field is also a flag, for example --data.downscale=2 --population.max_gaussians=2000000; --help FIELD
explains one, --help-fields all of them.

Times in the configuration count the images that were trained on. --schedule.scale=0.5 makes the whole
schedule half as long; with --minutes=M the run measures its speed and chooses this factor itself.

RUN gets config.yaml, cameras.json, log.jsonl, checkpoints/, evaluation/, summary.json, trajectory.svg and
report.html (open it in a browser), exposures.json with model.exposure, and tensorboard/ if TensorBoard is
installed. A checkpoint is written every 10 minutes (log.checkpoint_seconds) and when the run is interrupted
(Ctrl-C, SIGTERM or SIGHUP). The same command with --resume continues from the newest checkpoint; without any
checkpoint it starts a new run and says so. With --resume and without --config, the run's own configuration is
used. --extend trains a finished run longer.

To share the work among M processes, run torchrun --nproc-per-node=M -m blitzgs train with the same flags.
With torchrun's --max-restarts=K and --resume, a job that loses a process continues from its last checkpoint.
"""


ARGUMENTS = f"""{DEVICES}
--config RECIPE  name of a recipe, or a YAML file (default: aerial on a GPU, aerial_cpu on a CPU)
--data DIR  folder of the capture, or another program's project
--out RUN  folder for the results
--start FILE  begin with the Gaussians of a file (PLY, SPZ, SOG, .splat) in the capture's coordinates (under
    torchrun, which refuses this flag: --model.start=FILE)
--resume  continue from the newest checkpoint in RUN, if any
--extend IMAGES|FACTOR  train the finished run in RUN longer: by a number of images (100 or more), or to a
    multiple of its length (--extend=1.5)
--minutes M  end after M minutes of training, with the whole schedule fitted into them (0: no limit)
--show-config  print the resulting configuration and stop
--check  read the capture, print what was understood and roughly what the training will take, and stop;
    needs no GPU and no --out
--sfm DIR  folder for the capture that is made of photographs without poses (default: RUN_capture)
--no-sfm  refuse photographs without poses
--viewer [PORT=8080]  show the training in the browser (default port: %(const)s); needs the extra view
--viewer-host HOST  address to listen on (default: %(default)s, this machine only)
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    types: Types = {
        "--config": os.path.expanduser,
        "--extend": _EXTENSION,
        "--minutes": float,
        "--viewer": int,
    }
    parser = add_command(commands, "train", run, summary, HELP, ARGUMENTS, types, add_help=False)
    parser.set_defaults(device="auto", viewer_host="127.0.0.1")
    parser.add_argument(
        "-h",
        "--help",
        nargs="?",
        metavar="FIELD",
        action=_Help,
        help="show this help, or explain a field or section of the configuration, and stop",
    )
    parser.add_argument(
        "--help-fields",
        nargs="?",
        choices=("text", "markdown"),
        action=_Help,
        help="explain all fields of the configuration, as text or as a page, and stop",
    )
    for field in (*flat(to_dict(Config())), *REMOVED):
        parser.add_argument(
            f"--{field}", dest="overrides", action="append", default=[], type=f"{field}={{}}".format,
            help=argparse.SUPPRESS,
        )  # fmt: skip


class _Help(argparse.Action):
    """Prints the help of the command, of a field, or of all fields, and stops."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """Print the help; exit with status 2 if there is no such field."""
        if option_string == "--help-fields":
            print(describe_page() if values == "markdown" else printable(describe_all(), lines=True))
        elif isinstance(values, str):
            try:
                print(printable(describe(values), lines=True))
            except ConfigError as error:
                parser.error(str(error))
        else:
            parser.print_help()
        parser.exit()


def run(args: argparse.Namespace) -> None:
    """Train."""
    if args.extend is not None and args.minutes is not None:
        args.parser.error("--extend and --minutes exclude each other: --extend says how many images")
    args.resume = args.resume or args.extend is not None
    if args.out is None and not args.show_config and (args.resume or not args.check):
        needed = "--out" if args.data or args.config else "--data, --out"
        args.parser.error(f"the following arguments are required: {needed}")
    config = _config(args)
    if args.show_config:
        print(json.dumps(to_dict(config), indent=1))
        return
    if args.viewer is not None:
        from blitzgs.viewer.page import require_viser

        require_viser()
    if args.resume and not config.data.path and not (args.out / run_files.CONFIG).exists():
        raise FileNotFoundError(
            f"{args.out} holds no run to continue (it has no config.yaml): check --out, or name the capture "
            "of a new run with --data"
        )
    # Before the photographs, which take long.
    if (gate := config.population.gate) is not None and gate != RANDOM:
        SpawnGate(gate_file(gate))
    if config.model.start and not args.resume and not Path(config.model.start).exists():
        raise FileNotFoundError(f"{config.model.start}: there is no such file of Gaussians (--start)")
    if args.check:
        _check(args, config)
        return
    check_unclaimed(args.out, args.resume)
    if (photographs := Path(config.data.path) / config.data.images).is_dir():
        check_outside(args.out, photographs)
    job, laps = config.ranks, Laps(since_start=True)
    laps.lap("imports")
    if not args.no_sfm:
        posed = with_poses(config, args.sfm or args.out.with_name(f"{args.out.name}_capture"))
        if posed is not config:
            laps.lap("poses")
        config = posed
    if args.resume:
        check_before_capture(args.out, config, args.extend is not None)
    with (
        kept_warnings() as warned,
        nullcontext(read_ahead(config.data)) as reading,  # while the ranks join
        Ranks.from_environment(
            args.device,
            job.timeout_seconds,
            job.transport,
            args.share_gpus,
            tables_on_host=config.memory.resident_gb > 0,
            lap=laps.lap,
        ) as ranks,
    ):
        # A capture that cannot be read leaves no empty folder behind.
        capture, images = open_capture(config, ranks, reading=reading)
        check_worlds(capture)
        laps.lap("capture")
        # Otherwise a damaged photograph would be found when its turn comes, a held-out one at the end.
        images.check_files(range(ranks.rank, len(capture.cameras), ranks.world_size))
        laps.lap("files")
        if ranks.rank == 0:
            print("\n".join(understood(config, capture, images)), flush=True)
        with locked(args.out, ranks):
            trainer = Trainer(config, capture, images, args.out, ranks, args.resume, args.extend, laps)
            trainer.warned = warned
            if args.viewer is not None:
                trainer.watch(live_page(trainer.state, args.viewer, args.viewer_host))
            summary = trainer.train()
            if ranks.rank == 0:
                reported = write_final_report(args.out, summary)
                if summary is not None:
                    _print_summary(summary, args.out, reported)


def _check(args: argparse.Namespace, config: Config) -> None:
    if not args.no_sfm and (text := understood_alone(config)) is not None:
        print(text)
        return
    capture, images = open_capture(config, Ranks())
    check_worlds(capture)
    lines = understood(config, capture, images)
    images.close()
    used = [m for m, _ in find_models(capture.root) if m == capture.root / capture.about.cameras]
    if used and (fit := fit_of(used[0])) is not None:
        lines.append(f"{'poses:':15}{fit}")
    rough = estimate(config, capture, _on_gpu(args), torch.get_num_threads())
    lines.append(f"{'training:':15}{rough}")
    print("\n".join(lines), flush=True)


def _on_gpu(args: argparse.Namespace) -> bool:
    return bool(args.device.startswith("cuda") or (args.device == "auto" and torch.cuda.is_available()))


def _config(args: argparse.Namespace) -> Config:
    own = args.out / run_files.CONFIG if args.out is not None else None
    if args.config is not None:
        source = recipe_path(args.config)
    elif args.resume and own is not None and own.exists():
        source = own
    else:
        recipe = "aerial" if _on_gpu(args) else "aerial_cpu"
        source = recipe_path(recipe)
        if os.environ.get("RANK", "0") == "0":  # torchrun's number of the process
            print(f"recipe: {recipe} (choose another one with --config)", file=sys.stderr)
    minutes = [] if args.minutes is None else [f"schedule.minutes={args.minutes}"]
    begun = args.resume and own is not None and any((args.out / run_files.CHECKPOINTS).glob("checkpoint_*"))
    if args.minutes and begun and own is not None and own.exists() and load_config(own).schedule.minutes == 0:
        raise ConfigError(
            f"--minutes: the run in {args.out} began without it or was extended, so its length is decided: "
            "leave out --minutes to continue it; once it is finished, --extend 1.5 trains half as long again"
        )
    config = load_config(source, [*args.overrides, *minutes])
    if args.data is not None:
        # Set the path directly: YAML does not allow all characters that a path may have.
        config = changed(config, "data", path=os.path.realpath(args.data))
    if args.start is not None:
        config = changed(config, "model", start=os.path.realpath(args.start))
    return config


# How figures are printed: label, digits after the point, unit.
_FIGURES: dict[str, tuple[str, int, float]] = {
    "psnr": ("PSNR, dB", 2, 1),
    "ssim": ("SSIM", 4, 1),
    "psnr_corrected": ("PSNR, colours fitted, dB", 2, 1),
    "images": ("images trained on", 0, 1),
    "seconds": ("training time, minutes", 1, 60),
    "images_per_second": ("images per second", 1, 1),
    "gaussians": ("Gaussians", 0, 1),
    "peak_gaussians": ("Gaussians at most", 0, 1),
    "peak_memory_bytes": ("peak memory, GB", 2, 1e9),
    "budget_seconds": ("time limit, minutes", 1, 60),
    "scale": ("scale of the schedule", 2, 1),
    "largest_fall": ("largest fall of the training PSNR, dB", 2, 1),
}


def _print_summary(summary: dict[str, object], folder: Path, reported: bool) -> None:
    console, table = Console(emoji=False), Table(show_header=False)

    def say(text: str) -> None:  # as it is: rich must not interpret brackets and colons in paths
        console.out(printable(text), highlight=False)

    say(str(folder))
    if summary.get("split") == "train":
        console.print("no view is held out: the figures are those of the training views", style="yellow")
    for name, value in summary.items():
        label, digits, unit = _FIGURES.get(name, (name, 4 if isinstance(value, float) else 0, 1))
        if isinstance(value, (int, float)):
            table.add_row(label, f"{value / unit:,.{digits}f}")
    console.print(table)
    # Quoted, so that the commands can be copied.
    name = shlex.quote(str(folder))
    split, views = ("--split train ", "training") if summary.get("split") == "train" else ("", "held-out")
    commands = {
        f"view {name}": "the model in the browser",
        f"render {name} {split}--out PICTURES": f"the {views} views as pictures",
        f"export {name} --ply MODEL.ply": "the model for viewers",
        f"train --out {name} --extend 1.5": "train half as long again",
    }
    width = max(map(len, commands))
    if reported:
        say(f"report: {folder / run_files.REPORT}")
    say(f"pictures: {folder / run_files.EVALUATION}")
    say("next:")
    for command, what in commands.items():
        say(f"  blitzgs {command:{width}}   {what}")


def live_page(state: TrainingState, port: int, host: str) -> Live | None:
    """Open the page of a training on rank 0, and print its address; None on other ranks.

    A page that cannot be opened is a message: the training goes on without it.
    """
    if state.ranks.rank != 0:
        return None
    from blitzgs.viewer.live import Live
    from blitzgs.viewer.studio import box_of
    from blitzgs.viewer.world import Exhibit

    capture, images, options = state.capture, state.images, state.render_options
    exhibit = Exhibit(
        title=f"{state.folder.resolve().name} (training)",
        space=state.space,
        sh_degree=state.config.model.sh_degree,
        background=options.background,
        levels=state.progress.level_count > 1,
        lod=state.progress.level_count > 1,
        smooth=state.config.view.lod == "smooth",
        box=box_of(state.table["means"]),
        cameras=capture.cameras,
        test=capture.test,
        photograph=lambda index: np.asarray(images.get(index).numpy()),
        paths=state.folder / "paths",
        frame=capture.about.frame,
    )
    try:
        page = Live(exhibit, state.schedule.iterations, host, port)
    except OSError as error:
        print(f"{error}; training goes on without the viewer", flush=True)
        return None
    print(f"viewer: open {page.page.url}", flush=True)
    return page
