# SPDX-License-Identifier: Apache-2.0
"""Configurations from YAML files and `--section.field=value` overrides, checked against the dataclasses."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import math
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import yaml

from blitzgs.distributed.group import Transport
from blitzgs.output import write_file
from blitzgs.training.config import Config


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the field, the value and the remedy."""


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """Build a configuration from the defaults, a YAML file and overrides, in this order.

    Args:
        path: YAML file with sections as in `Config`, or None. A file may name another one under `base`
            (relative to itself) whose values it changes.
        overrides: "section.field=value" with a YAML value; leading dashes are allowed.

    Raises:
        ConfigError: unknown field, ill-typed or impossible value, unreadable file.
    """
    values: dict[str, Any] = {}
    if path is not None:
        values = _read(Path(path), set())
    for text in overrides:
        name, equals, value = text.lstrip("-").partition("=")
        if not equals:
            raise ConfigError(f"'{text}' is not an override: write --section.field=value")
        try:
            _merge(values, _nest(name.split("."), yaml.safe_load(value)), name)
        except yaml.YAMLError as error:
            raise ConfigError(f"{name}: cannot read the value '{value}': {error}") from error
    config: Config = _build(Config, values, "")
    _check(config)
    return config


def from_dict(values: dict[str, Any]) -> Config:
    """Rebuild a configuration from `to_dict`'s nested dictionary; raises ConfigError like `load_config`."""
    config: Config = _build(Config, values, "")
    return config


