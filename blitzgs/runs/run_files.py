# SPDX-License-Identifier: Apache-2.0
"""What lies where in the folder of a run."""

from __future__ import annotations

from pathlib import Path

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"
SUMMARY = "summary.json"
REPORT = "report.html"
EVALUATION = "evaluation"
# In the folder of a run's last evaluation: metrics of some training views.
TRAINED_VIEWS = "trained.json"
LINEAGE = "lineage"


def run_and_checkpoint(path: Path) -> tuple[Path, str | None]:
    """Return the folder of a run and the name of a checkpoint, for either's folder; None: the newest."""
    inside = path.resolve()
    return (inside.parent.parent, inside.name) if inside.parent.name == CHECKPOINTS else (path, None)


def check_is_run(folder: Path) -> None:
    """Refuse a folder that has neither a configuration nor checkpoints (FileNotFoundError)."""
    if not (folder / CONFIG).exists() and not (folder / CHECKPOINTS).exists():
        lacks = f"it has no {CONFIG} and no {CHECKPOINTS}" if folder.exists() else "there is no such path"
        raise FileNotFoundError(f"{folder} is not a run: {lacks}")
