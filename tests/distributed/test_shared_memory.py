# SPDX-License-Identifier: Apache-2.0
"""Peer memory delivers what collectives deliver; where it cannot be used, errors are clear."""

import dataclasses
import os
import time
from types import SimpleNamespace

import pytest
import torch

from blitzgs.config.fields import OptimiserConfig, ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed import group, shared_memory
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.shared_memory import MAX_VALUES, SharedMemory, control_words
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import backward_splats, render_frame
from blitzgs.frame.tiles import TileAssignment
from blitzgs.frame.transport.collective import CollectiveTransport
from blitzgs.frame.transport.peer import PeerTransport
from blitzgs.frame.transport.protocol import CapacityEstimate
from blitzgs.ops.rasterize import SplatGradients, gradient_columns
from blitzgs.optim.table_adam import TableAdam
from blitzgs.table.table import GaussianTable
from tests.distributed.rank_harness import RankError, on_cuda, run_ranks
from tests.frame.test_sharded_rendering import OPTIONS, cameras
from tests.helpers import parameter_gradients, refused
from tests.training.tiny import random_gaussians


def _table(count, ranks):
    """This rank's part of a scene; at four ranks one has none."""
    table = random_gaussians(count) if count else random_gaussians(1)
    owner = torch.arange(len(table)) % ranks.world_size
    table.keep((owner == ranks.rank) & (owner != 2) & (count > 0))
    return GaussianTable({name: table[name].to(ranks.device) for name in table})


def _assignment(ranks, n_views=3):
    views = cameras(n_views, device=ranks.device)
    ranges = TileOwners(ranks).divide(range(n_views), views.width, views.height)
    return views, TileAssignment(ranks, ranges)


def _exchange(table, ranks, transport):
    """Splats that arrive here in a fixed order, and the sums of a function of them that return."""
    views, assignment = _assignment(ranks)
    frame = render_frame(table, views, OPTIONS, assignment=assignment, transport=transport)
    got = frame.splats
    order = (got.ids * 4 + got.camera_ids).argsort()
    arrived = [column[order].clone() for column in got]
    gradients = [got.means2d * 2, got.conics + 1, got.opacities, got.colors**2]
    if isinstance(transport, PeerTransport):
        columns = [g[:, None] if g.dim() == 1 else g for g in gradients]
        packed = frame.way_back.cleared_table()
        packed.copy_(torch.cat((*columns, torch.ones_like(got.conics)), 1))
        [returned] = frame.way_back.return_gradients(SplatGradients([packed])).parts
        sums = [column.contiguous() for column in gradient_columns(returned)]
    else:
        sums = frame.way_back.return_gradients(SplatGradients(gradients)).parts
    own = assignment.ranges.pixel_mask(ranks.rank, ranks.device)
    return [*arrived, *sums, frame.renders[own], frame.visible.clone()], frame.way_back.traffic.needed


