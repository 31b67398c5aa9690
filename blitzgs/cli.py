# SPDX-License-Identifier: Apache-2.0
"""The command line: `blitzgs train | eval | render | export | synth`."""

from __future__ import annotations

import argparse
import io
import json
import math
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from rich.console import Console
from rich.table import Table
from torch import Tensor

from blitzgs import __version__
from blitzgs.distributed.group import MismatchError, Ranks, Transport
from blitzgs.distributed.ownership import TileOwners
from blitzgs.output import OutputFolder
from blitzgs.progress import image_progress
from blitzgs.scene import ply
from blitzgs.scene.pictures import encode_image
from blitzgs.scene.synth import command as synth
from blitzgs.training import run
from blitzgs.training.batches import PhotographError
from blitzgs.training.checkpoint import CheckpointError
from blitzgs.training.config_io import load_config, to_dict
from blitzgs.training.evaluation import evaluate, load_lpips, render_view
from blitzgs.training.folder_checks import FolderError, locked
from blitzgs.training.guard import NonFiniteError
from blitzgs.training.trainer import Trainer
from blitzgs.training.views import ViewSet, render_options

# What a user can cause and mend: reported as a message. Anything else is ours and keeps its traceback.
USER_ERRORS = (
    ValueError,
    OSError,
    ImportError,
    CheckpointError,
    FolderError,
    MismatchError,
    NonFiniteError,
    PhotographError,
)

TRAIN_HELP = """\
Train a model of a capture: a COLMAP model (DIR/sparse/0 and DIR/images) or a transforms.json.

Every field of the configuration is a flag, e.g.
  blitzgs train --config configs/aerial.yaml --data DIR --out RUN --data.downscale=2 --schedule.scale=0.5
Times are counted in images; schedule.scale stretches the whole schedule. `blitzgs train --show-config` prints
the resolved configuration and stops.

RUN gets config.yaml, log.jsonl, tensorboard/, checkpoints/, evaluation/ and summary.json. A checkpoint is
written every 10 minutes (log.checkpoint_seconds) and when the run is interrupted (Ctrl-C, SIGTERM or SIGHUP);
the same command with --resume continues from the newest, or starts anew and says so where there is none.

Several processes share the work with torchrun --nproc-per-node=M train.py (the same flags). With --resume and
--max-restarts=K, a job that loses a process continues from its last checkpoint.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (1: failed, 2: wrong usage, 130: Ctrl-C)."""
    parser = _parser()
    args, rest = parser.parse_known_args(arguments)
    if rest and not (args.command == "train" and all(text.startswith("--") and "=" in text for text in rest)):
        hint = " (configuration fields are written --section.field=value)" if args.command == "train" else ""
        args.parser.error(f"unrecognized arguments: {' '.join(rest)}{hint}")
    args.overrides = rest
    # A warning of ours is about the user's data, not about the line of code that noticed.
    warnings.formatwarning = lambda message, *_, **__: f"blitzgs {args.command}: warning: {message}\n"
    try:
        status: int = args.run(args)
    except USER_ERRORS as error:
        Console(stderr=True, highlight=False).print(
            f"blitzgs {args.command}: {_message(error)}", style="red", markup=False, soft_wrap=True
        )
        return 1
    except KeyboardInterrupt:
        print(f"blitzgs {args.command}: interrupted", file=sys.stderr)
        return 130
    return status


def _message(error: Exception) -> str:
    """The error's text; for one of the operating system, the file and what is wrong with it."""
    if not isinstance(error, OSError) or error.filename is None or error.strerror is None:
        return str(error)
    if isinstance(error, FileExistsError):
        return f"{error.filename} is a file where a folder is needed: choose another name"
    return f"{error.filename}: {error.strerror}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="blitzgs", description="City-scale 3D Gaussian Splatting.")
    parser.add_argument("--version", action="version", version=f"blitzgs {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = _add(commands, "train", _train, "train a model of a capture", TRAIN_HELP)
    train.add_argument(
        "--config", type=Path, metavar="YAML", help="configuration file (default: the defaults)"
    )
    train.add_argument("--data", metavar="DIR", help="the capture (or --data.path=DIR)")
    train.add_argument("--out", type=Path, metavar="RUN", help="folder of the run")
    train.add_argument(
        "--resume", action="store_true", help="continue from the newest checkpoint in RUN, if any"
    )
    train.add_argument("--show-config", action="store_true", help="print the resolved configuration and stop")
    _add_device(train)

    evaluation = _add(commands, "eval", _eval, "measure the held-out views of a run")
    _add_run(evaluation)
    evaluation.add_argument("--split", choices=("test", "train"), default="test", help="views (%(default)s)")
    evaluation.add_argument("--out", type=Path, metavar="DIR", help="default: RUN/evaluation/SPLIT")
    evaluation.add_argument(
        "--pictures", type=int, default=8, metavar="N", help="side-by-side pictures (%(default)s)"
    )
    evaluation.add_argument("--lpips", metavar="FILE", help="TorchScript module of LPIPS with its weights")

    render = _add(commands, "render", _render, "render the views of a run to files")
    _add_run(render)
    render.add_argument(
        "--split", choices=("test", "train", "all"), default="test", help="views (%(default)s)"
    )
    render.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the images")
    render.add_argument(
        "--raw",
        action="store_true",
        help="write float32 arrays [H, W, 3] as .npy, not clamped, instead of PNG",
    )

    export = _add(commands, "export", _export, "write the model of a run to a file other programs read")
    _add_run(export, needs_data=False)
    export.add_argument("--ply", type=Path, required=True, metavar="FILE", help="PLY in INRIA's layout")

    city = _add(commands, "synth", synth.run, "generate a synthetic city to train on")
    synth.add_arguments(city)
    return parser


def _add(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    function: object,
    summary: str,
    description: str | None = None,
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=description or summary[0].upper() + summary[1:] + ".",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=function, parser=parser)
    return parser


def _add_run(parser: argparse.ArgumentParser, needs_data: bool = True) -> None:
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of a run")
    if needs_data:
        parser.add_argument("--data", metavar="DIR", help="where the capture is now (default: where it was)")
        parser.add_argument(
            "--share-gpus", action="store_true", help="with torchrun: let ranks share too few GPUs (slow)"
        )
    _add_device(parser)


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device", default="auto", help="auto (a GPU when there is one), cpu, cuda or cuda:N (%(default)s)"
    )


