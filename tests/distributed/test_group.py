# SPDX-License-Identifier: Apache-2.0
"""Groups of ranks, and sums over the ranks of a host."""

import os
import re
import signal
import subprocess
import time

import pytest
import torch
from torch.distributed import HashStore

from blitzgs.cli import main
from blitzgs.distributed import watchdog
from blitzgs.distributed.group import (
    ALLOCATOR_VARIABLES,
    MismatchError,
    Ranks,
    extend_memory_in_place,
    resolve_device,
)
from blitzgs.distributed.host_sum import HostSum
from blitzgs.util.errors import UserError
from tests.distributed.rank_harness import RankError, on_each_device, run_ranks
from tests.helpers import refused


def _collectives(ranks):
    m, size, place = ranks.rank, ranks.world_size, ranks.device
    sums = ranks.all_reduce(torch.tensor([m, 10], device=place))
    assert sums.tolist() == [size * (size - 1) // 2, 10 * size]
    assert ranks.all_reduce(torch.tensor(m, device=place), "max").item() == size - 1
    # Rank m sends m + n + 1 rows to rank n, and nothing to itself.
    sent = [0 if n == m else m + n + 1 for n in range(size)]
    for dtype in (torch.int64, torch.uint8, torch.float32, torch.float16):
        rows = torch.cat([torch.full((count, 2), 100 * m + n) for n, count in enumerate(sent)])
        counts = ranks.exchange_counts(torch.tensor(sent, device=place)).tolist()
        got = ranks.all_to_all(rows.to(place, dtype), sent, counts)
        assert counts == [0 if n == m else m + n + 1 for n in range(size)]
        assert got.device == place and got.dtype == dtype
        assert got[:, 0].tolist() == [100 * n + m for n in range(size) for _ in range(counts[n])]
        assert len(ranks.all_to_all(got[:0], [0] * size, [0] * size)) == 0
    assert ranks.broadcast_object({"from": m}) == {"from": 0}
    assert ranks.all_gather_object(m) == list(range(size))
    gathered = ranks.all_gather(torch.tensor(m, device=place))
    assert [part.item() for part in gathered] == list(range(size))
    ranks.barrier()
    ranks.compare_across_ranks({"config": {"a": 1}, "code": "x"})
    try:
        ranks.compare_across_ranks({"config": {"a": 1}, "code": "x" if m < 2 else "y"})
    except MismatchError as error:
        return str(error)
    return None


@pytest.mark.parametrize("transport", ["auto", "collective"])
@pytest.mark.parametrize(("world_size", "device"), on_each_device(3))
def test_collectives_and_mismatch(world_size, device, transport):
    start = time.monotonic()
    messages = run_ranks(_collectives, world_size, device=device, transport=transport)
    assert time.monotonic() - start < 60
    for message in messages:
        assert "the ranks disagree on code: ranks 0, 1" in message
        assert "'x'; rank 2 " in message and "'y'" in message


def test_one_process_needs_no_group():
    with Ranks.from_environment("cpu") as ranks:
        assert (ranks.rank, ranks.world_size) == (0, 1)
        rows = torch.arange(6).view(3, 2)
        assert torch.equal(ranks.all_to_all(rows, [3], [3]), rows)
        assert ranks.exchange_counts(torch.tensor([3])).tolist() == [3]
        assert ranks.all_reduce(torch.tensor(4)).item() == 4
        assert ranks.broadcast_object("a") == "a"
        ranks.compare_across_ranks({"config": 1})
        ranks.barrier()
        assert not torch.distributed.is_initialized()


def test_missing_gpu_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    refused(ValueError, "local rank 0 needs cuda:99", Ranks.from_environment, "cuda:99")


def test_ranks_of_several_hosts_share_no_gpus(monkeypatch):
    for name, value in {"WORLD_SIZE": 4, "RANK": 1, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    refused(ValueError, "of one host, but 2 of 4 .* this one", Ranks.from_environment, "cpu", share_gpus=True)


def test_ranks_share_gpus_only_when_told(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    first, second = torch.device("cuda:0"), torch.device("cuda:1")

    def places(device, ranks, share_gpus):
        return [resolve_device(device, m, ranks, share_gpus) for m in range(ranks)]

    assert places("cuda", 2, False) == places("cuda", 2, True) == [(first, False), (second, False)]
    assert places("cuda", 3, True) == [(first, True), (second, True), (first, True)]
    assert places("cuda:1", 2, True) == [(second, True)] * 2
    assert places("cuda:1", 1, True) == [(second, False)]
    assert places("cpu", 2, True) == [(torch.device("cpu"), False)] * 2
    refused(ValueError, r"rank 2 needs cuda:2, .* 2 CUDA.*\(--share-gpus\)", places, "cuda", 3, False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.version, "cuda", None)
    refused(ValueError, r"device cuda: .* \(.*\) is built for CPUs alone; install", places, "cuda", 2, True)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    refused(ValueError, "device cuda: this torch sees no GPU; install one with CUDA", places, "cuda", 2, True)


def _fail(ranks, how):
    if how == "stop":  # a host that is gone closes no connection
        watchdog.PATIENCE_SECONDS = watchdog.SILENCE_SECONDS = 3.0
    if how == "report":
        watchdog.GRACE_SECONDS = 1.0
    ranks.barrier()
    if ranks.rank == 1:
        if how == "raise":
            raise ValueError("shard 1 has a hole")
        if how == "memory":
            with ranks.watchdog.waiting("project"):
                raise torch.OutOfMemoryError("no room for shard 1")
        if how == "report":
            ranks.watchdog.report_failure("shard 1 has a hole")
        if how in ("kill", "stop"):
            os.kill(os.getpid(), signal.SIGKILL if how == "kill" else signal.SIGSTOP)
        time.sleep(60)
        return
    ranks.all_reduce(torch.zeros(4))


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("raise", "rank 1 failed: ValueError: shard 1 has a hole"),
        ("memory", "rank 1 failed: OutOfMemoryError: no room for shard 1"),
        ("kill", "rank 1 has stopped reporting"),
        ("hang", "exit code 75"),
        ("stop", "exit code 75"),
        ("report", "exit code 75"),  # it lives on, and no rank waits for it
    ],
)
def test_a_bad_rank_ends_the_job_with_its_message(how, expected):
    start = time.monotonic()
    timeout = 600.0 if how in ("stop", "report") else 3.0
    stuck = {1} if how in ("stop", "report", "hang") else set()
    with pytest.raises(RankError) as failure:
        run_ranks(_fail, 3, how, timeout_seconds=timeout, limit=45, stuck=stuck)
    assert time.monotonic() - start < 45
    if how == "stop":
        assert "in all_reduce: rank 1 has stopped reporting" in failure.value.blame
    if how == "hang":
        assert "waited 3 s in all_reduce: rank 1 has not arrived" in failure.value.blame
    assert expected in failure.value.messages[0]
    assert expected in failure.value.messages[2]
    if how in ("raise", "memory", "kill"):  # of which commands print no traceback
        assert "UserError: rank 0: all_reduce failed" in failure.value.messages[0]


def _start(rank, arguments):
    watchdog.START_SECONDS = 3.0
    if rank == 1:
        return main(arguments) if arguments else None
    if rank == 2:  # does something else first, as `with_poses` does
        while arguments and not watchdog.early_failure():
            time.sleep(0.1)
        assert not arguments, watchdog.early_failure()
        return None
    return Ranks.from_environment("cpu", timeout_seconds=1.0)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["doctor", "--devise=cpu"], "rank 1 failed: wrong usage"),
        (["eval", "/dev/null", "--device=cuda:99"], "rank 1 failed: ValueError: .* cuda:99"),
        ([], r"has waited 3 s for ranks that have not started: 1, 2\. Look"),
    ],
)
def test_a_rank_that_ends_before_it_joins_is_named(arguments, expected):
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_start, 3, arguments, join=False, limit=60)
    messages = failure.value.messages
    assert set(messages) == ({0, 1, 2} if "--devise=cpu" in arguments else {0, 2} if arguments else {0})
    for rank in messages.keys() - {1}:
        assert re.search(expected, messages[rank])
    assert "UserError" in messages[0] and time.monotonic() - start < 45


