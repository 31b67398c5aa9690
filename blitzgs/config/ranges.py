# SPDX-License-Identifier: Apache-2.0
"""The allowed values of configuration fields, checks of several fields together, and the text of --help."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import itertools
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import yaml

from blitzgs.config.fields import (
    MAX_STRETCH,
    RESET_OPACITY,
    SCALE,
    Config,
    ConfigError,
    Range,
    ScheduleConfig,
)

# Factors of `schedule.resolution`: float32 intrinsics are divided by them exactly.
REDUCTIONS = (2, 4, 8)
# Images of a whole run: its tables of learning rates take 376 bytes a step.
MAX_IMAGES = 10_000_000


# The class of each section; that of "" has the fields without a section.
_SECTIONS: Mapping[str, Any] = {"": Config} | {
    name: kind for name, kind in get_type_hints(Config).items() if dataclasses.is_dataclass(kind)
}
# Of all fields, by names such as "section.field".
_HINTS: Mapping[str, Any] = {
    f"{section}.{name}".lstrip("."): hint
    for section, kind in _SECTIONS.items()
    for name, hint in get_type_hints(kind, include_extras=True).items()
    if not dataclasses.is_dataclass(hint)
}
# The numbers and the texts that a field may have, by its name.
RANGES: Mapping[str, Range] = {
    name: hint.__metadata__[0] for name, hint in _HINTS.items() if get_origin(hint) is Annotated
}
CHOICES: Mapping[str, tuple[str, ...]] = {
    name: get_args(hint) for name, hint in _HINTS.items() if get_origin(hint) is Literal
}


def problems(config: Config) -> Iterator[str]:
    """Name each field whose value makes no sense, with the value and what is allowed."""
    for name, value in flat(dataclasses.asdict(config)).items():
        allowed = RANGES.get(name)
        if allowed and value is not None and not all(number in allowed for number in _numbers(value)):
            yield f"{name}: must be {allowed}, got {value}"
    schedule, population = config.schedule, config.population
    yield from _problems_of_length(schedule)
    yield from _problems_of_resolution(schedule)
    if schedule.reset_every > 0 and not population.min_opacity < RESET_OPACITY:
        yield (
            f"population.min_opacity: must be below {RESET_OPACITY}, the cap of schedule.reset_every, or all "
            f"Gaussians are pruned; got {population.min_opacity}"
        )
    if config.loss.opacity > 0 and config.loss.opacity_total > 0:
        yield (
            f"loss.opacity: loss.opacity_total ({config.loss.opacity_total:g}) sets it by the number of "
            f"views; for {config.loss.opacity:g}, add --loss.opacity_total=0"
        )
    if population.strategy == "relocation" and population.gate is not None:
        yield "population.gate: withholds candidates of population.strategy=density; relocation has none"
    if config.view.lod not in (False, True, "smooth"):
        yield f"view.lod: must be true, false or smooth, got {config.view.lod}"
    if config.view.cull and not population.importance:
        yield "view.cull: needs population.importance=true, whose passes make the mask"
    t1, t2 = config.schedule.t1, config.schedule.t2
    if population.importance and 0 < t2 <= t1 < config.schedule.iterations:
        yield f"schedule.t2: the second pass must come after the first (schedule.t1), got {t2} and {t1}"


def _numbers(value: Any) -> list[Any]:
    return [number for part in value for number in _numbers(part)] if isinstance(value, tuple) else [value]


def _problems_of_length(schedule: ScheduleConfig) -> Iterator[str]:
    images = [image for image, _ in schedule.pace]
    if any(image >= after for image, after in itertools.pairwise([0, *images])):
        yield f"schedule.pace: its images must be above 0 and increase, got {images}"
    factors = [factor for _, factor in schedule.pace]
    if wrong := [factor for factor in factors if factor not in SCALE]:
        yield f"schedule.pace: its factors must be {SCALE}, got {wrong[0]}"
    stretch = MAX_STRETCH if schedule.images_per_view > 0 else 1.0
    total = schedule.iterations * schedule.scale * stretch * max([1.0, *factors])
    if total > MAX_IMAGES:
        most = f"must be at most {MAX_IMAGES:,} images, got {total:,.0f}"
        yield f"schedule.iterations: times schedule.scale {most}"
    if schedule.minutes > 0 and schedule.scale != 1.0:
        yield (
            f"schedule.scale: must be 1 with schedule.minutes (--minutes), which chooses the scale; got "
            f"{schedule.scale}: add --schedule.scale=1 or leave out the minutes"
        )


def _problems_of_resolution(schedule: ScheduleConfig) -> Iterator[str]:
    factors, times = [pair[0] for pair in schedule.resolution], [pair[1] for pair in schedule.resolution]
    if any(factor not in REDUCTIONS for factor in factors) or factors != sorted(set(factors), reverse=True):
        yield f"schedule.resolution: its factors must be 8, 4 or 2 and decrease, got {factors}"
    if times != sorted(set(times)):
        yield f"schedule.resolution: its times must increase, got {times}"


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested dictionaries by names such as "section.field"."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        found |= flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return found


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
    if name in _SECTIONS:
        return _section(name)
    found = [field for field in _HINTS if name in (field, field.rpartition(".")[2])]
    if not found:
        known = [field if "." in name else field.rpartition(".")[2] for field in _HINTS]
        close = difflib.get_close_matches(name, dict.fromkeys([*known, *_SECTIONS]), n=3)
        hint = f"did you mean {', '.join(close)}?" if close else "--help-fields describes all fields"
        raise ConfigError(f"{name}: there is no such field of the configuration; {hint}")
    return "\n\n".join(map(_field, found))


def describe_all() -> str:
    """Describe all sections and fields."""
    return "\n\n\n".join(map(_section, _SECTIONS))


def describe_page() -> str:
    """Return docs/configuration.md: the first sentence about every field, in a table for each section."""
    parts = [_PAGE_HEAD]
    for section in _SECTIONS:
        if section:
            parts.append(f"## {section}\n\n{_about(section).partition(chr(10))[0]}")
        rows = ["field|default|meaning", "---|---|---"]
        for names, meaning in _entries(section).items():
            fields = ", ".join(f"`{name}`" for name in names)
            defaults = ", ".join(f"`{_default(name)}`" for name in names)
            rows.append(f"{fields}|{defaults}|{_first_clause(meaning)}")
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _first_clause(text: str) -> str:
    """Return a text up to the first semicolon or full stop outside of parentheses."""
    ends = re.finditer(r";|\.(?= [A-Z0-9]|$)", text)
    clauses = (text[: end.start()] for end in ends)
    return next((clause for clause in clauses if clause.count("(") == clause.count(")")), text)


def _section(section: str) -> str:
    about = f"{section}: {_about(section)}" if section else _about(section)
    fields = [name for name in _HINTS if name.rpartition(".")[0] == section]
    return "\n\n".join([about, *map(_field, fields)])


def _about(section: str) -> str:
    return (inspect.getdoc(_SECTIONS[section]) or "").partition("\nAttributes:")[0].strip()


def _field(name: str) -> str:
    """Return a line with default, kind and allowed values, and the meaning below it."""
    names, meaning = next(entry for entry in _entries(name.rpartition(".")[0]).items() if name in entry[0])
    # Fields that share their meaning begin with all their names.
    text = (f"({', '.join(name.rpartition('.')[2] for name in names)}) " if len(names) > 1 else "") + meaning
    head = f"--{name}={_default(name)}   ({_type(_HINTS[name])})"
    return f"{head}\n{textwrap.indent(textwrap.fill(text, _WIDTH), '    ')}"


def _default(name: str) -> str:
    value = flat(dataclasses.asdict(Config()))[name]
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(plain, default_flow_style=True).split("\n...")[0].strip()


def _type(hint: Any) -> str:
    """Return the kind of a field's values, and those that are allowed, as text."""
    origin, options = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return f"{_type(options[0])}, {options[1]}"
    if origin is Literal:
        return f"one of {', '.join(options)}"
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_type, options))
    if origin is tuple:
        return "list" if options[-1] is Ellipsis else f"list of {len(options)}"
    return _KINDS[hint]


def _entries(section: str) -> dict[tuple[str, ...], str]:
    """Return the meaning of the fields that share one, from the part "Attributes:" of a docstring."""
    text = (inspect.getdoc(_SECTIONS[section]) or "").partition("Attributes:\n")[2]
    entries: dict[tuple[str, ...], str] = {}
    for entry in filter(str.strip, re.split(r"^    (?=\S)", text, flags=re.MULTILINE)):
        names, _, meaning = entry.partition(":")
        fields = tuple(f"{section}.{name.strip()}".lstrip(".") for name in names.split(","))
        entries[fields] = " ".join(meaning.split())
    return entries
