# SPDX-License-Identifier: Apache-2.0
"""Rows written to other GPUs' memory: what collectives carry too, and clear errors where it cannot be."""

import dataclasses
import os
import time
from types import SimpleNamespace

import pytest
import torch

from blitzgs import pipeline
from blitzgs.distributed import exchange
from blitzgs.distributed import peers as peers_module
from blitzgs.distributed.exchange import send_back
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import Share, TileOwners
from blitzgs.distributed.peers import MAX_VALUES, Peers, mail_words
from blitzgs.model import GaussianTable
from blitzgs.ops.rasterize import gradient_columns
from blitzgs.training.config import OptimiserConfig, ScheduleConfig
from blitzgs.training.optimiser import LazyAdam
from blitzgs.training.schedule import Schedule
from tests.distributed.rank_harness import RankError, on_cuda, run_ranks
from tests.distributed.test_sharded_rendering import OPTIONS, cameras
from tests.helpers import sum_tables
from tests.training.tiny import random_gaussians


def _table(count, ranks):
    """This rank's part of a scene; at four ranks one has none."""
    table = random_gaussians(count) if count else random_gaussians(1)
    owner = torch.arange(len(table)) % ranks.world_size
    table.keep((owner == ranks.rank) & (owner != 2) & (count > 0))
    return GaussianTable({name: table[name].to(ranks.device) for name in table})


def _exchange(table, ranks):
    """Rows that arrive here in a fixed order, and the sums of a function of them that return."""
    views = cameras(3, device=ranks.device)
    ranges = TileOwners(ranks).divide(range(3), views.width, views.height)
    frame = pipeline.forward(table, views, OPTIONS, share=Share(ranks, ranges))
    got = frame.splats
    order = (got.ids * 4 + got.camera_ids).argsort()
    arrived = [column[order].clone() for column in got]
    gradients = [got.means2d * 2, got.conics + 1, got.opacities, got.colors**2]
    if frame.route.space is None:
        sums = send_back(gradients, frame.route, ranks)
    else:
        columns = [g[:, None] if g.dim() == 1 else g for g in gradients]
        space = frame.route.space
        space.table().copy_(torch.cat((*columns, torch.ones_like(got.conics)), 1))
        returned = sum_tables(space.share_table(frame.route.places), len(frame.rows.means2d))
        sums = [column.contiguous() for column in gradient_columns(returned)]
    own = ranges.pixel_mask(ranks.rank, ranks.device)
    return [*arrived, *sums, frame.renders[own], frame.visible.clone()], frame.route.traffic.most_isects


