# SPDX-License-Identifier: Apache-2.0
"""Tells whether a checkpoint belongs to the run in whose folder it is."""

from __future__ import annotations

import json
import os
from pathlib import Path

from blitzgs.distributed.group import Ranks
from blitzgs.runs.cameras import CAMERAS
from blitzgs.runs.checkpoint import CheckpointError
from blitzgs.runs.log import LOG

# The last records of a log are within this number of bytes.
_TAIL_BYTES = 1 << 16


def check_own(folder: Path, checkpoint: Path, run_id: str, ranks: Ranks) -> None:
    """Check that a checkpoint was written by the run whose cameras and log are in `folder`. Collective.

    Args:
        folder: folder of the run.
        checkpoint: the checkpoint, for the message.
        run_id: id of the run that wrote it; empty in old checkpoints, which are not checked.
        ranks: the job.

    Raises:
        CheckpointError: on every rank; it was written by another run.
    """
    known = ranks.broadcast_object(known_id(folder) if ranks.rank == 0 else "")
    if known and run_id and known != run_id:
        raise CheckpointError(
            f"{checkpoint} was written by another run ({run_id}) than the one in {folder} ({known}), whose "
            "cameras would be used with it: put back this run's own checkpoints, or use the folder of the "
            "other run"
        )


def known_id(folder: Path) -> str:
    """Return the id of the run in a folder, from its cameras, else from its log; empty if it is not known."""
    try:
        found = json.loads((folder / CAMERAS).read_text(encoding="utf-8")).get("run", "")
    except (OSError, ValueError, AttributeError, RecursionError):
        found = ""
    if isinstance(found, str) and found:
        return found
    for line in reversed(_tail(folder / LOG)):
        try:
            found = json.loads(line).get("run", "")
        except (ValueError, AttributeError, RecursionError):
            continue  # an incomplete line
        if isinstance(found, str) and found:
            return found
    return ""


def _tail(path: Path) -> list[str]:
    """Return the last lines of a file."""
    try:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _TAIL_BYTES))
            return file.read().decode(errors="replace").splitlines()
    except OSError:
        return []
