# SPDX-License-Identifier: Apache-2.0
"""Where the first Gaussians come from; relocation: its closed form, and the event row by row."""

import math
from collections import defaultdict
from fractions import Fraction

import numpy as np
import pytest
import torch

from blitzgs.config.fields import OptimiserConfig, ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.ops.counter_random import hash_keys, sampling_keys
from blitzgs.ops.population import MAX_COPIES, draw_weights, residual_draws, share_rows_
from blitzgs.optim import table_adam
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.density import DensityRules
from blitzgs.population.initialisation import octree_gaussians
from blitzgs.population.relocation import draw_in_proportion, relocate, shared_among_copies
from blitzgs.spawn.lineage import Cause
from blitzgs.table.table import EXP_AVG_SQS, PARAMETERS, GaussianTable, opacity_logit
from blitzgs.view.levels import Levels, measure_levels
from tests.distributed.rank_harness import run_ranks
from tests.population.test_density import LEVELS, SEED, STEP, TIME, random_table


def scene(scale=1.0):
    g = torch.Generator().manual_seed(1)
    points = torch.rand(1500, 3, generator=g, dtype=torch.float64) * torch.tensor([4.0, 4.0, 0.2]).double()
    colors = torch.randint(0, 256, (1500, 3), generator=g, dtype=torch.uint8)
    centres = torch.rand(20, 3, generator=g, dtype=torch.float64) * 3 + torch.tensor([0.0, 0.0, 0.5]).double()
    return points * scale, colors, centres * scale


def make(points, colors, centres, threshold=0.5):
    levels = measure_levels(points, centres, 2.0)
    return levels, octree_gaussians(points, colors, centres, levels, threshold).table(2, 0.1)


def brute_force(points, colors, centres, levels: Levels, threshold):
    """Return [(level, mean, colour)] one voxel at a time."""
    origin = points.min(axis=0)
    kept = []
    for level in range(levels.count):
        size = levels.voxel_size / 2.0**level
        cells = np.floor((points - origin) / size).astype(int)
        for cell in {tuple(c) for c in cells}:
            inside = (cells == cell).all(axis=1)
            mean = origin + (np.array(cell) + 0.5) * size
            distances = np.linalg.norm(centres - mean, axis=1)
            finest = np.clip(np.round(np.log2(levels.reference_distance / distances)), 0, levels.count - 1)
            if (finest >= level).mean() > threshold:
                kept.append((level, mean, colors[inside].mean(axis=0)))
    return kept


@pytest.mark.parametrize("threshold", [0.9, 0.3])
def test_voxels_match_brute_force(threshold):
    points, colors, centres = scene()
    levels, table = make(points, colors, centres, threshold)
    expected = brute_force(points.numpy(), colors.double().numpy(), centres.numpy(), levels, threshold)
    assert levels.count > 2 and len(table) == len(expected)
    colour = table["sh"][:, 0] * 0.28209479 + 0.5
    got = torch.cat((table["level"][:, None], table["means"], colour * 255), dim=1).double().numpy()
    want = np.array([[level, *mean, *colour] for level, mean, colour in expected])
    order = [np.lexsort(np.round(rows[:, :4], 4).T) for rows in (got, want)]
    np.testing.assert_allclose(got[order[0]], want[order[1]], atol=2e-3)
    assert table["id"].tolist() == list(range(len(table)))
    assert not table["sh"][:, 1:].any()


def test_shape_and_opacity_of_the_first_gaussians():
    levels, table = make(*scene())
    distances = torch.cdist(table["means"].double(), table["means"].double()).fill_diagonal_(math.inf)
    spacing = distances.topk(3, largest=False).values.mean(dim=1)
    smallest = 1e-4 * levels.voxel_size
    torch.testing.assert_close(
        table["scales"].double().exp(),
        spacing.clamp(min=smallest)[:, None].expand(-1, 3),
        rtol=1e-4,
        atol=1e-6,
    )
    torch.testing.assert_close(table["opacities"].sigmoid(), torch.full((len(table),), 0.1))
    assert torch.equal(table["quats"], torch.tensor([1.0, 0, 0, 0]).expand(len(table), 4))


def test_scales_with_the_world():
    points, colors, centres = scene()
    _, table = make(points, colors, centres)
    _, scaled = make(points * 32, colors, centres * 32)
    assert torch.equal(scaled["means"], table["means"] * 32)
    assert torch.equal(scaled["level"], table["level"]) and torch.equal(scaled["sh"], table["sh"])


