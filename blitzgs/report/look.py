# SPDX-License-Identifier: Apache-2.0
"""The model in 3D, for the report."""

from __future__ import annotations

from pathlib import Path

from blitzgs.distributed.group import Ranks
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.web import web_file

# Size of the look in the report.
MAX_BYTES = 4_000_000


def look_of(folder: Path) -> dict[str, str]:
    """Return the newest model of a run as a page with its viewer ("html"), and what it lacks ("note").

    The checkpoint is read into host memory, with the optimiser's moments.

    Raises:
        FileNotFoundError: there is no checkpoint.
        CheckpointError: all checkpoints are damaged.
        ValueError: the model has no visible Gaussian.
    """
    found = web_file(open_model(folder, Ranks()), MAX_BYTES)
    note = f"{found.gaussians:,} of {found.of:,} Gaussians. {found.left_out}"
    if found.left_out:
        note += " blitzgs export RUN --html FILE writes more, blitzgs view RUN shows all."
    return {"html": found.text, "note": note}
