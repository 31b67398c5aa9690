# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from tests.distributed.rank_harness import on_each_device, run_ranks

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