def test_a_stray_point_does_not_spoil_the_grid():
    points, colors, centres = scene()
    _, table = make(points, colors, centres)
    stray = torch.cat((points, torch.full((1, 3), -1e9, dtype=torch.float64)))
    levels = measure_levels(points, centres, 2.0)
    spoilt = octree_gaussians(stray, torch.cat((colors, colors[:1])), centres, levels, 0.5).table(2, 0.1)
    assert abs(len(spoilt) - len(table)) < 0.1 * len(table)
    assert spoilt["means"].abs().max() < 10


def test_one_point():
    levels = Levels(1, 2.0, 1.0, 0.1)
    one = octree_gaussians(
        torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.uint8),
        torch.ones(2, 3, dtype=torch.float64), levels, 0.9,
    ).table(sh_degree=0, opacity=0.1)  # fmt: skip
    assert len(one) == 1 and bool(one["scales"].isfinite().all())


def test_parts_of_the_first_gaussians_are_rows_of_the_whole_table():
    points, colors, centres = scene()
    first = octree_gaussians(points, colors, centres, measure_levels(points, centres, 2.0), 0.5)
    whole, parts = first.table(1, 0.1), [first.table(1, 0.1, part=slice(rank, None, 3)) for rank in range(3)]
    for rank, part in enumerate(parts):
        for name in whole:
            assert torch.equal(part[name], whole[name][rank::3]), name
    assert sum(len(part) for part in parts) == len(whole) == len(first)


@pytest.mark.parametrize("most", [0, 1, 2, 40, 333, 10**6])
def test_a_limit_keeps_the_coarsest_levels_and_a_random_part_of_the_next(most):
    points, colors, centres = scene()
    levels = measure_levels(points, centres, 2.0)
    whole = octree_gaussians(points, colors, centres, levels, 0.5)
    some = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=3)
    assert len(some) == (min(most, len(whole)) or len(whole)) and some.found == len(whole)
    counts = [(whole.levels == level).sum().item() for level in range(levels.count)]
    for level, count in enumerate(counts):
        left = max(0, len(some) - sum(counts[:level]))
        assert (some.levels == level).sum() == min(count, left)
    # All of them are first Gaussians, with sizes that fit their own neighbours.
    rows = {tuple(row) for row in whole.means.tolist()}
    assert all(tuple(row) in rows for row in some.means.tolist())
    if 1 < len(some) < len(whole):
        assert some.log_scales.mean() > whole.log_scales.mean()
        again = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=3)
        other = octree_gaussians(points, colors, centres, levels, 0.5, most=most, seed=4)
        assert torch.equal(again.means, some.means) and not torch.equal(other.means, some.means)


RULES = DensityRules(grad_threshold=1.0, clone_scale=0.05, min_opacity=0.05, max_scale=0.9)
CALL = {"time": TIME, "step": STEP, "seed": SEED, "level_count": LEVELS}


def by_the_double_sum(opacity: float, copies: int, least: float = 0.0) -> tuple[float, float]:
    """Return opacity and factor of the scales as eq. 9 of the paper has them, in rational numbers."""
    new = max(1.0 - (1.0 - opacity) ** (1.0 / copies), least)
    total = Fraction(0)
    for i in range(1, copies + 1):
        for k in range(i):
            root = Fraction(1 / math.sqrt(k + 1))
            total += math.comb(i - 1, k) * (-1) ** k * root * Fraction(new) ** (k + 1)
    return new, opacity / float(total)


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20, MAX_COPIES])
def test_the_closed_form_is_the_paper_s_double_sum(copies):
    opacities = torch.tensor([0.006, 0.1, 0.5, 0.9, 0.99, 0.999999], dtype=torch.float64)
    scales = torch.randn(len(opacities), 3, dtype=torch.float64)
    logits, logarithms = shared_among_copies(opacities.logit(), scales, torch.full((len(opacities),), copies))
    for i, opacity in enumerate(opacities.tolist()):
        new, factor = by_the_double_sum(opacity, copies)
        assert math.isclose(float(logits[i].sigmoid()), new, rel_tol=1e-9)
        assert torch.allclose(logarithms[i], scales[i] + math.log(factor), atol=1e-8)


def test_the_copies_of_other_rows_change_no_bit():
    copies = torch.arange(1, MAX_COPIES + 1)
    opacities, scales = torch.linspace(-6, 9, MAX_COPIES), torch.zeros(MAX_COPIES, 3)
    together = shared_among_copies(opacities, scales, copies)
    for i, count in enumerate(copies.tolist()):
        alone = shared_among_copies(opacities, scales, torch.full_like(copies, count))
        assert all(torch.equal(x[i], y[i]) for x, y in zip(together, alone, strict=True))
    none = shared_among_copies(opacities[:0], scales[:0], copies[:0])
    assert [tuple(part.shape) for part in none] == [(0,), (0, 3)]