def _train(args: argparse.Namespace) -> int:
    overrides = [*args.overrides]
    if args.data is not None:
        overrides.append(f"data.path={json.dumps(str(Path(args.data).resolve()))}")
    source = args.config
    if args.resume and source is None and args.out is not None and (args.out / run.CONFIG).exists():
        source = args.out / run.CONFIG
    config = load_config(source, overrides)
    if args.show_config:
        print(json.dumps(to_dict(config), indent=1))
        return 0
    if args.out is None:
        args.parser.error("the following arguments are required: --out")
    job = config.ranks
    with Ranks.from_environment(
        args.device, job.timeout_seconds, cast(Transport, job.transport), job.share_gpus
    ) as ranks:
        with locked(args.out, ranks):
            capture, images = run.open_capture(config, ranks)
            summary = Trainer(config, capture, images, args.out, ranks, args.resume).train()
        if summary is not None and ranks.rank == 0:
            _print_summary(summary, args.out)
    return 0


def _print_summary(summary: dict[str, object], folder: Path) -> None:
    table = Table(title=str(folder), show_header=False)
    for name, value in summary.items():
        if isinstance(value, (int, float)):
            table.add_row(name, f"{value:,.4f}" if isinstance(value, float) else f"{value:,}")
    Console().print(table)


def _eval(args: argparse.Namespace) -> int:
    with Ranks.from_environment(args.device, share_gpus=args.share_gpus) as ranks:
        model = run.open_model(args.folder, ranks, args.data)
        capture, images = run.open_capture(model.config, ranks)
        run.check_capture(model.space, capture, args.folder)
        if not getattr(capture, args.split):
            raise ValueError(f"{args.folder} has no {args.split} views: choose another --split")
        with image_progress("Comparing", ranks.rank == 0) as report:
            result = evaluate(
                model.table,
                ViewSet(list(capture.cameras), model.space, ranks.device),
                capture.cameras,
                images,
                getattr(capture, args.split),
                render_options(model.config, model.space, model.progress.sh_degree),
                args.out or args.folder / run.EVALUATION / args.split,
                TileOwners(ranks),
                pictures=args.pictures,
                lpips=load_lpips(args.lpips),
                report=report,
                inputs=run.input_files(capture),
            )
        if ranks.rank == 0:
            print(json.dumps({name: value for name, value in result.items() if name != "views"}, indent=1))
    return 0


def _render(args: argparse.Namespace) -> int:
    with Ranks.from_environment(args.device, share_gpus=args.share_gpus) as ranks:
        model = run.open_model(args.folder, ranks, args.data)
        capture, _ = run.open_capture(model.config, ranks)
        run.check_capture(model.space, capture, args.folder)
        views = ViewSet(list(capture.cameras), model.space, ranks.device)
        options = render_options(model.config, model.space, model.progress.sh_degree)
        indices = range(len(capture.cameras)) if args.split == "all" else getattr(capture, args.split)
        owners = TileOwners(ranks)
        output = OutputFolder(args.out, run.input_files(capture))
        # Of all views, so that a view's file has the same name whichever split is rendered.
        paths = output.paths([view.name for view in capture.cameras], ".npy" if args.raw else ".png")
        args.out.mkdir(parents=True, exist_ok=True)
        with image_progress("Rendering", ranks.rank == 0) as report:
            for position, index in enumerate(indices):
                # The ranks take turns at writing.
                render = render_view(model.table, views, index, options, owners, position % ranks.world_size)
                report(position + 1, len(indices))
                if render is None:
                    continue
                content = _npy(render) if args.raw else encode_image(render, ".png")
                output.write(paths[index], content)
        if ranks.rank == 0:
            print(f"{args.out}: {len(indices)} images")
    return 0


def _npy(render: Tensor) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, render.cpu().numpy())
    return buffer.getvalue()


def _export(args: argparse.Namespace) -> int:
    ranks = Ranks.from_environment(args.device)
    if ranks.world_size > 1:
        raise ValueError("export writes one file from one process: run it without torchrun")
    model = run.open_model(args.folder, ranks)
    table, space = model.table, model.space
    args.ply.parent.mkdir(parents=True, exist_ok=True)
    ply.write_ply(
        args.ply,
        means=table["means"].cpu().double() * space.unit,
        quats=table["quats"].cpu(),
        scales=table["scales"].cpu() + math.log(space.unit),
        opacities=table["opacities"].cpu(),
        sh=table["sh"].cpu(),
        offset=np.array(space.offset),
    )
    print(f"{args.ply}: {len(table):,} Gaussians, {args.ply.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
