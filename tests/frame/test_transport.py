# SPDX-License-Identifier: Apache-2.0
"""Transports of splats between ranks, with doubles that record calls or stand for a GPU."""

from types import SimpleNamespace

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import render_frame, run_attempts
from blitzgs.frame.tiles import LOSS_HALO, TileAssignment, TileRanges
from blitzgs.frame.transport import open_transport
from blitzgs.frame.transport.collective import CollectiveTransport
from blitzgs.frame.transport.peer import WORDS_PER_SPLAT, PeerTransport
from blitzgs.frame.transport.protocol import CapacityEstimate, LocalTransport, Traffic, WayBack
from blitzgs.ops.exchange import scatter_splats
from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions, Sizes
from blitzgs.ops.rasterize import SplatGradients
from tests.distributed.rank_harness import run_ranks
from tests.frame.test_sharded_rendering import OPTIONS, cameras
from tests.frame.without_gpu import Host, Memory, replace_cuda
from tests.helpers import parameter_gradients, refused
from tests.training.tiny import random_gaussians


class TooSmall(LocalTransport):
    """A transport whose first exchanges fail as if the capacity were too small."""

    def __init__(self, too_small):
        super().__init__()
        self.too_small, self.capacities = too_small, []

    def project_and_send(self, inputs, assignment, capacity):
        self.capacities.append(capacity)
        exchange = super().project_and_send(inputs, assignment, capacity)

        def finish():
            needed, result = exchange.finish()
            self.too_small -= 1
            return needed, None if self.too_small >= 0 else result

        return exchange._replace(finish=finish)


WIDTH, HEIGHT, CAMERAS = 100, 60, 2
TILES = CAMERAS * 7 * 4


def scene(n=240, dtype=torch.float32):
    g = torch.Generator().manual_seed(1)
    means = torch.randn(n, 3, generator=g) * torch.tensor([1.5, 1.0, 0.5])
    quats = torch.randn(n, 4, generator=g)
    scales = torch.randn(n, 3, generator=g) * 0.5 - 3
    opacities, sh = torch.randn(n, generator=g), torch.randn(n, 1, 3, generator=g)
    viewmats = torch.eye(4).repeat(CAMERAS, 1, 1)
    viewmats[:, 2, 3] = torch.tensor([3.0, 4.0])
    K = torch.tensor([[80.0, 0, 51], [0, 80, 29], [0, 0, 1]])
    ids = torch.randperm(n, generator=g) + 2**40
    return ProjectionInputs(
        [t.to(dtype) for t in (means, quats, scales, opacities, sh)],
        [t.to(dtype) for t in (viewmats, K.repeat(CAMERAS, 1, 1))],
        ProjectionOptions(WIDTH, HEIGHT),
        ids=ids,
    )


def ranges_for(world_size):
    bounds = {1: (0, TILES), 2: (0, 17, TILES), 4: (0, 9, 9, 40, TILES)}[world_size]
    return TileRanges(bounds, CAMERAS, WIDTH, HEIGHT, halo=LOSS_HALO)


def owned_by(inputs, rank, world_size):
    """The Gaussians of one rank; at four ranks rank 2 has none."""
    owner = torch.arange(len(inputs.ids)) % world_size
    if world_size == 4:
        owner[owner == 2] = 3
    mine = owner == rank
    return inputs._replace(gaussians=[t[mine] for t in inputs.gaussians], ids=inputs.ids[mine])


def weight_of(splats):
    """A number per splat that depends on its id alone."""
    return (((splats.ids * 2654435761) >> 7) % 1000).to(splats.means2d.dtype) / 1000


def gradients_of(splats, rank):
    """Gradients that depend on the splat and on the rank that composited it."""
    w = weight_of(splats)[:, None] * (1 + rank)
    return [
        2 * w * splats.means2d, w.expand(-1, 3), 3 * w[:, 0] * splats.opacities**2, 2 * w * splats.colors
    ]  # fmt: skip


def _round_trip(ranks, capacity):
    inputs = owned_by(scene(dtype=torch.float64), ranks.rank, ranks.world_size)
    transport = open_transport(ranks)
    assignment = TileAssignment(ranks, ranges_for(ranks.world_size))
    exchange = transport.project_and_send(inputs, assignment, capacity)
    got = exchange.arrived
    assert exchange.gradient_table is None
    needed, result = exchange.finish()
    projected, splats, totals, visible, way_back = result
    assert list(needed[:3]) == projected.counts.tolist() == totals[:3]
    traffic = way_back.traffic
    assert splats is got and sum(traffic.received) == len(got.ids)
    for _ in range(2):
        way_back.check_still_valid()
        returned = way_back.return_gradients(SplatGradients(gradients_of(got, ranks.rank)))
    ids = (inputs.ids[projected.gaussian_ids.long()] - 2**40) * CAMERAS + projected.camera_ids
    return ids, returned.parts, got._asdict(), visible, traffic.splats


