# SPDX-License-Identifier: Apache-2.0
"""Options of density control in whole runs: resumed, and on two ranks, they end as on one rank in one go."""

import shutil
from pathlib import Path

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files, trained_model
from tests.distributed.rank_harness import run_ranks
from tests.distributed.test_training import require_agreement, train_on
from tests.helpers import needs_cuda
from tests.training.tiny import assert_same_table, events_of

RELOCATION = (
    "population.strategy=relocation", "population.max_gaussians=450", "population.min_opacity=0.06",
    "loss.opacity=0.01", "model.antialiased=true", "optimiser.opacity=0.1", "optimiser.position_noise=1e6",
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
@needs_cuda
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
    from blitzgs.spawn.lineage import Cause
    from blitzgs.spawn.lineage_parts import read_lineage

    options, _, _ = whole
    train_on(Ranks(), tmp_path, "population.lineage=true", *options)
    log = read_lineage(tmp_path / run_files.LINEAGE)
    relocated = log["deaths"]["id"][log["deaths"]["cause"] == Cause.RELOCATED]
    living = set(log["births"]["id"].tolist()) - set(log["deaths"]["id"].tolist())
    assert len(relocated) > 5
    assert living == set(trained_model.restore(tmp_path, Ranks()).table["id"].tolist())
