# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from tests.distributed.rank_harness import on_each_device, run_ranks


def _sums(ranks):
    out = []
    for step in range(6):
        values = torch.arange(1000, device=ranks.device) * (ranks.rank + 1) + step
        total = HostSum(lambda x=values: x.float(), [values], ranks)
        del values  # its memory must not be handed on before it was read
        torch.full((1000,), -1, device=ranks.device)
        out.append(total)
    first = out[0].read()
    assert first is out[0].read()  # waits and copies once
    return [total.read() for total in out]


@pytest.mark.parametrize(("world_size", "device"), on_each_device(1, 2))
def test_sums_reach_the_host_of_every_rank(world_size, device):
    factor = sum(range(1, world_size + 1))
    for answer in run_ranks(_sums, world_size, device=device):
        for step, total in enumerate(answer):
            assert total.device.type == "cpu" and not total.is_pinned()
            assert torch.equal(total, torch.arange(1000) * float(factor) + world_size * step)


def test_one_rank_needs_no_group():
    assert HostSum(lambda: torch.ones(3), [], Ranks()).read().tolist() == [1.0, 1.0, 1.0]
