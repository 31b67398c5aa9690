# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: what is in it, and how to open a trained model again."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
import resource
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import blitzgs
from blitzgs.distributed.group import Ranks
from blitzgs.model import GaussianTable
from blitzgs.scene.capture import Capture, load_capture
from blitzgs.scene.images import ImageStore
from blitzgs.training import checkpoint
from blitzgs.training.config import Config
from blitzgs.training.config_io import ConfigError, from_dict, load_config, to_dict
from blitzgs.training.guard import bad_column, check_before_saving
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.schedule import Schedule
from blitzgs.training.views import Space

CONFIG = "config.yaml"
CHECKPOINTS = "checkpoints"
SUMMARY = "summary.json"
EVALUATION = "evaluation"
# Sections and fields that a resumed run may change: they decide nothing about the result beyond rounding.
FREE_FIELDS = (
    "log",
    "ranks",
    "data.path",
    "data.cache_bytes",
    "data.threads",
    "data.prefetch",
    "schedule.checkpoint_every",
    "schedule.evaluate_every",
)
# Half precision changes the result by 1e-3.
BOUND_FIELDS = ("ranks.half_exchange",)

# Fields that may differ between the hosts of a job.
HOST_FIELDS = ("data.path", "data.cache_bytes", "data.threads")


@dataclass(frozen=True)
class Progress:
    """Where a run stands; saved with every checkpoint.

    Attributes:
        step: optimiser steps taken.
        sh_degree: spherical-harmonics degree of the last step.
        level_count: octree levels K.
        peak_gaussians: most Gaussians so far.
        seconds: of training so far, without evaluations.
        milestones: how many Gaussians there were at the points of the run that are named so.
    """

    step: int
    sh_degree: int
    level_count: int
    peak_gaussians: int
    seconds: float
    milestones: dict[str, int] = dataclasses.field(default_factory=dict)


@dataclass
class TrainedModel:
    """A model read back from a run, caught up and ready to render.

    Attributes:
        config: of the run.
        progress: where the run stood.
        space: how the trained world lies in the capture's.
        table: this rank's Gaussians.
    """

    config: Config
    progress: Progress
    space: Space
    table: GaussianTable


def open_capture(config: Config, ranks: Ranks) -> tuple[Capture, ImageStore]:
    """Load the capture that a configuration names, and open its images.

    The processes of one host share the budget for images in memory.

    Raises:
        ConfigError: `data.path` is not set.
        FileNotFoundError, ValueError: the capture is incomplete or damaged.
    """
    data = config.data
    if not data.path:
        raise ConfigError("data.path: no capture given; use --data DIR")
    capture = load_capture(
        data.path,
        images=data.images,
        downscale=data.downscale,
        split=data.split,
        masks=data.masks,
        undistort=data.undistort,
        exif=data.exif,
        allow_missing=data.allow_missing,
    )
    budget = data.cache_bytes // ranks.local_world_size
    return capture, ImageStore(capture, budget, data.threads, background=config.model.background)


def input_files(capture: Capture) -> list[Path]:
    """The photographs and masks of a capture, which no command may overwrite."""
    images = [camera.image_path for camera in capture.cameras]
    return images + [camera.mask_path for camera in capture.cameras if camera.mask_path is not None]


def check_capture(space: Space, capture: Capture, folder: Path) -> None:
    """Check that a capture is the one that the run in `folder` was trained on.

    Raises:
        ValueError: its cameras lie elsewhere.
    """
    if Space.of(capture.offset, capture.extent) != space:
        raise ValueError(f"{capture.root} is not the capture of the run in {folder}: its cameras differ")


def check_alike(config: Config, capture: Capture, ranks: Ranks, resume: bool) -> None:
    """Check that all ranks run the same code with the same configuration and flag on the same capture.

    Raises:
        MismatchError: on every rank, naming the field and the ranks.
    """
    if ranks.world_size == 1:
        return
    fields = {
        f"configuration field {name}": value
        for name, value in _flatten(to_dict(config))
        if name not in HOST_FIELDS
    }
    ranks.compare_across_ranks(
        {"code version": code_fingerprint(), "capture": capture_fingerprint(capture), "flag --resume": resume}
        | fields
    )


def code_fingerprint() -> str:
    """Version of the package and a digest of its sources and kernels."""
    digest = hashlib.sha256()
    root = Path(blitzgs.__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.glob("_lib/libblitzgs_*.so")]):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return f"{blitzgs.__version__}+{digest.hexdigest()[:12]}"


def capture_fingerprint(capture: Capture) -> str:
    """Digest of the cameras, the points and the split."""
    digest = hashlib.sha256()
    for camera in capture.cameras:
        digest.update(f"{camera.name} {camera.width} {camera.height}".encode())
        digest.update(camera.K.tobytes() + camera.world_to_camera.tobytes())
    digest.update(capture.points.tobytes() + capture.colors.tobytes())
    digest.update(repr((capture.train, capture.test)).encode())
    return digest.hexdigest()[:12]


def _flatten(fields: dict[str, Any], where: str = "") -> list[tuple[str, object]]:
    flat: list[tuple[str, object]] = []
    for name, value in fields.items():
        flat += _flatten(value, f"{where}{name}.") if isinstance(value, dict) else [(where + name, value)]
    return flat


