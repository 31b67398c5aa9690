# SPDX-License-Identifier: Apache-2.0
"""The event that writes a checkpoint, and what happens if that fails."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from blitzgs.config.files import save_config
from blitzgs.config.schedule import Event
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.cameras import save_cameras
from blitzgs.runs.checkpoint import CheckpointError, Saving
from blitzgs.runs.trained_model import TrainedModel
from blitzgs.training.state import TrainingState
from blitzgs.util.output import is_lack_of_space

# If a checkpoint cannot be written, training continues and tries again after this time.
RETRY_SECONDS = 60.0
# If the last checkpoint of a run cannot be written, the run waits this long, then twice as long each time.
FIRST_WAIT_SECONDS = 1.0
LONGEST_WAIT_SECONDS = 20.0
# For lack of space the run waits up to a day, so that its user can see the message and free some space.
PATIENCE_SECONDS = 24 * 3600.0
# A run that was told to stop waits less: torchrun kills a process 30 seconds after SIGTERM.
STOPPING_PATIENCE_SECONDS = 15.0


def save_checkpoint(state: TrainingState, event: Event | None = None) -> None:
    """Begin to write a checkpoint while training goes on; all ranks `finish_checkpoint`.

    If it cannot be written, the run continues and tries again a minute later. If a value is not finite,
    NonFiniteError is raised, and earlier checkpoints are kept.
    """
    finish_checkpoint(state)
    with _reported(state):
        state.save_clock.saving = _write(state, in_background=True)


def finish_checkpoint(state: TrainingState) -> None:
    """Wait for the checkpoint that is being written, if there is one. Collective."""
    saving, state.save_clock.saving = state.save_clock.saving, None
    if saving is not None:
        with _reported(state):
            saving.finish()


@contextlib.contextmanager
def _reported(state: TrainingState) -> Iterator[None]:
    try:
        yield
    except CheckpointError as error:
        state.save_clock.restart(RETRY_SECONDS)
        _report(state, error, f"Training goes on; trying again in {RETRY_SECONDS:.0f} s.")


def save_last(state: TrainingState, patience_seconds: float, gives_up: Callable[[], bool]) -> None:
    """Write the checkpoint at the end of a run; if there is no space for it, wait and try again.

    `gives_up`, the same on every rank, is asked before each wait. If it cannot be written for another reason,
    which waiting does not change, the model is saved elsewhere. CheckpointError: it could not be written in
    time, or not at all; the message says whether and where the model was saved instead.
    """
    finish_checkpoint(state)
    waited, pause = 0.0, FIRST_WAIT_SECONDS
    while True:
        try:
            _write(state).finish()
            return
        except CheckpointError as error:
            if not error.lacks_space:
                raise CheckpointError(f"{error} {_rescue(state)}") from error
            if waited >= patience_seconds or gives_up():
                raise
            left = f"{max(1, round((patience_seconds - waited) / 60)):,} minutes"
            _report(
                state,
                error,
                f"The model is still in memory: free some space. Trying again in {pause:.0f} s, for up to "
                f"{left}; Ctrl-C gives it up.",
            )
        time.sleep(pause)
        waited, pause = waited + pause, min(2 * pause, LONGEST_WAIT_SECONDS)


def _rescue(state: TrainingState) -> str:
    """Save the model in another folder than the run's; return where it is, and how to continue, as text."""
    run, name = state.folder.resolve(), f"rescued_{state.run_id}"
    for folder in (run / name, run.with_name(f"{run.name}_{name}")):
        try:
            _save(state, folder).finish()
        except (CheckpointError, OSError):
            continue
        if state.ranks.rank == 0:
            with contextlib.suppress(OSError):
                save_config(state.config, folder / run_files.CONFIG)
                save_cameras(folder, state.capture, state.run_id)
        return f"The model is saved in {folder}: continue with --resume --out {shlex.quote(str(folder))}"
    return f"The model could not be saved elsewhere ({run / name} and beside {run}): it is lost"


def _write(state: TrainingState, in_background: bool = False) -> Saving:
    """Begin to write a checkpoint, after the lineage has been written and found to add up."""
    state.stepper.write_back()
    if state.lineage is not None:
        try:
            ledger = state.lineage.flush_and_check(state.table["id"], state.progress.step)
        except OSError as error:
            text = f"no checkpoint was written, because {error}."
            raise CheckpointError(text, is_lack_of_space(error)) from error
        state.progress.ledger = asdict(ledger)
    saving = _save(state, state.folder, in_background)
    state.save_clock.restart()
    return saving


def _save(state: TrainingState, folder: Path, in_background: bool = False) -> Saving:
    state.progress.curve = asdict(state.curve)
    # The division of tiles decides the order of sums, and therefore their last bits.
    shared = state.owners.columns() if state.ranks.world_size > 1 else {}
    if state.stepper.exposures is not None:
        shared |= state.stepper.exposures.columns()
    shared = {name: column.clone() for name, column in shared.items()}
    model = TrainedModel(state.config, state.progress, state.space, state.table, state.run_id, shared=shared)
    return trained_model.save(folder, model, state.ranks, in_background)


def _report(state: TrainingState, error: CheckpointError, what_next: str) -> None:
    state.log.event(state.images_seen, "checkpoint failed", {"reason": str(error)}, f"{error} {what_next}")
