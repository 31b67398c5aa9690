# SPDX-License-Identifier: Apache-2.0
"""Describes the fields of the configuration, from the docstrings of their sections.

For `--help FIELD`, `--help-fields` and docs/configuration.md.
"""

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

from blitzgs.config.fields import Config, ConfigError
from blitzgs.config.ranges import RANGES

_WIDTH = 100
_PAGE_HEAD = """# Configuration

Every field is a flag of `blitzgs train` (`--data.downscale=2`) and a line of a recipe, which overrides these
defaults; with `--show-config` it prints the result. `--help data.downscale` has the range and the details of
a field, and `--help-fields=markdown` made this page."""
_KINDS = {int: "integer", float: "number", bool: "true or false", str: "text", type(None): "null"}


def describe(wanted: str) -> str:
    """Describe fields: meaning, kind, default and allowed values.

    `wanted` is "section.field", a field's name without its section, or a section; leading dashes are allowed.
    ConfigError: there is no such field.
    """
    name = wanted.lstrip("-").partition("=")[0]
    sections = _sections()
    if name in sections:
        return _section(name)
    fields = [(section, field) for section, kind in sections.items() for field in _fields(kind)]
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


def describe_page() -> str:
    """Return docs/configuration.md: the first sentence about every field, in a table for each section."""
    parts = [_PAGE_HEAD]
    for section, kind in _sections().items():
        if section:
            parts.append(f"## {section}\n\n{_about(kind).partition(chr(10))[0]}")
        rows = ["field|default|meaning", "---|---|---"]
        for names, meaning in _entries(kind).items():
            fields = ", ".join(f"`{_joined(section, name)}`" for name in names)
            defaults = ", ".join(f"`{_default(kind, name)}`" for name in names)
            rows.append(f"{fields}|{defaults}|{_first_clause(meaning)}")
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _first_clause(text: str) -> str:
    """Return a text up to the first semicolon or full stop outside of parentheses."""
    depth = 0
    for place, sign in enumerate(text):
        depth += (sign == "(") - (sign == ")")
        if depth == 0 and re.match(r";|\.(?= [A-Z0-9]|$)", text[place:]):
            return text[:place]
    return text


def _sections() -> dict[str, type]:
    """Return the class of each section; that of "" has the fields without a section."""
    found: dict[str, Any] = {"": Config}
    hints = typing.get_type_hints(Config)
    return found | {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}


def _fields(kind: type) -> dict[str, Any]:
    """Return the types of a section's fields."""
    hints = typing.get_type_hints(kind)
    return {name: hint for name, hint in hints.items() if not dataclasses.is_dataclass(hint)}


def _joined(section: str, field: str) -> str:
    return f"{section}.{field}" if section else field


def _section(name: str) -> str:
    """Return the description of a section and of all of its fields."""
    kind = _sections()[name]
    about = f"{name}: {_about(kind)}" if name else _about(kind)
    return "\n\n".join([about, *(_field(name, field) for field in _fields(kind))])


def _about(kind: type) -> str:
    """Return what the docstring of a section says before its fields."""
    return (inspect.getdoc(kind) or "").partition("\nAttributes:")[0].strip()


def _field(section: str, field: str) -> str:
    """Return a line with kind, default and allowed values, and the meaning below it."""
    kind, name = _sections()[section], _joined(section, field)
    allowed = f", {RANGES[name]}" if name in RANGES else ""
    head = f"--{name}={_default(kind, field)}   ({_type(_fields(kind)[field])}{allowed})"
    names, meaning = next(entry for entry in _entries(kind).items() if field in entry[0])
    # Fields that share their meaning begin with all their names.
    text = (f"({', '.join(names)}) " if len(names) > 1 else "") + meaning
    return f"{head}\n{textwrap.indent(textwrap.fill(text, _WIDTH), '    ')}"


def _default(kind: type, field: str) -> str:
    """Return the default of a field as YAML."""
    value = getattr(kind(), field)
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(plain, default_flow_style=True).split("\n...")[0].strip()


def _type(hint: Any) -> str:
    """Return the kind of a field's values as text."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_type(option) for option in options)
    if origin is tuple:
        return "list" if options[-1] is Ellipsis else f"list of {len(options)}"
    return _KINDS.get(hint, "value")


def _entries(kind: type) -> dict[tuple[str, ...], str]:
    """Return the meaning of the fields that share one, from the part "Attributes:" of a docstring."""
    text = (inspect.getdoc(kind) or "").partition("Attributes:\n")[2]
    entries: dict[tuple[str, ...], str] = {}
    for entry in filter(str.strip, re.split(r"^    (?=\S)", text, flags=re.MULTILINE)):
        names, _, meaning = entry.partition(":")
        entries[tuple(name.strip() for name in names.split(","))] = " ".join(meaning.split())
    return entries