def _work(ranks, hang):
    announced = []
    ranks.watchdog.announce = lambda late, waited: announced.append(late)
    ranks.barrier()
    if ranks.rank == 1:
        with ranks.watchdog.working("writing to a slow disk"):
            time.sleep(6)
        if hang:
            time.sleep(60)
    return ranks.all_reduce(torch.ones(1)).item(), announced[:1]


def test_a_rank_that_is_at_work_is_waited_for():
    """A rank may work longer than the timeout if it reports what it does and sends signs of life."""
    first, second = run_ranks(_work, 2, False, timeout_seconds=3.0, limit=60)
    assert first == (2.0, ["rank 1 has not arrived (writing to a slow disk)"]) and second == (2.0, [])
    with pytest.raises(RankError) as failure:
        run_ranks(_work, 2, True, timeout_seconds=3.0, limit=60, stuck={1})
    assert "rank 1 has not arrived (last collective: barrier" in failure.value.blame


def _pause(ranks):
    watchdog.PATIENCE_SECONDS = 3.0
    both = " ".join(map(str, ranks.all_gather_object(os.getpid())))
    if ranks.rank == 0:
        subprocess.Popen(["sh", "-c", f"sleep 1; kill -STOP {both}; sleep 7; kill -CONT {both}"])
        time.sleep(2)
        time.sleep(1)  # rank 1 still waits after the pause
    return ranks.all_reduce(torch.ones(1)).item()


