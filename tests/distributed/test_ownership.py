# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.ownership import TILE_COST, TileOwners, TileRanges, cost_balance, divide


@pytest.mark.parametrize("parts", [1, 2, 3, 4, 8])
def test_parts_cost_the_same_up_to_one_tile(parts):
    rng = np.random.default_rng(0)
    cost = rng.gamma(0.5, 100.0, 1500) + TILE_COST
    bounds = divide(cost, parts)
    sums = [cost[a:b].sum() for a, b in zip(bounds, bounds[1:], strict=False)]
    assert len(bounds) == parts + 1 and bounds[0] == 0 and bounds[-1] == 1500
    assert max(abs(s - cost.sum() / parts) for s in sums) <= cost.max()
    assert cost_balance(cost, bounds) <= 1.05


def test_extreme_costs():
    assert divide(np.array([0.0, 0.0, 9.0, 0.0]), 3)[-1] == 4
    assert divide(np.zeros(5), 2)[0] == 0
    assert divide(np.ones(2), 4) == (0, 0, 1, 2, 2) or divide(np.ones(2), 4)[-1] == 2
    bounds = divide(np.ones(3), 8)
    assert list(bounds) == sorted(bounds)


def test_costs_are_those_of_the_last_visit():
    owners = TileOwners(Ranks(world_size=1))
    owners.ranks = type("TwoRanks", (), {"world_size": 2, "all_reduce": staticmethod(lambda t: t)})()
    # 64 x 48: 4 x 3 tiles a view.
    assert owners.divide(["a", "b"], 64, 48).bounds == (0, 12, 24)
    work = torch.zeros(24, dtype=torch.int32)
    work[:12] = 1000  # all in view a
    owners.record(["a", "b"], work)
    assert owners.divide(["a", "b"], 64, 48).bounds == (0, 6, 24)
    assert owners.divide(["b", "a"], 64, 48).bounds == (0, 18, 24)
    # A view never seen is expected to cost what the others do on average.
    assert owners.divide(["c", "a"], 64, 48).bounds[1] in (13, 14, 15, 16)
    # Another resolution: nothing is known.
    assert owners.divide(["a"], 32, 32).bounds == (0, 2, 4)


def test_pixel_rows_and_halo():
    ranges = TileRanges((0, 9, 9, 40, 56), 2, 100, 60)  # 7 x 4 tiles a view
    assert ranges.of(2) == (9, 40)
    assert ranges.halo(0) == [(9, 17)]
    assert ranges.halo(1) == []
    assert ranges.halo(2) == [(1, 9), (40, 48)]  # stops at no view's border it does not reach
    assert ranges.halo(3) == [(32, 40)]
    assert ranges.pixel_rows(0, 0) == (0, 42)
    assert ranges.pixel_rows(0, 1) == (0, 0)
    assert ranges.pixel_rows(2, 0) == (6, 60)
    assert ranges.pixel_rows(2, 1, margin=0) == (0, 32)
    assert ranges.pixel_rows(1, 0) == (0, 0)
