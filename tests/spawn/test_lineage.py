# SPDX-License-Identifier: Apache-2.0
"""Lineage: its log, its parts, its sums after any events, and its error when they do not match."""

import errno
import os
import threading

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from blitzgs.distributed.group import Ranks
from blitzgs.population.density import DensityRules, densify
from blitzgs.spawn.candidates import FEATURES, spawn_features
from blitzgs.spawn.lineage import (
    PART_NAME,
    Births,
    Cause,
    Ledger,
    Lineage,
    LineageError,
    initial_births,
    read_lineage,
)
from blitzgs.table.placement import redistribute
from blitzgs.table.table import GaussianTable
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.population.test_density import random_table

pytest.importorskip("pyarrow")
RULES = DensityRules(
    grad_threshold=4e-4, clone_scale=0.02, min_opacity=0.02, max_screen_radius=25.0, max_scale=0.3
)


def some(ids, time=0):
    ids = torch.tensor(ids, dtype=torch.int64)
    return Births(ids, ids + 1, torch.ones(len(ids), 3), torch.full((len(ids), len(FEATURES)), 1.5 + time))


def shaken(table, event):
    """New statistics, as if trained."""
    g = torch.Generator().manual_seed(100 + event)
    draws = torch.rand(100_003, 3, generator=g)[table["id"] % 100_003].to(table.device)
    table["grad_count"].copy_((5 * draws[:, 0]).int())
    table["grad_sum"].copy_(1e-3 * draws[:, 1] * table["grad_count"])
    table["max_radii"].copy_(30 * draws[:, 2])
    table["exp_avg_sq.sh"].copy_(draws[:, :1, None].expand_as(table["exp_avg_sq.sh"]))


def live(folder):
    tables = read_lineage(folder)
    births, deaths = tables["births"]["id"], tables["deaths"]["id"]
    assert len(np.unique(births)) == len(births) and len(np.unique(deaths)) == len(deaths)
    return np.setdiff1d(births, deaths), tables


def test_a_run_of_events_is_logged_row_by_row(tmp_path):
    table = random_table(300)
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    lineage.born(initial_births(table["id"], table["parent"], table["means"]), 0)
    reports = []
    for event in range(1, 4):
        shaken(table, event)
        before = GaussianTable({name: table[name].clone() for name in table})
        reports.append(
            densify(
                table, RULES, time=100 * event, step=event, seed=3, level_count=4, ranks=Ranks(), extent=2.0,
                lineage=lineage,
            )
        )  # fmt: skip
    ledger = lineage.flush_and_check(table["id"], 3)
    lineage.close()
    alive, tables = live(tmp_path)
    assert alive.tolist() == sorted(table["id"].tolist())
    births, deaths = tables["births"], tables["deaths"]
    assert ledger.births == len(births["id"]) and ledger.deaths == len(deaths["id"])
    grown = sum(r.cloned + 2 * r.split for r in reports)
    assert len(births["id"]) == 300 + grown
    assert (deaths["cause"] == Cause.SPLIT).sum() == sum(r.split for r in reports) > 10
    assert {Cause.OPACITY, Cause.SIZE} <= set(deaths["cause"].tolist())
    last = births["time"] == 300
    assert last.sum() > 10
    place = {int(i): row for row, i in enumerate(before["id"])}
    parents = torch.tensor([place[int(parent)] for parent in births["parent"][last]])
    is_split = before["scales"][parents].amax(1).exp() > RULES.clone_scale
    features = spawn_features(before, parents, is_split, 300, 2.0, 4)
    for name, column in zip(FEATURES, features.T, strict=True):
        np.testing.assert_array_equal(births[name][last], column, name)
    first = births["parent"] == -1
    assert first.sum() == 300 and np.isnan(births["gradient"][first]).all()


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_ledger_matches_the_log_after_random_events(data, tmp_path_factory):
    """Births, deaths and checkpoints in any order: log and ledger match the live population."""
    folder = tmp_path_factory.mktemp("lineage")
    lineage, alive, next_id, step = Lineage(folder, Ranks(), 0, Ledger()), set(), 0, 0
    for what in data.draw(st.lists(st.sampled_from(["birth", "death", "save", "resume"]), max_size=12)):
        step += 1
        if what == "birth":
            count = data.draw(st.integers(0, 5))
            lineage.born(some(range(next_id, next_id + count)), step)
            alive |= set(range(next_id, next_id + count))
            next_id += count
        elif what == "death" and alive:
            gone = data.draw(st.lists(st.sampled_from(sorted(alive)), unique=True))
            lineage.died(torch.tensor(gone, dtype=torch.int64), torch.ones(len(gone)), step, step)
            alive -= set(gone)
        else:
            ledger = lineage.flush_and_check(torch.tensor(sorted(alive), dtype=torch.int64), step)
            assert ledger.births - ledger.deaths == len(alive)
            if what == "resume":
                lineage.born(some([next_id + 10_000]), step + 1)  # lost with the process
                lineage.flush(step + 1)
                lineage.close()
                lineage = Lineage(folder, Ranks(), step, ledger)
    lineage.flush_and_check(torch.tensor(sorted(alive), dtype=torch.int64), step + 1)
    lineage.close()
    if next_id:
        assert live(folder)[0].tolist() == sorted(alive)