def _both_ways(ranks):
    """Exchanges of growing, shrinking and empty shards; each by peers and by collectives."""
    peers, sizes = ranks.peers, []
    assert peers is not None, ranks.transport
    for count in (3, 700, 400_000, 0, 1000):
        table = _table(count, ranks)
        ranks.peers = peers
        written, needed = _exchange(table, ranks)
        for room in (needed, needed // 2, 0):  # for lists: enough, too little, not known
            peers.n_isects, before = room, peers.exchanges
            again, _ = _exchange(table, ranks)
            assert all(torch.equal(x, y) for x, y in zip(written, again, strict=True))
            assert peers.n_isects >= needed
            assert peers.exchanges - before == (2 if 0 < room < needed else 1)
        ranks.peers = None
        carried, _ = _exchange(table, ranks)
        for x, y in zip(written, carried, strict=True):
            assert x.dtype == y.dtype and torch.equal(x, y)
        sizes.append(len(peers.buffers[0]))
    assert sizes[0] == sizes[1] < sizes[2] == sizes[3] == sizes[4]
    return sizes[2]


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_peers_bring_what_collectives_bring(world_size, device):
    sizes = run_ranks(_both_ways, world_size, device=device, transport="peer")
    assert len(set(sizes)) == 1


def _gradients(ranks):
    """Gradients read in the ranks' tables are those that collectives carry, also of tiny shards."""
    peers = ranks.peers
    assert peers is not None, ranks.transport
    exchange.LEAST_ROWS = 0
    options = dataclasses.replace(OPTIONS, sh_degree=3, deterministic=True)
    views, stepped = cameras(3, device=ranks.device), []
    optimiser = LazyAdam(OptimiserConfig(), Schedule(ScheduleConfig()), 1.0, ranks.device)
    for count in (3, 700, 100_000, 0):
        small = _table(count, ranks)
        columns = {name: small[name] for name in small if "exp_avg" not in name}
        columns["sh"] = torch.nn.functional.pad(small["sh"], (0, 0, 0, 15))  # fused only so
        table = GaussianTable.create(columns)
        frames, rows, gradients = [], [], []
        for ranks.peers in (None, peers):
            share = Share(ranks, TileOwners(ranks).divide(range(3), views.width, views.height))
            frame = pipeline.forward(table, views, options, share=share, backward_follows=count != 700)
            v_renders = torch.where(frame.renders > 0, 1e-3, 1e-4)
            rows.append(pipeline.backward_rows(frame, v_renders))
            gradients.append(pipeline.backward(table, frame, v_renders))  # from zeros again
            frames.append(frame)
        assert rows[0].tables.places is None and rows[1].means2d is None
        found = sum_tables(rows[1].tables, len(frames[1].rows.means2d))
        for x, y in zip(gradient_columns(found), rows[0][:4], strict=True):
            assert torch.equal(x, y)
        for x, y in zip(*gradients, strict=True):
            atol = 2e-6 * float(x.abs().max()) if x.numel() else 0.0
            torch.testing.assert_close(x, y, rtol=1e-5, atol=atol)
        kept = torch.full_like(rows[0].means2d, torch.nan)
        optimiser.step(table, frames[1], rows[1], None, 1, kept)
        assert torch.equal(kept, rows[0].means2d)
        stepped.append((table["last_step"] == 1).sum().item())
    assert (min(stepped[1:3]) > 0) == (ranks.rank != 2)
    return stepped


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_gradients_in_tables_are_those_that_return(world_size, device):
    assert len(run_ranks(_gradients, world_size, device=device, transport="peer")) == world_size


def _hidden(ranks):
    """A rank composites what one rank would, where rows are hidden after it has listed them."""
    exchange.LEAST_ROWS = 0
    whole, views = random_gaussians(2000), cameras(3, device=ranks.device)
    whole["scales"].add_(1)
    whole["sh"][::5] = torch.nan
    columns = {name: whole[name] for name in whole if "exp_avg" not in name}
    parts = [
        GaussianTable.create({name: column[first::step].to(ranks.device) for name, column in columns.items()})
        for first, step in ((ranks.rank, ranks.world_size), (0, 1))
    ]
    ranges = TileOwners(ranks).divide(range(3), views.width, views.height)
    own = ranges.pixel_mask(ranks.rank, ranks.device)
    alone = pipeline.forward(parts[1], views, OPTIONS)
    apart = []
    for _ in range(4):
        frame = pipeline.forward(parts[0], views, OPTIONS, share=Share(ranks, ranges))
        assert torch.equal(frame.renders[own], alone.renders[own])
        assert torch.equal(frame.transmittances[own], alone.transmittances[own])
        apart.append(frame.route.space.apart)
    hidden = frame.splats.opacities == 0
    assert hidden.any() and not hidden.all()
    return apart


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_rows_that_turn_out_to_be_hidden_are_not_composited(world_size, device):
    apart = run_ranks(_hidden, world_size, device=device, transport="peer")
    assert apart == [[False, True, True, True]] * world_size


def _overtaken(ranks):
    table, views = _table(300, ranks), cameras(2, device=ranks.device)
    share = Share(ranks, TileOwners(ranks).divide(range(2), views.width, views.height))
    frame = pipeline.forward(table, views, OPTIONS, share=share)
    pipeline.forward(table, views, OPTIONS, share=share)
    with pytest.raises(RuntimeError, match="a later exchange has overwritten"):
        pipeline.backward(table, frame, torch.ones_like(frame.renders))
    return True


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2))
def test_an_overtaken_exchange_is_refused(world_size, device):
    assert run_ranks(_overtaken, world_size, device=device, transport="peer") == [True] * world_size


def _abandoned(ranks, how):
    table = _table(300, ranks)
    _exchange(table, ranks)
    if ranks.rank == 1:
        if how == "kill":
            os.kill(os.getpid(), 9)
        time.sleep(30)
    _exchange(table, ranks)


@pytest.mark.parametrize("how", ["kill", "hang"])
@pytest.mark.parametrize(("world_size", "device"), on_cuda(2))
def test_a_rank_that_leaves_a_meeting_is_named(world_size, device, how):
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_abandoned, world_size, how, device=device, timeout_seconds=3.0, limit=50)
    assert time.monotonic() - start < 50
    assert "waited 3 s in read: rank 1 has not" in failure.value.blame