def save(
    folder: Path,
    table: GaussianTable,
    progress: Progress,
    space: Space,
    config: Config,
    ranks: Ranks,
    run_id: str = "",
) -> Path:
    """Write a checkpoint of a run; rows that are behind stay behind, so that saving changes nothing.

    Returns:
        The checkpoint's folder.

    Raises:
        NonFiniteError: a value is not finite; nothing is written, and earlier checkpoints are kept.
        CheckpointError: a rank could not write; earlier checkpoints are kept.
    """
    check_before_saving(table, progress.step, ranks)
    state = {
        "progress": dataclasses.asdict(progress),
        "space": dataclasses.asdict(space),
        "config": to_dict(config),
        "run": run_id,
    }
    return checkpoint.save(folder / CHECKPOINTS, table.columns, state, ranks, config.log.keep_checkpoints)


@dataclass
class Restored:
    """What a checkpoint of a run holds.

    Attributes:
        table: this rank's Gaussians.
        progress: where the run stood.
        space: how the trained world lies in the capture's.
        config: of the run.
        run_id: names the run in its log.
        source: which checkpoint it is and why that one, in words.
    """

    table: GaussianTable
    progress: Progress
    space: Space
    config: Config
    run_id: str
    source: str


def restore(folder: Path, ranks: Ranks) -> Restored | None:
    """Read the newest sound checkpoint of a run; None when there is none.

    Raises:
        CheckpointError: there are checkpoints, but none is sound.
    """
    loaded = checkpoint.load_latest(folder / CHECKPOINTS, ranks, ranks.device, _problem_of_columns)
    if loaded is None:
        return None
    state = loaded.state
    why = "the newest sound one" if loaded.refused else "the newest"
    skipped = f"; {len(loaded.refused)} newer refused" if loaded.refused else ""
    return Restored(
        GaussianTable(loaded.columns),
        Progress(**state["progress"]),
        Space(**(state["space"] | {"offset": tuple(state["space"]["offset"])})),
        from_dict(state["config"]),
        state.get("run", ""),
        f"{loaded.name} ({why}{skipped})",
    )


def _problem_of_columns(columns: dict[str, torch.Tensor]) -> str | None:
    return bad_column(GaussianTable(columns))


def open_model(folder: Path, ranks: Ranks, data: str | None = None) -> TrainedModel:
    """Open the newest model of a run for rendering, with the configuration that was saved with it.

    Args:
        folder: of the run.
        ranks: the job.
        data: where the capture is now; None: where it was.

    Raises:
        FileNotFoundError: the folder is not a run, or holds no checkpoint.
    """
    if not (folder / CONFIG).exists() and not (folder / CHECKPOINTS).exists():
        raise FileNotFoundError(f"{folder} is not a run: it has no {CONFIG} and no {CHECKPOINTS}")
    restored = restore(folder, ranks)
    if restored is None:
        raise FileNotFoundError(f"{folder} has no checkpoint yet; let the training finish or save one")
    config, progress, table = restored.config, restored.progress, restored.table
    if ranks.rank == 0:
        _compare_with_file(config, folder / CONFIG)
    if data is not None:
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, path=data))
    optimiser = LazyAdam(config.optimiser, Schedule(config.schedule), restored.space.extent, ranks.device)
    optimiser.catch_up(table, None, progress.step)
    return TrainedModel(config, progress, restored.space, table)


def _compare_with_file(config: Config, path: Path) -> None:
    """Say so when a run's configuration file is not what its checkpoint was trained with."""
    try:
        fields = _changed_fields(config, load_config(path))
        what = f"differs in {', '.join(fields)}" if fields else ""
    except ConfigError as error:
        what = f"cannot be read ({error})"
    if what:
        warnings.warn(f"{path} {what}: what the checkpoint was trained with counts", stacklevel=3)


def check_resumable(saved: Config, wanted: Config) -> None:
    """Check that a resumed run computes what the checkpoint's run would have.

    Raises:
        ConfigError: names the first field that differs.
    """
    for name, old, new in _differences(to_dict(saved), to_dict(wanted), ""):
        if not _is_free(name):
            raise ConfigError(
                f"{name}: the checkpoint was trained with {old!r}, now {new!r}; "
                "resume with the run's own configuration or start another run"
            )


def _is_free(name: str) -> bool:
    return name not in BOUND_FIELDS and any(
        name == free or name.startswith(free + ".") for free in FREE_FIELDS
    )


def _changed_fields(saved: Config, found: Config) -> list[str]:
    return [name for name, *_ in _differences(to_dict(saved), to_dict(found), "") if not _is_free(name)]


def _differences(old: dict[str, Any], new: dict[str, Any], where: str) -> list[tuple[str, Any, Any]]:
    found = []
    for name in old | new:
        path, a, b = where + name, old.get(name), new.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += _differences(a, b, path + ".")
        elif a != b:
            found.append((path, a, b))
    return found


def peak_memory_bytes(device: torch.device) -> int:
    """Most memory this process has used: on the GPU when there is one, else resident memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def versions(device: torch.device) -> dict[str, str]:
    """Return what the result was made with."""
    found = {"blitzgs": blitzgs.__version__, "torch": torch.__version__, "python": platform.python_version()}
    if device.type == "cuda":
        found |= {"device": torch.cuda.get_device_name(device), "cuda": str(torch.version.cuda)}
    return found | {"machine": platform.platform()}