def test_a_job_that_was_stopped_and_continued_goes_on():
    assert run_ranks(_pause, 2, timeout_seconds=4.0, limit=60) == [2.0, 2.0]


def test_memory_is_extended_in_place_unless_the_user_has_configured_it(monkeypatch):
    present, former = ALLOCATOR_VARIABLES
    for name in ALLOCATOR_VARIABLES:
        monkeypatch.setenv(name, "max_split_size_mb:128")  # so that the test's end restores both
        monkeypatch.delenv(name)
    extend_memory_in_place()
    assert os.environ[present] == "expandable_segments:True"
    monkeypatch.delenv(present)
    monkeypatch.setenv(former, "max_split_size_mb:128")
    extend_memory_in_place()
    assert present not in os.environ


@pytest.mark.parametrize(
    ("variables", "processes", "threads"),
    [
        ({"TORCHELASTIC_RUN_ID": "none", "OMP_NUM_THREADS": "1"}, 2, 4),
        ({"TORCHELASTIC_RUN_ID": "none", "OMP_NUM_THREADS": "1"}, 16, 1),
        ({"TORCHELASTIC_RUN_ID": "none", "OMP_NUM_THREADS": "3"}, 2, 3),
        ({"OMP_NUM_THREADS": "1"}, 2, 3),
        ({"TORCHELASTIC_RUN_ID": "none", "OMP_NUM_THREADS": "1"}, 1, 3),
    ],
)
def test_processes_of_torchrun_share_the_cores(monkeypatch, variables, processes, threads):
    before = torch.get_num_threads()
    for name in ("TORCHELASTIC_RUN_ID", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    torch.set_num_threads(3)
    try:
        Ranks.from_environment("cpu")
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_a_process_that_ends_inside_its_job_stops_watching_first(monkeypatch):
    at_exit = []
    monkeypatch.setattr(watchdog, "open_store", lambda *_args, **_options: HashStore())
    monkeypatch.setattr(watchdog.atexit, "register", at_exit.append)
    monkeypatch.setattr(watchdog.atexit, "unregister", at_exit.remove)
    dogs = [watchdog.Watchdog(0, 1, 10.0) for _ in range(2)]
    assert at_exit == [dog.stop for dog in dogs]
    dogs[0].stop()
    assert at_exit == [dogs[1].stop] and not dogs[0].thread.is_alive() and dogs[1].thread.is_alive()
    at_exit[0]()
    assert not dogs[1].thread.is_alive() and not at_exit


def test_a_store_that_ends_before_the_ranks_have_joined_is_said(monkeypatch):
    class Gone(HashStore):
        def check(self, keys):
            raise RuntimeError("Broken pipe")

    monkeypatch.setattr(watchdog, "open_store", lambda *_args, **_options: Gone())
    dog = watchdog.Watchdog(0, 2, 10.0)
    refused(UserError, "rank 0 has not begun, because the job's store is gone", dog.await_start)
    dog.stop()


def test_a_job_whose_store_ends_works_on_and_says_so_once(monkeypatch, capsys):
    class Ending(HashStore):
        is_there, asked = True, 0

        def set(self, key, value):
            self.asked += not self.is_there
            if not self.is_there:
                raise RuntimeError("Broken pipe")
            super().set(key, value)

    store = Ending()
    monkeypatch.setattr(watchdog, "open_store", lambda *_args, **_options: store)
    dog = watchdog.Watchdog(0, 2, 0.1)
    with dog.waiting("all_reduce"):
        store.is_there = False
        dog.thread.join(timeout=10)
    for _ in range(3):
        with dog.working("writing a checkpoint"):
            pass
    assert store.asked == 1 and f"process {os.getpid()} works on without it" in capsys.readouterr().err


VIEWS = 3


def _share(tiles, ranks):
    cuts = [tiles * m // ranks.world_size for m in range(ranks.world_size + 1)]
    return cuts[ranks.rank], cuts[ranks.rank + 1]


def _sums(ranks):
    out = []
    # One sum needs more memory than those before it, and one has no loss.
    for step, tiles in enumerate((1000, 1000, 999, 300_000, 5, 1000)):
        parts = torch.arange(VIEWS * 8.0, dtype=torch.float64).view(VIEWS, 4, 2) * (ranks.rank + 1)
        parts = None if step == 4 else parts.to(ranks.device)
        work = torch.arange(tiles, dtype=torch.int32, device=ranks.device) + step
        total = HostSum(ranks, parts, work, _share(tiles, ranks))
        del parts, work  # their memory must not be used again before it was read
        torch.full((tiles,), -1, device=ranks.device)
        out.append(total)
    first = out[0].read()
    assert first is out[0].read()  # the first call waits and copies
    return [total.read() for total in out]


@pytest.mark.parametrize(("world_size", "device"), on_each_device(1, 2))
def test_sums_reach_the_host_of_every_rank(world_size, device):
    factor = sum(range(1, world_size + 1))
    parts = torch.arange(VIEWS * 8.0).view(VIEWS, 4, 2)
    for answer in run_ranks(_sums, world_size, device=device):
        for step, total in enumerate(answer):
            assert total.device.type == "cpu" and not total.is_pinned()
            sums = parts.sum(1).T.flatten() * factor if step != 4 else torch.zeros(0)
            work = torch.arange(len(total) - len(sums)) + step
            assert torch.equal(total, torch.cat((sums, work.float())))


def _sums_read_one_step_later(ranks):
    """The GPU is behind the host. Pinned memory is used again, and the sums of some steps are never read."""
    found, before = {}, None
    for step in range(16):
        tiles = 700 if step % 5 == 4 else 1000
        if ranks.device.type == "cuda":
            torch.cuda._sleep(2_000_000)
        parts = torch.full((VIEWS, 4, 2), step + ranks.rank, dtype=torch.float64, device=ranks.device)
        work = torch.full((tiles,), step, dtype=torch.int32, device=ranks.device)
        now = HostSum(ranks, parts, work, _share(tiles, ranks))
        del parts, work
        torch.full((VIEWS, 4, 2), -1.0, dtype=torch.float64, device=ranks.device)
        torch.full((tiles,), -1, dtype=torch.int32, device=ranks.device)
        if before is not None and step % 4 != 2:
            found[step - 1] = before.read()
        before = now
    return found


@pytest.mark.parametrize(("world_size", "device"), on_each_device(1, 2))
def test_memory_is_used_again_after_it_was_read(world_size, device):
    for found in run_ranks(_sums_read_one_step_later, world_size, device=device):
        assert len(found) == 11
        for step, total in found.items():
            assert len(total) == 2 * VIEWS + (700 if step % 5 == 4 else 1000)
            assert total[: 2 * VIEWS].eq(4 * sum(step + rank for rank in range(world_size))).all()
            assert total[2 * VIEWS :].eq(step).all()


def test_sums_of_one_process_need_no_wait():
    parts = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]], dtype=torch.float64)
    assert HostSum(Ranks(), parts).read().tolist() == [4.0, 6.0]
    assert HostSum(Ranks(), None, torch.tensor([5, 6], dtype=torch.int32), (0, 2)).read().tolist() == [5, 6]
