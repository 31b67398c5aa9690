# SPDX-License-Identifier: Apache-2.0
"""Blocks and views that a device holds of a host's table."""

import weakref

import pytest
import torch

from blitzgs.ops import host
from blitzgs.ops.blocks import BLOCK_ROWS, seen_blocks, swap_blocks_
from blitzgs.ops.host import PinnedNumbers
from blitzgs.table.blocks import BlockIndex
from tests.helpers import DEVICES
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, make_table, make_views

SHAPES = [((3,), torch.float32), ((), torch.float32), ((4, 3), torch.float32), ((), torch.int64),
          ((), torch.uint8), ((5,), torch.int32)]  # fmt: skip


def sizes_of(count, device):
    return torch.tensor([[WIDTH, HEIGHT]] * count, dtype=torch.int32, device=device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(3))
def test_blocks_that_no_view_sees_have_no_active_rows(device, seed):
    table = make_table(60_000, device, seed)
    viewmats, Ks = make_views(4, device, seed + 20)
    index = BlockIndex(table)
    seen = seen_blocks(index.bounds, viewmats, Ks, sizes_of(4, device), NEAR, FAR)
    ids, views = index.active(table, viewmats, Ks, WIDTH, HEIGHT, NEAR, FAR).listed()
    assert (views & ~seen[ids.long() // BLOCK_ROWS] == 0).all()
    # Few blocks are seen that have no active rows.
    used = torch.unique(ids.long() // BLOCK_ROWS)
    assert len(used) <= (seen != 0).sum() <= 1.3 * len(used) + 10
    assert (seen == 0).any()


@pytest.mark.parametrize("device", DEVICES)
def test_views_have_sizes_of_their_own(device):
    table = make_table(20_000, device)
    viewmats, Ks = make_views(2, device)
    bounds = BlockIndex(table).bounds
    sizes = torch.tensor([[WIDTH, HEIGHT], [3 * WIDTH, 2 * HEIGHT]], dtype=torch.int32, device=device)
    both = seen_blocks(bounds, viewmats, Ks, sizes, NEAR, FAR)
    for view in range(2):
        alone = seen_blocks(
            bounds, viewmats[view : view + 1], Ks[view : view + 1], sizes[view : view + 1], NEAR, FAR
        )
        assert torch.equal(both >> view & 1, alone)
    small = seen_blocks(bounds, viewmats, Ks, sizes_of(2, device), NEAR, FAR)
    assert (small >> 1 & 1).sum() < (both >> 1 & 1).sum()


def columns(rows, device, pinned=False, seed=0):
    g = torch.Generator().manual_seed(seed)
    made = [torch.randint(0, 200, (rows, *shape), generator=g).to(dtype) for shape, dtype in SHAPES]
    return [column.pin_memory() if pinned else column.to(device) for column in made]


@pytest.mark.parametrize("device", DEVICES)
def test_swapped_blocks_have_the_right_contents(device):
    blocks, slots, rest = 40, 12, 100
    pool = columns(slots * BLOCK_ROWS + 7, device, seed=1)
    table = columns(blocks * BLOCK_ROWS + rest, "cpu", device == "cuda", seed=2)
    g = torch.Generator().manual_seed(3)
    chosen = torch.randperm(blocks, generator=g)[:20].int()
    moves = torch.stack((torch.randperm(slots, generator=g)[:10].int(), chosen[:10], chosen[10:]))
    moves[1, 2], moves[2, 5], moves[1:, 7] = -1, -1, -1
    wanted_pool, wanted_table = ([column.clone().cpu() for column in side] for side in (pool, table))
    for slot, leaving, coming in moves.T.tolist():
        here = slice(slot * BLOCK_ROWS, (slot + 1) * BLOCK_ROWS)
        for c, (old, new) in enumerate(zip(wanted_pool, wanted_table, strict=True)):
            if leaving >= 0 and c < 4:
                new[leaving * BLOCK_ROWS : (leaving + 1) * BLOCK_ROWS] = old[here]
            if coming >= 0:
                old[here] = new[coming * BLOCK_ROWS : (coming + 1) * BLOCK_ROWS]
    swap_blocks_(pool, table, 4, *moves.to(device))
    if device == "cuda":
        torch.cuda.synchronize()
    for got, want in zip([*pool, *table], [*wanted_pool, *wanted_table], strict=True):
        assert torch.equal(got.cpu(), want)
    swap_blocks_(pool, table, 4, *moves[:, :0].to(device))


def test_errors_name_the_value():
    pool, table = columns(512, "cpu"), columns(1024, "cpu")
    lists = [torch.zeros(2, dtype=torch.int32)] * 3
    with pytest.raises(RuntimeError, match="the same columns, at most 48; got 6 and 5"):
        swap_blocks_(pool, table[1:], 1, *lists)
    with pytest.raises(RuntimeError, match=r"rows of pool and table must be alike, got \[512, 3\] and"):
        swap_blocks_([pool[0]], [table[0][:, :2].contiguous()], 1, *lists)
    with pytest.raises(RuntimeError, match="a column of the pool must be Long, got Float"):
        swap_blocks_([pool[1]], [table[3]], 1, *lists)
    with pytest.raises(RuntimeError, match="columns must be contiguous"):
        swap_blocks_([pool[0][:, :1]], [table[0][:, :1]], 1, *lists)
    with pytest.raises(RuntimeError, match="slots must be Int, got Long"):
        swap_blocks_(pool, table, 1, lists[0].long(), *lists[1:])
    with pytest.raises(RuntimeError, match=r"coming must have shape \[2\], got \[1\]"):
        swap_blocks_(pool, table, 1, *lists[:2], lists[2][:1])
    viewmats, Ks = make_views(33)
    bounds = torch.zeros(1, 8)
    with pytest.raises(RuntimeError, match="at most 32 views at once, got 33"):
        seen_blocks(bounds, viewmats, Ks, sizes_of(33, "cpu"), NEAR, FAR)
    with pytest.raises(RuntimeError, match=r"sizes must have shape \[2, 2\], got \[1, 2\]"):
        seen_blocks(bounds, viewmats[:2], Ks[:2], sizes_of(1, "cpu"), NEAR, FAR)


def test_opcheck():
    viewmats, Ks = make_views(2)
    bounds = BlockIndex(make_table(600)).bounds
    torch.library.opcheck(
        torch.ops.blitzgs.seen_blocks, (bounds, viewmats, Ks, sizes_of(2, "cpu"), NEAR, FAR, 0.3)
    )
    lists = torch.tensor([[0], [2], [1]], dtype=torch.int32)
    torch.library.opcheck(
        torch.ops.blitzgs.swap_blocks_, (columns(512, "cpu"), columns(1024, "cpu"), 3, *lists)
    )


class Event:
    is_recorded = False

    def query(self):
        return self.is_recorded


def test_memory_of_a_copy_that_is_not_read_is_kept_until_it_is_written(monkeypatch):
    monkeypatch.setattr(host, "_abandoned", {})
    events = [Event() for _ in range(3)]
    pinned = [PinnedNumbers(torch.zeros(1), event, []) for event in events]
    memory = [weakref.ref(piece.memory) for piece in pinned]
    pinned.pop(0).abandon()
    pinned.pop(0).abandon()
    assert memory[0]() is not None and memory[1]() is not None
    events[1].is_recorded = True
    pinned.pop().abandon()
    assert [found() is not None for found in memory] == [True, False, True]