def test_events_that_a_stop_kept_from_happening_are_logged_beside_those_of_the_same_step(tmp_path):
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    lineage.born(some([1, 2]), 3)
    ledger = lineage.flush_and_check(torch.tensor([1, 2]), 3)
    lineage.close()
    for first in (7, 3):  # the first of two resumed processes is killed after it has written a part
        lineage = Lineage(tmp_path, Ranks(), 3, ledger)
        lineage.born(some([first, first + 1]), 3)
        if first == 7:
            lineage.died(torch.tensor([2]), torch.tensor([Cause.SIZE]), 10, 3)
            lineage.flush(3)
        else:
            lineage.flush_and_check(torch.tensor([1, 2, 3, 4]), 3)
        lineage.close()
    assert live(tmp_path)[0].tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        ([1, 2, 3], "5 births less 1 deaths is not the live population of 3 Gaussians;"),
        ([1, 2, 3, 9], r"the live population of 4 Gaussians \(their numbers agree, their ids do not\)"),
    ],
)
def test_a_ledger_that_misses_the_population_stops_the_run(tmp_path, ids, message):
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    lineage.born(some([1, 2, 3, 4, 5]), 1)
    lineage.died(torch.tensor([5]), torch.tensor([Cause.SIZE]), 10, 1)
    refused(LineageError, message, lineage.flush_and_check, torch.tensor(ids), 1)
    lineage.close()


def _generations(ranks, folder):
    torch.set_num_threads(1)
    table = random_table(400)
    mine = torch.arange(400) % 3 == 0 if ranks.rank == 0 else torch.arange(400) % 3 > 0
    if ranks.world_size == 2:
        table.keep(mine)
    lineage = Lineage(folder, ranks, 0, Ledger())
    lineage.born(initial_births(table["id"], table["parent"], table["means"]), 0)
    for event in range(1, 4):
        shaken(table, event)
        densify(
            table, RULES, time=100 * event, step=event, seed=3, level_count=4, ranks=ranks, lineage=lineage
        )
        redistribute(table, ranks, max_imbalance=1.0)
        ledger = lineage.flush_and_check(table["id"], event)
    lineage.close()
    return ledger


def test_two_ranks_log_the_same_births_and_deaths(tmp_path):
    alone = _generations(Ranks(), tmp_path / "1")
    both = run_ranks(_generations, 2, tmp_path / "2")
    assert both[0] == both[1] == alone
    tables = [live(tmp_path / name)[1] for name in ("1", "2")]
    for name in ("births", "deaths"):
        one, two = (t[name] for t in tables)
        order, other = np.argsort(one["id"]), np.argsort(two["id"])
        for column in one:
            np.testing.assert_array_equal(one[column][order], two[column][other], column)


def test_flushed_lineage_is_synced_to_disk(tmp_path, monkeypatch):
    synced, fsync = set(), os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (synced.add(os.fstat(file).st_ino), fsync(file)))
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    lineage.born(some([1, 2]), 1)
    lineage.died(torch.tensor([1]), torch.tensor([Cause.SPLIT]), 4, 1)
    lineage.flush_and_check(torch.tensor([2]), 1)
    lineage.close()
    parts = list(tmp_path.glob("*.parquet"))
    assert len(parts) == 2
    assert {path.stat().st_ino for path in (*parts, tmp_path)} <= synced


def test_features_of_no_candidate(tmp_path):
    table = random_table(5)
    none = torch.zeros(0, dtype=torch.int64)
    assert spawn_features(table, none, none.bool(), 5, 1.0, 4).shape == (0, len(FEATURES))
    with pytest.raises(FileNotFoundError, match="holds no lineage: train with --population.lineage=true"):
        read_lineage(tmp_path)


def test_a_resumed_log_deletes_only_files_that_blitzgs_writes(tmp_path):
    """Other programs keep hidden files and folders where they look at a run."""
    (tmp_path / ".notes").mkdir()
    (tmp_path / ".index").write_text("mine")
    torn = tmp_path / ".0123456789ab.partial"  # of a process that was killed while it wrote
    torn.write_text("torn")
    Lineage(tmp_path, Ranks(), 0, Ledger()).close()
    assert (tmp_path / ".notes").is_dir() and (tmp_path / ".index").read_text() == "mine"
    assert not torn.exists()


parquet = pytest.importorskip("pyarrow.parquet")


