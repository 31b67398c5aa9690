# SPDX-License-Identifier: Apache-2.0
"""Reads configurations from recipes, YAML files and `--section.field=value` overrides, and checks them."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import hashlib
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from blitzgs.config.fields import FORK, POSITION_LEFT, SH_SHARE, Config, LossConfig
from blitzgs.config.fields import ConfigError as ConfigError
from blitzgs.config.ranges import flat as flat
from blitzgs.config.ranges import problems
from blitzgs.util.output import write_file

T = typing.TypeVar("T")
# Marks a removed field whose values have no effect any more.
IGNORED = object()


@dataclasses.dataclass(frozen=True)
class Share:
    """Marks a removed field whose value is now a share of another field's."""

    field: str
    share: float

    def __repr__(self) -> str:
        return f"{self.share:g} times {self.field}"


# Fields of earlier versions, each with the value that stands for what BlitzGS does now. Files and checkpoints
# that have this value are still read.
REMOVED: Mapping[str, Any] = {
    "data.threads": IGNORED,
    "data.prefetch": IGNORED,
    "model.far": 1e6,
    "model.eps2d": 0.3,
    "model.initial_opacity": 0.1,
    "model.scale_floor": 0.0,
    "lod.base_resolution": 0.001,
    "lod.fork": FORK,
    "schedule.adaptive": False,
    "schedule.adaptive_limit": IGNORED,
    "schedule.placed": [],
    "schedule.levels_until": 0,
    "optimiser.final_share": 1.0,
    "optimiser.beta1": 0.9,
    "optimiser.beta2": 0.999,
    "optimiser.eps": 1e-15,
    "optimiser.sparse": False,
    "optimiser.position_final": Share("optimiser.position", POSITION_LEFT),
    "optimiser.sh_rest": Share("optimiser.sh_dc", SH_SHARE),
    "loss.size": 0.0,
    "loss.scale_reference": 10.0,
    "population.absolute_gradients": False,
    "population.absolute_threshold": IGNORED,
    "population.relocate": False,
    "population.opacity_decay": 0.0,
    "population.reset_opacity": 0.01,
    "view.first_levels": IGNORED,
    "view.most_kept": 0.8,
    "view.level_ratio": IGNORED,
    "view.smooth": False,
    "ranks.half_exchange": False,
    "ranks.max_imbalance": IGNORED,
    "ranks.share_gpus": IGNORED,
    "log.pictures": IGNORED,
    "log.lpips_weights": IGNORED,
}


def load_config(path: Path | str | None = None, overrides: Iterable[str] = ()) -> Config:
    """Build a configuration from the defaults, then a YAML file, then overrides, "section.field=value".

    A file may name another one under `base` (relative to itself, or the name of a recipe); it then changes
    the values of that file. Values of overrides are YAML; leading dashes are allowed. ConfigError: an unknown
    field, an ill-typed or impossible value, or an unreadable file.
    """
    values: dict[str, Any] = {}
    if path is not None:
        values = _read(Path(path), set())
        try:
            build(Config, values)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    for text in overrides:
        name, equals, value = text.lstrip("-").partition("=")
        if not equals:
            raise ConfigError(f"'{text}' is not an override: write --section.field=value")
        try:
            parsed = yaml.load(value, _Loader)
        except _UNREADABLE as error:
            raise ConfigError(f"{name}: cannot read the value '{value}': {error}") from error
        for part in reversed(name.split(".", 2)):
            parsed = {part: parsed}
        _merge(values, parsed, name)
    config = from_dict(values)
    for problem in problems(config):
        raise ConfigError(problem)
    return config


def from_dict(values: dict[str, Any]) -> Config:
    """Rebuild a configuration from `to_dict`'s nested dictionary; raises ConfigError like `load_config`."""
    return build(Config, values)


def to_dict(config: Config) -> dict[str, Any]:
    """Return the configuration as nested dictionaries of JSON-able values."""
    return typing.cast(dict[str, Any], json.loads(json.dumps(dataclasses.asdict(config))))


def changed(config: Config, section: str, **fields: Any) -> Config:
    """Return a configuration with other values of some fields of a section."""
    return dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), **fields)})


def save_config(config: Config, path: Path) -> None:
    """Write the resolved configuration as YAML; `load_config` reads it back to the same object."""
    write_file(path, yaml.safe_dump(to_dict(config), sort_keys=False))


