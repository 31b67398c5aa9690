# SPDX-License-Identifier: Apache-2.0
"""Projection and compositing on CUDA agree with the CPU kernel and with float64."""

import pytest
import torch

from blitzgs.ops.project import queue_projection
from blitzgs.ops.projection_types import VIEW_TOTALS, Sizes, splats_of
from blitzgs.ops.rasterize import RasterizeSaved
from tests.cuda.conftest import Scene, ops, relative_error
from tests.ops.splats import kept_by

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
def test_splat_gradients_match_float64(scene, degree, antialiased):
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
            inputs.gaussians, *inputs.cameras, scale_reg, None, *structure, None,
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
        inputs.gaussians, *inputs.cameras, None, None, *splats[1:4], None,
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
    expected = queue_projection(scene.inputs("cpu"), None, tiles)
    found = queue_projection(scene.inputs("cuda"), None, tiles)
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
    expected, expected_ids, totals = queue_projection(inputs, None)
    counts = totals.cpu()[:3]
    visible, splats, _ = counts.tolist()
    assert (splats > visible > 100) == splats_seen
    assert len(expected.gaussian_ids) == splats and len(expected.visible_ids) == visible
    assert torch.equal(expected_ids, ids[expected.gaussian_ids.long()])
    sizes = [
        (visible, splats), (visible - 1, splats), (visible, splats - 1), (1, 1), (visible + 1, splats + 200),
    ]  # fmt: skip
    for size in [*sizes, (2 * visible + 3, 3 * splats + 1000)]:
        if min(size) < 1:
            with pytest.raises(RuntimeError, match="how many visible Gaussians and splats there is room for"):
                queue_projection(inputs, Sizes(*size, 0))
            continue
        written, splat_ids, counted = queue_projection(inputs, Sizes(*size, 0))
        assert torch.equal(counted, totals)
        if size[0] < visible or size[1] < splats:
            continue
        for a, b in zip(splats_of(written, Sizes(*counts.tolist()))[:12], expected[:12], strict=True):
            assert a.is_contiguous() and torch.equal(a, b)
        assert torch.equal(splat_ids[:splats], expected_ids)


# Where rounding decides whether a splat takes part, the images differ by up to about alpha = 1/255.
CUT_SHARE = 2e-3


class Job:
    """Splats and lists of a scene, and its rasterisation on either device."""

    def __init__(self, scene: Scene, channels: int, tile_size: int = 16, begin: int = 0, end: int = -1):
        g = torch.Generator().manual_seed(5)
        splats = scene.project("cpu")
        self.grid = scene.grid(tile_size, begin, end)
        self.splats = [splats[4], splats[5], splats[7], torch.rand(len(splats[0]), channels, generator=g)]
        self.backgrounds = torch.rand(len(scene.Ks), channels, generator=g)
        means2d, conics, opacities, _ = self.splats
        self.lists = ops.intersect(means2d, conics, opacities, splats[6], splats[1], None, *self.grid, -1)

    def inputs(self, device, dtype):
        moved = [t.to(device, dtype) for t in (*self.splats, self.backgrounds)]
        return [*moved, *(t.to(device) for t in self.lists)]

    def saved(self, device, dtype, outputs):
        """What the backward pass takes of the forward pass."""
        *splats, backgrounds, isect_splats, tile_offsets = self.inputs(device, dtype)
        return RasterizeSaved(splats, backgrounds, [isect_splats, tile_offsets], kept_by(outputs))

    def forward(self, device, dtype=torch.float32, backward_follows=False):
        return ops.rasterize_fwd(*self.inputs(device, dtype), *self.grid, True, backward_follows)

    def backward(self, device, dtype, saved, v_renders, v_alphas, absgrad, deterministic):
        v = [t.to(device, dtype) for t in (v_renders, v_alphas)]
        return ops.rasterize_bwd(*self.saved(device, dtype, saved), *v, *self.grid, absgrad, deterministic)


