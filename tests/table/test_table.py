# SPDX-License-Identifier: Apache-2.0
"""The table, and the rows that new Gaussians get."""

import pytest
import torch

from blitzgs.ops.blocks import BLOCK_ROWS
from blitzgs.table.blocks import BlockIndex, morton_order, spread
from blitzgs.table.host_table import HostTable
from blitzgs.table.placement import place
from blitzgs.table.table import PARAMETERS, REQUIRED, ZERO_AT_BIRTH, GaussianTable, Placement, schema
from tests.helpers import refused


def filled_table(count: int, seed: int = 0) -> GaussianTable:
    """A table in which every entry of every column is derived from the row's id."""
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randperm(1000, generator=generator)[:count]
    columns = {}
    for name, column in schema(sh_degree=1).items():
        value = ids.reshape(-1, *([1] * len(column.shape))).expand(count, *column.shape) % 251
        columns[name] = ids if name == "id" else value.to(column.dtype).contiguous()
    return GaussianTable(columns)


def append(table: GaussianTable, rows) -> None:
    """Add rows at the end, in their order."""
    count, nothing = len(table), torch.empty(0, dtype=torch.int64, device=table.device)
    new = torch.arange(count, count + len(rows["means"]), device=table.device)
    table.replace(Placement(count + len(new), new, nothing, nothing), rows)


def assert_rows_whole(table: GaussianTable) -> None:
    for name in table:
        column = table[name]
        expected = table["id"] if name == "id" else table["id"] % 251
        expected = expected.reshape(-1, *([1] * (column.dim() - 1))).expand(column.shape)
        assert torch.equal(column.long(), expected), name


def test_permute_keep_and_append_move_whole_rows():
    table = filled_table(100)
    table["extra"] = (table["id"] % 251).double()
    ids = table["id"].clone()
    order = torch.randperm(100, generator=torch.Generator().manual_seed(1))
    table.permute(order)
    assert torch.equal(table["id"], ids[order])
    assert_rows_whole(table)
    mask = table["id"] % 3 != 0
    table.keep(mask)
    assert torch.equal(table["id"], ids[order][mask])
    assert_rows_whole(table)
    more = filled_table(7, seed=2)
    before = len(table)
    append(table, {**more.columns, "extra": (more["id"] % 251).double()})
    assert len(table) == before + 7
    assert_rows_whole(table)


@pytest.mark.parametrize("host", [False, True])
def test_replace_writes_the_rows_that_change_and_no_others(host):
    table = filled_table(700)
    if host:
        table = HostTable(dict(table.columns), pinned=False)
    table["cull"] = torch.arange(2 * 700, dtype=torch.int32).view(700, 2) * 77
    for leaving, joining in ((90, 90), (40, 130), (7, 9), (200, 20), (3, 3)):
        count, more = len(table), filled_table(joining, seed=joining)
        new = {name: more[name] for name in more if not name.startswith("exp_avg")}
        new["cull"] = torch.full((joining, 2), joining, dtype=torch.int32)
        before = {name: table[name].clone() for name in table}
        gone = torch.randperm(count)[:leaving].sort().values
        placement = place(count, gone, torch.randint(count, (joining,)), new["means"])
        table.replace(placement, new, most=900)
        for name in table:
            rows = torch.zeros_like(before[name][:1]).expand(placement.total, *before[name].shape[1:]).clone()
            kept = min(count, placement.total)
            rows[:kept] = before[name][:kept]
            rows[placement.moved_to] = before[name][placement.moved_from]
            rows[placement.new] = new.get(name, torch.zeros_like(rows[:joining]))
            assert torch.equal(table[name], rows), name
        order = torch.randperm(len(table))
        before = {name: table[name].clone() for name in table}
        table.permute(order)
        for name in table:
            assert torch.equal(table[name], before[name][order]), name


def test_a_growing_table_moves_its_columns_rarely():
    table = filled_table(1000)
    places, nothing = set(), torch.empty(0, dtype=torch.int64)
    for _ in range(14):
        more = {name: column[:50] for name, column in table.columns.items()}
        table.replace(place(len(table), nothing, torch.arange(50), more["means"]), more, most=1650)
        places.add(table["sh"].data_ptr())
        row_bytes = sum(table.row_bytes.values())
        assert len(table) * row_bytes <= table.memory_bytes <= max(1650, 1.02 * len(table)) * row_bytes
    assert len(table) == 1700 and len(places) <= 5
    more = {name: column[:0] for name, column in table.columns.items()}
    table.replace(place(len(table), torch.arange(900), nothing, more["means"]), more, most=1650)
    table.permute(torch.randperm(800))
    assert table.memory_bytes == 1000 * row_bytes
    assert_rows_whole(table)