def test_rows_that_stand_for_copies_equal_torch_s(device):
    n, least = 3 * MAX_COPIES, opacity_logit(0.05)
    g = torch.Generator().manual_seed(4)
    opacities, scales = torch.linspace(-4, 16, n), torch.randn(n, 3, generator=g)
    moments = [torch.randn(n, *shape, generator=g) for shape in [(3,), (4,), (3,), (), (16, 3)] * 2]
    rows = torch.randperm(n, generator=g)[: 2 * MAX_COPIES]
    copies = torch.arange(len(rows)) % MAX_COPIES + 1
    logits, logarithms = shared_among_copies(opacities[rows], scales[rows], copies)
    logits = logits.clamp(min=least)
    expected = [column.clone() for column in (opacities, scales, *moments)]
    expected[0][rows], expected[1][rows] = logits.float(), logarithms.float()
    share, dimmed = 1.0 / copies.double(), logits.sigmoid() / opacities[rows].double().sigmoid()
    for i, column in enumerate(expected[2:]):
        factor = (dimmed if i % 5 == 3 else share) ** (1 if i < 5 else 2)
        column[rows] *= factor.float().view(-1, *[1] * (column.dim() - 1))
    got = [column.to(device) for column in (opacities, scales, *moments)]
    share_rows_(got[0], got[1], got[2:], rows.to(device), copies.to(device), least)
    for column, wanted in zip(got, expected, strict=True):
        torch.testing.assert_close(column.cpu(), wanted, rtol=3e-7, atol=0)


