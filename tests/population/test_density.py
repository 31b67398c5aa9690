# SPDX-License-Identifier: Apache-2.0
"""Density control equals a row-by-row reimplementation; growth and cleaning follow their limits."""

import math

import numpy as np
import pytest
import torch

from blitzgs.config.fields import PopulationConfig
from blitzgs.distributed.group import Ranks
from blitzgs.ops.blocks import WORD_BITS
from blitzgs.ops.counter_random import hash_keys, normal
from blitzgs.population import density
from blitzgs.population.density import (
    DensityRules,
    GrowthLimit,
    cap_opacities,
    densify,
    growth_limit,
    memory_limit,
    rotations,
    rows_that_fit,
)
from blitzgs.runs.clean import floaters, views_counting
from blitzgs.table.placement import place
from blitzgs.table.table import PARAMETERS, GaussianTable

TIME, STEP, SEED, LEVELS = 1200, 300, 9, 4


def random_table(count: int, seed: int = 0) -> GaussianTable:
    g = torch.Generator().manual_seed(seed)
    table = GaussianTable.create(
        {
            "means": torch.randn(count, 3, generator=g),
            "quats": torch.randn(count, 4, generator=g),
            "scales": torch.rand(count, 3, generator=g) * 6 - 7,
            "opacities": torch.randn(count, generator=g) * 3 - 2,
            "sh": torch.randn(count, 4, 3, generator=g),
            "last_step": torch.full((count,), STEP, dtype=torch.int32),
            "id": torch.randperm(10 * count, generator=g)[:count],
            "level": torch.randint(0, LEVELS, (count,), generator=g, dtype=torch.uint8),
        }
    )
    for name in table:
        if name.startswith("exp_avg"):
            table[name].copy_(torch.rand(table[name].shape, generator=g))
    table["grad_count"].copy_(torch.randint(0, 5, (count,), generator=g))
    table["grad_sum"].copy_(torch.rand(count, generator=g) * 1e-3 * table["grad_count"])
    table["max_radii"].copy_(torch.rand(count, generator=g) * 30)
    return table


def brute_force(table: GaussianTable, rules: DensityRules) -> dict[int, dict[str, np.ndarray]]:
    """Return id -> row after the event, one Gaussian at a time."""
    rows = [{name: table[name][i].numpy().copy() for name in table} for i in range(len(table))]

    def gradient(row):
        return np.float32(row["grad_sum"]) / np.float32(max(row["grad_count"], 1))

    def pruned(row, radius):
        opacity = 1 / (1 + math.exp(-row["opacities"]))
        size = math.exp(row["scales"].max())
        return (
            opacity < rules.min_opacity
            or (rules.max_scale is not None and size > rules.max_scale)
            or (rules.max_screen_radius is not None and radius > rules.max_screen_radius)
        )

    def child(row, slot):
        parent = int(row["id"])
        key = int(hash_keys(torch.tensor([parent]), TIME, slot)) & (2**63 - 1)
        new = {name: value for name, value in row.items() if name in PARAMETERS} | {
            "id": key,
            "parent": parent,
            "birth": TIME,
            "level": int(row["level"]) if slot == 0 else min(int(row["level"]) + 1, LEVELS - 1),
            "last_step": STEP,
        }
        if slot > 0:
            draw = np.array([float(normal(torch.tensor([key]), SEED, TIME, axis)) for axis in range(3)])
            axes = rotations(torch.tensor(row["quats"])[None].double())[0].numpy()
            new["means"] = row["means"] + axes @ (np.exp(row["scales"].astype(np.float64)) * draw)
            new["scales"] = np.log(np.exp(row["scales"]) / 1.6)
        return new

    candidates = [row for row in rows if gradient(row) >= np.float32(rules.grad_threshold)]
    if rules.max_gaussians is not None:
        places_left = max(0, rules.max_gaussians - len(rows))
        candidates = sorted(candidates, key=lambda row: (-gradient(row), row["id"]))[:places_left]
    result, replaced = [], set()
    for row in candidates:
        if math.exp(row["scales"].max()) <= rules.clone_scale:
            result.append(child(row, 0))
        else:
            replaced.add(int(row["id"]))
            result += [child(row, 1), child(row, 2)]
    result = [row for row in result if not pruned(row, 0)]
    result += [row for row in rows if int(row["id"]) not in replaced and not pruned(row, row["max_radii"])]
    return {int(row["id"]): row for row in result}


