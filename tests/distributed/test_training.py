# SPDX-License-Identifier: Apache-2.0
"""Training on several ranks from one checkpoint: the same ids, and the same numbers up to rounding.

Runs with options of density control also end, when they are resumed, as in one go.
"""

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files, trained_model
from blitzgs.training.events import densify
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import EIGHT, all_fail, on_each_device, run_ranks
from tests.training.tiny import (
    OVERRIDES,
    as_flags,
    assert_same_table,
    at_step,
    events_of,
    lose_view,
    make_trainer,
    read_log,
    sorted_rows,
    steps_of,
    stop_at,
    tiny_config,
    tiny_scene,
)

ROOT = Path(__file__).parents[2]
# 10 + 20 steps of 2 images; density events (after 28, 36, 44 and 52 images) fall into the 20 steps.
SETTINGS = (
    "schedule.iterations=60", "schedule.batch_size=2", "schedule.densify_from=28",
    "schedule.densify_until=60", "schedule.densify_every=8", "schedule.size_prune_after=0",
    "population.grad_threshold=4e-3", "population.clone_scale=0.02", "population.max_gaussians=490",
    "schedule.checkpoint_every=19", "log.every=2", "log.keep_checkpoints=9",
)  # fmt: skip


def train_on(ranks, folder, *overrides):
    torch.set_num_threads(1)
    densify.MAX_IMBALANCE = 1.02  # so that ranks of a few hundred Gaussians are redistributed
    trainer = make_trainer(folder, *SETTINGS, *overrides, ranks=ranks, resume=True)
    summary = trainer.train()
    return summary, trainer.state.table["id"].cpu()


