# SPDX-License-Identifier: Apache-2.0
"""New rows are checked against a stack of the rows that leave, and for how compact blocks stay."""

import pytest
import torch

from blitzgs.ops.blocks import BLOCK_ROWS
from blitzgs.table.blocks import BlockIndex, morton_order, spread
from blitzgs.table.placement import place
from blitzgs.table.table import GaussianTable
from tests.helpers import DEVICES


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


@pytest.mark.parametrize("device", DEVICES)
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
