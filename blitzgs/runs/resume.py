# SPDX-License-Identifier: Apache-2.0
"""Compares the configuration of a run's checkpoint with another: what a run that goes on may change."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from blitzgs.config.fields import Config
from blitzgs.config.files import ConfigError, flat, from_dict, load_config, to_dict
from blitzgs.config.schedule import Schedule
from blitzgs.runs.checkpoint import names_of
from blitzgs.runs.checkpoint_files import DAMAGE, read_manifest
from blitzgs.runs.run_files import CHECKPOINTS
from blitzgs.util.errors import warn

# Sections and fields that a resumed run may change, because they do not change the result beyond rounding.
# The exception is `data.allow_missing`: a run whose photograph is lost could not be resumed without it.
FREE_FIELDS = (
    "log",
    "memory",
    "ranks",
    "data.path",
    "data.allow_missing",
    "data.cache_bytes",
    "schedule.checkpoint_every",
    "schedule.evaluate_every",
)


def compare_with_file(config: Config, path: Path) -> None:
    """Warn if a run's configuration file differs from the configuration in its checkpoint."""
    try:
        # The file has the pace of the run's beginning or, after its end, the final one.
        found = with_pace_of(load_config(path), config)
        fields = [name for name, *_ in _differences(config, found) if not _is_free(name)]
        what = f"differs in {', '.join(fields)}" if fields else ""
    except ConfigError as error:
        what = f"cannot be read ({error})"
    if what:
        warn(f"{path} {what}: the configuration in the checkpoint is used")


def check_resumable(saved: Config, wanted: Config, step: int) -> None:
    """Refuse a configuration that gives another result than that of a checkpoint after `step` steps.

    ConfigError: names a field.
    """
    # An extension that was killed before its first checkpoint has left its configuration.
    is_finished = step >= Schedule(saved.schedule).steps
    is_longer = is_finished and wanted.schedule.iterations > saved.schedule.iterations
    for name, old, new in _differences(saved, wanted):
        # The number of minutes may change: the rest of the run is then fitted into the rest of the new time.
        is_budget = name == "schedule.minutes" and old > 0 and new > 0
        is_longer_by = is_longer and (name == "schedule.iterations" or (name, new) == ("schedule.minutes", 0))
        if not (_is_free(name) or is_budget or is_longer_by):
            longer = name in ("schedule.scale", "schedule.iterations", "schedule.minutes")
            remedy = ", or train a finished run longer with --extend" if longer else ""
            raise ConfigError(
                f"{name}: the checkpoint was trained with {old!r}, now {new!r}; "
                "leave out --config and the fields to resume with the run's own configuration, or start "
                f"another run{remedy}"
            )


def check_before_capture(folder: Path, wanted: Config, extends: bool) -> None:
    """Refuse, before the capture is read, what a run that goes on in `folder` would refuse afterwards.

    FileNotFoundError: a run that `extends` has no checkpoint. ConfigError: as `check_resumable`, but for what
    `wanted` leaves to the capture.
    """
    names = names_of(folder / CHECKPOINTS)
    if extends and not names:
        raise FileNotFoundError(f"{folder} has no checkpoint: there is no finished run to extend")
    for name in reversed(names):
        with suppress(*DAMAGE):
            state = read_manifest(folder / CHECKPOINTS / name).state
            saved, step = from_dict(state["config"]), int(state["progress"]["step"])
            break
    else:
        return  # the checkpoints are damaged, which is said when one is read
    if extends:
        wanted = replace(wanted, schedule=saved.schedule)
    check_resumable(saved, with_pace_of(decided_as(saved, wanted), saved), step)


def decided_as(saved: Config, wanted: Config) -> Config:
    """Return `wanted` with the saved values of what it leaves to the capture.

    These are the near plane, the background, and what follows from the number of views: length and opacity
    term.
    """
    schedule, loss, model = wanted.schedule, wanted.loss, wanted.model
    if schedule.images_per_view > 0:
        schedule = replace(schedule, scale=saved.schedule.scale, images_per_view=0.0)
    if loss.opacity_total > 0:
        loss = replace(loss, opacity=saved.loss.opacity, opacity_total=0.0)
    if model.near == 0:
        model = replace(model, near=saved.model.near)
    if model.background is None:
        model = replace(model, background=saved.model.background)
    return replace(wanted, schedule=schedule, loss=loss, model=model)


def with_pace_of(config: Config, saved: Config | None) -> Config:
    """Return `config` with the pace of the checkpoint's configuration, `saved`.

    With `schedule.minutes`, the pace comes from `saved`, because the run has measured it; `saved` is None at
    the start of a run, which has not measured any yet. Without `schedule.minutes`, the pace of `config` is
    kept.
    """
    schedule = config.schedule
    if schedule.minutes > 0:
        schedule = replace(schedule, pace=() if saved is None else saved.schedule.pace)
    return replace(config, schedule=schedule)


def _is_free(name: str) -> bool:
    return any(name == free or name.startswith(free + ".") for free in FREE_FIELDS)


def _differences(saved: Config, found: Config) -> list[tuple[str, Any, Any]]:
    """Return the name and both values of the fields that differ."""
    old, new = flat(to_dict(saved)), flat(to_dict(found))
    return [(name, old[name], new[name]) for name in old if old[name] != new[name]]
