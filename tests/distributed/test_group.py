# SPDX-License-Identifier: Apache-2.0
import os
import time

import pytest
import torch

from blitzgs.distributed.group import MismatchError, Ranks
from tests.distributed.rank_harness import RankError, run_ranks


def _collectives(ranks):
    m, size = ranks.rank, ranks.world_size
    assert ranks.all_reduce(torch.tensor([m, 10])).tolist() == [size * (size - 1) // 2, 10 * size]
    assert ranks.all_reduce(torch.tensor(m), "max").item() == size - 1
    assert ranks.all_reduce(torch.tensor(float(m)), "min").item() == 0
    # Rank m sends m + n + 1 rows to rank n, and nothing to itself.
    sent = [0 if n == m else m + n + 1 for n in range(size)]
    rows = torch.cat([torch.full((count, 2), 100 * m + n) for n, count in enumerate(sent)])
    got, counts = ranks.exchange_rows(rows, sent)
    assert counts == [0 if n == m else m + n + 1 for n in range(size)]
    assert got[:, 0].tolist() == [100 * n + m for n in range(size) for _ in range(counts[n])]
    assert ranks.broadcast_object({"from": m}, source=1) == {"from": 1}
    assert ranks.all_gather_object(m) == list(range(size))
    assert [part.item() for part in ranks.all_gather(torch.tensor(m))] == list(range(size))
    ranks.barrier()
    ranks.compare_across_ranks({"config": {"a": 1}, "code": "x"})
    try:
        ranks.compare_across_ranks({"config": {"a": 1}, "code": "x" if m < 2 else "y"})
    except MismatchError as error:
        return str(error)
    return None


def test_collectives_and_mismatch_on_three_ranks():
    start = time.monotonic()
    messages = run_ranks(_collectives, 3)
    assert time.monotonic() - start < 60
    for message in messages:
        assert "the ranks disagree on code: ranks 0, 1" in message
        assert "'x'; rank 2 " in message and "'y'" in message


def test_one_process_needs_no_group():
    with Ranks.from_environment("cpu") as ranks:
        assert (ranks.rank, ranks.world_size) == (0, 1)
        rows = torch.arange(6).view(3, 2)
        assert torch.equal(ranks.all_to_all(rows, [3], [3]), rows)
        assert ranks.exchange_rows(rows, [3])[1] == [3]
        assert ranks.all_reduce(torch.tensor(4)).item() == 4
        assert ranks.broadcast_object("a") == "a"
        ranks.compare_across_ranks({"config": 1})
        ranks.barrier()
        assert not torch.distributed.is_initialized()


def test_missing_gpu_is_named():
    with pytest.raises(ValueError, match="local rank 0 needs cuda:99"):
        Ranks.from_environment("cuda:99")


def _out_of_memory():
    raise torch.OutOfMemoryError("no room for shard 1")


def _fail(ranks, how):
    ranks.barrier()
    if ranks.rank == 1:
        if how == "raise":
            raise ValueError("shard 1 has a hole")
        if how == "memory":
            ranks.reading(_out_of_memory)
        if how == "kill":
            os.kill(os.getpid(), 9)
        time.sleep(60)
        return
    ranks.all_reduce(torch.zeros(4))


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("raise", "rank 1 failed: ValueError: shard 1 has a hole"),
        ("memory", "rank 1 failed: OutOfMemoryError: no room for shard 1"),
        ("kill", "rank 1 has not arrived"),
        ("hang", "exit code 75"),
    ],
)
def test_a_bad_rank_ends_the_job_with_its_message(how, expected):
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_fail, 3, how, timeout_seconds=5.0, limit=45)
    assert time.monotonic() - start < 45
    if how == "hang":
        assert "waited 5 s in all_reduce: rank 1 has not arrived" in failure.value.blame
    assert expected in failure.value.messages[0]
    assert expected in failure.value.messages[2]


def _fail_and_stay(ranks):
    ranks.barrier()
    if ranks.rank == 1:
        ranks.watchdog.report_failure("shard 1 has a hole")
        time.sleep(60)
    ranks.all_reduce(torch.zeros(4))


def test_nobody_waits_for_a_rank_that_has_failed():
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_fail_and_stay, 2, timeout_seconds=600.0, limit=45)
    assert time.monotonic() - start < 45
    assert "exit code 75" in failure.value.messages[0]
