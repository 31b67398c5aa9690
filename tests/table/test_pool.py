# SPDX-License-Identifier: Apache-2.0
import copy
import gc
import sys
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from blitzgs.ops.blocks import BLOCK_ROWS, seen_blocks
from blitzgs.ops.projection_types import Views
from blitzgs.table import host_table
from blitzgs.table.blocks import BlockIndex, BlockVisibility, Cameras, culled_blocks
from blitzgs.table.host_table import HostMemoryError, HostTable
from blitzgs.table.pool import Moved, Pool, PoolError
from blitzgs.table.table import GaussianTable
from tests.helpers import refused
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, make_table, make_views
from tests.table.test_table import append

LIMITS = (NEAR, FAR, 0.3)
BLOCK_BYTES = BLOCK_ROWS * (3 * 14 * 4 + 2 * 4 + 2 * 8 + 4 + 1 + 3 * 4)


def host_copy(table, device="cpu"):
    return HostTable({name: table[name].clone() for name in table}, pinned=device == "cuda")


def make_pool(n=20_000, slots=30, device="cpu", seed=0):
    table = make_table(n, seed=seed)
    table["means"].nan_to_num_(0, 0, 0)  # so that tables can be compared
    return table, Pool(host_copy(table, device), torch.device(device), (slots + 1) * BLOCK_BYTES, None)


def cameras(views, device="cpu", seed=1):
    """Narrow views, each of which sees few blocks."""
    viewmats, Ks = make_views(views, device, seed)
    Ks[:, 0, 0], Ks[:, 1, 1] = 500.0, 450.0
    sizes = torch.tensor([[WIDTH, HEIGHT]] * views, dtype=torch.int32, device=device)
    return Cameras(viewmats, Ks, sizes, LIMITS)


def first(views, begin, count=None):
    return Cameras(
        *(column[begin:] if count is None else column[begin : begin + count] for column in views[:3]), LIMITS
    )


def assert_same(table, other):
    for name in table:
        assert torch.equal(table[name].cpu(), other[name].cpu()), name


def active_rows(index, table, camera):
    found = index.active(table, Views(*(column[:1] for column in camera[:2]), WIDTH, HEIGHT), LIMITS)
    return found.listed()[0]


@pytest.mark.parametrize("slots", [40, 50, 65])
def test_steps_change_the_rows_that_they_would_change_in_the_whole_table(device, slots):
    """Steps that move all rows of their views, through a pool and in the table itself."""
    table, pool = make_pool(slots=slots, device=device)
    table = GaussianTable({name: table[name].to(device) for name in table})
    views, steps = cameras(16, device), 12
    whole = BlockIndex(table)
    for step in range(steps):
        index = pool.load_for_step(step, first(views, step), 1)
        rows = active_rows(index, pool.held, first(views, step))
        expected = active_rows(whole, table, first(views, step))
        assert torch.equal(pool.rows_of(rows).sort().values, expected)
        assert len(expected) > 0
        pool.prefetch(step + 1)
        for at, side, view in ((rows, pool.held, index), (expected, table, whole)):
            side["means"][at.long(), 0] += 0.5
            side["grad_count"][at.long()] += 1
            view.update(side, at)
        pool.store_bounds(index)
    pool.write_back()
    assert_same(pool.table, table)
    moved = pool.moved
    assert moved.steps == steps and 0 < moved.loaded <= moved.needed
    pool.write_back()  # nothing is left to write back
    assert pool.moved == moved


@pytest.mark.parametrize("n", [20_000, 20_480, 100])
def test_all_rows_pass_through_the_pool(device, n):
    table, pool = make_pool(n, slots=9, device=device)

    def set_step(pool):
        pool["last_step"].fill_(7)

    pool.catch_up(set_step)
    assert (pool.table["last_step"] == 7).all() and len(pool.table) == n
    table["last_step"].fill_(7)
    assert_same(pool.table, table)


