# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.blocks import rows_of_sectors, sectors_of_rows
from blitzgs.table.layouts import CULL, sectors_in
from blitzgs.table.placement import place
from tests.helpers import DEVICES
from tests.training.tiny import random_gaussians


def random_rows(n, words, device="cpu"):
    generator = torch.Generator().manual_seed(n + words)
    return torch.randint(-(2**31), 2**31, (n, words), generator=generator).int().to(device)


@pytest.mark.parametrize("device", DEVICES)
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


@pytest.mark.parametrize("device", DEVICES)
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
    table.append({name: table[name][:70] for name in table})
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
        table.append({name: more[name] for name in more})
    parents = torch.tensor([7, 7, 0, 99, 3])
    table.append({name: more[name] for name in more} | table.inherited(parents))
    assert torch.equal(table[CULL][100:], table[CULL][parents])
    with pytest.raises(ValueError, match=r"column 'cull' of new rows must be torch.int32 \[5, 1\]"):
        table.append({name: more[name] for name in more} | {CULL: random_rows(5, 2)})
    del table[CULL]
    assert CULL not in table


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match=r"rows must be int32|rows must be .*Int"):
        sectors_of_rows(torch.zeros(4, 2))
    with pytest.raises(RuntimeError, match=r"sectors must have shape \[2, \*, 8\], got \[1, 32, 8\]"):
        rows_of_sectors(sectors_of_rows(random_rows(200, 1)), 300)
    with pytest.raises(RuntimeError, match="a multiple of 32 columns, got 31"):
        rows_of_sectors(torch.zeros(1, 31, 8, dtype=torch.int32), 200)


@pytest.mark.parametrize("device", DEVICES)
def test_opcheck(device):
    rows = random_rows(300, 2, device)
    torch.library.opcheck(torch.ops.blitzgs.sectors_of_rows, (rows,))
    torch.library.opcheck(torch.ops.blitzgs.rows_of_sectors, (sectors_of_rows(rows), 300))
