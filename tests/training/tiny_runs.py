# SPDX-License-Identifier: Apache-2.0
"""Runs of the tiny capture: training it, stopping it after a step, and reading what it logged."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.table.table import GaussianTable
from blitzgs.training.trainer import Trainer
from tests.training.tiny import tiny_config, tiny_scene


def train(
    folder: Path, *overrides: str, scale: float = 1.0, ranks: Ranks | None = None, resume: bool = False
) -> tuple[Trainer, dict[str, Any] | None]:
    """Train the tiny capture; return the trainer and its summary, None if it was stopped."""
    trainer = Trainer(tiny_config(*overrides), *tiny_scene(scale), folder, ranks or Ranks(), resume)
    return trainer, trainer.train()


def at_step(monkeypatch, number: int, action: Callable[[Trainer], object]) -> None:
    """Call `action(trainer)` after step `number`."""
    step = Trainer.step

    def changed(self, taken):
        step(self, taken)
        if taken == number:
            action(self)

    monkeypatch.setattr(Trainer, "step", changed)


def stop_at(monkeypatch, number: int) -> None:
    """Ask the process to stop after step `number`."""
    at_step(monkeypatch, number, lambda trainer: os.kill(os.getpid(), signal.SIGTERM))


def read_log(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a run's log."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def steps_of(folder: Path) -> list[dict[str, Any]]:
    """Return the records of steps in a run's log."""
    return [record for record in read_log(folder) if "loss" in record]


def events_of(folder: Path, event: str) -> list[dict[str, Any]]:
    """Return the records of one kind of event in a run's log."""
    return [record for record in read_log(folder) if record.get("event") == event]


def assert_same_table(a: GaussianTable, b: GaussianTable) -> None:
    """Check that two tables hold the same bits."""
    assert len(a) == len(b)
    for name in a:
        assert torch.equal(a[name], b[name]), name