def test_the_blocks_that_are_needed_last_go_first():
    _, pool = make_pool(slots=40)
    views = cameras(8)
    seen = [set(np.flatnonzero(_blocks(pool, views, view))) for view in range(8)]
    pool.load_for_step(0, views, 1)
    pool.prefetch(1)
    pool.load_for_step(1, first(views, 1), 1)
    pool.prefetch(2)
    loaded = pool.moved.loaded
    pool.load_for_step(2, first(views, 2), 1)
    assert pool.moved.loaded == loaded  # all of them were loaded ahead
    slots = torch.arange(0, len(pool.held), BLOCK_ROWS, dtype=torch.int32)
    here = set((pool.rows_of(slots) // BLOCK_ROWS).tolist()) & set(range(78))  # the full blocks
    assert seen[1] | seen[2] <= here
    gone = seen[0] - here
    # Blocks that were replaced are not needed sooner than idle blocks that stayed.
    next_use = {b: min((v for v in range(1, 8) if b in seen[v]), default=99) for b in range(78)}
    idle = here - seen[1] - seen[2]
    assert gone
    if idle:
        assert min(next_use[b] for b in gone) >= max(next_use[b] for b in idle)


def known(monkeypatch, steps):
    """Let step i of single views see the blocks `steps[i]`; return cameras for all of them."""

    def seen_blocks(bounds, viewmats, *_):
        seen = torch.zeros(len(bounds), dtype=torch.int64)
        for view, blocks in enumerate(steps[len(steps) - len(viewmats) :]):
            seen[list(blocks)] |= 1 << view
        return torch.where(seen < 1 << 31, seen, seen - (1 << 32)).int()

    monkeypatch.setattr("blitzgs.table.blocks.seen_blocks", seen_blocks)
    return cameras(len(steps))


def loads(pool, views):
    """Return how many blocks each step loads, where it begins and ahead."""
    counts = []
    for step in range(len(views.viewmats)):
        before = pool.moved.loaded
        index = pool.load_for_step(step, first(views, step), 1)
        pool.prefetch(step + 1)
        pool.store_bounds(index)
        counts.append(pool.moved.loaded - before)
    return counts


def fewest_loads(steps, slots):
    """Try all choices of what leaves a pool that holds the blocks of each step and of the next one."""
    costs = {frozenset(steps[0]): len(steps[0])}
    for now, following in pairwise(steps):
        found = {}
        for held, cost in costs.items():
            must, rest = now | following, sorted(held - now - following)
            for kept in combinations(rest, min(len(rest), slots - len(must))):
                pool = frozenset(must.union(kept))
                found[pool] = min(found.get(pool, 10**6), cost + len(following - held))
        costs = found
    return min(costs.values())


@pytest.mark.parametrize("seed", range(8))
def test_no_choice_of_what_leaves_loads_fewer_blocks(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    steps = [set(rng.choice(9, 2, replace=False).tolist()) for _ in range(20)]
    _, pool = make_pool(9 * BLOCK_ROWS, slots=5 - 1)
    assert len(pool.held) == 5 * BLOCK_ROWS
    fewest = fewest_loads(steps, 5)
    assert sum(loads(pool, known(monkeypatch, steps))) == fewest
    # It matters what leaves: the choice of what was not used for longest loads more.
    recent, least_recent = [], 0
    for now, following in pairwise([set(), *steps]):
        least_recent += len(following - set(recent))
        recent = [b for b in recent if b not in now | following] + sorted(now) + sorted(following - now)
        recent = recent[-5:]
    assert fewest < least_recent


def test_a_view_elsewhere_is_loaded_over_the_steps_before_it(monkeypatch):
    """Nine steps see two blocks each, the tenth sees 18 others: all steps load two blocks."""
    steps = [{0, 1}] * 9 + [set(range(2, 20))] + [{0, 1}] * 3
    _, pool = make_pool(40 * BLOCK_ROWS, slots=25)
    counts = loads(pool, known(monkeypatch, steps))
    assert counts == [2 + 2, *[2] * 8, *[0] * 4]


def _blocks(pool, views, view):
    """Return the views, as bits, that see each full block of the table."""
    one, full = first(views, view, 1), len(pool.table) // BLOCK_ROWS
    return seen_blocks(BlockIndex(pool.table).bounds[:full], *one[:3], *LIMITS).numpy()


def test_a_step_waits_for_blocks_that_were_not_prefetched():
    """The pool fits one step at a time; blocks of the next step do not replace blocks of the present one."""
    _, pool = make_pool(slots=60)
    views = cameras(4)
    counts = [int((_blocks(pool, views, v) != 0).sum()) for v in range(4)]
    _, pool = make_pool(slots=max(counts))
    for step in range(4):
        index = pool.load_for_step(step, first(views, step), 1)
        assert len(active_rows(index, pool.held, first(views, step))) > 0
        pool.prefetch(step + 1)
    _, pool = make_pool(slots=max(counts) - 1)
    with pytest.raises(
        PoolError,
        match=rf"see {max(counts)} blocks .* room for {max(counts) - 1},.*raise memory.*--resident-gb",
    ):
        for step in range(4):
            pool.load_for_step(step, first(views, step), 1)
            pool.prefetch(step + 1)


def test_large_batches_do_without_a_look_ahead():
    _, pool = make_pool(60_000, slots=233)
    views = cameras(40)
    views.Ks[:, :2, :2] *= 8
    for step in range(2):
        index = pool.load_for_step(step, first(views, 20 * step, 20), 20)
        found = index.active(pool.held, Views(*first(views, 20 * step, 20)[:2], WIDTH, HEIGHT), LIMITS)
        assert int(found.length) > 0
        pool.prefetch(step + 1)
    assert pool.moved.needed > pool.moved.loaded


def test_a_budget_below_two_blocks_is_refused():
    refused(PoolError, "less than two blocks", make_pool, slots=0)


def test_a_table_that_fits_is_loaded_once():
    table, pool = make_pool(5000, slots=100)
    views = cameras(12)
    for step in range(12):
        pool.load_for_step(step, first(views, step), 1)
        pool.prefetch(step + 1)
    assert pool.moved.loaded <= 5000 // BLOCK_ROWS
    assert pool.moved.bytes_out == 0
    assert len(pool.held) == 5000


def test_changes_of_the_table_reach_the_pool():
    table, pool = make_pool(slots=40)
    views = cameras(2)
    pool.load_for_step(0, views, 1)
    pool.prefetch(1)
    pool.write_back()
    kept = torch.arange(len(table)) % 3 > 0
    pool.table.keep(kept)
    pool.table["phi"] = torch.rand(len(pool.table))
    pool.reindex(None)
    index = pool.load_for_views(first(views, 0, 1))
    rows = active_rows(index, pool.held, views).long()
    places = pool.rows_of(rows).long()
    assert len(rows) > 0
    for name in pool.held:
        assert torch.equal(pool.held[name][rows], pool.table[name][places]), name
    table.keep(kept)
    pool.write_back()
    for name in table:
        assert torch.equal(pool.table[name], table[name])


def test_traffic_between_two_counts():
    later, earlier = Moved(10, 100, 25, 3_000_000, 2_000_000), Moved(5, 50, 20, 1_000_000, 0)
    assert later.since(earlier).values() == {"resident_hits": 0.9, "moved_mb_per_step": 0.8}


def test_columns_keep_their_memory_when_rows_change():
    plain = make_table(1000)
    table = host_copy(plain)
    places = {name: table[name].data_ptr() for name in table}
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    for each in (plain, table):
        each.permute(order)
        each.keep(order < 900)
        append(each, {name: each[name][:200].clone() for name in each})
    assert {name: table[name].data_ptr() for name in table} == places
    assert_same_bits(table, plain)
    for each in (plain, table):
        append(each, {name: each[name][:400].clone() for name in each})
        each["phi"] = each["scales"][:, 0].clone()
        del each["phi"]
        each.keep(torch.arange(len(each)) < 10)
    assert table["means"].data_ptr() != places["means"]
    assert_same_bits(table, plain)


def assert_same_bits(table, other):
    assert list(table) == list(other)
    for name in table:
        assert torch.equal(table[name].nan_to_num(0), other[name].nan_to_num(0)), name


def test_a_host_without_room_is_named(monkeypatch):
    monkeypatch.setattr(host_table, "available_bytes", lambda: 40 << 10)
    refused(
        HostMemoryError,
        r"10,000 Gaussians needs [0-9.]+ [kM]B .*max_gaussians",
        host_copy,
        make_table(10_000),
    )


class FakeRuntime:
    """Replaces the CUDA runtime: records which memory is pinned, and checks that it is mapped."""

    def __init__(self):
        self.pinned, self.calls = {}, 0

    def cudaHostRegister(self, address, size, flags):  # noqa: N802
        assert is_mapped(address) and is_mapped(address + size - 1) and flags == 0
        assert address not in self.pinned
        self.pinned[address] = size
        self.calls += 1
        return 0

    def cudaHostUnregister(self, address):  # noqa: N802
        assert is_mapped(address)
        del self.pinned[address]
        return 0


def is_mapped(address):
    ranges = (line.split()[0].split("-") for line in Path("/proc/self/maps").read_text().splitlines())
    return any(int(begin, 16) <= address < int(end, 16) for begin, end in ranges)


def test_memory_is_unpinned_before_it_goes(monkeypatch):
    gc.collect()  # the real runtime unpins the tables of other tests
    runtime, unraisable = FakeRuntime(), []
    monkeypatch.setattr(torch.cuda, "cudart", lambda: runtime)
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    monkeypatch.setattr(sys, "excepthook", lambda *error: unraisable.append(error))
    table = host_copy(make_table(50_000), "cuda")
    columns = len(table.columns)
    assert runtime.calls == len(runtime.pinned) == columns
    kept = table.columns["sh"][5:9]
    append(table, {name: table[name].clone() for name in table})  # more rows than the memory has room for
    assert runtime.calls == 2 * columns and len(runtime.pinned) == columns + 1
    del kept
    assert len(runtime.pinned) == columns
    del table["level"]  # as the event that clears the cull mask; no column is stored afterwards
    assert len(runtime.pinned) == columns - 1
    del table
    assert not runtime.pinned and not unraisable


def test_the_given_columns_are_moved():
    table = make_table(300)
    expected = copy.deepcopy(table)
    moved = HostTable(table.columns, pinned=False)
    assert not table.columns
    assert_same_bits(moved, expected)


def test_blocks_that_views_leave_out_are_not_seen():
    generator = torch.Generator().manual_seed(0)
    blocks, views = 11, 70
    rows = torch.randint(-(2**31), 2**31 - 1, (blocks * BLOCK_ROWS, 3), generator=generator).int()
    shown = torch.rand(blocks, 96, generator=generator) < 0.5
    bits = (rows[:, :, None] >> torch.arange(32) & 1).bool().view(blocks, BLOCK_ROWS, 96) | ~shown[:, None]
    # In the layout of the kernels: by block and column.
    words = bits.view(blocks, 8, 32, 96).long() << torch.arange(32)[:, None]
    sectors = words.sum(2).mT.contiguous()
    culled = culled_blocks(torch.where(sectors < 1 << 31, sectors, sectors - (1 << 32)).int())
    expected = bits.all(1)
    assert torch.equal((culled[:, :, None] >> torch.arange(32) & 1).bool().flatten(1), expected)
    assert 0.3 < expected.float().mean() < 0.7
    columns = torch.randperm(views, generator=generator)[:32]
    bounds = torch.tensor([0.0, 0, 0, 0, 0, 0, 1, 1]).repeat(blocks, 1)
    viewmats, Ks = torch.eye(4).repeat(32, 1, 1), torch.eye(3).repeat(32, 1, 1)
    viewmats[:, 2, 3] = 5.0
    sizes = torch.full((32, 2), 100, dtype=torch.int32)
    visibility = BlockVisibility(bounds, Cameras(viewmats, Ks, sizes, LIMITS, columns), 1, culled)
    for view, column in enumerate(columns.tolist()):
        assert np.array_equal(visibility.blocks_of_batch(view), ~expected[:, column].numpy())
    assert all(BlockVisibility(bounds, Cameras(viewmats, Ks, sizes, LIMITS), 1, culled).blocks_of_batch(31))
