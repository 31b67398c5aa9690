# SPDX-License-Identifier: Apache-2.0
"""Projection on CUDA against the CPU kernel."""

import pytest
import torch
from cuda_scenes import Scene, ops, relative_error

from blitzgs.ops.capacity import Sizes
from blitzgs.ops.projection import rows_of

NAMES = ("gaussian_ids", "camera_ids", "visible_ids", "row_offsets")
NAMES += ("means2d", "conics", "depths", "opacities", "colors")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rows_match_the_cpu(degree, antialiased):
    scene = Scene(5000, views=3)
    scene.degree = degree
    expected = scene.project("cpu", antialiased=antialiased)
    rows = scene.project("cuda", antialiased=antialiased)
    assert torch.equal(rows.counts, expected.counts)
    for i in range(4):
        assert torch.equal(rows[i].cpu(), expected[i]), NAMES[i]
    for i in range(4, 9):
        assert relative_error(rows[i], expected[i]) < 1e-6, NAMES[i]
    assert (rows[9].cpu() - expected[9]).abs().max() <= 1
    assert (rows[10].cpu() != expected[10]).float().mean() < 1e-3


def test_active_rows_and_views(scene):
    g = torch.Generator().manual_seed(1)
    ids = torch.arange(0, 3000, 3, dtype=torch.int32)
    views = torch.randint(0, 4, (len(ids),), generator=g, dtype=torch.int32)
    expected = scene.project("cpu", active_ids=ids, active_views=views)
    rows = scene.project("cuda", active_ids=ids.cuda(), active_views=views.cuda())
    for i in range(4):
        assert torch.equal(rows[i].cpu(), expected[i]), NAMES[i]


def test_a_row_does_not_depend_on_the_others(scene):
    whole = scene.project("cuda")
    ids = torch.arange(1, 3000, 7, dtype=torch.int32, device="cuda")
    part = scene.project("cuda", active_ids=ids)
    kept = torch.isin(whole[0], ids)
    for i in (0, 1, 4, 5, 6, 7, 8, 9, 10):
        assert torch.equal(whole[i][kept], part[i]), i


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_gradients_match_float64(scene, degree, antialiased):
    scene.degree = degree
    rows = scene.project("cpu", antialiased=antialiased)
    g = torch.Generator().manual_seed(2)
    shapes = [rows[i].shape for i in (4, 5, 6, 7, 8)]
    v = [torch.randn(shape, generator=g) for shape in shapes]
    regularizer = torch.tensor([0.5, -2.0])

    def backward(device, dtype):
        inputs = scene.inputs(device, dtype, antialiased=antialiased)
        structure = [rows[i].to(device) for i in (1, 2, 3)]
        *gradients, scale_reg = [t.to(device, dtype) for t in (*v, regularizer)]
        means2d, conics, depths, opacities, colors = gradients
        return ops.project_bwd(
            inputs.gaussians, list(inputs.cameras), structure, inputs.options.ints, inputs.options.floats,
            [means2d, conics, opacities, colors], depths, scale_reg, True,
        )  # fmt: skip

    expected, gradients = backward("cpu", torch.float64), backward("cuda", torch.float32)
    names = ("means", "quats", "scales", "opacities", "sh", "viewmats")
    for name, value, target in zip(names, gradients, expected, strict=True):
        assert value.shape == target.shape
        assert relative_error(value, target) < 1e-5, name


@pytest.mark.parametrize("case", ["none", "behind", "nan", "no views"])
def test_nothing_visible(case):
    scene = Scene(0 if case == "none" else 100)
    if case == "behind":
        scene.means[:, 2] = -100.0
    if case == "nan":
        scene.means[:] = float("nan")
    if case == "no views":
        scene.viewmats, scene.Ks = scene.viewmats[:0], scene.Ks[:0]
    rows = scene.project("cuda")
    assert rows.counts.tolist() == [0, 0, 0]
    assert rows[3].tolist() == [0]
    inputs = scene.inputs("cuda")
    gradients = ops.project_bwd(
        inputs.gaussians, list(inputs.cameras), [rows[i] for i in (1, 2, 3)], inputs.options.ints,
        inputs.options.floats, [rows[i] for i in (4, 5, 7, 8)], rows.depths, None, True,
    )  # fmt: skip
    assert gradients[0].shape == (0, 3)
    assert not gradients[5].any()