def config_hash(config: Config) -> str:
    """Return the first 16 hex digits of the SHA-256 of the resolved configuration."""
    return hashlib.sha256(json.dumps(to_dict(config), sort_keys=True).encode()).hexdigest()[:16]


class _Loader(yaml.SafeLoader):
    """A YAML loader that refuses duplicate keys, of which PyYAML silently keeps the last.

    A number whose usual form is another one, and a date, stay text: 100_0001 may be the name of a folder.
    References to sections and lists are refused: a few lines of them stand for more than memory holds.
    """

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node as the parent class does; a reference to a section or a list is an error."""
        is_reference = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        if is_reference and isinstance(node, yaml.CollectionNode):
            text = "a reference repeats this section or list: write it out"
            raise yaml.MarkedYAMLError(problem=text, problem_mark=node.start_mark)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping as the parent class does; a duplicate key is an error."""
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                text = f"the key '{key.value}' is given twice"
                raise yaml.MarkedYAMLError(problem=text, problem_mark=key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> int | float | str:
        """Return the number if Python writes it as the file does, else its text, which `_convert` reads."""
        is_int = node.tag == "tag:yaml.org,2002:int"
        value: int | float = self.construct_yaml_int(node) if is_int else self.construct_yaml_float(node)
        not_finite = isinstance(value, float) and not math.isfinite(value)
        return value if not_finite or str(value) == node.value else node.value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_number)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_number)
_Loader.add_constructor("tag:yaml.org,2002:timestamp", lambda _, node: node.value)

# Errors that PyYAML raises for text that is not YAML or has a value that Python cannot represent.
_UNREADABLE = (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError)


def _read(path: Path, seen: set[Path]) -> dict[str, Any]:
    path = path.resolve()
    if path in seen:
        raise ConfigError(f"{path}: 'base' leads back to the same file")
    try:
        values = yaml.load(path.read_text(encoding="utf-8-sig"), _Loader) or {}
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the configuration: {error.strerror}") from error
    except _UNREADABLE as error:
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: must hold sections, got {type(values).__name__}")
    base = values.pop("base", None)
    if base is None:
        return values
    if not isinstance(base, str):
        raise ConfigError(f"{path}: base must be a file name or the name of a recipe, got {base!r}")
    # A file beside this one, or a recipe; a copy of a recipe's file names its base with ".yaml".
    found = path.parent / base
    if not found.is_file():
        problem = f"{path}: base: {base}: no such file in {path.parent} and no such recipe"
        found = _recipe(base.removesuffix(".yaml"), problem)
    merged = _read(found, seen | {path})
    _merge(merged, values, str(path))
    return merged


def _merge(target: dict[str, Any], changes: dict[str, Any], where: str) -> None:
    for name, value in changes.items():
        if isinstance(value, dict):
            section = target.setdefault(name, {})
            if not isinstance(section, dict):
                raise ConfigError(f"{where}: '{name}' is a value, not a section")
            _merge(section, value, where)
        else:
            target[name] = value


def build(kind: type[T], values: Any, where: str = "") -> T:
    """Return a dataclass of the fields of a section, nested too (ConfigError: names the field in `where`)."""
    hints = typing.get_type_hints(kind)
    if not isinstance(values, dict):
        name = where or "configuration"
        raise ConfigError(f"{name}: must be a section with {', '.join(hints)}; got {values!r:.80}")
    if where == "loss":
        values = _in_todays_unit(values)
    arguments = {}
    for name, value in values.items():
        path = f"{where}.{name}" if where else str(name)
        if path in REMOVED:
            # A value that stood for what BlitzGS does without the field changes nothing.
            if without_effect(path, value, {f"{where}.{other}": found for other, found in values.items()}):
                continue
            raise ConfigError(
                f"{path}: this field was removed: BlitzGS now does what {REMOVED[path]!r} stood for, got "
                f"{value!r}; leave the field out, or go on with a run that was trained with it by the "
                "version that wrote it"
            )
        if name not in hints:
            raise ConfigError(f"{path}: unknown field; {_hint(str(name), list(hints))}")
        arguments[name] = _convert(hints[name], value, path)
    return kind(**arguments)