def _both_ways(ranks):
    """Exchanges of growing, shrinking and empty shards; each by peers and by collectives."""
    memory, sizes = ranks.memory, []
    assert memory is not None, ranks.transport
    for count in (3, 700, 400_000, 0, 1000):
        table = _table(count, ranks)
        transport = PeerTransport(ranks)
        written, needed = _exchange(table, ranks, transport)
        for isects in (needed.isects, needed.isects // 2):  # capacities of lists: sufficient, too small
            given = needed._replace(splats=min(needed.splats, 1000), isects=max(isects, 1))
            transport, before = PeerTransport(ranks, CapacityEstimate(given)), memory.generation
            again, _ = _exchange(table, ranks, transport)
            assert all(torch.equal(x, y) for x, y in zip(written, again, strict=True))
            assert transport.estimate.sizes.holds(needed)
            enough = given.isects >= needed.isects
            assert memory.generation - before == (1 if enough else 2)
        carried, _ = _exchange(table, ranks, CollectiveTransport(ranks))
        for x, y in zip(written, carried, strict=True):
            assert x.dtype == y.dtype and torch.equal(x, y)
        sizes.append(len(memory.buffers[0]))
    assert sizes[0] == sizes[1] < sizes[2] == sizes[3] == sizes[4]
    return sizes[2]


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_peer_and_collective_transports_deliver_the_same(world_size, device):
    sizes = run_ranks(_both_ways, world_size, device=device, transport="peer")
    assert len(set(sizes)) == 1


def _gradients(ranks):
    """Gradients read in the ranks' tables are those that collectives carry, also of tiny shards."""
    options = dataclasses.replace(OPTIONS, sh_degree=3, deterministic=True)
    optimiser = TableAdam(OptimiserConfig(), Schedule(ScheduleConfig()), 1.0, ranks.device)
    views, assignment = _assignment(ranks)
    transports, stepped = (CollectiveTransport(ranks), PeerTransport(ranks)), []
    for count in (3, 700, 100_000, 0):
        small = _table(count, ranks)
        columns = {name: small[name] for name in small if "exp_avg" not in name}
        columns["sh"] = torch.nn.functional.pad(small["sh"], (0, 0, 0, 15))  # fused only so
        table = GaussianTable.create(columns)
        frames, splats, gradients, moments = [], [], [], []
        for transport in transports:
            frame = render_frame(
                table, views, options, assignment=assignment, transport=transport,
                backward_follows=count != 700,
            )  # fmt: skip
            v_renders = torch.where(frame.renders > 0, 1e-3, 1e-4)
            splats.append(backward_splats(frame, v_renders))
            copy = GaussianTable({name: table[name].clone() for name in table})
            optimiser.step(copy, frame, splats[-1], None, None, 1)
            moments.append(copy.exp_avgs)
            # The second pass starts from zeros; the gradients of the first one are read before.
            gradients.append(parameter_gradients(table, frame, v_renders))
            frames.append(frame)
        [found] = splats[1].parts
        torch.testing.assert_close(gradient_columns(found), splats[0].parts[:4], rtol=0, atol=0)
        # After one step, the first moments are the gradients times a factor.
        for pair in (gradients, moments):
            for x, y in zip(*pair, strict=True):
                atol = 2e-6 * float(x.abs().max()) if x.numel() else 0.0
                torch.testing.assert_close(x, y, rtol=1e-5, atol=atol)
        stepped.append((copy["last_step"] == 1).sum().item())
    assert (min(stepped[1:3]) > 0) == (ranks.rank != 2)
    return stepped


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_returned_gradients_equal_the_tables(world_size, device):
    assert len(run_ranks(_gradients, world_size, device=device, transport="peer")) == world_size


def _hidden(ranks):
    """Ranks composite the same image as one rank if the colours of some splats are not finite."""
    whole = random_gaussians(2000)
    whole["scales"].add_(1)
    whole["sh"][::5] = torch.nan
    columns = {name: whole[name] for name in whole if "exp_avg" not in name}
    parts = [
        GaussianTable.create({name: column[first::step].to(ranks.device) for name, column in columns.items()})
        for first, step in ((ranks.rank, ranks.world_size), (0, 1))
    ]
    views, assignment = _assignment(ranks)
    own = assignment.ranges.pixel_mask(ranks.rank, ranks.device)
    alone = render_frame(parts[1], views, OPTIONS)
    transport = PeerTransport(ranks)
    for _ in range(4):
        frame = render_frame(parts[0], views, OPTIONS, assignment=assignment, transport=transport)
        assert torch.equal(frame.renders[own], alone.renders[own])
        transmittances = [rendered.saved.composited[0][own] for rendered in (frame, alone)]
        assert torch.equal(*transmittances)
    hidden = frame.projected.opacities == 0
    assert hidden.any() and not hidden.all()
    return True


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2, 4))
def test_splats_without_a_finite_colour_are_not_composited(world_size, device):
    assert run_ranks(_hidden, world_size, device=device, transport="peer") == [True] * world_size


def _overtaken(ranks):
    table, (views, assignment) = _table(300, ranks), _assignment(ranks, 2)
    transport = PeerTransport(ranks)
    frame = render_frame(table, views, OPTIONS, assignment=assignment, transport=transport)
    render_frame(table, views, OPTIONS, assignment=assignment)  # another transport with the same memory
    refused(RuntimeError, "later .* overwritten", backward_splats, frame, torch.ones_like(frame.renders))
    return True


@pytest.mark.parametrize(("world_size", "device"), on_cuda(2))
def test_gradients_of_an_overwritten_exchange_are_refused(world_size, device):
    assert run_ranks(_overtaken, world_size, device=device, transport="peer") == [True] * world_size


def _abandoned(ranks, how):
    table, transport = _table(300, ranks), PeerTransport(ranks)
    _exchange(table, ranks, transport)
    if ranks.rank == 1:
        if how == "kill":
            os.kill(os.getpid(), 9)
        time.sleep(30)
    _exchange(table, ranks, transport)