def test_rows_with_nan_vanish_and_spread_nowhere(scene):
    clean = scene.project("cuda")
    broken = Scene()
    for k, name in enumerate(("means", "quats", "scales", "opacities", "sh")):
        getattr(broken, name)[k::50] = float("nan")
    bad = torch.zeros(3000, dtype=torch.bool)
    for k in range(4):
        bad[k::50] = True
    rows = broken.project("cuda")
    kept = ~bad.cuda()[clean.gaussian_ids.long()]
    assert torch.equal(rows.gaussian_ids, clean.gaussian_ids[kept])
    # Where only the colour is not finite there are rows, but nothing composites them.
    hidden = rows.gaussian_ids % 50 == 4
    assert hidden.any()
    for i in (7, 8, 9, 10):
        assert not rows[i][hidden].any()
    for i in (0, 1, 4, 5, 6, 7, 8, 9, 10):
        assert torch.equal(rows[i][~hidden], clean[i][kept][~hidden])


def test_ranks_of_rows_match_the_cpu(scene):
    tiles = [(0, 40), (30, 30), (30, 90), (50, 140)]
    expected = scene.inputs("cpu").run(None, tiles)
    found = scene.inputs("cuda").run(None, tiles)
    assert torch.equal(found.totals.cpu(), expected.totals)
    masks = expected.rows.rank_masks
    assert torch.equal(found.rows.rank_masks.cpu(), masks)
    assert expected.totals[5::2].tolist() == [(masks >> m & 1).sum().item() for m in range(4)]


@pytest.mark.parametrize("views", [1, 4, 9])
@pytest.mark.parametrize("n", [1, 200, 400_000])
def test_rows_are_written_in_order(views, n):
    scene = Scene(n, views, 150, 100)
    parts = [
        scene.project("cuda", active_ids=part)
        for part in torch.arange(n, dtype=torch.int32, device="cuda").chunk(7)
    ]
    expected = [torch.cat(columns) for columns in zip(*(part[:11] for part in parts), strict=True)]
    for _ in range(3):  # the room for the rows is that of the call before
        rows = scene.project("cuda")
        for i in (0, 1, 2, *range(4, 11)):
            assert torch.equal(rows[i], expected[i]), i
        assert rows[3][0] == 0 and rows[3][-1] == len(rows[0])
        assert torch.equal(rows[2].repeat_interleave(rows[3].diff()), rows[0])


@pytest.mark.parametrize("rows_seen", [True, False])
def test_rows_do_not_depend_on_the_capacity_that_was_guessed(scene, rows_seen):
    inputs = scene.inputs("cuda")
    if not rows_seen:
        inputs = inputs._replace(gaussians=[torch.full_like(inputs.gaussians[0], 1e6), *inputs.gaussians[1:]])
    ids = 7919 * torch.arange(len(inputs.gaussians[0]), device="cuda")
    inputs = inputs._replace(ids=ids)
    expected, expected_ids, totals = inputs.run(None)
    counts = totals.cpu()[:3]
    visible, rows, _ = counts.tolist()
    assert (rows > visible > 100) == rows_seen
    assert len(expected.gaussian_ids) == rows and len(expected.visible_ids) == visible
    assert torch.equal(expected_ids, ids[expected.gaussian_ids.long()])
    sizes = [(visible, rows), (visible - 1, rows), (visible, rows - 1), (1, 1), (visible + 1, rows + 200)]
    for size in [*sizes, (2 * visible + 3, 3 * rows + 1000)]:
        if min(size) < 1:
            with pytest.raises(RuntimeError, match="how many visible Gaussians and rows there is room for"):
                inputs.run(Sizes(*size, 0))
            continue
        written, row_ids, counted = inputs.run(Sizes(*size, 0))
        assert torch.equal(counted, totals)
        if size[0] < visible or size[1] < rows:
            continue
        for a, b in zip(rows_of(written[:12], counts)[:12], expected[:12], strict=True):
            assert a.is_contiguous() and torch.equal(a, b)
        assert torch.equal(row_ids[:rows], expected_ids)