def to_dict(config: Config) -> dict[str, Any]:
    """Return the configuration as nested dictionaries of JSON-able values."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return result


def save_config(config: Config, path: Path) -> None:
    """Write the resolved configuration as YAML; `load_config` reads it back to the same object."""
    write_file(path, yaml.safe_dump(to_dict(config), sort_keys=False))


def config_hash(config: Config) -> str:
    """First 16 hex digits of the SHA-256 of the resolved configuration."""
    return hashlib.sha256(json.dumps(to_dict(config), sort_keys=True).encode()).hexdigest()[:16]


def _read(path: Path, seen: set[Path]) -> dict[str, Any]:
    path = path.resolve()
    if path in seen:
        raise ConfigError(f"{path}: 'base' leads back to the same file")
    try:
        values = yaml.safe_load(path.read_text()) or {}
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: must hold sections, got {type(values).__name__}")
    base = values.pop("base", None)
    if base is None:
        return values
    if not isinstance(base, str):
        raise ConfigError(f"{path}: base must be a file name, got {base!r}")
    merged = _read(path.parent / base, seen | {path})
    _merge(merged, values, str(path))
    return merged


def _nest(names: list[str], value: Any) -> dict[str, Any]:
    return {names[0]: value if len(names) == 1 else _nest(names[1:], value)}


def _merge(target: dict[str, Any], changes: dict[str, Any], where: str) -> None:
    for name, value in changes.items():
        if isinstance(value, dict):
            section = target.setdefault(name, {})
            if not isinstance(section, dict):
                raise ConfigError(f"{where}: '{name}' is a value, not a section")
            _merge(section, value, where)
        else:
            target[name] = value


def _build(kind: type, values: Any, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    if not isinstance(values, dict):
        raise ConfigError(
            f"{where or 'configuration'}: must be a section with {', '.join(hints)}; got {values!r}"
        )
    arguments = {}
    for name, value in values.items():
        path = f"{where}.{name}" if where else str(name)
        if name not in hints:
            close = difflib.get_close_matches(str(name), hints, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(hints)}"
            raise ConfigError(f"{path}: unknown field; {hint}")
        arguments[name] = _convert(hints[name], value, path)
    return kind(**arguments)


def _convert(hint: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, path)
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return None
        return _convert(next(option for option in options if option is not type(None)), value, path)
    if origin is tuple:
        if not isinstance(value, (list, tuple)) or len(value) != len(options):
            raise ConfigError(f"{path}: must be a list of {len(options)} values, got {value!r}")
        return tuple(
            _convert(o, v, f"{path}[{i}]") for i, (o, v) in enumerate(zip(options, value, strict=True))
        )
    if hint is float and isinstance(value, str):
        # YAML 1.1 reads 1e-4 as a string.
        try:
            return float(value)
        except ValueError:
            pass
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is str and isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"{path}: must be {_kind(hint)}, got {value!r} ({type(value).__name__})")
    return value


def _kind(hint: type) -> str:
    return {int: "an integer", float: "a number", bool: "true or false", str: "text"}.get(hint, hint.__name__)


def _check(config: Config) -> None:
    schedule, population = config.schedule, config.population
    rules = [
        (0 <= config.model.sh_degree <= 3, "model.sh_degree", config.model.sh_degree, "0, 1, 2 or 3"),
        (0 < config.model.near < config.model.far, "model.near", config.model.near, "positive and below far"),
        (
            0 < config.model.initial_opacity < 1,
            "model.initial_opacity",
            config.model.initial_opacity,
            "between 0 and 1",
        ),
        (config.data.downscale >= 1, "data.downscale", config.data.downscale, "1 or more"),
        (config.data.threads >= 1, "data.threads", config.data.threads, "1 or more"),
        (config.data.prefetch >= 0, "data.prefetch", config.data.prefetch, "0 or more"),
        (config.lod.fork > 1, "lod.fork", config.lod.fork, "above 1"),
        (schedule.iterations >= 1, "schedule.iterations", schedule.iterations, "1 or more"),
        (schedule.scale > 0, "schedule.scale", schedule.scale, "positive"),
        (1 <= schedule.batch_size <= 32, "schedule.batch_size", schedule.batch_size, "1 to 32"),
        (schedule.densify_every >= 1, "schedule.densify_every", schedule.densify_every, "1 or more"),
        (schedule.reset_every >= 0, "schedule.reset_every", schedule.reset_every, "0 (never) or more"),
        (schedule.sh_every >= 1, "schedule.sh_every", schedule.sh_every, "1 or more"),
        (schedule.position_decay >= 1, "schedule.position_decay", schedule.position_decay, "1 or more"),
        (
            0 < config.optimiser.final_share <= 1,
            "optimiser.final_share",
            config.optimiser.final_share,
            "in (0, 1]",
        ),
        (0 <= config.loss.ssim <= 1, "loss.ssim", config.loss.ssim, "between 0 and 1"),
        (config.loss.scale_reference > 0, "loss.scale_reference", config.loss.scale_reference, "positive"),
        (
            population.min_opacity < population.reset_opacity < 1,
            "population.reset_opacity",
            population.reset_opacity,
            f"between population.min_opacity ({population.min_opacity}) and 1, or all Gaussians are pruned",
        ),
        (
            0 <= population.opacity_decay < 1,
            "population.opacity_decay",
            population.opacity_decay,
            "in [0, 1)",
        ),
        (
            population.max_gaussians >= 0,
            "population.max_gaussians",
            population.max_gaussians,
            "0 (no cap) or more",
        ),
        (0 < population.pass1_keep <= 1, "population.pass1_keep", population.pass1_keep, "in (0, 1]"),
        (0 < population.pass2_mass <= 1, "population.pass2_mass", population.pass2_mass, "in (0, 1]"),
        (schedule.t1 >= 0, "schedule.t1", schedule.t1, "0 (none) or more"),
        (schedule.t2 >= 0, "schedule.t2", schedule.t2, "0 (none) or more"),
        (
            config.ranks.transport in get_args(Transport),
            "ranks.transport",
            config.ranks.transport,
            "one of " + ", ".join(get_args(Transport)),
        ),
        (config.log.every >= 1, "log.every", config.log.every, "1 or more"),
        (config.log.keep_checkpoints >= 1, "log.keep_checkpoints", config.log.keep_checkpoints, "1 or more"),
    ]
    for name in ("position", "position_final", "sh_dc", "sh_rest", "opacity", "scale", "rotation", "eps"):
        rate = getattr(config.optimiser, name)
        rules.append((0 <= rate < math.inf, f"optimiser.{name}", rate, "0 or more, and finite"))
    for name in ("beta1", "beta2"):
        beta = getattr(config.optimiser, name)
        rules.append((0 <= beta < 1, f"optimiser.{name}", beta, "in [0, 1)"))
    for fine, name, value, wanted in rules:
        if not fine:
            raise ConfigError(f"{name}: must be {wanted}, got {value}")