@pytest.mark.parametrize(("how", "blame"), [("kill", "stopped reporting"), ("hang", "not")])
@pytest.mark.parametrize(("world_size", "device"), on_cuda(2))
def test_a_rank_that_leaves_a_barrier_is_named(world_size, device, how, blame):
    start = time.monotonic()
    with pytest.raises(RankError) as failure:
        run_ranks(_abandoned, world_size, how, device=device, timeout_seconds=3.0, limit=50)
    assert time.monotonic() - start < 50
    assert f"waited 3 s in share_counts: rank 1 has {blame}" in failure.value.blame


@pytest.fixture
def alone(monkeypatch):
    """Shared memory of one rank without a GPU: its control words, the memory, and the barriers it queued."""
    queued = []
    monkeypatch.setattr(SharedMemory, "map_symmetric", lambda self, name, mine: [mine])

    def barrier(control, rank, number, values, first, timeout, host=None):
        queued.append((number, values is not None, first, host is not None))

    monkeypatch.setattr(torch.ops.blitzgs, "device_barrier_", barrier)
    control = torch.arange(control_words(1))
    return control, SharedMemory(0, 1, torch.device("cpu"), control, 1.0), queued


def test_two_shares_in_turn_use_different_words(alone):
    """Two calls of `share` in turn use different memory."""
    control, memory, queued = alone
    numbers, second = torch.arange(3), 2 * MAX_VALUES
    first = MAX_VALUES - 2
    got = memory.share(numbers)
    assert got.everyone.tolist() == [[first, first + 1, first + 2]]
    assert got.sums.tolist() == [first + 3, first + 4, first + 5]
    memory.barrier()
    later = memory.share(numbers)
    assert later.everyone.tolist() == [[first + second, first + second + 1, first + second + 2]]
    assert later.host.data_ptr() != got.host.data_ptr() == memory.share(numbers).host.data_ptr()
    assert queued == [
        (1, True, first, True), (2, False, 1, False), (3, True, first + second, True), (4, True, first, True),
    ]  # fmt: skip
    assert 1 + 2 * second + 1 == len(control)


def test_sums_and_numbers_use_different_words(alone):
    _, memory, _ = alone
    calls = [memory.share(torch.zeros(n, dtype=torch.int64)) for n in (1, 7, MAX_VALUES, 3, 20, MAX_VALUES)]
    numbers = [{*call.everyone.flatten().tolist()} for call in calls]
    sums = [{*call.sums.tolist()} for call in calls]
    words = [set.union(*numbers[place::2], *sums[place::2]) for place in (0, 1)]
    assert words[0].isdisjoint(words[1])
    for place in (0, 1):
        assert set.union(*numbers[place::2]).isdisjoint(set.union(*sums[place::2]))
    refused(RuntimeError, "for input of size", memory.share, torch.zeros(MAX_VALUES + 1, dtype=torch.int64))


def test_boards_alternate_between_two_halves_and_grow(alone, monkeypatch):
    _, memory, queued = alone
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: SimpleNamespace(synchronize=lambda: None))
    monkeypatch.setattr(
        shared_memory, "symmetric_words", lambda words, dtype, device: torch.arange(words, dtype=dtype)
    )
    half = shared_memory.LEAST_BOARD
    for words, begin in ((5, 0), (5, half), (half, 0), (7, half), (half + 1, 0), (5, half + 1), (5, 0)):
        (board,) = memory.boards(words)
        assert len(board) == words and board[0] == begin
        memory.side_barrier()
    memory.barrier()  # these barriers are counted separately
    assert [number for number, *_ in queued] == [1, 2, 3, 4, 5, 6, 7, 1]


def _refused(rank):
    refused(RuntimeError, "peer is .* not every .* a GPU", Ranks.from_environment, "cpu", 30.0, "peer")
    return True


def test_peers_need_gpus():
    assert run_ranks(_refused, 2, join=False) == [True, True]
    with pytest.raises(ValueError, match="transport must be one of auto, peer, collective, not 'pigeon'"):
        Ranks.from_environment("cpu", transport="pigeon")


def test_ranks_on_one_gpu_need_to_be_told(monkeypatch):
    locations = [("host", 0), ("host", 1), ("host", 0)]
    monkeypatch.setattr(torch.cuda, "can_device_access_peer", lambda mine, other: mine != other)
    gpu = torch.device("cuda:0")
    assert "under the same number" in group.find_obstacle(locations, Ranks(device=gpu))
    assert group.find_obstacle(locations, Ranks(device=gpu, shares_gpu=True)) is None
    assert group.find_obstacle(locations[:2], Ranks(device=gpu)) is None


def _falls_back(ranks):
    return ranks.transport


def test_ranks_without_gpus_use_collectives():
    for text in run_ranks(_falls_back, 2):
        assert text == "collective (gloo); peer memory: not every rank computes on a GPU"
