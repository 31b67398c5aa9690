# SPDX-License-Identifier: Apache-2.0
"""Rows written to other GPUs' memory: what collectives carry too, and clear errors where it cannot be."""

import os
import time

import pytest
import torch

from blitzgs.distributed.exchange import Splats, plan_route, send, send_back
from blitzgs.distributed.group import Ranks
from tests.distributed.rank_harness import RankError, run_ranks
from tests.distributed.test_exchange import owned_by, ranges_for, scene

TWO_GPUS = [
    pytest.mark.cuda,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs 2 GPUs"),
]


def _to(device, splats):
    return Splats(*(column.to(device) for column in splats))


def _sorted(splats):
    order = splats.ids.argsort()
    return [column[order] for column in splats]


def _both_ways(ranks):
    """Exchanges of growing, shrinking and empty shards; each by peers and by collectives."""
    assert ranks.peers is not None, ranks.transport
    ranges, sizes = ranges_for(ranks.world_size), []
    for count in (3, 240, 400_000, 0, 1000):
        mine = _to(ranks.device, owned_by(scene(count), ranks.rank, ranks.world_size))
        answers = []
        for peers in (ranks.peers, None):
            route = plan_route(mine, ranges, ranks)
            route.peers = peers
            got = send(mine, route, ranks)
            gradients = [got.means2d * 2, got.conics + 1, got.opacities, got.colors**2]
            arrived = [column.clone() for column in _sorted(got)]
            answers.append((arrived, send_back(gradients, route, ranks)))
        for a, b in zip(*answers, strict=True):
            for x, y in zip(a, b, strict=True):
                assert x.dtype == y.dtype and torch.equal(x, y)
        sizes.append(len(ranks.peers.buffers[0]))
    assert sizes[0] == sizes[1] < sizes[2] == sizes[3] == sizes[4]
    return sizes[2]


@pytest.mark.parametrize(
    "world_size",
    [
        pytest.param(
            size,
            marks=[
                pytest.mark.cuda,
                pytest.mark.skipif(torch.cuda.device_count() < size, reason=f"needs {size} GPUs"),
            ],
        )
        for size in (2, 4)
    ],
)
def test_peers_bring_what_collectives_bring(world_size):
    sizes = run_ranks(_both_ways, world_size, device="cuda", transport="peer")
    assert len(set(sizes)) == 1


def _overtaken(ranks):
    mine, ranges = _to(ranks.device, owned_by(scene(), ranks.rank, 2)), ranges_for(2)
    first = plan_route(mine, ranges, ranks)
    got = send(mine, first, ranks)
    send(mine, plan_route(mine, ranges, ranks), ranks)
    with pytest.raises(RuntimeError, match="a later exchange has overwritten"):
        send_back([got.means2d], first, ranks)
    # Several differentiable exchanges may be open at once: they leave the peers' buffers alone.
    return True


@pytest.mark.parametrize("_", [pytest.param(0, marks=TWO_GPUS)])
def test_an_overtaken_exchange_is_refused(_):
    assert run_ranks(_overtaken, 2, device="cuda") == [True, True]


def _abandoned(ranks, how):
    mine, ranges = _to(ranks.device, owned_by(scene(), ranks.rank, 2)), ranges_for(2)
    send(mine, plan_route(mine, ranges, ranks), ranks)
    if ranks.rank == 1:
        if how == "kill":
            os.kill(os.getpid(), 9)
        time.sleep(30)
    plan_route(mine, ranges, ranks)


@pytest.mark.parametrize("how", [pytest.param(how, marks=TWO_GPUS) for how in ("kill", "hang")])
def test_a_rank_that_leaves_a_meeting_is_named(how):
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_abandoned, 2, how, device="cuda", timeout_seconds=3.0, limit=50)
    assert time.monotonic() - start < 50
    assert "waited 3 s in read: rank 1 has not" in failure.value.blame


def _refused(rank):
    with pytest.raises(RuntimeError, match="peer is impossible: not every rank computes on a GPU"):
        Ranks.from_environment("cpu", 30.0, "peer")
    return True


def test_peers_need_gpus():
    assert run_ranks(_refused, 2, join=False) == [True, True]
    with pytest.raises(ValueError, match="transport must be one of auto, peer, collective, not 'pigeon'"):
        Ranks.from_environment("cpu", transport="pigeon")


def _falls_back(ranks):
    return ranks.transport


def test_ranks_without_gpus_use_collectives():
    for text in run_ranks(_falls_back, 2):
        assert text == "collective (gloo); peer memory: not every rank computes on a GPU"