def test_new_rows_start_with_zero_moments_and_statistics():
    source = filled_table(5)
    table = GaussianTable.create({name: source[name] for name in REQUIRED})
    assert sorted(table) == sorted(REQUIRED + ZERO_AT_BIRTH)
    for name in table:
        if name in REQUIRED:
            assert torch.equal(table[name], source[name])
        else:
            assert table[name].shape == source[name].shape and not table[name].any(), name


def test_a_table_of_parameters_alone_holds_first_gaussians():
    source = filled_table(5)
    table = GaussianTable.create({name: source[name] for name in PARAMETERS})
    assert table["id"].tolist() == [0, 1, 2, 3, 4] and (table["parent"] == -1).all()
    assert not any(table[name].any() for name in ("last_step", "moment_step", "birth", "level"))
    with pytest.raises(ValueError, match=r"new rows lack the columns \['quats'\]"):
        GaussianTable.create({name: source[name] for name in PARAMETERS if name != "quats"})


def test_new_rows_without_a_column_that_was_added_later_are_refused():
    table, new = filled_table(5), filled_table(2, seed=2).columns
    table["phi"] = torch.arange(5.0)
    refused(ValueError, r"new rows lack the columns \['phi'\]", append, table, new)
    append(table, new | table.inherited(torch.tensor([3, 1])))
    assert table["phi"].tolist() == [0, 1, 2, 3, 4, 3, 1]


def test_empty_table():
    table = filled_table(0)
    table.keep(torch.zeros(0, dtype=torch.bool))
    append(table, filled_table(3).columns)
    assert len(table) == 3
    assert_rows_whole(table)


class LoopbackRanks:
    """Two ranks in one process: data sent to rank 1 are dropped, and data from rank 1 are fixed."""

    world_size = 2

    def __init__(self, incoming):
        self.incoming = incoming
        self.calls = 0

    def exchange_counts(self, counts):
        self.sent = counts.tolist()
        return torch.tensor([counts[0], len(self.incoming)])

    def all_to_all(self, rows, sent, received):
        assert rows.shape[0] == sum(sent) and sent == self.sent
        name = list(schema(1))[self.calls]
        self.calls += 1
        return torch.cat((rows[: sent[0]], self.incoming[name]))


def test_rows_move_with_every_column():
    table, incoming = filled_table(20), filled_table(6, seed=3)
    ids = table["id"].clone()
    destination = ids % 2
    table.move_rows(destination, LoopbackRanks(incoming))
    assert torch.equal(table["id"], torch.cat((ids[ids % 2 == 0], incoming["id"])))
    assert_rows_whole(table)


def test_errors_name_the_column():
    columns = filled_table(4).columns
    with pytest.raises(ValueError, match=r"columns \['quats'\] are missing"):
        GaussianTable({k: v for k, v in columns.items() if k != "quats"})
    with pytest.raises(ValueError, match=r"column 'means' must be torch.float32 \[4, 3\]"):
        GaussianTable({**columns, "means": torch.zeros(4, 2)})
    with pytest.raises(ValueError, match=r"rows lack the columns \['id'\]"):
        append(filled_table(4), {k: v for k, v in columns.items() if k != "id"})
    with pytest.raises(ValueError, match=r"no columns \['colour'\]"):
        append(filled_table(4), {**columns, "colour": torch.zeros(4)})
    with pytest.raises(ValueError, match=r"no columns \['colour'\]"):
        GaussianTable.create({name: columns[name] for name in PARAMETERS} | {"colour": torch.zeros(4)})
    refused(ValueError, r"mask must be bool \[4\]", filled_table(4).keep, torch.ones(3, dtype=torch.bool))
    refused(ValueError, r"order must be int64 \[4\]", filled_table(4).permute, torch.arange(3))