def sorted_table(folder):
    return sorted_rows(trained_model.restore(folder, Ranks()).table)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A run on one rank, and a folder with its checkpoint after 10 steps, from which all other runs begin."""

    @functools.cache
    def make(device):
        folder = tmp_path_factory.mktemp("start")
        train_on(Ranks(device=torch.device(device)), folder)
        base = tmp_path_factory.mktemp("base")
        checkpoint = Path("checkpoints") / "checkpoint_000000"
        shutil.copytree(folder / checkpoint, base / checkpoint)
        return folder, base

    return make


def require_agreement(folder, whole, counts, limit=1e-5):
    """The steps after the checkpoint, events and result of a run are those of one on one rank; its events."""
    expected = [record for record in steps_of(whole) if record["t"] > 20]
    for got, want in zip(steps_of(folder), expected, strict=True):
        assert all(got[name] == want[name] for name in ("t", "gaussians", "visible"))
        assert abs(got["loss"] - want["loss"]) <= limit * want["loss"]
        assert abs(got["psnr"] - want["psnr"]) <= 1e-4
    events = events_of(folder, "densify")
    assert len(events) == 4
    for got, want in zip(events, events_of(whole, "densify"), strict=True):
        assert [got[name] for name in counts] == [want[name] for name in counts]
    got, want = sorted_table(folder), sorted_table(whole)
    for name in ("id", "parent", "birth", "level", "last_step", "moment_step"):
        assert torch.equal(got[name], want[name]), name
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert (got[name] - want[name]).norm() <= limit * want[name].norm(), name
    return events


@pytest.mark.parametrize(("world_size", "device"), [*on_each_device(2, 4), EIGHT])
def test_twenty_steps_agree_with_one_rank(start, tmp_path, world_size, device):
    whole, base = start(device)
    folder = tmp_path / "run"
    shutil.copytree(base, folder)
    answers = run_ranks(train_on, world_size, folder, device=device)
    # On CUDA sums are added in no particular order, and Adam takes a whole step for a gradient that is only a
    # rounding error: two equal trainings on one GPU differ by 2e-4 to 3e-3 after 30 steps.
    limit = 1e-4 if device == "cuda" else 1e-5
    events = require_agreement(folder, whole, ("t", "cloned", "split", "pruned", "gaussians"), limit)
    assert len(steps_of(folder)) == 20 and sum(e["cloned"] + e["split"] for e in events) > 50
    assert events[-1]["held_back"] > 0  # the limit chose among the candidates of all ranks
    assert any(e.get("redistributed") for e in events)
    for summary, _ in answers:
        assert summary["gaussians"] == events[-1]["gaussians"]
    sizes = [len(ids) for _, ids in answers]
    assert max(sizes) <= 1.02 * min(sizes) + 1
    # The evaluation is that of one rank.
    metrics = [
        json.loads((f / "evaluation" / "000060" / "metrics.json").read_text()) for f in (folder, whole)
    ]
    assert abs(metrics[0]["psnr"] - metrics[1]["psnr"]) < 1e-3


def _train_with_rank_config(ranks, folder):
    train_on(ranks, folder, f"loss.ssim=0.{ranks.rank + 1}")


def _resume_on_one_rank(ranks, folder):
    make_trainer(folder, *SETTINGS, ranks=ranks, resume=ranks.rank == 1)


def _extend_on_one_rank(ranks, folder):
    extend = 2.0 if ranks.rank == 1 else None
    Trainer(tiny_config(*SETTINGS), *tiny_scene(), folder, ranks, True, extend)


@pytest.mark.parametrize(
    ("run", "text"),
    [
        (_train_with_rank_config, r"configuration field loss\.ssim: rank 0 \(.*\): 0\.1; rank 1 \("),
        (_resume_on_one_rank, r"flag --resume: rank 0 \(.*\): False; rank 1 \("),
        (_extend_on_one_rank, r"flag --extend: rank 0 \(.*\): None; rank 1 \("),
    ],
)
def test_what_the_ranks_disagree_on_is_named(tmp_path, run, text):
    all_fail(f"the ranks disagree on {text}", run, tmp_path)


def _lose_a_photograph(ranks, folder):
    trainer = make_trainer(folder, *SETTINGS, ranks=ranks)
    if ranks.rank == 1:
        at_step(pytest.MonkeyPatch(), 15, lambda _: trainer.state.images.lose())
    trainer.train()


LOST = r"PhotographError: .*{}.*put the photograph back and continue with --resume"


def test_a_photograph_lost_on_one_rank_is_named_by_all_and_costs_nothing(tmp_path):
    all_fail(LOST.format("rank 1: /photos/0"), _lose_a_photograph, tmp_path)
    # The other rank is in the middle of the step: they save where they next agree. The last checkpoint of the
    # schedule is that after 19 images.
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 16
    for summary, _ in run_ranks(train_on, 2, tmp_path):
        assert summary["images"] == 60


def _lose_the_last_photographs(ranks, folder):
    trainer = make_trainer(folder, *SETTINGS, ranks=ranks)
    trainer.loader._ahead = 0  # so that the last step reads its photographs itself
    if ranks.rank == 0:
        at_step(pytest.MonkeyPatch(), 29, lambda _: trainer.state.images.lose(error=ValueError))
    trainer.train()


def test_a_photograph_lost_in_the_last_step_is_named_by_all(tmp_path):
    all_fail(LOST.format("rank 0: /photos/0"), _lose_the_last_photographs, tmp_path)
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 30


def _lose_a_held_out_photograph(ranks, folder, resume):
    capture, images = scene = tiny_scene()
    capture.train, capture.test = [0, 2, 4, 6], [1, 3, 5, 7]
    if not resume:
        images.lose(5)
    options = (*SETTINGS, "schedule.evaluate_every=30")
    return make_trainer(folder, *options, scene=scene, ranks=ranks, resume=resume).train()


def test_a_held_out_photograph_lost_on_several_ranks_is_named_by_all_and_costs_nothing(tmp_path):
    all_fail(LOST.format("/photos/05.png"), _lose_a_held_out_photograph, tmp_path, False)
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 16  # the evaluation is due at 30
    assert all(run_ranks(_lose_a_held_out_photograph, 2, tmp_path, True))


def _stop_in_an_evaluation(ranks, folder, every):
    """Ask the last rank to stop when it compares its first view; return when each rank compared a view."""
    capture, images = scene = tiny_scene()
    capture.test = capture.train * 6
    options = (*SETTINGS, f"schedule.evaluate_every={every}")
    trainer = make_trainer(folder, *options, scene=scene, ranks=ranks)
    get, compared = images.get, []

    def stopping(index, factor=1):
        if threading.current_thread() is threading.main_thread():  # another one reads images for training
            compared.append(trainer.state.progress.step)
            if ranks.rank == ranks.world_size - 1:
                os.kill(os.getpid(), signal.SIGTERM)
        return get(index)

    images.get = stopping
    return compared, trainer.train()


@pytest.mark.parametrize("world_size", [1, 2])
@pytest.mark.parametrize(("every", "step"), [(22, 12), (0, 30)])  # images 22 and 23; after the last image
def test_a_signal_within_an_evaluation_does_not_wait_for_its_end(tmp_path, world_size, every, step):
    """torchrun ends a process 30 seconds after it was asked to stop; an evaluation may take longer."""
    for compared, summary in run_ranks(_stop_in_an_evaluation, world_size, tmp_path, every):
        assert compared == [step] and summary is None
    assert trained_model.restore(tmp_path, Ranks()).progress.step == step
    events = [record.get("event") for record in read_log(tmp_path)]
    assert "evaluation stopped" in events and "evaluation" not in events and events[-1] == "stopped"
    assert ("hint" in events) == (world_size > 1)  # a batch of 2 views
    for summary, _ in run_ranks(train_on, world_size, tmp_path, f"schedule.evaluate_every={every}"):
        assert summary["images"] == 60 and "psnr" in summary


def _resume_with_fewer_views(ranks, folder):
    """Train on views of two sizes, and go on from the first checkpoint without the first of them."""
    capture, images = scene = tiny_scene()
    for camera in capture.cameras[::2]:
        camera.width = 24
    images.images[::2] = [image[:, :24].contiguous() for image in images.images[::2]]
    make_trainer(folder, *SETTINGS, scene=scene, ranks=ranks).train()
    if ranks.rank == 0:
        for later in sorted((folder / run_files.CHECKPOINTS).glob("checkpoint_*"))[1:]:
            shutil.rmtree(later)
    ranks.barrier()
    known = trained_model.restore(folder, ranks).shared["steps"].tolist()
    lose_view(*scene, 0)
    options = (*SETTINGS, "data.allow_missing=true")
    resumed = make_trainer(folder, *options, scene=scene, ranks=ranks, resume=True)
    kept = resumed.state.owners.columns()
    return known, kept["views"].tolist(), kept["steps"].tolist(), resumed.train() is not None


def test_borders_of_views_that_are_lost_are_not_those_of_others(tmp_path):
    for known, views, steps, is_done in run_ranks(_resume_with_fewer_views, 2, tmp_path):
        assert known and is_done
        assert views == steps == []


def _train_and_stop(rank, arguments, signalled_at):
    """`blitzgs train`; rank 1 alone is asked to stop after a step."""
    if rank == 1:
        stop_at(pytest.MonkeyPatch(), signalled_at)
    return main(arguments)


def _command(rank, arguments):
    return main(arguments)


def train_flags(capture, folder, command="train"):
    settings = ["config=defaults", *OVERRIDES, *SETTINGS]
    return [command, "--data", str(capture), "--out", str(folder), "--resume", *as_flags(*settings)]


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    """The same run uninterrupted, on two ranks, through the command line."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert run_ranks(_command, 2, train_flags(capture, folder), join=False) == [0, 0]
    return folder


