# SPDX-License-Identifier: Apache-2.0
"""Ops that move rows and blocks of a table, and the keys by which rows are drawn."""

import weakref

import pytest
import torch

from blitzgs.ops import host
from blitzgs.ops.blocks import (
    BLOCK_ROWS,
    put_rows_,
    rows_of_sectors,
    sectors_of_rows,
    seen_blocks,
    swap_blocks_,
    take_rows,
)
from blitzgs.ops.counter_random import (
    KEY_BITS,
    find_digit_,
    key_histogram,
    keys_up_to,
    sampling_keys,
    uniform,
)
from blitzgs.ops.host import PinnedNumbers
from blitzgs.ops.projection_types import Views
from blitzgs.table.blocks import BlockIndex
from blitzgs.table.placement import place
from blitzgs.table.table import CULL, sectors_in
from tests.helpers import refused
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, make_table, make_views
from tests.table.test_table import append
from tests.training.tiny import random_gaussians

COLUMNS = [
    ((), torch.float32), ((3,), torch.float32), ((4,), torch.float32), ((16, 3), torch.float32),
    ((), torch.int64), ((3,), torch.float64), ((), torch.uint8), ((5,), torch.bool), ((3,), torch.float16),
    ((0,), torch.float32),
]  # fmt: skip


@pytest.mark.parametrize(("count", "taken"), [(700, 600), (257, 257), (9, 0)])
def test_equals_torch_s_indexing(device, count, taken):
    g = torch.Generator().manual_seed(count)

    def columns(n):
        return [torch.randint(0, 200, (n, *shape), generator=g).to(device, dtype) for shape, dtype in COLUMNS]

    old, fresh = columns(count), columns(taken)
    rows = torch.randperm(count, generator=g)[:taken].to(device)
    got = take_rows(old, rows)
    longer = [torch.cat((column, column[:1])) for column in got]
    assert (
        take_rows(old, rows.flip(0), [column[:taken] for column in longer])[0].data_ptr()
        == longer[0].data_ptr()
    )
    for column, taken_rows, more in zip(old, got, longer, strict=True):
        assert taken_rows.dtype == column.dtype and torch.equal(taken_rows, column.index_select(0, rows))
        assert torch.equal(more[:taken], taken_rows.flip(0)) and torch.equal(more[taken:], taken_rows[:1])
    for new in (fresh, []):
        changed = [column.clone() for column in old]
        put_rows_(changed, rows, new)
        for i, column in enumerate(old):
            column[rows] = new[i] if new else torch.zeros_like(fresh[i])
            assert torch.equal(changed[i], column)


def test_bits_and_unaligned_columns(device):
    numbers = torch.arange(4 * 21, dtype=torch.int32, device=device)
    numbers[::5] = 0x7FC12345  # a NaN with a payload, as float32
    column = numbers.view(torch.float32)[3:-1].view(20, 4)
    rows = torch.tensor([7, 0, 19, 7], device=device)
    got, some = take_rows([column, column[:, 1]], rows)
    assert torch.equal(got.view(torch.int32), numbers[3:-1].view(20, 4)[rows])
    assert torch.equal(some.isnan(), column[:, 1][rows].isnan())
    others = torch.tensor([8, 1, 18], device=device)
    put_rows_([column], others, [got[:3]])
    assert torch.equal(numbers[3:-1].view(20, 4)[others], got[:3].view(torch.int32))


def test_errors_name_the_value_of_copy_rows():
    rows, three = torch.tensor([0]), [torch.zeros(3)]
    refused(RuntimeError, "column must have rows", take_rows, [torch.tensor(1.0)], rows, [torch.zeros(1)])
    refused(RuntimeError, "rows must be Long, got Int", take_rows, three, rows.int())
    refused(RuntimeError, r"out must have 1 rows, got \[2\]", take_rows, three, rows, [torch.zeros(2)])
    refused(RuntimeError, "as many out as columns, got 0 for 1", take_rows, three, rows, [])
    with pytest.raises(RuntimeError, match=r"rows of fresh must be like those of column, got \[1, 2\]"):
        put_rows_([torch.zeros(3, 4)], rows, [torch.zeros(1, 2)])
    with pytest.raises(RuntimeError, match="fresh must be Float, got Double"):
        put_rows_(three, rows, [torch.zeros(1, dtype=torch.float64)])
    refused(RuntimeError, r"fresh must have 1 rows, got \[2\]", put_rows_, three, rows, [torch.zeros(2)])
    with pytest.raises(RuntimeError, match="fresh must be empty or as many as columns, got 2 for 1"):
        put_rows_(three, rows, three * 2)


