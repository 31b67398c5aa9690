# SPDX-License-Identifier: Apache-2.0
import weakref

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.host_sum import HostSum
from blitzgs.frame.ownership import TILE_COST, TileOwners
from blitzgs.frame.tiles import LOSS_HALO, TileRanges
from blitzgs.ops.intersect import TILE_SIZE


class FirstRank(Ranks):
    """Rank 0 of several ranks; the others add zeros."""

    def __init__(self, world_size=2):
        super().__init__(world_size=world_size)

    def all_reduce(self, tensor, op="sum"):
        return tensor


@pytest.mark.parametrize("parts", [1, 2, 3, 4, 8])
def test_parts_cost_the_same_up_to_one_tile(parts):
    owners = TileOwners(FirstRank(parts))
    work = np.random.default_rng(0).gamma(0.5, 100.0, 1500).astype(np.int32)
    for _ in range(3):
        owners.record(["a"], torch.from_numpy(work), TileRanges((0, *[1500] * parts), 1, 800, 480))
    cost, bounds = work + TILE_COST, owners.divide(["a"], 800, 480).bounds
    sums = [cost[a:b].sum() for a, b in zip(bounds, bounds[1:], strict=False)]
    assert len(bounds) == parts + 1 and bounds[0] == 0 and bounds[-1] == 1500
    assert max(abs(s - cost.sum() / parts) for s in sums) <= cost.max()
    assert max(sums) <= 1.05 * cost.sum() / parts


# 64 x 48: 4 x 3 tiles a view.
SIZE, TILES = (64, 48), 12


def visit(owners, costs):
    """Record a batch of views with the costs of their tiles."""
    work = torch.tensor(list(costs.values()), dtype=torch.int32).repeat_interleave(TILES)
    ranges = TileRanges((0, len(work), len(work)), len(costs), *SIZE)
    return owners.record(list(costs), work, ranges, torch.ones(len(costs), 1, 2, dtype=torch.float64))


def test_costs_are_used_two_batches_later():
    owners = TileOwners(FirstRank())
    assert owners.divide(["a", "b"], *SIZE).bounds == (0, 12, 24)
    work = torch.zeros(24, dtype=torch.int32)
    work[:12] = 1000  # all in view a
    parts = torch.tensor([[[1.0, 4.0], [1.0, 1.0]]], dtype=torch.float64)
    sums = owners.record(["a", "b"], work, TileRanges((0, 24, 24), 2, *SIZE), parts)
    assert sums.read()[:3].tolist() == [2, 5, 1000]
    for _ in range(2):
        assert owners.divide(["a", "b"], *SIZE).bounds == (0, 12, 24)
        visit(owners, {"b": 0})
    assert owners.divide(["a", "b"], *SIZE).bounds == (0, 6, 24)
    assert owners.divide(["b", "a"], *SIZE).bounds == (0, 18, 24)
    # The cost of a view without a visit is the mean cost of the others.
    assert owners.divide(["c", "a"], *SIZE).bounds[1] in (13, 14, 15, 16)
    # Nothing is known about another resolution.
    assert owners.divide(["a"], 32, 32).bounds == (0, 2, 4)


def test_batches_are_divided_without_waiting_for_the_device(monkeypatch):
    """Every division uses sums that the host has already read with the losses."""
    owners, queued, reads = TileOwners(FirstRank()), [], []
    read = HostSum.read

    def read_if_there(sums):
        assert sums in queued[:-1], "neither this batch nor the one before it is there yet"
        reads.append(sums)
        return read(sums)

    monkeypatch.setattr(HostSum, "read", read_if_there)
    for step in range(12):
        assert owners.divide([step, "unseen", 0], *SIZE).bounds[-1] == 3 * TILES
        queued.append(visit(owners, {step: 5}))
    assert len(reads) == 10


