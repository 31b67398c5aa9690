# SPDX-License-Identifier: Apache-2.0
"""Measures a gate's worth by continuing one checkpoint with different vetoes (BlitzGS, oracle analysis).

All arms continue the same checkpoint, from before the gate's onset:

- reference: no veto. Its lineage labels each spawn event, (parent, time, clone or split): non-surviving if
  and only if none of its children is in the final model.
- oracle: vetoes exactly the candidates labelled non-surviving; oracle_rate: of these, at most the gate's
  share.
- gate: vetoes by the learned ranking; gate_sampled: draws those that pass by their odds; random: vetoes as
  many at random.

If training repeats bit for bit (on the CPU, or with model.deterministic), the oracle's first event has the
same candidates as the reference's. Later events may differ, because each veto changes the rest of the run. An
oracle never vetoes a candidate that the reference did not have; `matched` is the share of candidates that it
did have. These include the candidates that the limit of the population held back in the reference, which have
no label, because they never became Gaussians.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.capture import Capture
from blitzgs.capture.images import ImageStore
from blitzgs.config.fields import Config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import hash_keys
from blitzgs.runs import run_files
from blitzgs.runs.checkpoint_files import MANIFEST
from blitzgs.runs.folder_checks import locked
from blitzgs.spawn.candidates import Candidates, Veto
from blitzgs.spawn.gate import SpawnGate, random_veto, rank_veto, sampled_veto, veto_draws, veto_lowest
from blitzgs.spawn.lineage import read_lineage
from blitzgs.training.trainer import Trainer
from blitzgs.util.errors import WRONG_CONTENT, warn

REFERENCE = "reference"
ARMS = (REFERENCE, "oracle", "oracle_rate", "gate", "gate_sampled", "random")
FIGURES, TABLE = "replay.json", "replay.md"
# An empty file in the folder of the reference until this arm is trained: a replay that ended before that
# begins again.
BEGUN = "replay_begun"


class OracleVeto:
    """Vetoes candidates whose children did not survive in a reference run."""

    def __init__(self, known: Tensor, dead: Tensor, rate: float | None, seed: int) -> None:
        """Take the `event_keys` of the reference's candidates and of its non-surviving events, int64 [K].

        With a `rate`, at most this share of the clones and of the splits is vetoed, drawn by `seed`.
        """
        self._known, self._dead, self._rate, self._seed = known, dead, rate, seed
        self.seen = self.matched = 0  # this rank's candidates, and those that the reference had too

    def __call__(self, candidates: Candidates, ranks: Ranks) -> Tensor:
        """Tell which candidates are vetoed, bool [M]. Collective."""
        keys = event_keys(candidates.parents, candidates.time, candidates.is_split)
        self.seen += len(keys)
        self.matched += int(torch.isin(keys, self._known.to(keys.device)).sum())
        dead = torch.isin(keys, self._dead.to(keys.device))
        if self._rate is None:
            return dead
        draws = veto_draws(candidates, self._seed).float()  # below 1
        return dead & veto_lowest(draws.where(dead, 2.0), candidates, self._rate, ranks)


def event_keys(parents: Tensor, times: Tensor | int, is_split: Tensor) -> Tensor:
    """Return a hash, int64, of the spawn events (parent, time, clone or split)."""
    return hash_keys(parents, times, is_split.long())


def label_events(lineage: Path) -> tuple[Tensor, Tensor]:
    """Return the keys of all spawn events of a run, and of those whose children all died."""
    tables = read_lineage(lineage)
    births, deaths = tables["births"], tables["deaths"]
    spawned = births["parent"] >= 0
    columns = (births[name][spawned] for name in ("parent", "time", "is_split"))
    parents, times, splits = map(torch.from_numpy, columns)
    keys = event_keys(parents, times.long(), splits.bool()).numpy()
    survived = ~np.isin(births["id"][spawned], deaths["id"])
    known = np.unique(keys)
    alive = np.unique(keys[survived])
    return torch.from_numpy(known), torch.from_numpy(np.setdiff1d(known, alive))


def branch_point(folder: Path, config: Config) -> Path:
    """Return the last checkpoint of a run before the gate's onset.

    FileNotFoundError: there is none. ValueError: the run or its densification ends before the gate's onset,
    or a checkpoint is damaged.
    """
    schedule, found = Schedule(config.schedule), []
    if not schedule.has_spawn_gate(schedule.iterations - 1):
        raise ValueError(
            f"{folder} ends before the gate's onset (schedule.gate_from {config.schedule.gate_from}, "
            f"{schedule.iterations} images): replay a run that goes on after it"
        )
    events = schedule.events(0, schedule.iterations)
    last = max((event.time for event in events if event.kind == "densify"), default=0)
    if not schedule.has_spawn_gate(last):
        raise ValueError(
            f"{folder} has no density event from the gate's onset on (schedule.gate_from "
            f"{config.schedule.gate_from}, the last event {last}): all arms would be the same run. Replay a "
            "run with an earlier schedule.gate_from"
        )
    for manifest in (folder / run_files.CHECKPOINTS).glob(f"checkpoint_*/{MANIFEST}"):
        try:
            step = int(json.loads(manifest.read_text())["state"]["progress"]["step"])
        except WRONG_CONTENT as error:
            raise ValueError(f"{manifest} is damaged: {error!r}") from error
        # Events before the end of a step belong to it.
        if not schedule.has_spawn_gate(step * schedule.batch_size - 1):
            found.append((step, manifest.parent))
    if not found:
        raise FileNotFoundError(
            f"{folder} has no checkpoint from before the gate's onset (schedule.gate_from "
            f"{config.schedule.gate_from}): train it with --population.lineage=true "
            f"--schedule.checkpoint_every={max(config.schedule.gate_from // 2, 1)} --log.keep_checkpoints=100"
        )
    return max(found)[1]


def replay(
    config: Config,
    capture: Capture,
    images: ImageStore,
    source: Path,
    out: Path,
    gate: SpawnGate,
    rate: float,
    ranks: Ranks,
) -> Iterator[dict[str, Any]]:
    """Train every arm to the end, one after the other. Collective.

    Yields, for each arm: its name, psnr, ssim, peak and final Gaussians, the seconds of training since the
    branch, the reference's share of non-surviving events (`dead`) and of candidates that the limit of the
    population held back (`held_back`), and of an oracle the share of the candidates that it knew (`matched`).
    A replay that ended before its first arm was trained is begun again.

    ValueError, FileNotFoundError: the run cannot be branched, or its arms could not be compared.
    FileExistsError: `out` holds a replay already, or another folder with the name of an arm. FolderError:
    another process is training in the folder of an arm.
    """
    _check_comparable(config, capture, images, source)
    _check_unclaimed(out, ranks)
    point = branch_point(source, config)

    def train(name: str, veto: Veto | None) -> dict[str, Any]:
        folder = out / name
        # No other process may train in the folder, least of all a replay that would begin again there.
        with locked(folder, ranks):
            if ranks.rank == 0:
                _branch(point, folder)
            ranks.barrier()
            trainer = Trainer(config, capture, images, folder, ranks, resume=True)
            trainer.state.veto, began = veto, trainer.state.progress.seconds
            if ranks.rank == 0:
                print(f"arm {name}:", flush=True)
            summary = trainer.train()
        if summary is None:
            raise InterruptedError(f"arm {name} was stopped by a signal")
        figures = {"psnr": "psnr", "ssim": "ssim", "peak": "peak_gaussians", "final": "gaussians"}
        found = {short: summary[long] for short, long in figures.items()}
        return {"arm": name, **found, "seconds": summary["seconds"] - began}

    candidates_met = [torch.empty(0, dtype=torch.int64)]

    def record(candidates: Candidates, ranks: Ranks) -> Tensor:
        """Veto nothing, and note the candidates before the limit of the population applies."""
        candidates_met.append(event_keys(candidates.parents, candidates.time, candidates.is_split).cpu())
        return torch.zeros_like(candidates.is_split)

    reference = train(REFERENCE, record)
    known = torch.cat(ranks.all_gather_object(torch.cat(candidates_met)))
    spawned, dead = label_events(out / REFERENCE / run_files.LINEAGE)
    held_back = _held_back(known, spawned, ranks)
    if ranks.rank == 0:
        (out / REFERENCE / BEGUN).unlink()
    yield reference | {"dead": len(dead) / max(1, len(spawned)), "held_back": held_back}
    for name, cap in (("oracle", None), ("oracle_rate", rate)):
        oracle = OracleVeto(known, dead, cap, config.seed)
        result = train(name, oracle)
        counts = torch.tensor([oracle.matched, oracle.seen], device=ranks.device)
        matched, seen = ranks.all_reduce(counts).tolist()
        yield result | {"matched": matched / max(1, seen)}
    yield train("gate", partial(rank_veto, gate, rate))
    yield train("gate_sampled", partial(sampled_veto, gate, rate, config.seed))
    yield train("random", partial(random_veto, rate, config.seed))


def _held_back(known: Tensor, spawned: Tensor, ranks: Ranks) -> float:
    """Return the share of the reference's candidates that became no Gaussians; warn if it is large."""
    share = int(torch.isin(known, spawned, invert=True).sum()) / max(1, len(known))
    if share > 0.5 and ranks.rank == 0:
        warn(
            f"the limit of the population held back {share:.0%} of the reference's candidates, so all "
            "arms may end alike: replay a run with a higher limit (population.max_gaussians, "
            "pixels_per_gaussian, gaussians_per_point)"
        )
    return share


