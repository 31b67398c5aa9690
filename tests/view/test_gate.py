# SPDX-License-Identifier: Apache-2.0
"""LOD gate and cull mask agree with brute force in float64, and do not change training or rendering."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.frame.tiles import TileAssignment
from blitzgs.ops.blocks import ActiveRows, GateRules, gate_views_
from blitzgs.ops.projection_types import Views
from blitzgs.optim.table_adam import TableAdam
from blitzgs.population.importance import ViewBatch, is_culled, sweep
from blitzgs.table.blocks import BlockIndex
from blitzgs.table.table import CULL, GaussianTable, sectors_in
from blitzgs.training.batches import Batch
from blitzgs.training.step import Stepper
from blitzgs.view.gate import SAMPLE, LodGate, ModelGate, ViewGate, all_rows, centres_of
from tests.distributed.rank_harness import on_each_device, run_ranks
from tests.helpers import refused
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, allowed, make_table, make_views, seen
from tests.training.tiny import caught_up, random_gaussians, schedule_of, step_some, tiny_config

# Distances of `make_table` are up to 60 or so: the gate cuts through the scene at every level.
GATE = LodGate(reference_distance=45.0, fork=2.0, count=6, finest=4)
COLUMNS = (5, -1, 63, 31)
OPTIONS = RenderOptions(0, NEAR, FAR)


def make_scene(n=3000, device="cpu", seed=0):
    """Gaussians with levels and a cull matrix of 64 columns."""
    table = make_table(n, device, seed)
    generator = torch.Generator().manual_seed(seed + 100)
    draw = lambda low, high, *shape: torch.randint(low, high, shape, generator=generator)  # noqa: E731
    table["level"] = draw(0, 6, n).to(device, torch.uint8)
    table[CULL] = draw(-(2**31), 2**31, n, 2).to(device, torch.int32)
    return table


def kept_by_definition(table, viewmats, gate=GATE, lod_views=range(32), columns=()):
    """Bool [N, B]: Eq. 2 and Eq. 3 in float64; and bool [N, B]: pairs that rounding may decide."""
    distances = torch.cdist(table["means"].double(), centres_of(viewmats))
    resolved = (gate.reference_distance / distances).log() / math.log(gate.fork)
    finest = resolved.round().clamp(0, gate.finest)
    kept = table["level"][:, None] <= finest
    close = ((resolved - resolved.floor() - 0.5).abs() < 1e-5) | distances.isnan()
    for view in range(len(viewmats)):
        if view not in lod_views:
            kept[:, view], close[:, view] = True, False
        if columns and columns[view] >= 0:
            word, bit = divmod(columns[view], 32)
            kept[:, view] &= (table[CULL][:, word] >> bit & 1) == 0
    return kept, close


def bits(views, count):
    return (views[:, None] >> torch.arange(count, device=views.device) & 1).bool()


def some_rows(table, views, seed=0):
    """Lists of an active set with spare capacity, and random views."""
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randperm(len(table), generator=generator)[: len(table) // 2].sort().values
    allowed = torch.randint(0, 1 << views, (len(ids),), generator=generator)
    unused = torch.full((len(table) - len(ids),), 2**31 - 1)
    columns = (torch.cat((ids, unused)), torch.cat((allowed, unused)), torch.tensor([len(ids)]))
    return ActiveRows(*(column.int().to(table.device) for column in columns))


@pytest.mark.parametrize("lod_views", [(), (0, 2, 3), (0, 1, 2, 3)])
@pytest.mark.parametrize("columns", [(), COLUMNS])
def test_every_set_is_that_of_the_definition(device, lod_views, columns):
    for seed in range(3):
        table = make_scene(device=device, seed=seed)
        viewmats, _ = make_views(device=device, seed=seed)
        active = some_rows(table, 4, seed)
        before = active.views.clone()
        gate = ViewGate(GATE.reach(), sum(1 << v for v in lod_views), columns)
        gate_views_(active, table["means"], viewmats, gate.rules(table))
        ids, views = active.listed()
        kept, close = (
            pairs[ids.long()] for pairs in kept_by_definition(table, viewmats, GATE, lod_views, columns)
        )
        expected = bits(before[: len(ids)], 4) & kept
        found = bits(views, 4)
        assert torch.equal(found | close, expected | close) and close.double().mean() < 0.02
        assert (views & ~before[: len(ids)] == 0).all()
        assert torch.equal(active.views[len(ids) :], before[len(ids) :])  # behind the list
        if lod_views or columns:
            assert 0.05 < found.sum() / before[: len(ids)].double().count_nonzero() < 2


def test_a_level_beyond_the_finest_is_kept_nowhere_and_level_0_everywhere(device):
    table = make_scene(device=device)
    viewmats, _ = make_views(device=device)
    gate = ModelGate(LodGate(1e6, 2.0, 6, 2), 1.0, table, Ranks(device=torch.device(device)))
    near = gate.active(table, viewmats)
    finite = table["means"].isfinite().all(1)
    assert torch.equal((near.views == 15)[finite], (table["level"] <= 2)[finite])
    gate = ModelGate(LodGate(1e-6, 2.0, 6, 5), 1.0, table, Ranks(device=torch.device(device)))
    far = gate.active(table, viewmats)
    assert torch.equal((far.views == 15)[finite], (table["level"] == 0)[finite])


def render(table, viewmats, Ks, active=None):
    return render_frame(table, Views(viewmats, Ks, WIDTH, HEIGHT), OPTIONS, active).renders


def test_images_are_those_of_the_gaussians_that_are_kept_with_blocks_and_without(device):
    table = make_scene(5000, device)
    table["scales"].clamp_(max=0.0)
    viewmats, Ks = make_views(device=device)
    gate = ViewGate(GATE.reach(), 0b1011, COLUMNS)
    with_blocks = BlockIndex(table).active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
    without = all_rows(len(table), 4, table.device)
    for active in (with_blocks, without):
        gate_views_(active, table["means"], viewmats, gate.rules(table))
    images = render(table, viewmats, Ks, with_blocks)
    assert torch.equal(images, render(table, viewmats, Ks, without))
    kept, _ = kept_by_definition(table, viewmats, GATE, (0, 1, 3), COLUMNS)
    everything = render(table, viewmats, Ks)
    for view in range(4):
        small = GaussianTable({name: table[name] for name in table})
        small.keep(kept[:, view])
        alone = render(small, viewmats[view : view + 1], Ks[view : view + 1])
        assert torch.equal(images[view], alone[0])
    assert (images != everything).flatten(1).any(1).sum() >= 2


@pytest.mark.parametrize("smooth", [False, True])
def test_training_behind_the_gate_is_dense_adams(device, smooth):
    """Rows that the gate leaves out have pending steps; a training that applies all steps at once ends alike.

    Adam turns a gradient of rounding size into a whole step, so two trainings that differ only by rounding
    diverge. A third training measures how far: it too applies all steps at once, but its means differ by a
    rounding error at the start.
    """
    steps, tables = 120, []
    overrides = ("schedule.iterations=200", "optimiser.position=2e-3")
    config = tiny_config(*overrides)
    schedule = Schedule(config.schedule)
    generator = torch.Generator().manual_seed(8)
    levels = torch.randint(0, 3, (300,), generator=generator).to(torch.uint8)
    targets = torch.randint(0, 256, (2, HEIGHT // 2, WIDTH // 2, 3), generator=generator, dtype=torch.uint8)
    samples = torch.full((2,), 3.0 * targets[0, ..., 0].numel(), device=device)
    K = torch.tensor([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]], device=device).repeat(2, 1, 1)
    trainings = []
    for applies_at_once, nudge in ((False, 1.0), (True, 1.0), (True, 1.0 + 2.0**-22)):
        small = random_gaussians(300)
        small["means"] *= nudge
        sets = []
        table = GaussianTable({name: small[name].to(device) for name in small})
        table["level"] = levels.to(device)
        optimiser = TableAdam(config.optimiser, schedule, 1.0, device)
        stepper = Stepper(table, optimiser, TileOwners(Ranks(device=torch.device(device))), config.loss, 1.0)
        lod = LodGate(4.0, 2.0, 3, 2, smooth)
        gate = ViewGate(lod.reach(), 0b11)
        for step in range(1, steps + 1):
            if applies_at_once:
                optimiser.catch_up(table, None, step - 1)
            viewmats = torch.eye(4).repeat(2, 1, 1)
            viewmats[:, 2, 3] = torch.tensor([2.0, 2.5]) + 0.8 * math.sin(step)
            views = Views(viewmats.to(device), K, WIDTH // 2, HEIGHT // 2)
            batch = Batch([0, 1], views, targets.to(device), None, samples, None)
            # Sums in another order would make two trainings diverge.
            options = RenderOptions(0, 0.05, 100.0, deterministic=True, fade=lod.fade())
            frame, terms, _ = stepper.forward(step, options, batch, view_filter=gate)
            stepper.backward(step, frame, terms)
            splats = frame.projected
            pairs = zip(splats.gaussian_ids.tolist(), splats.camera_ids.tolist(), strict=True)
            sets.append(set(pairs))
        assert int((table["moment_step"] < steps - 3).sum()) > 10  # these have pending steps
        optimiser.catch_up(table, None, steps)
        tables.append(table)
        trainings.append(sets)
    lazy, dense, rounded = tables
    assert trainings[0] == trainings[1]
    assert (
        sum(len(a ^ b) for a, b in pairwise(trainings[1])) > 1000
    )  # Gaussians cross the borders of the gate
    for name in ("means", "quats", "scales", "opacities", "sh"):
        apart, by_rounding = (
            1.0 - torch.isclose(table[name], dense[name], rtol=1e-4, atol=1e-5).double().mean()
            for table in (lazy, rounded)
        )
        # Where opacities fade, more pixels are close to the cut of alpha, which any rounding may decide.
        assert apart < 0.01 + (1.0 if smooth else 0.25) * by_rounding, name
        torch.testing.assert_close(lazy[name], dense[name], rtol=0, atol=0.01)


def test_the_gated_active_set_covers_pending_steps(device):
    """Blocks and rows are dropped by where pending steps may take them; dense Adam decides what is kept."""
    steps = 400
    table = make_scene(1500, device)
    rates = torch.full((steps + 1, 6), 1e-3, device=device)
    rates[:, 0] = 0.2  # means move far
    schedule = schedule_of(rates)
    index = BlockIndex(table, schedule.table)
    gate = ViewGate(GATE.reach(), 0b01, (3, 40))
    generator = torch.Generator().manual_seed(5)
    views = [make_views(2, device, seed=seed) for seed in range(20)]
    crossed, listed, without = 0, 0, 0
    for step in range(1, steps + 1):
        viewmats, Ks = views[step * 7 % len(views)]
        rules, seeing = gate.rules(table), (Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
        found = allowed(index.active(table, *seeing, rules=rules).listed())
        if step % 20 == 0:
            dense = caught_up(table, schedule, step - 1)
            kept, close = kept_by_definition(dense, viewmats, GATE, (0,), (3, 40))
            expected = {(r, v) for r, v in seen(dense, viewmats, Ks) if kept[r, v] and not close[r, v]}
            assert expected <= found
            early, _ = kept_by_definition(table, viewmats, GATE, (0,), (3, 40))
            crossed += int((early != kept).sum())
            listed += len(found)
            without += len(allowed(index.active(table, *seeing).listed()))
        ids = torch.tensor(sorted({r for r, _ in found}), dtype=torch.int32, device=device)
        index.update(table, step_some(table, ids, schedule, step, generator))
    assert crossed > 10  # pending steps move rows across the borders of the gate
    assert listed < 0.5 * without


def test_blocks_that_a_mask_leaves_out_are_dropped_unread(device):
    """Blocks from which the mask leaves nothing out are taken whole, as without a mask."""
    table = make_scene(30_000 + 100, device)
    viewmats, Ks = make_views(1, device)
    seeing, blocks = (Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3)), -(-len(table) // 256)
    plain = BlockIndex(table).active(table, *seeing)
    seen_blocks = (plain.listed()[0] // 256).unique()
    assert len(seen_blocks) > 8
    mask, none = torch.zeros_like(table[CULL]), torch.zeros(blocks, dtype=torch.bool, device=device)
    left_out = none.index_fill(0, seen_blocks[::2].long(), True)
    left_out[-1] = True  # a block that is not full
    of_row = left_out.repeat_interleave(256)[: len(table)]
    mask[:, 1] = torch.where(of_row, 1 << 5, 0).int()
    table[CULL] = mask
    rules = ViewGate([math.inf], 0, (37,)).rules(table)
    found = BlockIndex(table).active(table, *seeing, rules=rules)
    assert int(found.blocks) <= int(plain.blocks) - len(seen_blocks[::2])
    kept = ~of_row[plain.listed()[0].long()]
    for a, b in zip(found.listed(), plain.listed(), strict=True):
        assert torch.equal(a, b[kept])


@pytest.mark.parametrize("columns", [(), COLUMNS])
def test_the_gated_set_does_not_depend_on_the_order_of_the_rows(device, columns):
    """Without pending steps, the set is the part of the ungated set that the exact test keeps."""
    table = make_scene(60_000, device)
    viewmats, Ks = make_views(device=device)
    gate, sets, exact = ViewGate(GATE.reach(), 0b1011, columns), [], []
    for _ in range(2):
        rules = gate.rules(table)
        index = BlockIndex(table)
        with_gate = index.active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3), rules=rules)
        sets.append({(int(table["id"][row]), view) for row, view in allowed(with_gate.listed())})
        plain = index.active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
        for active in (with_gate, plain):
            gate_views_(active, table["means"], viewmats, rules)
            exact.append({(int(table["id"][row]), view) for row, view in allowed(active.listed())})
        table.permute(torch.randperm(len(table), generator=torch.Generator().manual_seed(3)).to(device))
    assert sets[0] == sets[1] and all(found == exact[0] for found in exact) and exact[0] <= sets[0]
    assert len(sets[0]) < 1.01 * len(exact[0])


def test_the_share_a_view_keeps_is_predicted_from_a_sample():
    viewmats, _ = make_views()
    for n, tolerance in ((3000, 1e-12), (4 * SAMPLE, 0.015)):
        table = make_scene(n)
        gate = ModelGate(GATE, 0.8, table, Ranks())
        kept, _ = kept_by_definition(table, viewmats)
        found = torch.tensor(gate.kept(centres_of(viewmats)), dtype=torch.float64)
        expected = (kept & table["means"].isfinite().all(1)[:, None]).double().mean(0)
        torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


def test_a_view_that_keeps_almost_all_has_no_gate():
    table = make_scene()
    viewmats, _ = make_views()
    kept = ModelGate(GATE, 0.8, table, Ranks()).kept(centres_of(viewmats))
    border = sum(sorted(kept)[1:3]) / 2  # between the views
    active = ModelGate(GATE, border, table, Ranks()).active(table, viewmats)
    for view, share in enumerate(kept):
        assert bits(active.views, 4)[:, view].all() == (share >= border)
    assert ModelGate(GATE, 0.0, table, Ranks()).active(table, viewmats) is None


def _gated_image(ranks):
    table = make_scene(4000)
    table["scales"].clamp_(max=0.0)
    table.keep(torch.arange(len(table)) % 5 % ranks.world_size == ranks.rank)  # 3 : 2 at two ranks
    table = GaussianTable({name: table[name].to(ranks.device) for name in table})
    viewmats, Ks = make_views(device=ranks.device)
    views, owners = Views(viewmats, Ks, WIDTH, HEIGHT), TileOwners(ranks)
    gate = ModelGate(GATE, 0.8, table, ranks)
    shares = gate.kept(centres_of(viewmats))
    images = []
    masked = BlockIndex(table).active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
    rules = ViewGate(GATE.reach(), 0b1101, COLUMNS).rules(table)
    gate_views_(masked, table["means"], viewmats, rules)
    smooth = replace(GATE, smooth=True)
    faded = ModelGate(smooth, math.inf, table, ranks).active(table, viewmats)
    fading = replace(OPTIONS, fade=smooth.fade())
    for active, options in ((gate.active(table, viewmats), OPTIONS), (masked, OPTIONS), (faded, fading)):
        if ranks.world_size == 1:
            images.append(render_frame(table, views, options, active).renders.cpu())
            continue
        ranges = owners.divide(range(4), WIDTH, HEIGHT)
        frame = render_frame(table, views, options, active, TileAssignment(ranks, ranges))
        own = ranges.pixel_mask(ranks.rank, ranks.device)
        images.append(torch.where(own[..., None], frame.renders, 0.0).cpu())
    return shares, images


@pytest.mark.parametrize(("world_size", "device"), on_each_device(2))
def test_gated_images_are_the_same_at_every_world_size(world_size, device):
    shares, images = _gated_image(Ranks(device=torch.device(device)))
    answers = run_ranks(_gated_image, world_size, device=device)
    for found, _ in answers:
        assert found == shares
    for k, image in enumerate(images):
        assert image.any() and torch.equal(sum(parts[k] for _, parts in answers), image)


def test_a_sweep_scores_what_the_gate_lets_views_show(device):
    table = make_scene(4000, device)
    table["scales"].clamp_(max=0.0)
    viewmats, Ks = make_views(device=device)
    views, ranks = Views(viewmats, Ks, WIDTH, HEIGHT), Ranks(device=torch.device(device))
    shares = ModelGate(GATE, 1.0, table, ranks).kept(centres_of(viewmats))
    gate = ModelGate(GATE, max(shares), table, ranks)  # one view has no gate
    found = sweep(table, [ViewBatch(range(4), views)], 4, OPTIONS, ranks, lod=gate)
    gated = [view for view in range(4) if shares[view] < max(shares)]
    assert len(gated) == 3
    kept, _ = kept_by_definition(table, viewmats, GATE, gated)
    score = torch.zeros(len(table), dtype=torch.float64, device=device)
    for view in range(4):
        small = GaussianTable({name: table[name] for name in table})
        small.keep(kept[:, view])
        one = Views(viewmats[view : view + 1], Ks[view : view + 1], WIDTH, HEIGHT)
        alone = sweep(small, [ViewBatch([0], one)], 1, OPTIONS, ranks)
        score[kept[:, view]] += alone.score
        culled = is_culled(found.cull, view)
        assert culled[~kept[:, view]].all()
        assert torch.equal(culled[kept[:, view]], is_culled(alone.cull, 0))
    torch.testing.assert_close(found.score.double(), score, rtol=1e-6, atol=1e-9)
    plain = sweep(table, [ViewBatch(range(4), views)], 4, OPTIONS, ranks)
    assert not torch.equal(plain.cull, found.cull)


def test_errors_name_the_value():
    table = make_scene(300)
    viewmats, _ = make_views(2)
    active = some_rows(table, 2)
    call = lambda *args: gate_views_(active, table["means"], viewmats, GateRules(table["level"], *args))  # noqa: E731
    refused(RuntimeError, "1 to 32 levels are supported, got 33", call, [1.0] * 33, 1)
    refused(RuntimeError, "finer levels reach no farther, got 1 and 2 for the", call, [1.0, 2.0], 1)
    with pytest.raises(RuntimeError, match="2 views need as many columns of the cull matrix, got 3"):
        call([1.0], 0, sectors_in(table.columns[CULL]), [0, 1, 2])
    with pytest.raises(RuntimeError, match="the cull matrix has 64 columns, got column 64"):
        call([1.0], 0, sectors_in(table.columns[CULL]), [0, 64])
    refused(RuntimeError, "columns need a cull matrix", call, [1.0], 0, None, [0, 1])
    many, _ = make_views(33)
    with pytest.raises(RuntimeError, match="at most 32 views at once, got 33"):
        gate_views_(active, table["means"], many, GateRules(table["level"], [1.0], 1))


def test_opcheck(device):
    table = make_scene(600, device)
    viewmats, _ = make_views(device=device)
    active = some_rows(table, 4)
    torch.library.opcheck(
        torch.ops.blitzgs.gate_views_,
        (active.ids, active.views, active.length, table["means"], table["level"], viewmats, GATE.reach(), 5,
         sectors_in(table.columns[CULL]), list(COLUMNS)),
    )  # fmt: skip
