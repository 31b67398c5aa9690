# SPDX-License-Identifier: Apache-2.0
"""Arguments that several commands share, and how flags are read: none of them twice or shortened."""

from __future__ import annotations

import argparse
import difflib
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from blitzgs.config.files import REMOVED
from blitzgs.config.ranges import RANGES
from blitzgs.util.errors import printable

if TYPE_CHECKING:
    from blitzgs.capture.capture import Capture
    from blitzgs.runs.cameras import RunCameras

Number = TypeVar("Number", int, float)
Commands = argparse._SubParsersAction  # argparse has no public name for it


def add_command(
    commands: Commands[argparse.ArgumentParser],
    name: str,
    function: Callable[[argparse.Namespace], int | None],
    summary: str,
    description: str | None = None,
    add_help: bool = True,
) -> argparse.ArgumentParser:
    """Add a command that calls `function` with its arguments and exits with what it returns, or 0.

    Without `add_help`, the caller adds the flag --help.
    """
    parser = commands.add_parser(
        name,
        help=summary,
        description=description or summary[0].upper() + summary[1:] + ".",
        formatter_class=HelpFormatter,
        add_help=add_help,
    )
    parser.set_defaults(run=function, parser=parser)
    return parser


def add_synth(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add `blitzgs synth`, a package of its own."""
    import blitzgs_synth

    blitzgs_synth.add_arguments(add_command(commands, "synth", blitzgs_synth.run, summary))


def named_path(text: str) -> Path:
    """Return a path; refuse an empty one, because `--out "$UNSET"` would mean the current folder."""
    if not text:
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def add_path(parser: argparse._ActionsContainer, name: str, metavar: str, text: str, **more: Any) -> None:
    """Add an argument that is a path, and no empty one; `text` is its help."""
    parser.add_argument(name, type=named_path, metavar=metavar, help=text, **more)


_PATHS = ("FILE", "DIR", "RUN")
_FLAG = re.compile(r"(--[\w-]+)(?: (\S+))?  (.*)", re.DOTALL)


def add_flags(
    parser: argparse._ActionsContainer, text: str, types: Mapping[str, Callable[[str], Any]] | None = None
) -> None:
    """Add the flags that a text describes.

    A line is "--name METAVAR  help", or "--name  help" for a switch; indented lines go on with the help.
    `types` has the functions that read values, by name; of others, FILE, DIR and RUN are paths.
    """
    for entry in re.split(r"\n(?=--)", text.strip()):
        match = _FLAG.fullmatch(entry)
        assert match is not None, entry
        name, metavar, meaning = match[1], match[2], " ".join(match[3].split())
        if metavar is None:
            parser.add_argument(name, action="store_true", help=meaning)
        else:
            kind = (types or {}).get(name, named_path if metavar in _PATHS else str)
            parser.add_argument(name, type=kind, metavar=metavar, help=meaning)


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add the argument RUN, the folder of a run."""
    add_path(parser, "folder", "RUN", "folder that blitzgs train wrote (its --out)")


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add the argument MODEL: the folder of a run, a checkpoint in it, or a file of Gaussians."""
    add_path(parser, "model", "MODEL", "run, checkpoint, or file of Gaussians")


def add_capture(parser: argparse.ArgumentParser) -> None:
    """Add the flag --data, the present folder of a run's capture."""
    add_flags(parser, "--data DIR  folder of the capture, if it has moved since the training")


def add_pool(parser: argparse.ArgumentParser) -> None:
    """Add the flag --resident-gb: views may need a larger pool on fewer ranks than the run was trained on."""
    allowed = RANGES["memory.resident_gb"]
    text = """
--resident-gb GB  gigabytes of each device that hold Gaussians; those that do not fit stay in host memory; 0:
    all are on the device (default: memory.resident_gb of the run)
"""
    add_flags(parser, text, {"--resident-gb": number(float, lambda value: value in allowed, str(allowed))})


def number(
    kind: Callable[[str], Number], fits: Callable[[Number], bool], described: str
) -> Callable[[str], Number]:
    """Return a type of argparse: numbers that fit; `described` follows "must be" in the error."""

    def parsed(text: str) -> Number:
        with suppress(ValueError):
            if fits(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"must be {described}, got {text}")

    return parsed


def add_split(parser: argparse.ArgumentParser, verb: str) -> None:
    """Add the flag --split, which views of the run to use; `verb` says for what."""
    parser.add_argument(
        "--split",
        choices=("test", "train", "all"),
        default="test",
        help=f"views to {verb} (default: %(default)s)",
    )


def chosen_views(split: str, cameras: Capture | RunCameras, folder: Path) -> Sequence[int]:
    """Return the cameras that --split names, as indices (ValueError: the run in `folder` has none)."""
    indices: Sequence[int] = range(len(cameras.cameras)) if split == "all" else getattr(cameras, split)
    if not indices:
        raise ValueError(f"{folder} has no {split} views: choose another --split")
    return indices


def add_device(parser: argparse.ArgumentParser, shares_gpus: bool = False) -> None:
    """Add the flag --device and, if `shares_gpus`, --share-gpus."""
    add_flags(parser, "--device DEVICE  auto (a GPU when there is one), cpu, cuda or cuda:N (default: auto)")
    parser.set_defaults(device="auto")
    if shares_gpus:
        add_flags(parser, "--share-gpus  with torchrun: let several processes use one GPU (slow)")


class HelpFormatter(argparse.HelpFormatter):
    """Fits the paragraphs of a description to the terminal; one with indented lines stays as it is."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(110, shutil.get_terminal_size().columns - 2))

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts = text.strip().split("\n\n")
        return "\n\n".join(part if "\n " in f"\n{part}" else textwrap.fill(part, width) for part in parts)


class Parser(argparse.ArgumentParser):
    """A parser without abbreviations, whose messages contain no control characters."""

    def __init__(self, *arguments: object, **settings: object) -> None:
        super().__init__(*arguments, **settings | {"allow_abbrev": False})  # type: ignore[arg-type]
        # argparse would take -1e-3 for a flag.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def error(self, message: str) -> NoReturn:
        """Print a message without the usage, which is many lines long, and exit with status 2."""
        self.exit(2, f"{self.prog}: {printable(message)} ({self.prog} --help explains all)\n")


def check_given_once(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> None:
    """Refuse a value that is given twice, of which the last one would win without a word."""
    seen: set[str] = set()
    switches = {flag for flag, has_value in flags_of(parser).items() if not has_value}
    for text in arguments:
        if text == "--":
            return
        name = text.partition("=")[0]
        if name.startswith("--") and name in seen - switches:
            parser.error(f"{name} is given twice: leave out one of them")
        seen.add(name)


def flags_of(parser: argparse.ArgumentParser) -> dict[str, bool]:
    """Return the long flags of a command, and whether each takes a value."""
    return {
        flag: action.nargs != 0
        for action in parser._actions  # argparse has no public list of them
        for flag in action.option_strings
        if flag.startswith("--")
    }


def flag_meant(parser: argparse.ArgumentParser, text: str) -> str | None:
    """Return the command's flag that an unknown one resembles; None if no flag is like it."""
    name = text.partition("=")[0]
    flags = [flag for flag in flags_of(parser) if flag[2:] not in REMOVED]
    if not name.startswith("--"):
        return None
    if len(longer := [flag for flag in flags if flag.startswith(name)]) == 1:
        return longer[0]
    return next(iter(difflib.get_close_matches(name, flags, n=1, cutoff=0.75)), None)