def test_draws_and_what_is_left_of_them_equal_torch_s(device):
    g = torch.Generator().manual_seed(6)
    opacities, causes = torch.randn(5000, generator=g) * 4, torch.randint(2, (5000,), generator=g).byte()
    ids = torch.randperm(5000, generator=g)
    weights = draw_weights(opacities.to(device), causes.to(device)).cpu()
    expected = (opacities.double().sigmoid().float().double() * 2**31).long()
    assert torch.equal(weights, expected.masked_fill(causes != 0, 0))
    draws, total = 1 << 30, int(weights.sum())
    whole, keys = residual_draws(weights.to(device), ids.to(device), draws, total, 3, -8)
    assert torch.equal(whole.cpu(), weights * draws // total)
    rest = (weights * draws % total).float()
    torch.testing.assert_close(keys.cpu(), sampling_keys(rest, ids, 3, -8), rtol=1e-7, atol=0)


def test_errors_and_opcheck_of_the_ops_of_relocation():
    rows, moments = torch.tensor([1]), [torch.zeros(2, 3) for _ in range(10)]
    moments[3], moments[8] = torch.zeros(2), torch.zeros(2)
    shared = (torch.zeros(2), torch.zeros(2, 3), moments, rows, torch.tensor([3]), -2.0)
    torch.library.opcheck(torch.ops.blitzgs.share_rows_, shared)
    torch.library.opcheck(torch.ops.blitzgs.overlap, (torch.rand(3).double(), torch.tensor([1, 2, 3])))
    for key in (torch.tensor([5]), None):
        torch.library.opcheck(torch.ops.blitzgs.hash_key, (rows, key, 3))
    torch.library.opcheck(torch.ops.blitzgs.draw_weights, (torch.rand(3), torch.zeros(3).byte()))
    torch.library.opcheck(torch.ops.blitzgs.residual_draws, (torch.arange(3), torch.arange(3), 2, 3, 4, 5))
    gone = torch.tensor([1, 300])
    torch.library.opcheck(torch.ops.blitzgs.bracket_keys, (gone, gone))
    matched = torch.zeros_like(gone), gone > 0, torch.arange(4), torch.arange(4), gone, gone
    torch.library.opcheck(torch.ops.blitzgs.match_brackets_, matched)
    with pytest.raises(RuntimeError, match="total must be positive, got 0"):
        residual_draws(torch.arange(3), torch.arange(3), 2, 0, 4, 5)
    with pytest.raises(RuntimeError, match="there must be 10 moments, got 9"):
        share_rows_(*shared[:2], moments[1:], *shared[3:])
    with pytest.raises(RuntimeError, match=r"a moment must have 2 rows, got \[3, 3\]"):
        share_rows_(*shared[:2], [torch.zeros(3, 3), *moments[1:]], *shared[3:])
    with pytest.raises(RuntimeError, match=r"a moment of the opacity must have shape \[2\], got \[2, 3\]"):
        share_rows_(*shared[:2], [*moments[:8], torch.zeros(2, 3), moments[9]], *shared[3:])


@pytest.mark.parametrize("copies", [2, 5, 30])
def test_copies_together_look_like_the_original(copies):
    """The opacity agrees at the centre, and integrated along a line through the centre."""
    opacity, x = torch.tensor([0.8], dtype=torch.float64), torch.linspace(-12, 12, 20001, dtype=torch.float64)
    logits, logarithms = shared_among_copies(
        opacity.logit(), torch.zeros(1, 3).double(), torch.tensor([copies])
    )
    new, scale = logits.sigmoid(), logarithms.exp()[0, 0]
    assert torch.allclose(1 - (1 - new) ** copies, opacity)
    alone = torch.trapezoid(opacity * torch.exp(-(x**2) / 2), x)
    together = torch.trapezoid(1 - (1 - new * torch.exp(-((x / scale) ** 2) / 2)) ** copies, x)
    assert math.isclose(float(together), float(alone), rel_tol=1e-9)


def test_draws_follow_the_weights_and_are_as_many_as_asked():
    g = torch.Generator().manual_seed(1)
    weights = (torch.rand(500, generator=g) ** 4 * 2**31).long()
    weights[::7] = 0
    ids, total = torch.randperm(5000, generator=g)[:500], torch.zeros(500).double()
    for event in range(400):
        drawn = draw_in_proportion(weights, int(weights.sum()), 60, ids, SEED, event, Ranks())
        assert int(drawn.sum()) == 60 and not drawn[weights == 0].any()
        total += drawn
    expected = 400 * 60 * weights / weights.sum()
    # A draw has a variance of at most its expectation.
    assert ((total - expected).abs() <= 5 * expected.sqrt() + 1).all()
    assert draw_in_proportion(weights, int(weights.sum()), 0, ids, SEED, 0, Ranks()).sum() == 0
    assert draw_in_proportion(torch.zeros_like(weights), 0, 60, ids, SEED, 0, Ranks()).sum() == 0
    alone = draw_in_proportion(torch.tensor([5, 0]), 5, 1000, torch.tensor([1, 2]), SEED, 0, Ranks())
    assert alone.tolist() == [MAX_COPIES - 1, 0]


@pytest.mark.parametrize(("growth", "cap"), [(0.0, None), (0.05, None), (0.5, 450), (0.5, 100)])
def test_matches_row_by_row(growth, cap):
    table = random_table(400)
    before = {int(i): {name: table[name][k].clone() for name in table} for k, i in enumerate(table["id"])}
    dead = {
        i
        for i, row in before.items()
        if row["opacities"].sigmoid() < RULES.min_opacity or row["scales"].max().exp() > RULES.max_scale
    }
    assert 20 < len(dead) < 380
    rules = DensityRules(**(vars(RULES) | {"max_gaussians": cap}))
    report = relocate(table, rules, growth=growth, ranks=Ranks(), **CALL)
    wanted = max(400, min(int(400 * (1 + growth)), cap or 1000))
    assert len(table) == wanted and report.relocated == len(dead)
    assert report.cloned == wanted - 400 + len(dead) and report.held_back == int(400 * (1 + growth)) - wanted
    after = {int(i): {name: table[name][k] for name in table} for k, i in enumerate(table["id"])}
    assert len(after) == wanted and dead.isdisjoint(after)
    born = {i: row for i, row in after.items() if i not in before}
    counts: dict[int, int] = {}
    for row in born.values():
        counts[int(row["parent"])] = counts.get(int(row["parent"]), 0) + 1
    assert max(counts.values()) > 1
    pairs = defaultdict(list)
    for i in before.keys() - dead:
        copies = [(0, after[i])]
        for slot in range(counts.get(i, 0)):
            key = int(hash_keys(torch.tensor([i]), TIME, slot + 3)) & (2**63 - 1)
            copies.append((1, born.pop(key)))
        old, n = before[i], len(copies)
        opacity, factor = by_the_double_sum(float(old["opacities"].double().sigmoid()), n)
        for is_copy, row in copies:
            expected = old | ({"parent": torch.tensor(i), "birth": torch.tensor(TIME)} if is_copy else {})
            if n > 1:
                opacity = max(opacity, RULES.min_opacity)
                expected["opacities"] = torch.tensor(math.log(opacity / (1 - opacity)))
                expected["scales"] = old["scales"] + math.log(factor)
            for name in (*PARAMETERS, "parent", "birth", "level", "last_step"):
                pairs[name].append((row[name], expected[name]))
            opaque = old["opacities"].double().sigmoid()
            for name in table:
                if name.startswith("exp_avg"):
                    share = row["opacities"].double().sigmoid() / opaque if "opacities" in name else 1 / n
                    share = 0 if is_copy else share ** (2 if "_sq" in name else 1)
                    pairs[name].append((row[name], old[name] if n == 1 else (old[name] * share).float()))
    for name, rows in pairs.items():
        found, expected = map(torch.stack, zip(*rows, strict=True))
        atol = 0 if name.startswith("exp_avg") else 1e-6
        np.testing.assert_allclose(found, expected, rtol=2e-6, atol=atol, err_msg=name)
    assert not born


@pytest.mark.parametrize("elsewhere", [False, True])
def test_an_event_before_rows_catch_up_is_that_after_they_did(monkeypatch, elsewhere):
    monkeypatch.setattr(table_adam, "_PART", 90)
    optimiser = TableAdam(OptimiserConfig(), Schedule(ScheduleConfig()), 1.0, torch.device("cpu"))
    tables = []
    for waits in (False, True):
        table = random_table(400)
        table["last_step"].copy_(STEP - table["id"] % 7)
        table["moment_step"].copy_(table["last_step"] - table["id"] % 3)
        for name in EXP_AVG_SQS:
            table[name].square_()
        if not waits:
            optimiser.catch_up(table, None, STEP)
        pending = optimiser.pending(table, STEP) if waits else None
        if elsewhere and pending is not None:
            pending._device = torch.device("cpu:0")  # as if the table were in host memory
        relocate(table, RULES, growth=0.2, ranks=Ranks(), pending=pending, **CALL)
        if waits:
            current = table["last_step"] == STEP
            assert 100 < current.sum() < len(table) and current[table["birth"] == TIME].all()
            optimiser.catch_up(table, None, STEP)
        tables.append(table)
    orders = [table["id"].argsort() for table in tables]
    for name in tables[0]:
        pair = (table[name][order] for table, order in zip(tables, orders, strict=True))
        torch.testing.assert_close(*pair, rtol=2e-6, atol=2e-6, msg=lambda text, name=name: f"{name}: {text}")


def test_no_live_gaussian_leaves_nothing_to_copy():
    table = random_table(5)
    table["opacities"].fill_(-9)
    report = relocate(table, RULES, growth=0.05, ranks=Ranks(), **CALL)
    assert (len(table), report.cloned, report.relocated) == (0, 0, 5)


@pytest.mark.cuda
def test_cuda_does_the_same():
    tables = []
    for device in ("cpu", "cuda"):
        ranks, table = Ranks(device=torch.device(device)), random_table(400)
        table = GaussianTable({name: table[name].to(device) for name in table})
        relocate(table, RULES, growth=0.2, ranks=ranks, **CALL)
        order = table["id"].argsort()
        tables.append({name: table[name][order].cpu() for name in table})
    for name in tables[0]:
        assert torch.allclose(*(table[name] for table in tables), rtol=1e-6, atol=0), name


def _relocate_a_share(ranks, growth):
    """Return this rank's part of an event on a table that is dealt unevenly."""
    table, logged = random_table(400), _Log()
    first = int(400 * 0.7) if ranks.world_size > 1 else 400
    mine = torch.arange(400) < first if ranks.rank == 0 else torch.arange(400) >= first
    table.keep(mine)
    report = relocate(table, RULES, growth=growth, ranks=ranks, lineage=logged, **CALL)
    return {name: table[name] for name in table}, vars(report), logged


class _Log:
    """Records the calls to a lineage."""

    def __init__(self):
        self.births, self.deaths = [], []

    def born(self, births, step):
        self.births += births.ids.tolist()
        assert births.features.isfinite().all() and step == STEP

    def died(self, ids, causes, time, step):
        self.deaths += ids.tolist()
        assert (causes == Cause.RELOCATED).all() and (time, step) == (TIME, STEP)


def test_the_result_does_not_depend_on_ranks_and_order():
    alone, report, log = _relocate_a_share(Ranks(), 0.2)
    shares = run_ranks(_relocate_a_share, 2, 0.2)
    order = alone["id"].argsort()
    together = {name: torch.cat([share[0][name] for share in shares]) for name in alone}
    positions = together["id"].argsort()
    for name in alone:
        assert torch.equal(alone[name][order], together[name][positions]), name
    assert report == {name: sum(share[1][name] for share in shares) for name in report}
    assert sorted(log.births) == sorted(shares[0][2].births + shares[1][2].births)
    assert sorted(log.deaths) == sorted(shares[0][2].deaths + shares[1][2].deaths)
    live = set(random_table(400)["id"].tolist()) - set(log.deaths) | set(log.births)
    assert live == set(alone["id"].tolist())
