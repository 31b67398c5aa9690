# SPDX-License-Identifier: Apache-2.0
"""The allowed values of every configuration field, and the description of fields for --help.

A test checks that every field has an entry. The limits exclude values that cannot work (an infinite rate, an
opacity of 2) or that would exhaust memory or never end; they are far from any sensible value.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import itertools
import math
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, get_args

import yaml

from blitzgs.config.fields import (
    MAX_STRETCH,
    RESET_OPACITY,
    Config,
    ConfigError,
    ScheduleConfig,
    ScoreRule,
    Transport,
)


@dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`; an end that is open is excluded."""

    low: float
    high: float
    low_open: bool = False
    high_open: bool = False

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.low_open else value >= self.low
        return above and (value < self.high if self.high_open else value <= self.high)

    def __str__(self) -> str:
        brackets = "(" if self.low_open else "[", ")" if self.high_open else "]"
        return f"in {brackets[0]}{self.low:,.12g}, {self.high:,.12g}{brackets[1]}"


# Factors of `schedule.resolution`: float32 intrinsics are divided by them exactly.
REDUCTIONS = (2, 4, 8)
# Images of a whole run: its table of learning rates takes 48 bytes a step.
MAX_IMAGES = 10_000_000
SCALE = Range(1e-4, 1e4)

_FIELDS: Mapping[Range, str] = {
    Range(0, 1): "model.background optimiser.position loss.ssim population.gate_rate",
    Range(0, 1, high_open=True): "lod.visible_threshold population.min_opacity",
    Range(0, 1, low_open=True): "population.pass1_keep population.pass2_mass population.pass2_keep",
    Range(0, 3): "model.sh_degree",
    Range(0, 10): "optimiser.sh_dc optimiser.opacity optimiser.scale optimiser.rotation population.growth",
    Range(0, 1000): "view.footprint",
    Range(0, 1e6): "model.near schedule.images_per_view schedule.minutes loss.opacity loss.opacity_total "
    "loss.scale population.clone_scale population.prune_screen_radius population.prune_world_scale "
    "population.gaussians_per_point population.pass2_views memory.resident_gb",
    Range(0, 1e9): "schedule.densify_from schedule.densify_until schedule.size_prune_after "
    "schedule.reset_every schedule.gate_from schedule.t1 schedule.t2 schedule.checkpoint_every "
    "schedule.evaluate_every population.pixels_per_gaussian log.checkpoint_seconds",
    Range(0, 1e11): "population.max_gaussians",
    Range(0, 1e12): "optimiser.position_noise",
    Range(0, 1e30): "population.grad_threshold",
    Range(0, 2**50): "data.cache_bytes",
    Range(0, 2**63 - 1): "seed",
    Range(1e-9, 1): "optimiser.final",
    Range(1e-6, 1e6): "loss.scale_reference",
    SCALE: "schedule.scale",
    Range(1e-4, 1e9): "schedule.pace",
    Range(1, 32): "schedule.batch_size",
    Range(1, 1000): "data.downscale",
    Range(1, 1e6): "population.min_observations ranks.timeout_seconds log.keep_checkpoints",
    Range(1, 1e9): "schedule.iterations schedule.resolution schedule.densify_every schedule.sh_every "
    "schedule.position_decay log.every",
}
RANGES: Mapping[str, Range] = {name: found for found, names in _FIELDS.items() for name in names.split()}

CHOICES: Mapping[str, tuple[str, ...]] = {
    "data.undistort": ("crop", "mask"),
    "data.exif": ("auto", "apply", "ignore"),
    "data.stray_cameras": ("drop", "keep"),
    "ranks.transport": get_args(Transport),
    "population.strategy": ("density", "relocation"),
    "population.score": get_args(ScoreRule),
    "population.gate_rule": ("rank", "sample"),
}


def problems(config: Config) -> Iterator[str]:
    """Name each field whose value makes no sense, with the value and what is allowed."""
    for name, value in flat(dataclasses.asdict(config)).items():
        if name in RANGES and not all(number in RANGES[name] for number in _numbers(value)):
            yield f"{name}: must be {RANGES[name]}, got {value}"
        if name in CHOICES and value not in CHOICES[name]:
            yield f"{name}: must be one of {', '.join(CHOICES[name])}, got {value}"
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


def _numbers(value: Any) -> list[Any]:
    """Return the values of nested tuples."""
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
    if not math.isnan(total) and total > MAX_IMAGES:
        yield (
            f"schedule.iterations: times schedule.scale must be at most {MAX_IMAGES:,} images, got "
            f"{total:,.0f}"
        )
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
    sections = _sections()
    if name in sections:
        return _section(name)
    fields = [(section, field) for section, kind in sections.items() for field in _fields(kind)]
    found = [(section, field) for section, field in fields if name in (field, _joined(section, field))]
    if not found:
        known = [_joined(section, field) if "." in name else field for section, field in fields]
        close = difflib.get_close_matches(name, dict.fromkeys([*known, *sections]), n=3)
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
    hints = typing.get_type_hints(kind)
    return {name: hint for name, hint in hints.items() if not dataclasses.is_dataclass(hint)}


def _joined(section: str, field: str) -> str:
    return f"{section}.{field}" if section else field


def _section(name: str) -> str:
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
