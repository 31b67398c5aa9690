# SPDX-License-Identifier: Apache-2.0
"""Several ranks that write to each other's memory, without a GPU: ranks are threads, CUDA ops are replaced.

The tests check that all ranks reach the same number of barriers, also if the capacity of some of them is too
small, and that splats and gradients are in the places that the transport names.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import backward_splats, render_frame, survey
from blitzgs.frame.tiles import LOSS_HALO, TileAssignment, TileRanges
from blitzgs.frame.transport.peer import WORDS_PER_SPLAT, PeerTransport, PeerWayBack, room_for
from blitzgs.frame.transport.protocol import CapacityEstimate
from blitzgs.ops.projection_types import Sizes
from blitzgs.table.table import GaussianTable
from tests.frame.test_sharded_rendering import OPTIONS, cameras
from tests.frame.without_gpu import Host, Memory, replace_cuda
from tests.training.tiny import random_gaussians

VIEWS = 3
INTERSECT = torch.ops.blitzgs.intersect


class ThreadRanks(Ranks):
    """A stand-in for `Ranks` of one thread."""

    def all_to_all(self, rows, sent, received):
        self.memory.log.append("all_to_all")
        parts = [groups[self.rank] for groups in self.memory.host.gather(self.rank, rows.split(list(sent)))]
        assert [len(part) for part in parts] == list(received)
        return torch.cat(parts)


def _intersect(*arguments, unchecked):
    """Replaces `intersect` for a capacity below the number of entries, which the CPU op refuses."""
    *given, _, n_splats = arguments
    return INTERSECT(*given, -1, n_splats, unchecked)


@pytest.fixture(autouse=True)
def without_gpu(monkeypatch):
    replace_cuda(monkeypatch)
    monkeypatch.setattr(torch.ops.blitzgs, "intersect", _intersect)
    returned = PeerWayBack.return_gradients

    def from_columns(self, gradients):
        table = self.tables[self.ranks.rank]  # compositing on a GPU writes them here
        flat = torch.cat([part.reshape(len(part), -1) for part in gradients.parts], 1)
        table[: len(flat), :9] = flat
        return returned(self, gradients)

    monkeypatch.setattr(PeerWayBack, "return_gradients", from_columns)


def _on_all(world_size, function):
    """Return [function(ranks) of each rank] and the calls of each rank to the shared memory."""
    host = Host(world_size)

    def rank(number):
        try:
            ranks = ThreadRanks(number, world_size, memory=Memory(host, number))
            return function(ranks), ranks.memory.log
        except BaseException:
            host.meeting.abort()
            raise

    with ThreadPoolExecutor(world_size) as pool:
        return list(zip(*pool.map(rank, range(world_size)), strict=True))


def _scene():
    """Return a table, its views, and the owner of each Gaussian among three ranks; the last owns none."""
    table, views = random_gaussians(600), cameras(VIEWS)
    tiles = TileRanges((0, 1), VIEWS, views.width, views.height).tiles_per_view * VIEWS
    ranges = TileRanges((0, tiles // 5, tiles // 2, tiles), VIEWS, views.width, views.height, halo=LOSS_HALO)
    return table, views, ranges, torch.arange(len(table)) % 7 // 6


def _part(table, owner, ranks):
    rows = owner == ranks.rank
    return GaussianTable({name: table[name][rows] for name in table})


def _keys(ids, camera_ids):
    return ids * VIEWS + camera_ids


@pytest.mark.parametrize("backward_follows", [False, True])
@pytest.mark.parametrize(
    ("sizes", "frames"),
    [
        (None, 2),
        (Sizes(10**4, 10**4, 10**5, 10), 1),
        (Sizes(10**4, 1000, 10**5, 10), 2),  # too small for the splats of one rank, sufficient for the others
        (Sizes(10**4, 10**4, 3000, 10), 2),  # sufficient for the lists of one rank, too small for the others
        (Sizes(1, 1, 1), 2),
    ],
)
def test_all_ranks_repeat_a_frame_that_did_not_fit(sizes, frames, backward_follows):
    table, views, ranges, owner = _scene()
    alone = render_frame(table, views, OPTIONS)
    weights = torch.linspace(-1, 1, alone.renders.numel()).view_as(alone.renders)
    expected = torch.cat([p.reshape(len(p), -1) for p in backward_splats(alone, weights).parts], 1)
    order = _keys(table["id"][alone.projected.gaussian_ids.long()], alone.projected.camera_ids).argsort()

    def rank(ranks):
        transport, part = PeerTransport(ranks, CapacityEstimate(sizes)), _part(table, owner, ranks)
        assignment, before = TileAssignment(ranks, ranges), ranks.memory.generation
        for count in (frames, 1):  # a second frame has the capacity that the first one needed
            frame = render_frame(
                part, views, OPTIONS, assignment=assignment, transport=transport,
                backward_follows=backward_follows,
            )  # fmt: skip
            assert ranks.memory.generation == before + count
            before = ranks.memory.generation
            own = ranges.pixel_mask(ranks.rank, ranks.device)
            assert torch.equal(frame.renders[own], alone.renders[own])
            assert torch.equal(frame.visible, alone.visible)
            for _ in range(2):
                [found] = backward_splats(frame, weights).parts
                ranks.memory.barrier()  # otherwise the next pass could write while other ranks read
        ids = part["id"][frame.projected.gaussian_ids.long()]
        return _keys(ids, frame.projected.camera_ids), found, transport.estimate.sizes

    results, logs = _on_all(3, rank)
    assert logs[0] == logs[1] == logs[2]
    assert results[0][2] == results[1][2] == results[2][2]
    keys, found, _ = (
        torch.cat(parts) if torch.is_tensor(parts[0]) else parts for parts in zip(*results, strict=True)
    )
    assert len(results[2][0]) == 0 and expected.any()
    torch.testing.assert_close(found[keys.argsort(), :9], expected[order], rtol=1e-4, atol=1e-4)


def test_buffers_grow_rarely_while_a_model_grows():
    words, lengths = room_for(100, 0), []
    for splats in range(100, 10_000):
        assert (grown := room_for(splats, words)) >= max(words, splats * WORDS_PER_SPLAT)
        if grown > words:
            lengths.append(words := grown)
    assert len(lengths) <= 20 and room_for(100, words) == words
    assert room_for(10**6, words) < (10**6 + 32) * WORDS_PER_SPLAT  # a single large request is not exceeded


def test_ranks_survey_together():
    table, views, ranges, owner = _scene()
    ranges = replace(ranges, halo=0)  # each tile counts once
    alone = survey(table, views, OPTIONS)
    order = _keys(table["id"][alone.splats.gaussian_ids.long()], alone.splats.camera_ids).argsort()

    def rank(ranks):
        part = _part(table, owner, ranks)
        got = survey(part, views, OPTIONS, TileAssignment(ranks, ranges), PeerTransport(ranks))
        return (
            _keys(part["id"][got.splats.gaussian_ids.long()], got.splats.camera_ids),
            got.weights,
            got.pixels,
        )

    results, logs = _on_all(3, rank)
    assert logs[0] == logs[1] == logs[2]
    keys, weights, pixels = map(torch.cat, zip(*results, strict=True))
    assert torch.equal(weights[keys.argsort()], alone.weights[order]) and alone.weights.any()
    assert torch.equal(pixels[keys.argsort()], alone.pixels[order])