def _in_todays_unit(loss: dict[str, Any]) -> dict[str, Any]:
    """Convert `loss.scale` of an earlier version, whose unit was the field `scale_reference`."""
    unit, scale = loss.get("scale_reference"), loss.get("scale", LossConfig.scale)
    if not (isinstance(unit, (int, float)) and unit > 0 and isinstance(scale, (int, float))):
        return loss
    return {**loss, "scale_reference": 10.0, "scale": scale * 10.0 / unit}


def without_effect(name: str, value: Any, values: Mapping[str, Any]) -> bool:
    """Tell whether a field is a removed one, with a value that stood for what BlitzGS does now.

    `values` has the fields given beside it, "section.field": value.
    """
    if name not in REMOVED:
        return False
    known = REMOVED[name]
    if isinstance(known, Share):
        whole = values.get(known.field, flat(to_dict(Config()))[known.field])
        return math.isclose(_convert(float, value, name), known.share * _convert(float, whole, known.field))
    found = _convert(float, value, name) if isinstance(known, float) else value
    return known is IGNORED or bool(found == known)


def _hint(name: str, known: list[str]) -> str:
    """Return what may have been meant by an unknown name: a similar one, else a field of another section."""
    if close := difflib.get_close_matches(name, known, n=1):
        return f"did you mean '{close[0]}'?"
    fields = [field for field in flat(to_dict(Config())) if field.rpartition(".")[2] == name]
    return f"did you mean '{fields[0]}'?" if fields else f"known: {', '.join(known)}"


def _convert(hint: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, path)
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        if value not in options:
            raise ConfigError(f"{path}: must be one of {', '.join(options)}, got {value!s:.80}")
        return value
    if origin in (types.UnionType, typing.Union):
        if value is None or (isinstance(value, bool) and bool in options):
            return value
        return _convert(next(option for option in options if option is not type(None)), value, path)
    if origin in (dict, list):
        hint = origin
    if origin is tuple:
        if options[-1] is Ellipsis and isinstance(value, (list, tuple)):
            options = options[:1] * len(value)
        if not isinstance(value, (list, tuple)) or len(value) != len(options):
            raise ConfigError(f"{path}: must be a list of {len(options)} values, got {value!r:.80}")
        return tuple(_convert(o, v, f"{path}[{i}]") for i, (o, v) in enumerate(zip(options, value)))  # noqa: B905
    if hint in (int, float) and isinstance(value, str):
        # YAML 1.1 reads 1e-4 as a string. An integer keeps all its digits, which a float may not hold.
        text = value
        for kind in (float, int):
            with contextlib.suppress(ValueError):
                value = kind(text)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ConfigError(f"{path}: {value!r:.80} is too large") from None
    if hint is str and isinstance(value, (int, float)) and not isinstance(value, bool):
        return str(value)
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        kinds: dict[type, str] = {int: "an integer", float: "a number", bool: "true or false", str: "text"}
        kinds |= {dict: "a section", list: "a list"}
        raise ConfigError(f"{path}: must be {kinds[hint]}, got {value!r:.80} ({type(value).__name__})")
    return value


# The name that stands for the default of every field, without a file.
DEFAULTS = "defaults"
_PACKAGE = Path(__file__).resolve().parent.parent
# In an installed package and in a checkout (setup.py copies the files).
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


def recipe_names() -> list[str]:
    """Return the names of the recipes, in alphabetical order."""
    return sorted({path.stem for folder in _FOLDERS for path in folder.glob("*.yaml")})


def recipe_path(given: str) -> Path | None:
    """Return the YAML file of a path or of a name of `recipe_names`; None for `DEFAULTS`."""
    if Path(given).is_file():
        return Path(given)
    return None if given == DEFAULTS else _recipe(given, f"{given}: no such file or recipe")


def _recipe(name: str, problem: str) -> Path:
    """Return the file of a recipe (ConfigError: there is none of this name; `problem` begins the message)."""
    files = (folder / f"{name}.yaml" for folder in _FOLDERS if "/" not in name)
    if (found := next((file for file in files if file.is_file()), None)) is not None:
        return found
    known = [*recipe_names(), DEFAULTS]
    close = difflib.get_close_matches(Path(name).stem, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    raise ConfigError(f"{problem}; {hint}recipes are {', '.join(known)}")