def close_images(job):
    """Both devices' forward results, and the pixels that lie on no cut [B, H, W]."""
    exact = job.forward("cpu", torch.float64)
    ours = job.forward("cuda")
    error = (ours[0].cpu().double() - exact[0]).abs().amax(dim=-1)
    decided = (error <= 2e-5) & (ours[2].cpu() == exact[2])
    assert torch.isfinite(ours[0]).all()
    assert (~decided).float().mean() < CUT_SHARE
    assert error.max() < 0.02
    return exact, ours, decided


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 9])
def test_image_matches_float64(scene, channels):
    exact, ours, decided = close_images(Job(scene, channels))
    assert (ours[1].cpu() - exact[1])[decided].abs().max() < 2e-5
    same_work = ours[3].cpu() == exact[3]
    assert same_work.float().mean() > 0.9


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("absgrad", [False, True])
def test_gradients_match_float64(scene, channels, deterministic, absgrad):
    job = Job(scene, channels)
    exact, ours, decided = close_images(job)
    g = torch.Generator().manual_seed(6)
    v_renders = torch.randn(exact[0].shape, generator=g) * decided[..., None]
    v_alphas = torch.randn(decided.shape, generator=g) * decided
    expected = job.backward("cpu", torch.float64, exact, v_renders, v_alphas, absgrad, True)
    gradients = job.backward("cuda", torch.float32, ours, v_renders, v_alphas, absgrad, deterministic)
    names = ("means2d", "conics", "opacities", "colors", "abs")
    for name, value, target in zip(names, gradients, expected, strict=True):
        assert value.shape == target.shape
        assert relative_error(value, target) < 1e-4, name


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_packed_gradients_are_the_same(scene, channels, absgrad):
    job = Job(scene, channels)
    renders, rest, *_, table = saved = job.forward("cuda", backward_follows=True)
    assert table.shape == (len(job.splats[0]), 12) and not table.any()
    v_renders = torch.randn(renders.shape, generator=torch.Generator().manual_seed(7)).cuda()
    none = torch.zeros_like(rest)
    *columns, absolute = job.backward("cuda", torch.float32, saved, v_renders, none, absgrad, True)
    arguments = *job.saved("cuda", torch.float32, saved), v_renders, None, *job.grid
    ops.rasterize_bwd(*arguments, absgrad, True, table)
    assert torch.equal(table[:, : 6 + channels], torch.cat([c.view(len(c), -1) for c in columns], 1))
    if absgrad:
        begin = ops.splat_gradient_layout()[4]
        assert absolute.any() and torch.equal(table[:, begin : begin + 2], absolute)


@pytest.mark.parametrize("n_splats", [0, 1, 1000, 300_000])
@pytest.mark.parametrize("begin,end", [(0, -1), (3, 9), (5, 5)])
def test_forward_zeroes_the_gradient_table(n_splats, begin, end):
    """The table is zeroed for few and many splats, and for some tiles and none."""
    job = Job(Scene(4, views=1, width=90, height=50), 3, 16, begin, end)
    job.splats = [
        torch.zeros(n_splats, 2), torch.ones(n_splats, 3), torch.ones(n_splats), torch.ones(n_splats, 3),
    ]  # fmt: skip
    job.lists = [torch.zeros(0, dtype=torch.int32), torch.zeros(25, dtype=torch.int64)]
    torch.full((n_splats, 12), float("nan"), device="cuda")  # what the table would hold otherwise
    assert len(job.forward("cuda")[6]) == 0
    table = job.forward("cuda", backward_follows=True)[6]
    assert table.shape == (n_splats, 12) and not table.any()


def test_splats_of_many_channels_get_no_gradient_table(scene):
    assert len(Job(scene, 9).forward("cuda", backward_follows=True)[6]) == 0


def test_packed_gradients_have_four_channels_at_most(scene):
    job = Job(scene, 9)
    renders, *_, table = saved = job.forward("cuda")
    arguments = *job.saved("cuda", torch.float32, saved), renders, None, *job.grid
    with pytest.raises(RuntimeError, match="1 to 4 channels, got 9"):
        ops.rasterize_bwd(*arguments, False, True, table)


