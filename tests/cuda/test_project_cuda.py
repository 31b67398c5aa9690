# SPDX-License-Identifier: Apache-2.0
"""Projection on CUDA agrees with the CPU kernel."""

import pytest
import torch

from blitzgs.ops.projection_types import VIEW_TOTALS, Sizes, WeightedViews, splats_of
from tests.cuda.scenes import Scene, ops, relative_error

NAMES = ("gaussian_ids", "camera_ids", "visible_ids", "splat_offsets")
NAMES += ("means2d", "conics", "depths", "opacities", "colors")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_match_the_cpu(degree, antialiased):
    scene = Scene(5000, views=3)
    scene.degree = degree
    expected = scene.project("cpu", antialiased=antialiased)
    splats = scene.project("cuda", antialiased=antialiased)
    assert torch.equal(splats.counts, expected.counts)
    for i in range(4):
        assert torch.equal(splats[i].cpu(), expected[i]), NAMES[i]
    for i in range(4, 9):
        assert relative_error(splats[i], expected[i]) < 1e-6, NAMES[i]
    assert (splats[9].cpu() - expected[9]).abs().max() <= 1
    assert (splats[10].cpu() != expected[10]).float().mean() < 1e-3


def test_active_rows_and_views(scene):
    g = torch.Generator().manual_seed(1)
    ids = torch.arange(0, 3000, 3, dtype=torch.int32)
    views = torch.randint(0, 4, (len(ids),), generator=g, dtype=torch.int32)
    expected = scene.project("cpu", active_ids=ids, active_views=views)
    splats = scene.project("cuda", active_ids=ids.cuda(), active_views=views.cuda())
    for i in range(4):
        assert torch.equal(splats[i].cpu(), expected[i]), NAMES[i]


def test_a_splat_does_not_depend_on_other_gaussians(scene):
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
    splats = scene.project("cpu", antialiased=antialiased)
    g = torch.Generator().manual_seed(2)
    shapes = [splats[i].shape for i in (4, 5, 6, 7, 8)]
    v = [torch.randn(shape, generator=g) for shape in shapes]
    regularizer = torch.tensor([0.5, -2.0])

    def backward(device, dtype):
        inputs = scene.inputs(device, dtype, antialiased=antialiased)
        structure = [splats[i].to(device) for i in (1, 2, 3)]
        *gradients, scale_reg = [t.to(device, dtype) for t in (*v, regularizer)]
        means2d, conics, depths, opacities, colors = gradients
        return ops.project_bwd(
            inputs.gaussians, *WeightedViews(*inputs.cameras, scale_reg), *structure, None,
            *inputs.options, [means2d, conics, opacities, colors], depths, True,
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
    splats = scene.project("cuda")
    assert splats.counts.tolist() == [0, 0, 0]
    assert splats[3].tolist() == [0]
    inputs = scene.inputs("cuda")
    gradients = ops.project_bwd(
        inputs.gaussians, *WeightedViews(*inputs.cameras), *splats[1:4], None,
        *inputs.options, [splats[i] for i in (4, 5, 7, 8)], splats.depths, True,
    )  # fmt: skip
    assert gradients[0].shape == (0, 3)
    assert not gradients[5].any()


def test_splats_with_nan_vanish_and_spread_nowhere(scene):
    clean = scene.project("cuda")
    broken = Scene()
    for k, name in enumerate(("means", "quats", "scales", "opacities", "sh")):
        getattr(broken, name)[k::50] = float("nan")
    bad = torch.zeros(3000, dtype=torch.bool)
    for k in range(4):
        bad[k::50] = True
    splats = broken.project("cuda")
    kept = ~bad.cuda()[clean.gaussian_ids.long()]
    assert torch.equal(splats.gaussian_ids, clean.gaussian_ids[kept])
    # Where only the colour is not finite there are splats, but nothing composites them.
    hidden = splats.gaussian_ids % 50 == 4
    assert hidden.any()
    for i in (7, 8, 9, 10):
        assert not splats[i][hidden].any()
    for i in (0, 1, 4, 5, 6, 7, 8, 9, 10):
        assert torch.equal(splats[i][~hidden], clean[i][kept][~hidden])


def test_ranks_of_splats_match_the_cpu(scene):
    tiles = [(0, 40), (30, 30), (30, 90), (50, 140)]
    expected = scene.inputs("cpu").run(None, tiles)
    found = scene.inputs("cuda").run(None, tiles)
    assert torch.equal(found.totals.cpu(), expected.totals)
    masks = expected.splats.rank_masks
    assert torch.equal(found.splats.rank_masks.cpu(), masks)
    assert expected.totals[VIEW_TOTALS + 2 :: 2].tolist() == [(masks >> m & 1).sum().item() for m in range(4)]


@pytest.mark.parametrize("views", [1, 4, 9])
@pytest.mark.parametrize("n", [1, 200, 400_000])
def test_splats_are_written_in_order(views, n):
    scene = Scene(n, views, 150, 100)
    parts = [
        scene.project("cuda", active_ids=part)
        for part in torch.arange(n, dtype=torch.int32, device="cuda").chunk(7)
    ]
    expected = [torch.cat(columns) for columns in zip(*(part[:11] for part in parts), strict=True)]
    for _ in range(3):  # the capacity is estimated from the call before
        splats = scene.project("cuda")
        for i in (0, 1, 2, *range(4, 11)):
            assert torch.equal(splats[i], expected[i]), i
        assert splats[3][0] == 0 and splats[3][-1] == len(splats[0])
        assert torch.equal(splats[2].repeat_interleave(splats[3].diff()), splats[0])


@pytest.mark.parametrize("splats_seen", [True, False])
def test_splats_do_not_depend_on_the_capacity_that_was_guessed(scene, splats_seen):
    inputs = scene.inputs("cuda")
    if not splats_seen:
        inputs = inputs._replace(gaussians=[torch.full_like(inputs.gaussians[0], 1e6), *inputs.gaussians[1:]])
    ids = 7919 * torch.arange(len(inputs.gaussians[0]), device="cuda")
    inputs = inputs._replace(ids=ids)
    expected, expected_ids, totals = inputs.run(None)
    counts = totals.cpu()[:3]
    visible, splats, _ = counts.tolist()
    assert (splats > visible > 100) == splats_seen
    assert len(expected.gaussian_ids) == splats and len(expected.visible_ids) == visible
    assert torch.equal(expected_ids, ids[expected.gaussian_ids.long()])
    sizes = [
        (visible, splats),
        (visible - 1, splats),
        (visible, splats - 1),
        (1, 1),
        (visible + 1, splats + 200),
    ]
    for size in [*sizes, (2 * visible + 3, 3 * splats + 1000)]:
        if min(size) < 1:
            with pytest.raises(RuntimeError, match="how many visible Gaussians and splats there is room for"):
                inputs.run(Sizes(*size, 0))
            continue
        written, splat_ids, counted = inputs.run(Sizes(*size, 0))
        assert torch.equal(counted, totals)
        if size[0] < visible or size[1] < splats:
            continue
        for a, b in zip(splats_of(written, Sizes(*counts.tolist()))[:12], expected[:12], strict=True):
            assert a.is_contiguous() and torch.equal(a, b)
        assert torch.equal(splat_ids[:splats], expected_ids)