@pytest.mark.parametrize(
    "rules",
    [
        DensityRules(grad_threshold=5e-4, clone_scale=0.05, min_opacity=0.05),
        DensityRules(5e-4, 0.05, 0.05, max_screen_radius=20.0, max_scale=0.25),
        DensityRules(5e-4, 0.05, 0.05, max_gaussians=230),
        DensityRules(5e-4, 0.05, 0.05, max_gaussians=100),
        DensityRules(5e-4, 0.0, 0.05),
    ],
    ids=["plain", "size", "cap", "full", "splits only"],
)
def test_matches_row_by_row(rules):
    table = random_table(200)
    before = len(table)
    expected = brute_force(table, rules)
    report = densify(table, rules, time=TIME, step=STEP, seed=SEED, level_count=LEVELS, ranks=Ranks())
    assert sorted(table["id"].tolist()) == sorted(expected)
    for i, key in enumerate(table["id"].tolist()):
        for name in (*PARAMETERS, "parent", "birth", "level", "last_step"):
            np.testing.assert_allclose(table[name][i].numpy(), expected[key][name], rtol=2e-6, atol=1e-6)
        fresh = key not in range(10 * before)
        for name in table:
            if name.startswith("exp_avg"):
                assert bool(table[name][i].any()) != fresh
    for name in ("grad_sum", "grad_count", "max_radii"):
        assert not table[name].any()
    assert len(table) == before + report.cloned + report.split - report.pruned
    assert report.split > 0 or rules.max_gaussians == 100
    if rules.max_gaussians is not None:
        assert len(table) <= max(rules.max_gaussians, before)
        assert report.held_back > 0


def test_outcome_does_not_depend_on_the_order_of_the_rows():
    rules = DensityRules(grad_threshold=3e-4, clone_scale=0.05, min_opacity=0.05, max_gaussians=270)
    straight, shuffled = random_table(200), random_table(200)
    shuffled.permute(torch.randperm(200, generator=torch.Generator().manual_seed(5)))
    for table in (straight, shuffled):
        densify(table, rules, time=TIME, step=STEP, seed=SEED, level_count=LEVELS, ranks=Ranks())
        table.permute(table["id"].argsort())
    for name in straight:
        assert torch.equal(straight[name], shuffled[name]), name


def test_split_children_scatter_like_their_parent():
    table = random_table(1)
    keep = {name: table[name].repeat(20_000, *[1] * (table[name].dim() - 1)) for name in table}
    table = GaussianTable(keep | {"id": torch.arange(20_000)})
    table["opacities"].fill_(0.0)
    table["grad_sum"].fill_(1.0)
    table["grad_count"].fill_(1)
    mean, scales = table["means"][0].double(), table["scales"][0].double().exp()
    axes = rotations(table["quats"][:1].double())[0]
    densify(
        table, DensityRules(0.5, 1e-9, 0.0), time=TIME, step=STEP, seed=SEED, level_count=LEVELS,
        ranks=Ranks(),
    )  # fmt: skip
    assert len(table) == 40_000
    local = (table["means"].double() - mean) @ axes / scales
    assert local.mean(0).abs().max() < 0.02
    assert (local.T @ local / 40_000 - torch.eye(3)).abs().max() < 0.03


def test_empty_table():
    table = random_table(0)
    report = densify(
        table, DensityRules(1e-4, 0.1, 0.01), time=0, step=1, seed=0, level_count=1, ranks=Ranks()
    )
    assert len(table) == 0 and report.cloned == report.split == report.pruned == report.held_back == 0


def test_capping_opacities_lowers_those_above_and_clears_their_moments():
    table = random_table(200)
    before, others = table["opacities"].clone(), table["exp_avg.means"].clone()
    cap_opacities(table, 0.01)
    after = table["opacities"].sigmoid()
    low = before.sigmoid() <= 0.01
    assert 0 < int(low.sum()) < 200
    assert torch.equal(table["opacities"][low], before[low])
    torch.testing.assert_close(after[~low], torch.full_like(after[~low], 0.01))
    assert not table["exp_avg.opacities"].any() and not table["exp_avg_sq.opacities"].any()
    assert torch.equal(table["exp_avg.means"], others)


