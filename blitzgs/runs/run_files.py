# SPDX-License-Identifier: Apache-2.0
"""What lies where in the folder of a run."""

from __future__ import annotations

from pathlib import Path

CONFIG = "config.yaml"  # the resolved configuration
CAMERAS = "cameras.json"  # all cameras, and which are held out
LOG = "log.jsonl"
CHECKPOINTS = "checkpoints"
EVALUATION = "evaluation"  # a folder for each evaluation
TRAINED_VIEWS = "trained.json"  # in that of the last evaluation: metrics of some training views
LINEAGE = "lineage"  # births and deaths of Gaussians
EXPOSURES = "exposures.json"  # of a finished run: gain and bias, [2, 3], by the name of the photograph
SUMMARY = "summary.json"  # of a finished run
REPORT = "report.html"
PICTURE = "trajectory.svg"  # the population over time
# What a run writes beside its checkpoints.
WRITTEN = (CONFIG, CAMERAS, LOG, SUMMARY, PICTURE, LINEAGE, REPORT, EXPOSURES)


def run_and_checkpoint(path: Path) -> tuple[Path, str | None]:
    """Return the folder of a run and the name of a checkpoint, for either's folder; None: the newest."""
    inside = path.resolve()
    return (inside.parent.parent, inside.name) if inside.parent.name == CHECKPOINTS else (path, None)


def check_is_run(folder: Path) -> None:
    """Refuse a folder that has neither a configuration nor checkpoints (FileNotFoundError)."""
    if not (folder / CONFIG).exists() and not (folder / CHECKPOINTS).exists():
        lacks = f"it has no {CONFIG} and no {CHECKPOINTS}: name the --out of a `blitzgs train`"
        raise FileNotFoundError(
            f"{folder} is not a run: {lacks if folder.exists() else 'there is no such path'}"
        )
