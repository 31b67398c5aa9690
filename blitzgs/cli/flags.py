# SPDX-License-Identifier: Apache-2.0
"""Reads flags: fields of the configuration beside a command's own flags, none of them twice or shortened."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Sequence
from typing import NoReturn

from blitzgs.util.terminal import printable


class Parser(argparse.ArgumentParser):
    """A parser without abbreviations, whose messages contain no control characters."""

    def __init__(self, *arguments: object, **settings: object) -> None:
        super().__init__(*arguments, **settings | {"allow_abbrev": False})  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, and exit with status 2."""
        super().error(printable(message))


def split_fields(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate the fields of a configuration from a command's other arguments.

    A field is a flag with a dot, or one that the command does not have and that has a value after "=". Its
    value follows after "=" or as the next argument.

    Args:
        parser: the command, which has the method `error`.
        arguments: what follows the command's name.

    Returns:
        The other arguments, and the fields as "--section.field=value".
    """
    others: list[str] = []
    fields: list[str] = []
    known = flags_of(parser)
    waiting = list(arguments)
    while waiting:
        text = waiting.pop(0)
        name, equals, _ = text.partition("=")
        if text == "--":
            return [*others, text, *waiting], fields
        if not name.startswith("--") or name in known or not (equals or "." in name):
            others.append(text)
            # The value of a flag is no field, even if it looks like one.
            if name in known and not equals and known[name] and waiting and not waiting[0].startswith("--"):
                others.append(waiting.pop(0))
        elif equals:
            if "." not in name and (meant := flag_meant(parser, name)):
                parser.error(f"unrecognized arguments: {text}; did you mean {meant}?")
            fields.append(text)
        elif waiting and not waiting[0].startswith("--"):
            fields.append(f"{text}={waiting.pop(0)}")
        else:
            parser.error(f"{text} needs a value: write {text}=VALUE")
    return others, fields


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
    """Return the command's flag that an unknown one resembles; None for a field and if no flag is like it."""
    name = text.partition("=")[0]
    flags = re.findall(r"--[\w-]+", parser.format_usage())
    if not name.startswith("--") or "." in name:
        return None
    if len(longer := [flag for flag in flags if flag.startswith(name)]) == 1:
        return longer[0]
    return next(iter(difflib.get_close_matches(name, flags, n=1, cutoff=0.75)), None)