def test_opcheck_of_copy_rows():
    rows, column = torch.tensor([3, 1]), torch.randn(5, 2)
    torch.library.opcheck(torch.ops.blitzgs.take_rows_, ([torch.zeros(2, 2)], [column], rows))
    torch.library.opcheck(torch.ops.blitzgs.put_rows_, ([column], rows, [torch.randn(2, 2)]))
    torch.library.opcheck(torch.ops.blitzgs.put_rows_, ([column], rows, []))


def random_rows(n, words, device="cpu"):
    generator = torch.Generator().manual_seed(n + words)
    return torch.randint(-(2**31), 2**31, (n, words), generator=generator).int().to(device)


@pytest.mark.parametrize("words", [0, 1, 3, 40])
@pytest.mark.parametrize("n", [0, 1, 31, 256, 257, 5000])
def test_every_bit_is_at_its_place_and_comes_back(n, words, device):
    rows = random_rows(n, words, device)
    sectors = sectors_of_rows(rows)
    blocks = -(-n // 256)
    assert sectors.shape == (blocks, 32 * words, 8) and sectors.dtype == torch.int32
    lanes = torch.arange(32, device=device)
    by_row = (rows[:, :, None] >> lanes & 1).reshape(n, 32 * words)
    by_sector = (sectors[..., None] >> lanes & 1).reshape(blocks, 32 * words, 256)
    whole = torch.zeros(256 * blocks, 32 * words, dtype=torch.int32, device=device)
    whole[:n] = by_row
    assert torch.equal(by_sector, whole.view(blocks, 256, 32 * words).transpose(1, 2))
    assert torch.equal(rows_of_sectors(sectors, n), rows)


@pytest.mark.parametrize("n", [300, 1024])
def test_a_table_s_mask_moves_with_its_rows(n, device):
    """The table also has an ordinary column with the same numbers."""
    small = random_gaussians(n)
    table = type(small)({name: small[name].to(device) for name in small})
    mask = random_rows(n, 3, device)
    table[CULL], table["plain"] = mask, mask.clone()

    def check(count):
        assert len(table) == count and torch.equal(table[CULL], table["plain"])
        assert sectors_in(table.columns[CULL]).shape == (-(-count // 256), 96, 8)

    check(n)
    generator = torch.Generator().manual_seed(2)
    table.permute(torch.randperm(n, generator=generator).to(device))
    check(n)
    table.keep(torch.rand(n, generator=generator).to(device) < 0.7)
    left = len(table)
    check(left)
    append(table, {name: table[name][:70] for name in table})
    check(left + 70)
    assert table[CULL][left:].any()
    gone = torch.arange(0, left + 70, 5, device=device)
    more = {name: table[name][5:10].clone() for name in table}
    table.replace(place(left + 70, gone, torch.arange(5, 10, device=device), more["means"]), more)
    check(left + 75 - len(gone))
    kept = table[CULL]
    assert torch.equal(table.release()[CULL], kept) and not table.columns


def test_new_rows_need_a_mask_and_may_inherit_it():
    table = random_gaussians(100)
    table[CULL] = random_rows(100, 1)
    more = random_gaussians(5)
    with pytest.raises(ValueError, match=r"new rows lack the columns \['cull'\]"):
        append(table, {name: more[name] for name in more})
    parents = torch.tensor([7, 7, 0, 99, 3])
    append(table, {name: more[name] for name in more} | table.inherited(parents))
    assert torch.equal(table[CULL][100:], table[CULL][parents])
    with pytest.raises(ValueError, match=r"column 'cull' of new rows must be torch.int32 \[5, 1\]"):
        append(table, {name: more[name] for name in more} | {CULL: random_rows(5, 2)})
    del table[CULL]
    assert CULL not in table


def test_errors_name_the_value_of_cull_mask():
    refused(RuntimeError, r"rows must be int32|rows must be .*Int", sectors_of_rows, torch.zeros(4, 2))
    with pytest.raises(RuntimeError, match=r"sectors must have shape \[2, \*, 8\], got \[1, 32, 8\]"):
        rows_of_sectors(sectors_of_rows(random_rows(200, 1)), 300)
    with pytest.raises(RuntimeError, match="a multiple of 32 columns, got 31"):
        rows_of_sectors(torch.zeros(1, 31, 8, dtype=torch.int32), 200)


def test_opcheck_of_cull_mask(device):
    rows = random_rows(300, 2, device)
    torch.library.opcheck(torch.ops.blitzgs.sectors_of_rows, (rows,))
    torch.library.opcheck(torch.ops.blitzgs.rows_of_sectors, (sectors_of_rows(rows), 300))


SHAPES = [((3,), torch.float32), ((), torch.float32), ((4, 3), torch.float32), ((), torch.int64),
          ((), torch.uint8), ((5,), torch.int32)]  # fmt: skip


def sizes_of(count, device):
    return torch.tensor([[WIDTH, HEIGHT]] * count, dtype=torch.int32, device=device)


@pytest.mark.parametrize("seed", range(3))
def test_blocks_that_no_view_sees_have_no_active_rows(device, seed):
    table = make_table(60_000, device, seed)
    viewmats, Ks = make_views(4, device, seed + 20)
    index = BlockIndex(table)
    seen = seen_blocks(index.bounds, viewmats, Ks, sizes_of(4, device), NEAR, FAR)
    ids, views = index.active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3)).listed()
    assert (views & ~seen[ids.long() // BLOCK_ROWS] == 0).all()
    # Few blocks are seen that have no active rows.
    used = torch.unique(ids.long() // BLOCK_ROWS)
    assert len(used) <= (seen != 0).sum() <= 1.3 * len(used) + 10
    assert (seen == 0).any()


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


def test_errors_name_the_value_of_pool_ops():
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


def test_opcheck_of_pool_ops():
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


def test_keys_match_the_formula(device):
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(3000, generator=g) * 1e9
    weights[::7] = 0
    ids = torch.randint(0, 2**62, (3000,), generator=g)
    keys = sampling_keys(weights.to(device), ids.to(device), 5, -17).cpu()
    expected = (-uniform(5, -17, ids).log() / weights.double()).float()
    torch.testing.assert_close(keys, expected, rtol=1e-7, atol=0)
    assert keys[::7].isinf().all()


@pytest.mark.parametrize("count", [0, 700, 100_000])
def test_digits_of_keys_are_counted_under_a_prefix(device, count):
    g = torch.Generator().manual_seed(count)
    keys = torch.randn(count, generator=g) * torch.randn(count, generator=g).exp()
    keys[::9], keys[1::9], keys[2::9] = torch.inf, 0.0, -0.0
    values, shift = keys.double().tolist(), KEY_BITS - 11
    bits = [int(torch.tensor(abs(v)).float().view(torch.int32)) for v in values]
    ordered = torch.tensor(
        [2**31 + b if v >= 0 else 2**31 - 1 - b for v, b in zip(values, bits, strict=True)]
    )
    keys = keys.to(device)
    for limit in ordered[:3].tolist() + [-1, 2**31, 2**32]:
        up_to = keys_up_to(keys, torch.tensor([limit], device=device))
        assert torch.equal(up_to.cpu(), ordered <= limit)
    first = key_histogram(keys, torch.zeros(1, dtype=torch.int64, device=device), shift, 11)
    assert torch.equal(first.cpu(), torch.bincount(ordered.long() >> shift, minlength=2048))
    for prefix in (2**10, 2**11 - 1, 2**10 + 511) if count else ():
        under = ordered[ordered >> shift == prefix]
        second = key_histogram(keys, torch.tensor([prefix], device=device), shift - 10, 10)
        assert torch.equal(second.cpu(), torch.bincount(under >> shift - 10 & 1023, minlength=1024))


@pytest.mark.parametrize("width", [0, 5, 9, 11, 13])
def test_a_search_takes_the_digit_that_its_number_lies_in(device, width):
    counts = torch.randint(3, (1 << width,), generator=torch.Generator().manual_seed(width))
    counts[::3] = 0
    counts[-1] += 1
    ends = counts.cumsum(0)
    for k in {1, 2, int(ends[-1]) // 2 + 1, int(ends[-1]), int(ends[-1]) + 1}:
        search = torch.tensor([5, k, -1], device=device)
        find_digit_(search, counts.to(device))
        digit = min(int((ends < k).sum()), len(ends) - 1)
        before = int(ends[digit] - counts[digit])
        assert search.tolist() == [5 << width | digit, k - before, int(counts[digit])]


def test_errors_name_the_value_of_sampling():
    with pytest.raises(RuntimeError, match=r"ids must have shape \[3\], got \[2\]"):
        sampling_keys(torch.ones(3), torch.arange(2), 0, 0)
    with pytest.raises(RuntimeError, match="a digit must have 1 to 11 of 32 bits, got 12 after 20"):
        key_histogram(torch.ones(3), torch.zeros(1, dtype=torch.int64), 20, 12)

    with pytest.raises(RuntimeError, match="there must be a power of two counts, got 6"):
        find_digit_(torch.zeros(3, dtype=torch.int64), torch.zeros(6, dtype=torch.int64))


def test_opcheck_of_sampling():
    torch.library.opcheck(torch.ops.blitzgs.keys_up_to, (torch.rand(9), torch.tensor([3])))
    torch.library.opcheck(torch.ops.blitzgs.find_digit_, (torch.tensor([0, 1, 0]), torch.tensor([1, 2])))
    torch.library.opcheck(torch.ops.blitzgs.sampling_keys, (torch.rand(9), torch.arange(9), 1, 2))
    prefix = torch.zeros(1, dtype=torch.int64)
    torch.library.opcheck(torch.ops.blitzgs.key_histogram, (torch.rand(9), prefix, 21, 11))
