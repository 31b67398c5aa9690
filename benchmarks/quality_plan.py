# SPDX-License-Identifier: Apache-2.0
"""Lists the runs of `bm_quality.py`: captures x recipes x seeds.

The stress grid says how far a recipe is from losing what it has learnt: every capture x schedule x change of
one value x batch size; a column has one capture and one value of the grid's other axes. A cell has the
held-out PSNR, and the largest fall of the training PSNR below its running best
(`blitzgs.training.state.Curve.fall`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import shlex
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from harness import markdown_table
from opponents.gsplat_training import STRATEGIES, GsplatOptions

from blitzgs.config.fields import Config
from blitzgs.config.files import ConfigError, load_config, to_dict

OPPONENT = "gsplat-"
PARTITION = "partition-"
DEFAULTS = "defaults"
SAFE = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-+=")

SCHEDULES = (0.15, 0.25, 0.5, 1.0)
FACTORS = (0.5, 2.0)
BATCHES = (1, 4, 16)
STRESS_SEEDS = (0, 1)
# Name in the table and field; one at a time is halved and doubled.
VALUES = {
    "opacity": "optimiser.opacity",
    "position": "optimiser.position",
    "growth": "population.growth",
    "noise": "optimiser.position_noise",
}


@dataclass(frozen=True)
class RunSpec:
    """One run, as it is passed to its process."""

    capture: str  # its name
    data: list[str]  # overrides of the section `data`, including the path
    recipe: str  # its name
    # A YAML file, "defaults", "gsplat-" and one of gsplat's strategies, or "partition-COLUMNSxROWS:" and a
    # YAML file or "defaults".
    source: str
    overrides: list[str]  # "--section.field=value" of the configuration, or "--option=value" of the opponent
    seed: int
    evaluate_at: list[int]  # image counts at which held-out views are measured, in addition to the end
    lpips: str | None  # TorchScript file
    device: str
    ranks: int = 1  # processes (and GPUs) that train together

    @property
    def strategy(self) -> str | None:
        """The opponent's strategy; None when BlitzGS trains."""
        return self.source.removeprefix(OPPONENT) if self.source.startswith(OPPONENT) else None

    @property
    def grid(self) -> tuple[int, int] | None:
        """Columns and rows of a spatial partition; None where the whole scene is trained."""
        if not self.source.startswith(PARTITION):
            return None
        shape = self.source.removeprefix(PARTITION).partition(":")[0].split("x")
        if len(shape) != 2 or not all(number.isdigit() and int(number) > 0 for number in shape):
            raise ValueError(f"{self.source}: write partition-COLUMNSxROWS:SOURCE, as partition-4x5:defaults")
        return int(shape[0]), int(shape[1])

    def config(self) -> Config:
        """Return the training's configuration; an opponent's has the capture alone."""
        own = [] if self.strategy is not None else [*self.overrides, f"seed={self.seed}"]
        log = ["log.tensorboard=false", "log.checkpoint_seconds=0"]
        log += ["schedule.checkpoint_every=0", "schedule.evaluate_every=0"]
        source = self.source if self.grid is None else self.source.partition(":")[2]
        path = None if self.strategy is not None or source == DEFAULTS else source
        return load_config(path, [*own, *self.data, *log])

    def options(self) -> GsplatOptions:
        """Return the options of an opponent."""
        assert self.strategy is not None
        return GsplatOptions.of(self.strategy, parse_flags(self.overrides))

    @property
    def settings(self) -> str:
        """A digest of all settings that decide the result; without seed, code and folder of the capture."""
        values: dict[str, Any] = to_dict(self.config())
        del values["log"], values["data"]["path"], values["seed"]
        if self.strategy is not None:
            values = {"data": values["data"], "strategy": self.strategy} | dataclasses.asdict(self.options())
        if self.grid is not None:
            values["grid"] = self.grid
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:8]

    @property
    def name(self) -> str:
        """The name of the run's files."""
        together = f".r{self.ranks}" if self.ranks > 1 else ""
        return f"{self.capture}.{self.recipe}.s{self.seed}.{self.settings}{together}"


def parse_flags(flags: Iterable[str]) -> dict[str, Any]:
    """Return {"option": value} of "--option=value" texts, the values read as YAML."""
    values = {}
    for flag in flags:
        name, equals, value = flag.lstrip("-").partition("=")
        if not equals:
            raise ValueError(f"'{flag}' is not an option: write --name=value")
        values[name] = yaml.safe_load(value)
    return values


