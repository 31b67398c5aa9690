# SPDX-License-Identifier: Apache-2.0
"""The features of candidates equal their formulas."""

import pytest
import torch

from blitzgs.spawn.candidates import FEATURES, spawn_features
from blitzgs.table.table import GaussianTable
from tests.helpers import DEVICES
from tests.population.test_density import LEVELS, random_table

TIME, EXTENT = 700, 12.5


def candidates(count, device="cpu"):
    """A table, every third of its rows, and whether each is to be split."""
    g = torch.Generator().manual_seed(4)
    table = random_table(count)
    table["birth"].copy_(torch.randint(0, TIME, (count,), generator=g))
    table = GaussianTable({name: column.to(device) for name, column in table.columns.items()})
    rows = torch.arange(count - 1, -1, -3, device=device)
    return table, rows, torch.rand(len(rows), generator=g).to(device) < 0.5


def expected(table, rows, is_split):
    """The definition, column by column."""
    of = {name: column.cpu()[rows.cpu()].double() for name, column in table.columns.items()}
    views, level, scales = of["grad_count"], of["level"], of["scales"]
    columns = {
        "gradient": of["grad_sum"] / views.clamp(min=1),
        "parent_opacity": of["opacities"].sigmoid(),
        "parent_scale": scales.exp().mean(1) / EXTENT,
        "parent_age": TIME - of["birth"],
        "views": views,
        "level": torch.where(is_split.cpu(), (level + 1).clamp(max=LEVELS - 1), level),
        "time": torch.full_like(views, TIME),
        "is_split": is_split.cpu().double(),
        "parent_color_gradient": of["exp_avg_sq.sh"][:, 0].mean(1).sqrt(),
        "parent_flatness": scales.amin(1).exp() / scales.amax(1).exp(),
    }
    return torch.stack([columns[name] for name in FEATURES], 1)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [1, 1000])
def test_matches_the_formulas(device, count):
    table, rows, is_split = candidates(count, device)
    features = spawn_features(table, rows, is_split, TIME, EXTENT, LEVELS)
    assert features.dtype == torch.float32
    torch.testing.assert_close(features.cpu().double(), expected(table, rows, is_split), rtol=2e-7, atol=0)


def test_wrong_arguments():
    table = random_table(6)
    rows, is_split = torch.arange(6), torch.zeros(6, dtype=torch.bool)
    with pytest.raises(RuntimeError, match="rows must be Long, got Int"):
        spawn_features(table, rows.int(), is_split, TIME, EXTENT, LEVELS)
    with pytest.raises(RuntimeError, match=r"is_split must have shape \[6\], got \[5\]"):
        spawn_features(table, rows, is_split[:5], TIME, EXTENT, LEVELS)
    with pytest.raises(RuntimeError, match="extent must be positive"):
        spawn_features(table, rows, is_split, TIME, 0.0, LEVELS)
    with pytest.raises(RuntimeError, match="level_count must be positive"):
        spawn_features(table, rows, is_split, TIME, EXTENT, 0)


def test_opcheck():
    table, rows, is_split = candidates(9)
    names = ("grad_sum", "grad_count", "opacities", "scales", "birth", "level", "exp_avg_sq.sh")
    torch.library.opcheck(
        torch.ops.blitzgs.spawn_features,
        ([table[name] for name in names], rows, is_split, TIME, EXTENT, LEVELS),
    )