def _check_unclaimed(out: Path, ranks: Ranks) -> None:
    """Refuse to replace anything in the folder of a replay, except a reference that was not trained."""
    found = None
    # Rank 0 checks for all, because another rank might check after rank 0 has begun to write.
    if ranks.rank == 0:
        begun = (out / REFERENCE / BEGUN).is_file()
        names = [FIGURES, TABLE, *ARMS[begun:]]
        found = next((name for name in names if os.path.lexists(out / name)), None)
    found = ranks.broadcast_object(found)
    if found in (FIGURES, TABLE):
        raise FileExistsError(f"{out} already holds a replay: choose another --out, or delete it")
    if found is not None:
        raise FileExistsError(f"{out} has {found}, which a replay would replace: choose another --out")


def _branch(point: Path, folder: Path) -> None:
    """Make a run in `folder` that continues from the checkpoint `point`.

    Of a reference that was begun before, the checkpoints are deleted. Its other files are dealt with as those
    of any run that is resumed from an early checkpoint.
    """
    checkpoints = folder / run_files.CHECKPOINTS
    if folder.name == REFERENCE:
        if (folder / BEGUN).exists() and checkpoints.exists():
            shutil.rmtree(checkpoints)
        (folder / BEGUN).touch()
    shutil.copytree(point, checkpoints / point.name)


def _check_comparable(config: Config, capture: Capture, images: ImageStore, source: Path) -> None:
    if not config.population.lineage:
        raise ValueError(f"{source} was trained without --population.lineage=true: nothing can be branched")
    if config.population.strategy == "relocation":
        raise ValueError(
            f"{source} was trained with population.strategy=relocation, which has no candidates: replay a "
            "run with population.strategy=density"
        )
    if config.schedule.minutes > 0:
        raise ValueError(
            f"{source} was trained with schedule.minutes ({config.schedule.minutes:g}): its arms would "
            "differ in length, and could not be compared. Train it with schedule.scale instead"
        )
    masks = (images.mask(index) for index in capture.test or capture.train)
    if not any(mask is None or bool(mask.any()) for mask in masks):
        raise ValueError(
            f"{source}: its arms could not be compared, because the views that are measured are masked as a "
            "whole. Train it with another data.split or other masks"
        )