def test_children_have_their_parents_phi_and_cull_row():
    table = random_table(300)
    g = torch.Generator().manual_seed(5)
    table["phi"] = torch.rand(300, generator=g)
    table["cull"] = torch.randint(-(2**31), 2**31, (300, 3), generator=g).int()
    parents = {int(i): row for row, i in enumerate(table["id"])}
    phi, cull = table["phi"].clone(), table["cull"].clone()
    rules = DensityRules(grad_threshold=2e-4, clone_scale=0.02, min_opacity=0.005)
    report = densify(table, rules, time=TIME, step=STEP, seed=SEED, level_count=LEVELS, ranks=Ranks())
    assert report.cloned > 5 and report.split > 5
    born = (table["birth"] == TIME).nonzero().squeeze(1).tolist()
    assert len(born) > 10
    for row in range(len(table)):
        origin = parents[int(table["parent" if row in born else "id"][row])]
        assert table["phi"][row] == phi[origin]
        assert torch.equal(table["cull"][row], cull[origin])


def test_the_tightest_limit_wins_and_is_named():
    def limit(points=3_000, memory_count=None, **changed):
        none = {"max_gaussians": 0, "pixels_per_gaussian": 0.0, "gaussians_per_point": 0.0}
        return growth_limit(PopulationConfig(**none | changed), 1_000_000, points, memory_count)

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
def test_a_gpu_holds_more_than_a_small_table_and_less_than_its_memory():
    table = random_table(100_000)
    table = type(table)({name: table[name].cuda() for name in table})
    count = memory_limit(table, Ranks(device=torch.device("cuda")))
    _, total = torch.cuda.mem_get_info()
    row_bytes = sum(table[name][:1].nbytes for name in table)
    assert 100_000 < count < total // row_bytes


@pytest.mark.cuda
def test_a_table_on_the_host_is_limited_by_the_memory_of_the_host(monkeypatch):
    table, ranks = random_table(999), Ranks(device=torch.device("cuda"), local_world_size=2)
    sizes = table.row_bytes.values()
    monkeypatch.setattr(density, "available_bytes", lambda: 2_000_000_000)
    nothing, new = torch.empty(0, dtype=torch.int64), {name: table[name][:1] for name in table}
    table.replace(place(999, nothing, nothing.new_zeros(1), new["means"]), new)
    available = 1_000_000_000 + 1250 * sum(sizes)
    assert memory_limit(table, ranks) == rows_that_fit(1000, sum(sizes), max(sizes), available, 0)


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


def test_views_are_counted_from_the_packed_bits():
    rng = np.random.default_rng(0)
    for n_views in (1, 32, 70):
        culled = rng.random((20, n_views)) < 0.5
        words = -(-n_views // WORD_BITS)
        bits = np.zeros((20, words * WORD_BITS), dtype=np.uint8)
        bits[:, :n_views] = culled
        packed = np.packbits(bits, axis=1, bitorder="little").view("<i4").copy()
        found = views_counting(torch.from_numpy(packed), n_views)
        np.testing.assert_array_equal(found.numpy(), (~culled).sum(axis=1))


def test_floaters_are_weak_and_far_or_large():
    grid = torch.stack(torch.meshgrid(*[torch.arange(12.0)] * 2, torch.arange(3.0), indexing="ij"), dim=-1)
    sound = grid.reshape(-1, 3)
    extra = torch.tensor([
        [5.5, 5.5, 1.5],     # seen once among the others: a detail
        [5.5, 5.5, 60.0],    # seen once, far above
        [-500.0, 0.0, 0.0],  # seen by none, far beyond
        [5.5, 4.5, 1.5],     # seen once, among the others, large
        [5.5, 5.5, 80.0],    # far, but seen by three
    ])  # fmt: skip
    means = torch.cat([sound, extra])
    scales = torch.full((len(means), 3), -2.0) + 0.1 * torch.rand(len(means), 3)
    scales[len(sound)], scales[-2, 1] = -2.0, 3.0
    counted = torch.full((len(means),), 9)
    counted[-5:] = torch.tensor([1, 1, 0, 1, 3])
    found = floaters(means, scales, counted, 1)
    assert found.nonzero()[:, 0].tolist() == [len(sound) + i for i in (1, 2, 3)]
    assert floaters(means, scales, counted, 3).nonzero()[:, 0].tolist()[-1] == len(means) - 1
    # The unit of length does not matter.
    assert torch.equal(floaters(means * 1000, scales + np.log(1000), counted, 1), found)
    # Without a well-seen part there is nothing to compare with.
    assert not floaters(means, scales, torch.zeros_like(counted), 1).any()