def test_renders_are_the_same_bytes(trained, tmp_path):
    for world_size in (1, 2, 3, 4):
        out = tmp_path / str(world_size)
        arguments = ["render", str(trained), "--split", "all", "--raw", "--out", str(out)]
        assert run_ranks(_command, world_size, arguments, join=False) == [0] * world_size
    names = sorted(path.name for path in (tmp_path / "1").glob("*.npy"))
    assert len(names) == 8
    for name in names:
        expected = (tmp_path / "1" / name).read_bytes()
        assert np.load(tmp_path / "1" / name).std() > 0.1
        for world_size in (2, 3, 4):
            assert (tmp_path / str(world_size) / name).read_bytes() == expected


def assert_same_result(folder, expected):
    got, want = sorted_table(folder), sorted_table(expected)
    assert torch.equal(got["id"], want["id"])
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert (got[name] - want[name]).norm() <= 1e-5 * want[name].norm(), name


def test_sigterm_on_one_rank_saves_and_a_resume_finishes(capture, trained, tmp_path):
    flags = train_flags(capture, tmp_path)
    assert run_ranks(_train_and_stop, 2, flags, 12, join=False) == [0, 0]
    assert trained_model.restore(tmp_path, Ranks()).progress.step == 16  # where the ranks next agree
    assert not (tmp_path / "summary.json").exists()
    # Another number of ranks may continue.
    assert run_ranks(_command, 3, flags, join=False) == [0, 0, 0]
    assert_same_result(tmp_path, trained)


def test_a_resume_on_as_many_ranks_repeats_every_bit(capture, trained, tmp_path):
    """The tiles' costs are saved, so the ranks draw the borders that they would have drawn."""
    flags = train_flags(capture, tmp_path)
    assert run_ranks(_train_and_stop, 2, flags, 12, join=False) == [0, 0]
    assert (tmp_path / "checkpoints" / "checkpoint_000000" / "shared.safetensors").exists()
    assert run_ranks(_command, 2, flags, join=False) == [0, 0]
    assert_same_table(sorted_table(tmp_path), sorted_table(trained))
    got, want = (trained_model.restore(folder, Ranks()).shared for folder in (tmp_path, trained))
    assert len(set(want["views"].tolist())) == 7 and sorted(got) == sorted(want)
    for name in want:
        assert torch.equal(got[name], want[name]), name


# `blitzgs train` under torchrun, whose rank 1 is killed once, in the middle of a step.
KILLED_ONCE = """
import os, signal, sys
from blitzgs.cli import main
from blitzgs.training.trainer import Trainer
step = Trainer.step
def killed_once(self, number):
    first = os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
    if number == 25 and first and self.state.ranks.rank == 1:
        (self.state.folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    step(self, number)
Trainer.step = killed_once
sys.exit(main())
"""


