# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from blitzgs.ops.blocks import cull_blocks, morton_keys
from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, lazy_adam_catch_up_
from blitzgs.ops.project import project, queue_projection
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions, Views
from blitzgs.table.blocks import BlockIndex, morton_order
from blitzgs.table.table import EXP_AVG_SQS, EXP_AVGS, PARAMETERS, GaussianTable
from tests.helpers import refused
from tests.training.tiny import caught_up, schedule_of, step_some

WIDTH, HEIGHT, NEAR, FAR = 160, 120, 0.2, 60.0


def make_table(n=3000, device="cpu", seed=0):
    """Gaussians of every size on a plain with towers; a few are not finite."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    means = (draw(n, 3) - 0.5) * torch.tensor([80.0, 80.0, 10.0])
    scales = torch.log(10 ** (4 * draw(n, 3) - 3.5))
    means[5, 1], scales[9, 0], means[11] = math.nan, math.inf, -math.inf
    rows = {
        "means": means, "quats": draw(n, 4) - 0.5, "scales": scales, "opacities": 6 * draw(n) - 3,
        "sh": draw(n, 1, 3),
    }  # fmt: skip
    table = GaussianTable.create({name: column.to(device) for name, column in rows.items()})
    table.permute(morton_order(table["means"]))
    return table


def make_views(count=4, device="cpu", seed=1):
    """Cameras over the plain, looking down at all angles; principal points off centre, unequal focals."""
    generator = torch.Generator().manual_seed(seed)
    viewmats, Ks = torch.eye(4).repeat(count, 1, 1), torch.eye(3).repeat(count, 1, 1)
    for b in range(count):
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
        rotation *= torch.linalg.det(rotation).sign()
        centre = (torch.rand(3, generator=generator) - 0.5) * torch.tensor([60.0, 60.0, 20.0])
        viewmats[b, :3, :3], viewmats[b, :3, 3] = rotation, -rotation @ centre
        Ks[b, 0, 0], Ks[b, 1, 1] = 60.0 + 400 * b, 90.0 + 300 * b
        Ks[b, 0, 2], Ks[b, 1, 2] = 0.5 * WIDTH - 60 * (b % 2), 0.5 * HEIGHT + 90 * (b % 3 == 1)
    return viewmats.to(device), Ks.to(device)


def seen(table, viewmats, Ks):
    """Return the (row, view) pairs of the splats that projection makes of all rows."""
    rows = project(
        *(table[name] for name in PARAMETERS), viewmats, Ks, WIDTH, HEIGHT, near_plane=NEAR, far_plane=FAR
    )  # fmt: skip
    return set(zip(rows.gaussian_ids.tolist(), rows.camera_ids.tolist(), strict=True))


def allowed(active):
    """The (row, view) pairs of an active set."""
    pairs = zip(active[0].tolist(), active[1].tolist(), strict=True)
    return {(row, view) for row, mask in pairs for view in range(32) if mask >> view & 1}


def active_of(index, table, viewmats, Ks):
    return index.active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3)).listed()


@pytest.mark.parametrize("seed", range(4))
def test_no_visible_row_is_missed_and_most_others_are_dropped(device, seed):
    table = make_table(device=device, seed=seed)
    viewmats, Ks = make_views(device=device, seed=seed + 10)
    active = active_of(BlockIndex(table), table, viewmats, Ks)
    expected, got = seen(table, viewmats, Ks), allowed(active)
    assert len(expected) > 20
    assert expected <= got
    assert len(got) < 0.5 * 4 * len(table)
    ids = active[0].long()
    assert (ids[1:] > ids[:-1]).all() and active[0].dtype == active[1].dtype == torch.int32


@pytest.mark.parametrize("n", [3000, 60_000])
def test_the_set_does_not_depend_on_the_order_of_the_rows(device, n):
    table = make_table(n, device)
    viewmats, Ks = make_views(device=device)
    sorted_set = allowed(active_of(BlockIndex(table), table, viewmats, Ks))
    persistent = {(int(table["id"][row]), view) for row, view in sorted_set}
    table.permute(torch.randperm(len(table), generator=torch.Generator().manual_seed(3)).to(device))
    shuffled = allowed(active_of(BlockIndex(table), table, viewmats, Ks))
    assert {(int(table["id"][row]), view) for row, view in shuffled} == persistent


def test_rows_of_culled_blocks_are_not_read(device):
    """Rows of blocks behind the camera are not read; their values do not matter until bounds are updated."""
    table = make_table(12_000, device)
    _, Ks = make_views(count=1, device=device)
    viewmats = torch.eye(4, device=device)[None]
    viewmats[0, :3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # at the origin, along +x
    index = BlockIndex(table)
    before = active_of(index, table, viewmats, Ks)
    behind = (index.bounds[:, 3] < 0).repeat_interleave(256)[: len(table)]
    assert len(before[0]) > 0 and behind.sum() > 2000
    table["means"][behind] = torch.tensor([5.0, 0.0, 0.0], device=device)
    after = active_of(index, table, viewmats, Ks)
    assert torch.equal(before[0], after[0]) and torch.equal(before[1], after[1])


def looking_down(device):
    """A camera 60 above the origin that looks down at 60 x 45."""
    viewmat, K = torch.eye(4, device=device)[None], torch.eye(3, device=device)[None]
    viewmat[0, 1, 1] = viewmat[0, 2, 2] = -1.0
    viewmat[0, 2, 3] = 60.0
    K[0, 0, 0] = K[0, 1, 1] = WIDTH
    K[0, 0, 2], K[0, 1, 2] = 0.5 * WIDTH, 0.5 * HEIGHT
    return viewmat, K


def cull(index, table, views):
    """The active set of several cameras above the ground, as `BlockIndex.active` asks for it."""
    rows = (index.bounds, table["means"], table["scales"])
    return cull_blocks(*rows, Views(*views, WIDTH, HEIGHT), (NEAR, 100.0, 0.3)).listed()


def test_rows_of_blocks_inside_all_views_that_see_them_are_not_read(device):
    table = make_table(30_000, device)
    views = looking_down(device)
    index = BlockIndex(table)
    before = cull(index, table, views)
    low, high = index.bounds[:, :2], index.bounds[:, 3:5]
    inside = (low > -20).all(1) & (high < 20).all(1)
    finite = index.bounds[:, 7] == 1
    assert (inside & finite).sum() > 10 and (~finite).any()
    rows = (inside & finite).repeat_interleave(256)[: len(table)]
    assert torch.isin(rows.nonzero()[:, 0], before[0].long()).all()
    table["means"][rows] = 1000.0
    after = cull(index, table, views)
    assert torch.equal(before[0], after[0]) and torch.equal(before[1], after[1])


def test_a_row_that_is_not_finite_is_not_seen_amidst_a_view(device):
    table = make_table(30_000, device)
    views = looking_down(device)
    row = int(table["means"].nan_to_num(1e9).norm(dim=1).argmin())
    assert row in cull(BlockIndex(table), table, views)[0]
    table["scales"][row, 1] = math.nan
    index = BlockIndex(table)
    assert row not in cull(index, table, views)[0] and index.bounds[row // 256, 7] == 0
    table["scales"][row, 1] = 0.0
    index.update(table, torch.tensor([row], dtype=torch.int32, device=device))
    assert row in cull(index, table, views)[0] and index.bounds[row // 256, 7] == 1


def caught_up_and_projected(table, ids, views, count, viewmats, Ks):
    """The columns of a table whose rows `ids` were caught up, and their projection."""
    after = {name: table[name].clone() for name in table}
    rates = torch.full((101, 6), 1e-3, device=table.device)
    groups = ([after[name] for name in names] for names in (PARAMETERS, EXP_AVGS, EXP_AVG_SQS))
    state = AdamState(*groups, after["last_step"], after["moment_step"])
    lazy_adam_catch_up_(state, AdamSchedule(rates, 0.9, 0.999, 1e-15), 50, ids, count)
    active = [tensor for tensor in (ids, views, count) if tensor is not None]
    options = ProjectionOptions(WIDTH, HEIGHT, near_plane=NEAR, far_plane=FAR)
    inputs = ProjectionInputs([after[name] for name in PARAMETERS], (viewmats, Ks), options, active)
    splats, _, totals = queue_projection(inputs, None, [(0, 50)])
    return [*after.values(), *splats._replace(counts=totals)]


@pytest.mark.parametrize("n", [0, 1, 5000, 150_000])
@pytest.mark.parametrize("ahead", [True, False])
def test_the_active_set_is_used_with_its_count_on_the_device(device, n, ahead):
    table = make_table(max(n, 300), device)
    table.keep(torch.arange(len(table), device=device) < n)
    for name in (*EXP_AVGS, *EXP_AVG_SQS):
        table[name].fill_(1e-3)
    table["last_step"].copy_(torch.arange(n) % 40)
    viewmats, Ks = make_views(device=device)
    if not ahead:  # no view sees the scene
        viewmats[:] = torch.eye(4, device=device)
        viewmats[:, 2, 3] = -1e5
    active = BlockIndex(table).active(table, Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
    listed = active.listed()
    assert len(active.ids) == 256 * int(active.blocks) < n + 256
    assert (len(listed[0]) > 0) == ahead or n < 300
    active.ids[len(listed[0]) :] = 2**31 - 1  # entries after the count must not be read
    got = caught_up_and_projected(table, *active[:3], viewmats, Ks)
    expected = caught_up_and_projected(table, *listed, None, viewmats, Ks)
    for a, b in zip(got, expected, strict=True):
        assert torch.equal(a.view(torch.uint8), b.view(torch.uint8))


@pytest.mark.parametrize("n", [1, 5000, 150_000])
def test_too_small_a_capacity_gives_empty_lists_and_the_needed_number_of_blocks(device, n):
    table = make_table(max(n, 300), device)
    table.keep(torch.arange(len(table), device=device) < n)
    viewmats, Ks = make_views(device=device)
    index, views = BlockIndex(table), (Views(viewmats, Ks, WIDTH, HEIGHT), (NEAR, FAR, 0.3))
    exact = index.active(table, *views)
    needed = int(exact.blocks)
    assert len((exact.listed()[0] // 256).unique()) <= needed <= -(-n // 256)
    for capacity_blocks in {1, max(1, needed - 1), max(1, needed), needed + 1, 10**6}:
        active = index.active(table, *views, capacity_blocks=capacity_blocks)
        assert int(active.blocks) == needed
        assert len(active.ids) == len(active.views) == 256 * min(capacity_blocks, -(-n // 256))
        active.views[int(active.length) :] = 1  # entries after the count are ignored
        if capacity_blocks < needed:
            assert int(active.length) == 0
        else:
            assert all(torch.equal(a, b) for a, b in zip(active.listed(), exact.listed(), strict=True))
        active.views[: needed // 2] = 0  # as gates clear them
        assert int(active.considered()) == int((active.listed()[1] != 0).sum())


def test_the_active_set_covers_thousands_of_pending_steps(device):
    """Only rows of the set are caught up and stepped; dense Adam decides which rows are visible."""
    steps = 2000
    table = make_table(500, device)
    rates = torch.full((steps + 1, 6), 1e-3, device=device)
    rates[:, 0] = 0.05  # means move far
    rates[:, 2] = 0.02
    schedule = schedule_of(rates)
    index = BlockIndex(table, schedule.table)
    generator = torch.Generator().manual_seed(5)
    views = [make_views(2, device, seed=seed) for seed in range(20)]
    crossed = 0
    for step in range(1, steps + 1):
        viewmats, Ks = views[step * 7 % len(views)]
        ids, _ = active_of(index, table, viewmats, Ks)
        if step % 100 == 0:
            dense = caught_up(table, schedule, step - 1)
            expected = {row for row, _ in seen(dense, viewmats, Ks)}
            assert expected <= set(ids.tolist())
            crossed += len({row for row, _ in seen(table, viewmats, Ks)} ^ expected)
        # The other rows are not visible.
        index.update(table, step_some(table, ids, schedule, step, generator))
    assert crossed > 0  # pending steps moved rows across the borders of views
    assert int(table["last_step"].min()) < steps - 20


def test_bounds_follow_the_rows_that_were_stepped(device):
    table = make_table(device=device)
    index = BlockIndex(table)
    viewmats, Ks = make_views(count=1, device=device)
    centre, axis = viewmats[0, :3, :3].T @ -viewmats[0, :3, 3], viewmats[0, 2, :3]
    hidden = [
        row for row in range(len(table)) if row not in active_of(index, table, viewmats, Ks)[0].tolist()
    ]
    moved = torch.tensor(hidden[::400], dtype=torch.int32, device=device)
    table["means"][moved.long()] = centre + 2 * axis
    table["scales"][moved.long()] = -2.0
    index.update(table, moved)
    assert set(moved.tolist()) <= set(active_of(index, table, viewmats, Ks)[0].tolist())


def test_no_rows_stepped_leave_all_bounds_alone(device):
    table = make_table(device=device)
    index = BlockIndex(table)
    before = index.bounds.clone()
    table["means"].add_(1000.0)
    index.update(table, torch.empty(0, dtype=torch.int32, device=device))
    assert torch.equal(index.bounds, before)


def test_morton_order_keeps_neighbours_together(device):
    points = torch.rand(4096, 3, generator=torch.Generator().manual_seed(0)).to(device)
    points[3] = math.nan
    order = morton_order(points)
    assert torch.equal(order.sort().values, torch.arange(4096, device=device))
    assert int(order[-1]) == 3
    steps = points[order[:-1]].diff(dim=0).norm(dim=1).mean()
    assert steps < 0.2 * points[:3].diff(dim=0).norm(dim=1).mean()
    assert torch.equal(morton_order(points.double()), order)
    same = torch.zeros(5, 3, device=device)
    assert morton_order(same).tolist() == list(range(5))
    assert morton_keys(points)[3] == 2**63 - 1


def test_points_far_away_leave_the_morton_order_of_the_others(device):
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)).to(device)
    assert torch.equal(morton_order(points), morton_keys(points).sort(stable=True).indices)
    far = points.clone()
    far[::50] = torch.tensor([1e8, -3e38, 1e5], device=device)
    far[7] = torch.inf
    order = morton_order(far)
    near = points[order[:-1]][far[order[:-1], 0] < 1e8]
    assert int(order[-1]) == 7 and len(near) == 489
    assert near.diff(dim=0).norm(dim=1).median() < 0.4 * points.diff(dim=0).norm(dim=1).median()
    assert torch.equal(morton_order(far.cpu()), order.cpu())


def test_a_morton_order_without_a_span_is_that_of_the_keys(device):
    """Most points lie in one place, or few are finite."""
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).to(device)
    points[10:] = 0.5
    assert torch.equal(morton_order(points), morton_keys(points).sort(stable=True).indices)
    points[1:] = torch.nan
    assert morton_order(points).tolist() == list(range(200))


def test_a_morton_order_needs_points():
    refused(TypeError, r"means must be a torch\.Tensor, got list", morton_order, [[0.0, 1.0, 2.0]])
    refused(ValueError, r"means must be \[N, 3\], got \[5, 2\]", morton_order, torch.zeros(5, 2))
    assert morton_order(torch.zeros(5, 3, requires_grad=True)).tolist() == list(range(5))


@pytest.mark.parametrize("n", [0, 1, 256, 257])
def test_odd_sizes(device, n):
    table = make_table(3000, device)
    table.keep(torch.arange(len(table), device=device) < n)
    viewmats, Ks = make_views(device=device)
    assert seen(table, viewmats, Ks) <= allowed(active_of(BlockIndex(table), table, viewmats, Ks))


def test_errors_name_the_value():
    table = make_table()
    index = BlockIndex(table)
    viewmats, Ks = make_views(33)
    refused(RuntimeError, "at most 32 views at once, got 33", active_of, index, table, viewmats, Ks)
    with pytest.raises(RuntimeError, match="capacity_blocks must be for 1 block or more, got 0"):
        index.active(table, Views(*make_views(1), WIDTH, HEIGHT), (NEAR, FAR, 0.3), capacity_blocks=0)
    table.keep(torch.arange(len(table)) < 100)
    refused(RuntimeError, r"bounds must .* \[1, 8\], got \[12, 8\]", active_of, index, table, *make_views(1))


def test_opcheck(device):
    table = make_table(600, device)
    viewmats, Ks = make_views(2, device)
    bounds = BlockIndex(table).bounds
    schedule = AdamSchedule(torch.ones(5, 6, device=device), 0.9, 0.999, 1e-15).table
    moments = [
        table[name] for name in ("exp_avg.means", "exp_avg_sq.means", "exp_avg.scales", "exp_avg_sq.scales")
    ]
    rows = [table["means"], table["scales"], *moments, table["last_step"], table["moment_step"], schedule]
    torch.library.opcheck(torch.ops.blitzgs.morton_keys, (table["means"],))
    torch.library.opcheck(torch.ops.blitzgs.update_block_bounds_, (bounds, None, rows))
    # The lists are undefined past their length, and opcheck's traced comparison reads all of them.
    utilities = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(
        torch.ops.blitzgs.cull_blocks,
        (bounds, rows, viewmats, Ks, WIDTH, HEIGHT, NEAR, FAR, 0.3),
        test_utils=utilities,
    )