def masks_by_lists(projected, world_size):
    """Return the ranks that each splat must reach, from the lists of each rank's intersection."""
    masks, ranges = torch.zeros(len(projected.depths), dtype=torch.int64), ranges_for(world_size)
    for rank in range(world_size):
        begin, end = ranges.composited(rank)
        listed, _ = intersect(
            projected.means2d, projected.conics, projected.opacities, projected.depths, projected.camera_ids,
            n_cameras=CAMERAS, width=WIDTH, height=HEIGHT, tile_begin=begin, tile_end=end,
        )  # fmt: skip
        masks[listed.long().unique()] |= 1 << rank
    return masks


@pytest.mark.parametrize("world_size", [2, 4])
@pytest.mark.parametrize("capacity", [None, Sizes(1, 1, 1), Sizes(500, 1000, 1)])
def test_splats_reach_their_tiles_and_gradients_return(world_size, capacity):
    whole = scene(dtype=torch.float64)
    projected = project_splats(whole)
    masks = masks_by_lists(projected, world_size)
    assert masks.unique().numel() > 2
    answers = run_ranks(_round_trip, world_size, capacity)
    ids = torch.cat([a[0] for a in answers])
    keys = (whole.ids[projected.gaussian_ids.long()] - 2**40) * CAMERAS + projected.camera_ids
    order, reference = ids.argsort(), keys.argsort()
    assert torch.equal(ids[order], keys[reference])
    times = sum(((masks >> m) & 1) * (1 + m) for m in range(world_size)).double()
    w = times * ((whole.ids[projected.gaussian_ids.long()] * 2654435761 >> 7) % 1000).double() / 1000
    wanted = [
        2 * w[:, None] * projected.means2d, w[:, None].expand(-1, 3), 3 * w * projected.opacities**2,
        2 * w[:, None] * projected.colors,
    ]  # fmt: skip
    for i, want in enumerate(wanted):
        got = torch.cat([a[1][i] for a in answers])[order]
        torch.testing.assert_close(got, want[reference], rtol=1e-12, atol=1e-12)
    place = {int(key): at for at, key in enumerate(keys)}
    counts = []
    for owned, *_ in answers:
        reaches = masks[[place[int(key)] for key in owned]]
        counts.append([int((reaches >> m & 1).sum()) for m in range(world_size)])
    for rank, (_, _, received, visible, splats) in enumerate(answers):
        assert splats == counts  # every rank knows how many splats each rank sends to each other
        key = (received["ids"] - 2**40) * CAMERAS + received["camera_ids"]
        at = torch.tensor([place[int(k)] for k in key], dtype=torch.int64)
        # Exactly the splats that touch this rank's tiles, once each, unchanged.
        assert torch.equal(at.sort().values, ((masks >> rank) & 1).nonzero().squeeze(1))
        for name, column in received.items():
            if name != "ids":
                assert torch.equal(column, getattr(projected, name)[at]), name
        assert torch.equal(visible, torch.bincount(projected.camera_ids, minlength=CAMERAS))


@pytest.fixture
def alone(monkeypatch):
    """One rank that writes to its own memory."""
    replace_cuda(monkeypatch)
    return Ranks(memory=Memory(Host(1), 0))


def test_memory_that_is_too_small_grows_and_the_frame_is_the_same(alone):
    ranges = ranges_for(1)
    assignment, inputs = TileAssignment(alone, ranges), scene()
    transport = PeerTransport(alone)

    def finished():
        def attempt(sizes):
            exchange = transport.project_and_send(inputs, assignment, sizes)
            assert exchange.n_isects > 0 and len(exchange.arrived.ids) >= len(exchange.gradient_table)
            return exchange, exchange

        result, exchange = run_attempts(transport, attempt)
        return result, exchange.finish()[0]

    result, needed = finished()
    assert alone.memory.generation == 2  # the first attempt had too small a capacity
    assert len(alone.memory.buffers[0]) >= len(result.projected.depths) * WORDS_PER_SPLAT
    projected = project_splats(inputs)
    assert all(torch.equal(a, b) for a, b in zip(result.projected[:11], projected[:11], strict=True))
    masks = masks_by_lists(projected, 1)
    assert torch.equal(result.splats.means2d, projected.means2d[masks == 1])
    table = result.way_back.cleared_table()
    table.copy_(torch.arange(table.numel()).view_as(table))
    [sums] = result.way_back.return_gradients(SplatGradients([table])).parts
    assert torch.equal(sums[masks == 1], table) and not sums[masks == 0].any()
    later, _ = finished()
    later.way_back.check_still_valid()
    refused(RuntimeError, "a later exchange has overwritten", result.way_back.check_still_valid)
    # One entry more than the capacity: the frame is repeated with a larger capacity.
    short = CapacityEstimate(Sizes(1, 1, needed[2] - 1))
    again = PeerTransport(alone, short)
    transport, before = again, alone.memory.generation
    finished()
    assert alone.memory.generation == before + 2


