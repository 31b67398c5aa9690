# SPDX-License-Identifier: Apache-2.0
"""How many Gaussians a run may have."""

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.population import growth
from blitzgs.population.density import DensityRules, densify
from blitzgs.population.growth import GrowthLimit, growth_limit, memory_limit, rows_that_fit
from tests.helpers import needs_cuda
from tests.population.test_density import LEVELS, SEED, STEP, TIME, random_table


def test_the_tightest_limit_wins_and_is_named():
    def limit(**changed):
        none = {
            "max_gaussians": 0,
            "pixels_per_gaussian": 0.0,
            "gaussians_per_point": 0.0,
            "memory_count": None,
        }
        return growth_limit(**none | {"pixels": 1_000_000, "points": 3_000} | changed)

    by_pixels = GrowthLimit(41_666, "population.pixels_per_gaussian")
    by_points = GrowthLimit(31_500, "population.gaussians_per_point")
    assert limit() is None
    assert limit(max_gaussians=500, pixels_per_gaussian=24.0) == GrowthLimit(500, "population.max_gaussians")
    assert limit(pixels_per_gaussian=24.0) == by_pixels
    assert limit(pixels_per_gaussian=24.0, gaussians_per_point=10.5) == by_points
    assert limit(gaussians_per_point=10.5, points=0) is None
    assert limit(max_gaussians=50_000, memory_count=40_000) == GrowthLimit(40_000, "memory")


def test_memory_holds_the_table_a_copy_of_its_widest_column_and_the_scratch():
    # 700 bytes a row and 300 of scratch a row: a thousandth of the memory each, but for the share kept free.
    assert rows_that_fit(100, 500, 200, available=1_000_000, scratch=30_000) == 900
    assert rows_that_fit(0, 500, 200, available=1_000_000, scratch=0) == int(0.9 * 1_000_000 / 700)


def test_the_cpu_has_no_limit_of_memory():
    assert memory_limit(random_table(10), Ranks()) is None


@pytest.mark.cuda
@needs_cuda
def test_a_gpu_holds_more_than_a_small_table_and_less_than_its_memory():
    table = random_table(100_000)
    table = type(table)({name: table[name].cuda() for name in table})
    count = memory_limit(table, Ranks(device=torch.device("cuda")))
    _, total = torch.cuda.mem_get_info()
    row_bytes = sum(table[name][:1].nbytes for name in table)
    assert 100_000 < count < total // row_bytes


@pytest.mark.cuda
@needs_cuda
def test_a_table_on_the_host_is_limited_by_the_memory_of_the_host(monkeypatch):
    table, ranks = random_table(1000), Ranks(device=torch.device("cuda"), local_world_size=2)
    sizes = table.row_bytes.values()
    monkeypatch.setattr(growth, "available_bytes", lambda: 2_000_000_000)
    available = 1_000_000_000 + 1000 * sum(sizes)
    assert memory_limit(table, ranks) == rows_that_fit(1000, sum(sizes), max(sizes), available, 0)
    monkeypatch.setattr(growth, "available_bytes", lambda: None)
    assert memory_limit(table, ranks) is None


def test_statistics_are_gathered_until_there_are_enough():
    table = random_table(300)
    seen, sums = table["grad_count"].clone(), table["grad_sum"].clone()
    by_id = {int(i): (int(n), float(s)) for i, n, s in zip(table["id"], seen, sums, strict=True)}
    enough = DensityRules(2e-4, 0.05, 0.0, min_observations=3)
    gradient = sums / seen.clamp(min=1)
    expected = int(((gradient >= enough.grad_threshold) & (seen >= 3)).sum())
    assert 0 < expected < int((gradient >= enough.grad_threshold).sum())
    report = densify(table, enough, time=TIME, step=STEP, seed=SEED, level_count=LEVELS, ranks=Ranks())
    assert report.cloned + report.split == expected
    old = [row for row in range(len(table)) if int(table["id"][row]) in by_id]
    for row in old:
        count, total = by_id[int(table["id"][row])]
        left = (count, total) if count < 3 else (0, 0.0)
        assert (int(table["grad_count"][row]), float(table["grad_sum"][row])) == pytest.approx(left)
    assert not table["max_radii"].any()