def test_cost_memory_of_many_4k_views_is_small():
    """Sums of whole batches are freed, and each 4K view takes 16 KB; the division stays as good."""
    owners, alive, generator = TileOwners(FirstRank()), [], torch.Generator().manual_seed(0)
    size, tiles = (3840, 2160), 240 * 135
    work = torch.randint(0, 3000, (40, tiles), generator=generator, dtype=torch.int32)
    work[:, : tiles // 2] //= 10
    for view in range(0, 40, 2):
        batch = work[view : view + 2].flatten()
        sums = owners.record([view, view + 1], batch, TileRanges((0, 2 * tiles, 2 * tiles), 2, *size))
        alive.append(weakref.ref(sums))
        del sums
    assert [ref() is not None for ref in alive] == [False] * 18 + [True] * 2
    columns = owners.columns()
    assert len(columns["views"]) == 40
    assert columns["costs"].element_size() * len(columns["costs"]) <= 40 * 16_384
    for view in range(0, 36, 2):
        _, border, _ = owners.divide([view, view + 1], *size).bounds
        cost = work[view : view + 2].flatten().double().numpy() + TILE_COST
        assert cost[:border].sum() == pytest.approx(cost[border:].sum(), rel=0.002)


def test_pixel_rows_and_composited_tiles():
    ranges = TileRanges((0, 9, 9, 40, 56), 2, 100, 60, halo=LOSS_HALO)  # 7 x 4 tiles a view
    assert ranges.of(2) == (9, 40)
    assert ranges.composited(0) == (0, 17)
    assert ranges.composited(1) == (1, 1)  # a rank without tiles composites none
    assert ranges.composited(2) == (1, 48)
    assert ranges.composited(3) == (32, 56)
    plain = TileRanges(ranges.bounds, 2, 100, 60)
    assert [plain.composited(rank) for rank in range(4)] == [plain.of(rank) for rank in range(4)]
    assert ranges.pixel_rows(0) == [(0, 42), (0, 0)]
    assert ranges.pixel_rows(2) == [(6, 60), (0, 42)]
    assert ranges.pixel_rows(1) == [(0, 0), (0, 0)]


@pytest.mark.parametrize("halo", [LOSS_HALO, 16, 40])
@pytest.mark.parametrize("bounds", [(0, 0, 1), (0.1, 0.35, 0.35, 0.7), (0.24, 0.25, 0.26, 0.5, 0.98, 1)])
def test_composited_tiles_cover_the_halo(halo, bounds):
    """A rank composites every pixel within `halo` pixels of an owned one, and few others."""
    n_views, width, height = 3, 284, 200
    per_view = -(-width // TILE_SIZE) * -(-height // TILE_SIZE)
    cuts = (0, *(round(n_views * per_view * at) for at in bounds), n_views * per_view)
    ranges = TileRanges(cuts, n_views, width, height, halo)
    firsts = [ranges.composited(rank)[0] for rank in range(len(cuts) - 1)]
    assert firsts == sorted(firsts)
    for rank in range(len(cuts) - 1):
        begin, end = ranges.composited(rank)
        owned = ranges.pixel_mask(rank, torch.device("cpu"))
        there = TileRanges((0, begin, end), n_views, width, height).pixel_mask(1, torch.device("cpu"))
        near = torch.nn.functional.max_pool2d(owned[:, None].float(), 2 * halo + 1, 1, halo)[:, 0] > 0
        assert not (near & ~there).any()
        low, high = ranges.of(rank)
        if low == high:
            assert begin == end
            continue
        ring = -(-halo // TILE_SIZE)
        assert low - begin <= ring * (ranges.tiles_x + 1) and end - high <= ring * (ranges.tiles_x + 1)
        # A rank composites nothing in a view in which it owns nothing.
        views_owned = owned.flatten(1).any(1)
        assert not there.flatten(1).any(1)[~views_owned].any()


def test_restored_costs_give_the_same_borders():
    """The saved state is taken at every step; recent measurements count from the same batch on."""
    batches = [[5, 2], [2, 1], [5, 1], [7, 2], [1, 7], [2, 5]]
    for saved_at in range(len(batches)):
        owners, again = TileOwners(FirstRank()), TileOwners(FirstRank())
        for step, keys in enumerate(batches):
            planned = owners.plan(step + 1, keys, *SIZE, 0)  # one batch ahead, as in training
            if step == saved_at:
                again.restore(owners.columns())
            if step >= saved_at:
                assert again.plan(step + 1, keys, *SIZE, 0) == planned
                visit(again, {key: 10 ** (key % 5) + step for key in keys})
            visit(owners, {key: 10 ** (key % 5) + step for key in keys})
        saved, whole = again.columns(), owners.columns()
        assert all(torch.equal(saved[name], whole[name]) for name in ("views", "tiles", "costs", "ages"))
        again.forget_before(99)
        assert again.plan(1, [5, 2], *SIZE, 0).bounds != owners.plan(1, [5, 2], *SIZE, 0).bounds
    # Divisions for another number of ranks are ignored, costs are used.
    four = TileOwners(Ranks(world_size=4))
    four.restore(whole)
    assert len(four.plan(1, [5, 2], *SIZE, 0).bounds) == 5
    assert torch.equal(four.columns()["costs"], whole["costs"])


def test_costs_of_an_earlier_version_are_left_out():
    owners = TileOwners(FirstRank())
    owners.restore(
        {
            "views": torch.tensor([5]),
            "tiles": torch.tensor([TILES]),
            "costs": torch.rand(TILES),
            "steps": torch.tensor([7]),
            "bounds": torch.tensor([[0, 3, 24]]),
        }
    )
    assert owners.plan(7, [5, 2], *SIZE, 0).bounds == (0, 3, 24)
    assert owners.plan(8, [5, 2], *SIZE, 0).bounds == (0, 12, 24)


def test_a_stored_division_of_another_resolution_is_not_used():
    owners = TileOwners(Ranks(world_size=4))
    first = owners.plan(7, [0, 1], 160, 96, halo=10)
    assert owners.plan(7, [0, 1], 160, 96, halo=10).bounds == first.bounds
    again = TileOwners(Ranks(world_size=4))
    again.restore(owners.columns())
    reduced = again.plan(7, [0, 1], 80, 48, halo=10)
    assert reduced.bounds[-1] == 2 * 5 * 3 != first.bounds[-1]
    assert again.columns()["bounds"].tolist() == [list(reduced.bounds)]