def parse_named(text: str) -> tuple[str, str]:
    """Split "NAME=rest" (ValueError: there is no name, or the name cannot be part of a file name)."""
    name, equals, rest = text.partition("=")
    if not equals or not name or not set(name) <= SAFE or not rest.strip():
        raise ValueError(f"'{text}': write NAME=..., with a name of letters, digits and _-+")
    return name, rest


def runs_of(
    captures: Mapping[str, str],
    recipes: Mapping[str, str],
    seeds: Sequence[int],
    evaluate_at: Sequence[int],
    lpips: Path | None,
    device: str,
    ranks: int = 1,
) -> list[RunSpec]:
    """Return every run, checked; all recipes and captures of one seed come before the next seed.

    `captures`: name -> "DIR [--data.field=value ...]". `recipes`: name -> "SOURCE [--field=value ...]". The
    others are as in `RunSpec`. ValueError: an argument is missing or cannot be used; the message names it.
    """
    if not captures or not recipes or not seeds:
        raise ValueError("nothing to train: give at least one --capture, one --recipe and one seed")
    specs = []
    for seed in seeds:
        for recipe, recipe_text in recipes.items():
            source, *overrides = shlex.split(recipe_text)
            for capture, capture_text in captures.items():
                folder, *fields = shlex.split(capture_text)
                if not Path(folder).is_dir():
                    raise ValueError(f"capture {capture}: {folder} is not a folder")
                spec = RunSpec(
                    capture=capture,
                    data=[f"data.path={json.dumps(str(Path(folder).resolve()))}", *fields],
                    recipe=recipe,
                    source=source,
                    overrides=overrides,
                    seed=seed,
                    evaluate_at=sorted(set(evaluate_at)),
                    lpips=None if lpips is None else str(lpips.resolve()),
                    device=device,
                    ranks=ranks,
                )
                check(spec)
                specs.append(spec)
    return specs


def check(spec: RunSpec) -> None:
    """Raise ValueError when a run cannot be configured."""
    if spec.strategy is not None and spec.strategy not in STRATEGIES:
        known = ", ".join(OPPONENT + name for name in STRATEGIES)
        raise ValueError(f"recipe {spec.recipe}: there is no opponent {spec.source}; known are {known}")
    if spec.ranks > 1 and (spec.strategy is not None or spec.grid is not None):
        raise ValueError(f"recipe {spec.recipe}: {spec.source} trains on one rank, not on {spec.ranks}")
    try:
        spec.config()
        if spec.strategy is not None:
            spec.options()
    except ConfigError as error:
        raise ValueError(f"recipe {spec.recipe} on capture {spec.capture}: {error}") from error


def stress_recipes(source: str) -> dict[str, str]:
    """Return the grid's recipes, name -> source and overrides, the present values first.

    Names have no dots: factors and schedules are in per cent. `source`: file whose values are changed.
    """
    config = load_config(source)
    changes = [("base", "")]
    for factor, (name, field) in itertools.product(FACTORS, VALUES.items()):
        section, value = field.split(".")
        changed = factor * getattr(getattr(config, section), value)
        changes.append((f"{name}={factor:.0%}".rstrip("%"), f" --{field}={changed:.8g}"))
    return {
        f"{change}+schedule={round(100 * scale)}+B={batch}": (
            f"{source} --schedule.scale={scale:g} --schedule.batch_size={batch}{override}"
        )
        for (change, override), scale, batch in itertools.product(changes, SCHEDULES, BATCHES)
    }


def stress_markdown(runs: Sequence[dict[str, Any]]) -> str:
    """Return the stress table: worst PSNR and largest fall over the seeds, and the loss against the column.

    Runs that are not of the grid are left out.
    """
    cells: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for run in runs:
        change, _, column = run["recipe"].partition("+")
        if run["status"] == "done" and column:
            cells[run["capture"], column, change].append(run)
    worst = {key: min(end_of(run)["psnr"] for run in group) for key, group in cells.items()}
    rows = []
    for (capture, column, change), group in sorted(cells.items()):
        best = max(value for key, value in worst.items() if key[:2] == (capture, column))
        psnr = worst[capture, column, change]
        rows.append(
            {
                "capture": capture,
                "schedule, batch": column,
                "change": change,
                "seeds": len(group),
                "PSNR": f"{psnr:.2f}",
                "below the column's best": f"{best - psnr:.2f}",
                "largest fall": f"{max(run['largest_fall'] for run in group):.2f}",
            }
        )
    return markdown_table(rows) + "\n"


def end_of(run: dict[str, Any]) -> dict[str, Any]:
    """Return the last metrics of a run: of its held-out views, or of all views if none is held out."""
    last = run["evaluations"][-1]
    return last.get("test", last.get("train"))