def test_torchrun_restarts_after_a_rank_is_killed(capture, trained, tmp_path):
    program = tmp_path / "killed_once.py"
    program.write_text(KILLED_ONCE)
    torchrun = f"{sys.executable} -m torch.distributed.run --standalone --nproc-per-node=2 --max-restarts=1"
    command = [*torchrun.split(), str(program), *train_flags(capture, tmp_path, "train")]
    variables = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=270, env=variables)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "rank 0: " in done.stderr and "rank 1 has stopped reporting" in done.stderr
    assert "number 0" not in done.stderr
    assert (tmp_path / "killed").exists()
    assert_same_result(tmp_path, trained)


RELOCATION = (
    "population.strategy=relocation", "population.max_gaussians=450", "population.min_opacity=0.06",
    "loss.opacity=0.01", "model.antialiased=true", "model.random_background=true", "optimiser.opacity=0.1",
    "optimiser.position_noise=1e6",
)  # fmt: skip
# The second importance pass at the end of density control keeps half. Then rates fall.
PRUNED = (
    "population.importance=true", "population.score=weight", "population.pass2_mass=1",
    "population.pass2_keep=0.5", "schedule.t1=0", "schedule.densify_until=54", "schedule.t2=54",
    "schedule.position_decay=60", "optimiser.final=0.1",
)  # fmt: skip
OPTIONS = {"relocation": RELOCATION, "relocation, pruned": (*RELOCATION, *PRUNED)}
FIRST = Path("checkpoints") / "checkpoint_000000"


@pytest.fixture(scope="module", params=OPTIONS)
def whole(request, tmp_path_factory):
    """A run on one rank: the options, its folder, and a folder that has its first checkpoint alone."""
    folder, base = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("base")
    train_on(Ranks(), folder, *OPTIONS[request.param])
    shutil.copytree(folder / FIRST, base / FIRST)
    return OPTIONS[request.param], folder, base


def test_a_resumed_run_is_the_same(whole, tmp_path):
    options, folder, base = whole
    shutil.copytree(base, tmp_path / "run")
    train_on(Ranks(), tmp_path / "run", *options)
    resumed, expected = (trained_model.restore(f, Ranks()).table for f in (tmp_path / "run", folder))
    assert_same_table(resumed, expected)


@pytest.mark.cuda
@pytest.mark.parametrize("name", OPTIONS)
def test_cuda_trains_with_each_option_and_resumes_exactly(name, tmp_path):
    ranks, options = Ranks(device=torch.device("cuda")), (*OPTIONS[name], "model.deterministic=true")
    train_on(ranks, tmp_path / "whole", *options)
    shutil.copytree(tmp_path / "whole" / FIRST, tmp_path / "run" / FIRST)
    train_on(ranks, tmp_path / "run", *options)
    resumed, expected = (trained_model.restore(tmp_path / f, Ranks()).table for f in ("run", "whole"))
    assert_same_table(resumed, expected)
    events = events_of(tmp_path / "whole", "densify")
    assert sum(event["cloned"] for event in events) > 30


def test_two_ranks_agree_with_one(whole, tmp_path):
    options, folder, base = whole
    shutil.copytree(base, tmp_path / "run")
    run_ranks(train_on, 2, tmp_path / "run", *options)
    counts = ("t", "cloned", "split", "pruned", "relocated", "held_back", "gaussians")
    events = require_agreement(tmp_path / "run", folder, counts)
    assert sum(event["cloned"] for event in events) > 30


def test_relocation_keeps_the_population_and_grows_to_the_cap(whole):
    options, folder, _ = whole
    events = events_of(folder, "densify")
    assert sum(event["relocated"] for event in events) > 5
    if options is RELOCATION:
        counts = [event["gaussians"] for event in events]
        assert counts == sorted(counts) and counts[-1] == 450
        assert all(event["pruned"] == event["split"] == 0 for event in events)


def test_the_second_pass_follows_relocation(whole):
    options, folder, _ = whole
    passes = [(event["t"], event["before"], event["gaussians"]) for event in events_of(folder, "pass_2")]
    assert len(passes) == ("population.importance=true" in options)
    for time, before, after in passes:  # of the kept half, it prunes those of low opacity
        assert (time, before) == (54, 450) and 200 < after <= 225


def test_births_less_deaths_are_the_living(whole, tmp_path):
    pytest.importorskip("pyarrow")
    from blitzgs.spawn.lineage import Cause, read_lineage

    options, _, _ = whole
    train_on(Ranks(), tmp_path, "population.lineage=true", *options)
    log = read_lineage(tmp_path / run_files.LINEAGE)
    relocated = log["deaths"]["id"][log["deaths"]["cause"] == Cause.RELOCATED]
    living = set(log["births"]["id"].tolist()) - set(log["deaths"]["id"].tolist())
    assert len(relocated) > 5
    assert living == set(trained_model.restore(tmp_path, Ranks()).table["id"].tolist())