def test_tile_ranges_are_the_image_bit_for_bit(scene):
    whole = Job(scene, 3).forward("cuda")
    tiles = len(whole[3])
    total = torch.zeros_like(whole[0])
    work = torch.zeros_like(whole[3])
    cuts = [0, 11, 12, 70, tiles]
    for begin, end in zip(cuts, cuts[1:], strict=False):
        part = Job(scene, 3, 16, begin, end).forward("cuda")
        total += part[0]
        work += part[3]
    assert torch.equal(total, whole[0])
    assert torch.equal(work, whole[3])


@pytest.mark.parametrize("deterministic", [False, True])
def test_gradients_of_some_of_the_composited_tiles(scene, deterministic):
    """As in training on several ranks, the halo around the tiles is composited but not differentiated."""
    job = Job(scene, 3, 16, 8, 100)
    exact, ours, decided = close_images(job)
    g = torch.Generator().manual_seed(8)
    v_renders = torch.randn(exact[0].shape, generator=g) * decided[..., None]
    v_alphas = torch.randn(decided.shape, generator=g) * decided
    job.grid = scene.grid(16, 31, 77)
    expected = job.backward("cpu", torch.float64, exact, v_renders, v_alphas, False, True)
    gradients = job.backward("cuda", torch.float32, ours, v_renders, v_alphas, False, deterministic)
    for value, target in zip(gradients[:4], expected[:4], strict=True):
        assert target.any() and relative_error(value, target) < 1e-4


@pytest.mark.parametrize("deterministic", [False, True])
def test_entries_of_no_tile_name_any_splat(scene, deterministic):
    """Lists may be longer than the number of entries that the tiles have."""
    job = Job(scene, 3)
    saved = job.forward("cuda")
    v = torch.randn_like(saved[0]), torch.randn_like(saved[1])
    expected = job.backward("cuda", torch.float32, saved, *v, False, deterministic)
    entries, offsets = job.lists
    g = torch.Generator().manual_seed(9)
    anything = torch.randint(-(2**31), 2**31, (5000,), generator=g).int()
    anything[::2] = entries[torch.randint(len(entries), (2500,), generator=g)]
    job.lists = torch.cat((entries, anything)), offsets
    gradients = job.backward("cuda", torch.float32, saved, *v, False, deterministic)
    for value, target in zip(gradients, expected, strict=True):
        assert relative_error(value, target) <= (0 if deterministic else 1e-5)


def test_empty_lists_give_the_background(scene):
    scene.means[:, 2] = -100.0
    job = Job(scene, 3)
    saved = job.forward("cuda")
    expected = job.backgrounds[:, None, None, :].expand(-1, scene.height, scene.width, -1)
    assert torch.equal(saved[0].cpu(), expected)
    assert (saved[1] == 1).all() and not saved[2].any()
    v = torch.ones_like(saved[0]), torch.ones_like(saved[1])
    for gradient in job.backward("cuda", torch.float32, saved, *v, True, False):
        assert gradient.shape[0] == 0


def test_a_hundred_thousand_layers():
    n = 100_000
    scene = Scene(4, views=1, width=16, height=16)
    job = Job(scene, 3)
    job.splats = [torch.tensor([[7.3, 8.6]]).repeat(n, 1), torch.tensor([[0.02, 0.0, 0.02]]).repeat(n, 1),
                  torch.full((n,), 0.0042), torch.rand(n, 3)]  # fmt: skip
    job.lists = [torch.arange(n, dtype=torch.int32), torch.tensor([0, n])]
    exact, ours, decided = close_images(job)
    v = torch.ones_like(exact[0]) * decided[..., None], torch.zeros_like(exact[1])
    expected = job.backward("cpu", torch.float64, exact, *v, False, True)
    gradients = job.backward("cuda", torch.float32, ours, *v, False, False)
    for value, target in zip(gradients[:4], expected[:4], strict=True):
        assert relative_error(value, target) < 1e-3
