# SPDX-License-Identifier: Apache-2.0
"""The parts of a lineage: a density event does not wait until they are written, and none is lost."""

import errno
import threading
from collections import Counter

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from blitzgs.distributed.group import Ranks
from blitzgs.population.density import densify
from blitzgs.spawn import lineage_parts
from blitzgs.spawn.candidates import FEATURES
from blitzgs.spawn.lineage import Births, Cause, Ledger, Lineage
from blitzgs.spawn.lineage_parts import PART_NAME, read_lineage
from tests.distributed.rank_harness import run_ranks
from tests.helpers import needs_cuda
from tests.population.test_density import random_table
from tests.spawn.test_lineage import RULES, shaken, some

parquet = pytest.importorskip("pyarrow.parquet")
# Ops that only make another view of a tensor.
VIEWS = {"view", "select", "slice", "unsqueeze", "squeeze", "t", "transpose", "expand", "unbind", "alias"}


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
        with pytest.raises(OSError, match="the lineage could not be written: .*No space left on device"):
            lineage.flush_and_check(ids, 1)
    parquet.write_table = real
    ledger = lineage.flush_and_check(ids, 1)
    lineage.close()
    return ledger


@pytest.mark.parametrize("world_size", [1, 2])
def test_a_full_disk_keeps_rows_and_sums_for_the_next_check(tmp_path, world_size):
    ledgers = run_ranks(_full_disk_of_one_rank, world_size, tmp_path)
    assert {ledger.births for ledger in ledgers} == {3 * world_size}
    assert sorted(read_lineage(tmp_path)["births"]["id"]) == list(range(3 * world_size))


class _Ops(TorchDispatchMode):
    """Counts ops."""

    def __init__(self):
        super().__init__()
        self.calls = Counter()

    def __torch_dispatch__(self, op, types, args=(), kwargs=None):
        self.calls[op.name().removeprefix("aten::").partition(".")[0]] += 1
        return op(*args, **(kwargs or {}))


@torch.no_grad()
def test_the_log_adds_few_kernels_and_no_wait_to_an_event(tmp_path):
    def calls(lineage):
        table = random_table(500)
        shaken(table, 1)
        with _Ops() as ops:
            densify(table, RULES, time=100, step=1, seed=3, level_count=4, ranks=Ranks(), lineage=lineage)
        return ops.calls

    lineage = Lineage(tmp_path, Ranks(), 0, Ledger())
    added = calls(lineage) - calls(None)
    lineage.close()
    # These ops wait for a GPU: the host must know a size or a value.
    waits = {name: added[name] for name in ("nonzero", "_local_scalar_dense", "masked_select", "item")}
    assert waits == {"nonzero": 0, "_local_scalar_dense": 0, "masked_select": 0, "item": 0}
    assert sum(n for name, n in added.items() if name not in VIEWS) <= 20, added


@pytest.mark.cuda
@needs_cuda
def test_rows_leave_the_gpu_without_keeping_the_host(tmp_path, monkeypatch):
    monkeypatch.setattr(lineage_parts, "_STAGING_BYTES", 1000)
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
