# SPDX-License-Identifier: Apache-2.0
"""Arguments that several commands share, and how flags are read: none of them twice or shortened."""

from __future__ import annotations

import argparse
import difflib
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from blitzgs.config.files import REMOVED
from blitzgs.config.ranges import RANGES
from blitzgs.util.errors import printable

if TYPE_CHECKING:
    from blitzgs.capture.capture import Capture
    from blitzgs.runs.cameras import RunCameras

Number = TypeVar("Number", int, float)
Commands = argparse._SubParsersAction  # argparse has no public name for it
Types = Mapping[str, Callable[[str], Any]]  # the functions that read the values of arguments, by their names


def add_command(
    commands: Commands[argparse.ArgumentParser],
    name: str,
    function: Callable[[argparse.Namespace], int | None],
    summary: str,
    description: str | None = None,
    arguments: str = "",
    types: Types = MappingProxyType({}),
    add_help: bool = True,
    **defaults: Any,
) -> argparse.ArgumentParser:
    """Add a command that calls `function` with its arguments and exits with what it returns, or 0.

    `arguments` and `types` are those of `add_arguments`, `defaults` the values of arguments that are not
    given. Without `add_help`, the caller adds the flag --help.
    """
    parser = commands.add_parser(
        name,
        help=summary,
        description=description or summary[0].upper() + summary[1:] + ".",
        formatter_class=HelpFormatter,
        add_help=add_help,
    )
    add_arguments(parser, arguments, types)
    parser.set_defaults(run=function, parser=parser, **defaults)
    return parser


def add_arguments(parser: argparse._ActionsContainer, text: str, types: Types = MappingProxyType({})) -> None:
    """Add the arguments that a text describes.

    A line is "--name METAVAR  help", "--name  help" for a switch, or "name METAVAR  help" for an argument
    without a flag; indented lines go on with the help. A flag is required if its help ends so. Of METAVARs
    in small letters, "one|two" are the only values; "RUN..." takes one or more; "[K=1]" means 1 without a
    value. `types` has the functions that read values, by name; others follow from the METAVAR.
    """
    for entry in re.split(r"\n(?=\S)", text.strip()) if text else ():
        match = _ARGUMENT.fullmatch(entry)
        assert match is not None, entry
        name, metavar, meaning = match[1], match[2], " ".join(match[3].split())
        if metavar is None:
            parser.add_argument(name, action="store_true", help=meaning)
            continue
        word, _, implied = metavar.removesuffix("...").strip("[]").partition("=")
        kind = types.get(name) or _TYPES.get(word, str)
        more: dict[str, Any] = {"required": True} if meaning.endswith("(required)") else {}
        if "|" in word and word == word.lower():
            more["choices"] = [kind(choice) for choice in word.split("|")]
        else:
            more["metavar"] = word
        if implied:
            more |= {"nargs": "?", "const": kind(implied)}
        elif metavar.endswith("..."):
            more["nargs"] = "+"
        parser.add_argument(name, type=kind, help=meaning, **more)


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


def named_path(text: str) -> Path:
    """Return a path; refuse an empty one, because `--out "$UNSET"` would mean the current folder.

    Shells leave the ~ of `--out=~/runs` as it is, which would make a folder of that name.
    """
    if not text:
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(os.path.expanduser(text))


_ARGUMENT = re.compile(r"([\w-]+)(?: (\S+))?  (.*)", re.DOTALL)
_PATHS = ("FILE", "DIR", "DIR|FILE", "RUN", "MODEL", "PHOTOS", "CAPTURE", "NEW")
_SIZES = RANGES["memory.resident_gb"]
_TYPES: Types = {
    **dict.fromkeys(_PATHS, named_path),
    "GB": number(float, _SIZES.__contains__, str(_SIZES)),
}

# Arguments of several commands.
RUN = "folder RUN  folder that blitzgs train wrote (its --out)\n"
MODEL = "model MODEL  run, checkpoint, or file of Gaussians\n"
DATA = "--data DIR  folder of the capture, if it has moved since the training\n"
DEVICE = "--device DEVICE  auto (a GPU when there is one), cpu, cuda or cuda:N (default: %(default)s)\n"
DEVICES = f"{DEVICE}--share-gpus  with torchrun: let several processes use one GPU (slow)\n"
# Views may need a larger pool on fewer ranks than the run was trained on.
POOL = """\
--resident-gb GB  gigabytes of each device that hold Gaussians; those that do not fit stay in host memory; 0:
    all are on the device (default: memory.resident_gb of the run)
"""
SPLIT = "--split test|train|all  views to use (default: %(default)s)\n"


def chosen_views(split: str, cameras: Capture | RunCameras, folder: Path) -> Sequence[int]:
    """Return the cameras that --split names, as indices (ValueError: the run in `folder` has none)."""
    indices: Sequence[int] = range(len(cameras.cameras)) if split == "all" else getattr(cameras, split)
    if not indices:
        raise ValueError(f"{folder} has no {split} views: choose another --split")
    return indices


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
