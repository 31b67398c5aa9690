# SPDX-License-Identifier: Apache-2.0
"""Rasterisation on CUDA agrees with the CPU kernel in float64, for the same splats and lists."""

import pytest
import torch

from blitzgs.ops.rasterize import RasterizeSaved
from tests.cuda.scenes import Scene, ops, relative_error
from tests.ops.splats import kept_by

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
        torch.zeros(n_splats, 2),
        torch.ones(n_splats, 3),
        torch.ones(n_splats),
        torch.ones(n_splats, 3),
    ]
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