class SlowDisk:
    """A disk that notes when it is asked to write, and writes nothing until it is ready."""

    def __init__(self):
        self.asked, self.ready = threading.Event(), threading.Event()
        self._write_table = parquet.write_table

    def write_table(self, *args, **options):
        self.asked.set()
        assert self.ready.wait(60)
        self._write_table(*args, **options)


@pytest.fixture
def disk(monkeypatch):
    slow = SlowDisk()
    monkeypatch.setattr(parquet, "write_table", slow.write_table)
    yield slow
    slow.ready.set()


def parts(folder):
    return sorted(path.name for path in folder.iterdir() if PART_NAME.fullmatch(path.name))


def test_events_do_not_wait_for_the_disk(tmp_path, disk):
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    for step in range(1, 6):
        lineage.born(some([10 * step, 10 * step + 1]), step)
        lineage.died(torch.tensor([10 * step]), torch.tensor([Cause.SIZE]), step, step)
        lineage.flush(step)
    assert not parts(tmp_path)
    disk.ready.set()
    ledger = lineage.flush_and_check(torch.arange(11, 60, 10), 6)
    lineage.close()
    assert (ledger.births, ledger.deaths) == (10, 5) and len(parts(tmp_path)) == 10
    tables = read_lineage(tmp_path)
    assert tables["births"]["id"].tolist() == [10, 11, 20, 21, 30, 31, 40, 41, 50, 51]
    assert tables["deaths"]["time"].tolist() == [1, 2, 3, 4, 5]
    births, deaths = ({name: c.dtype for name, c in tables[table].items()} for table in ("births", "deaths"))
    assert births == {"id": np.int64, "parent": np.int64} | dict.fromkeys(
        ("x", "y", "z", *FEATURES), np.float32
    )
    assert deaths == {"id": np.int64, "time": np.int32, "cause": np.uint8}


def test_close_finishes_one_part_and_drops_the_others(tmp_path, disk):
    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    for step in range(1, 4):
        lineage.born(some([step]), step)
        lineage.flush(step)
    assert disk.asked.wait(60)
    threading.Timer(1.0, disk.ready.set).start()
    lineage.close()
    assert parts(tmp_path) == ["births_00000001_0000_0000.parquet"]
    assert not list(tmp_path.glob(".*"))


def _full_disk_of_one_rank(ranks, folder):
    lineage, real = Lineage(folder, ranks, 0, Ledger()), parquet.write_table
    ids = torch.arange(3) + 3 * ranks.rank
    lineage.born(some(ids.tolist()), 1)

    def write_table(*args, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    if ranks.rank == ranks.world_size - 1:
        parquet.write_table = write_table
    for _ in range(2):
        refused(OSError, "lineage could not be written: .*No space left on", lineage.flush_and_check, ids, 1)
    parquet.write_table = real
    ledger = lineage.flush_and_check(ids, 1)
    lineage.close()
    return ledger


@pytest.mark.parametrize("world_size", [1, 2])
def test_a_full_disk_keeps_rows_and_sums_for_the_next_check(tmp_path, world_size):
    ledgers = run_ranks(_full_disk_of_one_rank, world_size, tmp_path)
    assert {ledger.births for ledger in ledgers} == {3 * world_size}
    assert sorted(read_lineage(tmp_path)["births"]["id"]) == list(range(3 * world_size))


@pytest.mark.cuda
def test_rows_leave_the_gpu_without_keeping_the_host(tmp_path):
    device = torch.device("cuda", torch.cuda.current_device())
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(700, len(FEATURES), generator=generator)
    means, ids = torch.randn(700, 3, generator=generator), torch.randperm(700, generator=generator)
    born = Births(*(tensor.to(device) for tensor in (ids, ids + 9, means, features)))
    gone, causes = born.ids[:300], torch.full((300,), int(Cause.SIZE), device=device)
    for folder in (tmp_path / "warm-up", tmp_path / "timed"):  # the first call of a kernel loads it and waits
        lineage = Lineage(folder, Ranks(device=device), 0, Ledger())
        torch.cuda.synchronize()
        torch.cuda._sleep(1_000_000_000)
        lineage.born(born, 1)
        lineage.died(gone, causes, 10, 1)
        lineage.flush(1)
        slept = torch.cuda.current_stream().query()
        lineage.flush_and_check(born.ids[300:], 1)
        lineage.close()
    assert not slept
    tables = read_lineage(folder)
    births, deaths = tables["births"], tables["deaths"]
    np.testing.assert_array_equal(births["id"], ids)
    np.testing.assert_array_equal(births["parent"], ids + 9)
    got = np.stack([births[name] for name in ("x", "y", "z", *FEATURES)], 1)
    np.testing.assert_array_equal(got, torch.cat((means, features), 1))
    np.testing.assert_array_equal(deaths["id"], ids[:300])
    assert set(deaths["cause"]) == {Cause.SIZE} and set(deaths["time"]) == {10}
