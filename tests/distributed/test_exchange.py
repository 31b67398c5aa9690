# SPDX-License-Identifier: Apache-2.0
import torch

from blitzgs.distributed.exchange import exchange, plan_route, send, send_back
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import LOSS_REACH, TileRanges
from blitzgs.distributed.rows import Splats
from tests.distributed.rank_harness import run_ranks

WIDTH, HEIGHT, CAMERAS = 100, 60, 2
TILES = CAMERAS * 7 * 4


def scene(n=240, dtype=torch.float32):
    g = torch.Generator().manual_seed(1)
    means2d = torch.rand(n, 2, generator=g) * torch.tensor([140.0, 100.0]) - 20
    a, c = torch.rand(2, n, generator=g).mul(4).exp() * 0.003
    b = (torch.rand(n, generator=g) - 0.5) * (a * c).sqrt()
    return Splats(
        means2d.to(dtype),
        torch.stack((a, b, c), 1).to(dtype),
        torch.rand(n, generator=g).to(dtype),
        torch.rand(n, 3, generator=g).to(dtype),
        torch.rand(n, generator=g).to(dtype),
        torch.arange(n, dtype=torch.int32) % CAMERAS,
        torch.randperm(n, generator=g) + 2**40,
    )


def ranges_for(world_size):
    bounds = {1: (0, TILES), 2: (0, 17, TILES), 4: (0, 9, 9, 40, TILES)}[world_size]
    return TileRanges(bounds, CAMERAS, WIDTH, HEIGHT, reach=LOSS_REACH)


def owned_by(splats, rank, world_size):
    """The rows of one rank; at four ranks rank 2 has none."""
    owner = torch.arange(len(splats.ids)) % world_size
    if world_size == 4:
        owner[owner == 2] = 3
    return Splats(*(column[owner == rank] for column in splats))


def weight_of(splats):
    """A number per row that depends on its id alone, for a loss that has the same terms at any world size."""
    return ((splats.ids * 2654435761 >> 7) % 1000).double() / 1000


def _round_trip(ranks, half):
    whole = scene(dtype=torch.float32 if half else torch.float64)
    mine = owned_by(whole, ranks.rank, ranks.world_size)
    ranges = ranges_for(ranks.world_size)
    leaves = Splats(*(c.clone().requires_grad_() if c.is_floating_point() else c for c in mine))
    got, route = exchange(leaves, ranges, ranks, half)
    # Each rank sees a row as often as it owns intersections with it; here: once per rank, weighted by rank.
    w = weight_of(got)[:, None] * (1 + ranks.rank)
    loss = (
        (w * got.means2d**2).sum()
        + (w * got.conics).sum()
        + (w[:, 0] * got.opacities**3).sum()
        + (w * got.colors**2).sum()
        + (w[:, 0] * got.depths).sum()
    )
    loss.backward()
    grads = [leaf.grad for leaf in leaves if leaf.is_floating_point()]
    # The explicit form gives the same.
    plain = send(mine, plan_route(mine, ranges, ranks, half), ranks)
    assert all(torch.equal(a, b) for a, b in zip(plain, got, strict=True))
    n_bytes = sum(route.traffic.sent)
    return mine.ids, [g.detach() for g in grads], {k: v.detach() for k, v in got._asdict().items()}, n_bytes


def expected_gradients(whole, world_size):
    """Gradients by the masks of the routes, computed in one process."""
    from blitzgs.ops.route import route_count

    ranges = ranges_for(world_size)
    composited = [ranges.composited(rank) for rank in range(world_size)]
    masks, _ = route_count(*whole[:3], whole.camera_ids, composited, WIDTH, HEIGHT)
    reach = sum(((masks >> m) & 1) * (1 + m) for m in range(world_size)).double() * weight_of(whole)
    r = reach[:, None]
    return masks, [
        2 * r * whole.means2d,
        r.expand(-1, 3),
        3 * reach * whole.opacities**2,
        2 * r * whole.colors,
        reach,
    ]


def check_world(world_size):
    whole = scene(dtype=torch.float64)
    masks, wanted = expected_gradients(whole, world_size)
    answers = run_ranks(_round_trip, world_size, False)
    ids = torch.cat([a[0] for a in answers])
    order, reference = ids.argsort(), whole.ids.argsort()
    for i, want in enumerate(wanted):
        got = torch.cat([a[1][i] for a in answers])[order]
        torch.testing.assert_close(got, want[reference], rtol=1e-12, atol=1e-12)
    row_of = {int(i): row for row, i in enumerate(whole.ids)}
    for rank, (_, _, received, _) in enumerate(answers):
        rows = torch.tensor([row_of[int(i)] for i in received["ids"]], dtype=torch.int64)
        # Exactly the rows that touch this rank's tiles, once each, unchanged.
        assert torch.equal(rows.sort().values, ((masks >> rank) & 1).nonzero().squeeze(1))
        for name, column in received.items():
            assert torch.equal(column, getattr(whole, name)[rows])


def test_rows_reach_their_tiles_and_gradients_return():
    check_world(2)
    check_world(4)


def test_half_precision_is_close():
    whole = scene()
    answers = run_ranks(_round_trip, 2, True)
    exact = run_ranks(_round_trip, 2, False)
    row_of = {int(i): row for row, i in enumerate(whole.ids)}
    for (_, grads, received, _), (_, exact_grads, _, _) in zip(answers, exact, strict=True):
        rows = torch.tensor([row_of[int(i)] for i in received["ids"]])
        assert torch.equal(received["means2d"], whole.means2d[rows])
        assert torch.equal(received["depths"], whole.depths[rows])
        torch.testing.assert_close(received["colors"], whole.colors[rows], rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(received["opacities"], whole.opacities[rows], rtol=1e-3, atol=1e-6)
        scale = (whole.conics[rows, 0] * whole.conics[rows, 2]).sqrt()[:, None]
        assert ((received["conics"] - whole.conics[rows]).abs() / scale).max() < 4e-3
        a, b, c = received["conics"].unbind(1)
        assert (a * c - b * b > 0).all()
        for got, want in zip(grads, exact_grads, strict=True):
            torch.testing.assert_close(got.double(), want, rtol=2e-2, atol=1e-4)


def test_one_rank_and_no_rows():
    alone, ranges = Ranks(), ranges_for(1)
    whole = scene()
    route = plan_route(whole, ranges, alone)
    got = send(whole, route, alone)
    assert torch.equal(got.ids, whole.ids[route.masks == 1])
    back = send_back([torch.ones(len(got.ids), 2), torch.ones(len(got.ids))], route, alone)
    assert back[0].sum() == 2 * len(got.ids)
    assert back[1].shape == (len(whole.ids),)
    none = Splats(*(column[:0] for column in whole))
    route = plan_route(none, ranges, alone)
    got = send(none, route, alone)
    assert got.means2d.shape == (0, 2) and got.colors.shape == (0, 3)
    assert send_back([got.means2d], route, alone)[0].shape == (0, 2)
