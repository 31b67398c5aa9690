# SPDX-License-Identifier: Apache-2.0
"""Describes the fields of the configuration for `--help FIELD`, from the docstrings of their sections."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import re
import textwrap
import types
import typing
from typing import Any

import yaml

from blitzgs.config.errors import ConfigError
from blitzgs.config.fields import Config
from blitzgs.config.ranges import RANGES

_WIDTH = 100
_KINDS = {int: "integer", float: "number", bool: "true or false", str: "text", type(None): "null"}


def describe(wanted: str) -> str:
    """Describe fields: meaning, kind, default and allowed values.

    Args:
        wanted: "section.field", a field's name without its section, or a section; leading dashes are allowed.

    Raises:
        ConfigError: there is no such field.
    """
    name = wanted.lstrip("-").partition("=")[0]
    sections = _sections()
    if name in sections:
        return _section(name)
    fields = [(section, field) for section, own in sections.items() for field in own]
    found = [(section, field) for section, field in fields if name in (field, _joined(section, field))]
    if not found:
        known = [text for section, field in fields for text in (_joined(section, field), field)]
        close = difflib.get_close_matches(name, [*known, *sections], n=3)
        hint = f"did you mean {', '.join(close)}?" if close else "--help-fields describes all fields"
        raise ConfigError(f"{name}: there is no such field of the configuration; {hint}")
    return "\n\n".join(_field(section, field) for section, field in found)


def describe_all() -> str:
    """Describe all sections and fields."""
    return "\n\n\n".join(_section(name) for name in _sections())


def _sections() -> dict[str, list[str]]:
    """Return the names of the fields of each section; "" has those without a section."""
    hints = typing.get_type_hints(Config)
    sections = {name: list(typing.get_type_hints(kind)) for name, kind in hints.items() if _is_section(kind)}
    return {"": [name for name, kind in hints.items() if not _is_section(kind)]} | sections


def _is_section(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _kind_of(section: str) -> type:
    found: type = typing.get_type_hints(Config)[section] if section else Config
    return found


def _joined(section: str, field: str) -> str:
    return f"{section}.{field}" if section else field


def _section(name: str) -> str:
    """Return the description of a section and of all of its fields."""
    about = (inspect.getdoc(_kind_of(name)) or "").partition("\nAttributes:")[0].strip()
    parts = [f"{name}: {about}" if name else about]
    return "\n\n".join([*parts, *(_field(name, field) for field in _sections()[name])])


def _field(section: str, field: str) -> str:
    """Return a line with kind, default and allowed values, and the meaning below it."""
    kind, name = _kind_of(section), _joined(section, field)
    default = (
        yaml.safe_dump(_plain(getattr(kind(), field)), default_flow_style=True).split("\n...")[0].strip()
    )
    allowed = f", {RANGES[name]}" if name in RANGES else ""
    head = f"--{name}={default}   ({_type(typing.get_type_hints(kind)[field])}{allowed})"
    return f"{head}\n{textwrap.indent(textwrap.fill(_meanings(kind)[field], _WIDTH), '    ')}"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _type(hint: Any) -> str:
    """Return the kind of a field's values as text."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_type(option) for option in options)
    if origin is tuple:
        return "list" if options[-1] is Ellipsis else f"list of {len(options)}"
    return _KINDS.get(hint, "value")


def _meanings(kind: type) -> dict[str, str]:
    """Return the meaning of each field, from the part "Attributes:" of a docstring."""
    text = (inspect.getdoc(kind) or "").partition("Attributes:\n")[2]
    entries = re.split(r"^    (?=\S)", text, flags=re.MULTILINE)
    meanings: dict[str, str] = {}
    for entry in filter(str.strip, entries):
        names, _, meaning = entry.partition(":")
        shared = [name.strip() for name in names.split(",")]
        for name in shared:
            others = f"({names.strip()}) " if len(shared) > 1 else ""
            meanings[name] = others + " ".join(meaning.split())
    return meanings