@pytest.fixture
def alone(monkeypatch):
    """Shared memory of one rank without a GPU: its mail, the peers, and what meetings it queued."""
    met = []
    monkeypatch.setattr(Peers, "_map", lambda self, name, mine: [mine])

    def meet(mail, rank, number, values, first, timeout, known=None):
        met.append((number, values is not None, first, known is not None))

    monkeypatch.setattr(torch.ops.blitzgs, "meet_peers_", meet)
    mail = torch.arange(mail_words(1))
    return mail, Peers(Ranks(), mail, 1.0), met


def test_numbers_are_not_overwritten_before_all_have_read_them(alone):
    """Two calls of `share` in turn use different places."""
    mail, peers, met = alone
    numbers, second = torch.arange(3), 2 * MAX_VALUES
    first = MAX_VALUES - 2
    got = peers.share(numbers)
    assert got.everyone.tolist() == [[first, first + 1, first + 2]]
    assert got.sums.tolist() == [first + 3, first + 4, first + 5]
    peers.meet()
    later = peers.share(numbers)
    assert later.everyone.tolist() == [[first + second, first + second + 1, first + second + 2]]
    assert later.known.data_ptr() != got.known.data_ptr() == peers.share(numbers).known.data_ptr()
    assert met == [
        (1, True, first, True),
        (2, False, 1, False),
        (3, True, first + second, True),
        (4, True, first, True),
    ]
    assert 1 + 2 * second + 1 == len(mail)


def test_sums_are_where_no_rank_writes_numbers(alone):
    _, peers, _ = alone
    calls = [peers.share(torch.zeros(n, dtype=torch.int64)) for n in (1, 7, MAX_VALUES, 3, 20, MAX_VALUES)]
    numbers = [{*call.everyone.flatten().tolist()} for call in calls]
    sums = [{*call.sums.tolist()} for call in calls]
    words = [set.union(*numbers[place::2], *sums[place::2]) for place in (0, 1)]
    assert words[0].isdisjoint(words[1])
    for place in (0, 1):
        assert set.union(*numbers[place::2]).isdisjoint(set.union(*sums[place::2]))
    with pytest.raises(RuntimeError, match="invalid for input of size"):
        peers.share(torch.zeros(MAX_VALUES + 1, dtype=torch.int64))


def test_boards_have_two_places_and_grow(alone, monkeypatch):
    _, peers, met = alone
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: SimpleNamespace(synchronize=lambda: None))
    monkeypatch.setattr(
        peers_module.symmetric, "empty", lambda words, dtype, device: torch.arange(words, dtype=dtype)
    )
    half = peers_module._LEAST_BOARD
    for words, begin in ((5, 0), (5, half), (half, 0), (7, half), (half + 1, 0), (5, half + 1), (5, 0)):
        (board,) = peers.boards(words)
        assert len(board) == words and board[0] == begin
        peers.meet_beside()
    peers.meet()  # counts by itself
    assert [number for number, *_ in met] == [1, 2, 3, 4, 5, 6, 7, 1]


def _refused(rank):
    with pytest.raises(RuntimeError, match="peer is impossible: not every rank computes on a GPU"):
        Ranks.from_environment("cpu", 30.0, "peer")
    return True


def test_peers_need_gpus():
    assert run_ranks(_refused, 2, join=False) == [True, True]
    with pytest.raises(ValueError, match="transport must be one of auto, peer, collective, not 'pigeon'"):
        Ranks.from_environment("cpu", transport="pigeon")


def test_ranks_on_one_gpu_need_to_be_told(monkeypatch):
    places = [("host", 0), ("host", 1), ("host", 0)]
    monkeypatch.setattr(torch.cuda, "can_device_access_peer", lambda mine, other: mine != other)
    gpu = torch.device("cuda:0")
    assert "under the same number" in peers_module._obstacle(places, Ranks(device=gpu))
    assert peers_module._obstacle(places, Ranks(device=gpu, shares_gpu=True)) is None
    assert peers_module._obstacle(places[:2], Ranks(device=gpu)) is None


def _falls_back(ranks):
    return ranks.transport


def test_ranks_without_gpus_use_collectives():
    for text in run_ranks(_falls_back, 2):
        assert text == "collective (gloo); peer memory: not every rank computes on a GPU"