def test_a_frame_by_shared_memory_is_the_local_one(alone):
    table, views = random_gaussians(700), cameras(3)
    ranges = TileRanges((0, 3 * 60), 3, views.width, views.height)
    expected = render_frame(table, views, OPTIONS)
    assignment, transport = TileAssignment(alone, ranges), PeerTransport(alone)
    for backward_follows in (False, True):
        frame = render_frame(
            table, views, OPTIONS, assignment=assignment, transport=transport,
            backward_follows=backward_follows,
        )  # fmt: skip
        assert torch.equal(frame.renders, expected.renders)
        assert torch.equal(frame.visible, expected.visible)


def test_traffic_of_uneven_ranks():
    # Visible Gaussians, splats, tiles and blocks; splats of two views; splats and tiles for each rank.
    totals = [[4, 7, 30, 2, 3, 4, 5, 11, 1, 2, 6, 9], [2, 3, 8, 9, 1, 2, 0, 0, 3, 5, 2, 4], [0] * 12]
    traffic = Traffic.of(totals, 2, 1)
    assert traffic.own == Sizes(2, 3, 8, 9) and traffic.splats == [[5, 1, 6], [0, 3, 2], [0, 0, 0]]
    assert (traffic.sent, traffic.received, traffic.starts) == ([0, 3, 2], [1, 3, 0], [5, 1, 6])
    assert (traffic.most, traffic.n_isects, traffic.most_isects, traffic.most_blocks) == (12, 7, 13, 9)
    assert traffic.needed == Sizes(12, 12, 13, 9)


def test_a_transport_that_does_not_serve_the_job_says_so():
    assignment = TileAssignment(Ranks(), ranges_for(1))
    refused(ValueError, "serves one rank", LocalTransport().project_and_send, scene(), assignment, None)
    with pytest.raises(ValueError, match="need an assignment"):
        CollectiveTransport(Ranks()).project_and_send(scene(), None, None)
    refused(ValueError, "share no memory", PeerTransport, Ranks())


def test_one_rank_needs_no_way_back():
    _, result = LocalTransport().project_and_send(scene(), None, None).finish()
    assert result.way_back is None


def test_a_frame_that_did_not_fit_is_rendered_again_but_not_for_ever():
    table, views = random_gaussians(300), cameras(2)
    expected = render_frame(table, views, OPTIONS)
    transport = TooSmall(2)
    frame = render_frame(table, views, OPTIONS, transport=transport)
    first, second, _ = transport.capacities
    assert first is None and second.holds(expected.projected.counts)
    assert torch.equal(frame.renders, expected.renders)
    v_renders = torch.ones_like(frame.renders)
    gradients = parameter_gradients(table, frame, v_renders)
    for got, want in zip(gradients, parameter_gradients(table, expected, v_renders), strict=True):
        assert torch.equal(got, want)
    transport.too_small = 10
    with pytest.raises(RuntimeError, match="4 attempts have each needed more .* needs \\("):
        render_frame(table, views, OPTIONS, transport=transport)
    assert transport.too_small == 6


@pytest.mark.parametrize("splats", [0, 1, 31, 32, 33, 5000])
@pytest.mark.parametrize("world_size", [2, 4])
def test_sums_return_to_the_splats_that_were_sent(splats, world_size):
    g = torch.Generator().manual_seed(splats)
    masks = torch.randint(0, 1 << world_size, (splats,), generator=g)
    if world_size == 4:
        masks &= 0b1011  # rank 2 composites nothing
    sent = [(masks >> rank & 1).nonzero().squeeze(1) for rank in range(world_size)]
    counts = [len(which) for which in sent]
    _, places = scatter_splats([torch.zeros(splats)], masks, counts)
    returned = torch.randint(-(2**40), 2**40, (sum(counts), 2), generator=g)
    expected = torch.zeros(splats, 2, dtype=torch.int64)
    for which, group in zip(sent, returned.split(counts), strict=True):
        expected.index_add_(0, which, group)
    ranks = SimpleNamespace(all_to_all=lambda *_: returned)
    traffic = SimpleNamespace(sent=counts, received=counts, own=Sizes(0, splats, 0))
    way_back = WayBack(ranks, traffic, places)
    assert torch.equal(way_back.return_sums(returned), expected)