def in_place(gone, beside):
    """Return row -> new Gaussian, for those that a walk over the blocks with a stack of rows pairs."""
    waiting, found = [], {}
    order = sorted(range(len(beside)), key=lambda i: (beside[i] // BLOCK_ROWS, i))
    rows = list(gone)
    for i in order:
        while rows and rows[0] // BLOCK_ROWS <= beside[i] // BLOCK_ROWS:
            waiting.append(rows.pop(0))
        if waiting:
            found[waiting.pop()] = i
    return found


@pytest.mark.parametrize(
    ("count", "leaving", "joining"),
    [(5000, 300, 700), (5000, 300, 300), (5000, 900, 40), (5000, 0, 300), (5000, 300, 0), (700, 700, 3),
     (700, 700, 0), (0, 0, 0), (300, 1, 1), (5000, 0, 0)],
)  # fmt: skip
def test_every_row_is_taken_once_and_pairs_are_those_of_a_stack(device, count, leaving, joining):
    g = torch.Generator().manual_seed(count + leaving)
    gone = torch.randperm(count, generator=g)[:leaving].sort().values
    beside = (torch.rand(joining, generator=g) ** 2 * count).long()
    means = torch.rand(joining, 3, generator=g)
    placement = place(count, *(tensor.to(device) for tensor in (gone, beside, means)))
    total, new, moved_from, moved_to = placement
    assert total == count - leaving + joining and len(moved_from) == len(moved_to)
    new, moved_from, moved_to = new.cpu(), moved_from.cpu(), moved_to.cpu()
    stays = torch.ones(count, dtype=torch.bool)
    stays[gone] = False
    assert stays[moved_from].all() and (moved_from >= total).all()
    stays[moved_from] = False
    taken = torch.cat((stays.nonzero().squeeze(1), moved_to, new))
    assert torch.equal(taken.sort().values, torch.arange(total))
    pairs = in_place(gone.tolist(), beside.tolist())
    for row, i in pairs.items():
        assert row >= total or int(new[i]) == row
    if joining >= leaving:
        others = [i for i in range(joining) if i not in pairs.values()]
        appended = sorted((i for i in others if new[i] >= count), key=lambda i: int(new[i]))
        along = [i for i in morton_order(means).tolist() if new[i] >= count]
        assert appended == along and len(others) == joining - len(pairs)


def test_spread_is_the_sum_of_mean_widths_up_to_a_limit():
    bounds = torch.zeros(3, 8)
    bounds[0, 3:6] = torch.tensor([1.0, 2.0, 4.0])
    bounds[1, :3], bounds[1, 3:6] = -50.0, 50.0
    bounds[2, :3], bounds[2, 3:6] = 3e38, -3e38  # no row is finite
    assert spread(bounds, 10.0) == 3.5 + 10.0


def relocated(table, generator, share, growth):
    """Replace a share of the rows by copies of others, and let the table grow."""
    n = len(table)
    gone = torch.randperm(n, generator=generator)[: int(share * n)].sort().values
    lives = torch.ones(n, dtype=torch.bool)
    lives[gone] = False
    parents = lives.nonzero().squeeze(1)
    parents = parents[torch.randint(len(parents), (len(gone) + int(growth * n),), generator=generator)]
    new = {name: table[name][parents] for name in table}
    table.replace(place(n, gone, parents, new["means"]), new)


def test_blocks_stay_compact_while_a_table_grows():
    """Four events of 5 % enlarge the blocks less than a single one would whose new rows are put anywhere."""
    g = torch.Generator().manual_seed(3)
    n = 40_000
    means = torch.rand(n, 3, generator=g) * torch.tensor([100.0, 100.0, 2.0])
    rows = {"means": means, "quats": torch.ones(n, 4), "scales": torch.full((n, 3), -3.0)}
    table = GaussianTable.create(rows | {"opacities": torch.zeros(n), "sh": torch.zeros(n, 1, 3)})
    table.permute(morton_order(means))
    for _ in range(4):
        relocated(table, g, 0.01, 0.05)
    grown = spread(BlockIndex(table).bounds, 100.0)
    table.permute(morton_order(table["means"]))
    compact = spread(BlockIndex(table).bounds, 100.0)
    anywhere = table["means"].clone()
    some = torch.randperm(len(table), generator=g)[: len(table) // 20]
    anywhere[some] = anywhere[some[torch.randperm(len(some), generator=g)]]
    table["means"].copy_(anywhere)
    assert grown < 2 * compact < 0.5 * spread(BlockIndex(table).bounds, 100.0)
