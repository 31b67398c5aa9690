# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from blitzgs.ops.intersect import intersect, tile_counts
from blitzgs.ops.photometric import photometric_fwd_bwd
from blitzgs.ops.rasterize import GradientBuffer, gradient_columns, gradient_table_of, rasterize
from tests.helpers import on_threads, refused
from tests.ops.splats import Splats, by_definition, kept_by, random_splats
from tests.ops.test_photometric import images

WIDTH, HEIGHT = 53, 37  # neither is a multiple of a tile
ROOT = Path(__file__).resolve().parents[2]


def lists(splats, n_cameras=1, width=WIDTH, height=HEIGHT, tile_size=16, **tile_range):
    return intersect(
        *splats.geometry(), n_cameras=n_cameras, width=width, height=height, tile_size=tile_size, **tile_range
    )


def forward(splats, n_cameras=1, tile_size=16, backgrounds=None, tile_begin=0, tile_end=-1):
    """All outputs of the op."""
    tile_lists = lists(splats, n_cameras, tile_size=tile_size)
    return torch.ops.blitzgs.rasterize_fwd(
        *splats.values(), backgrounds, *tile_lists, n_cameras, WIDTH, HEIGHT, tile_size, tile_begin, tile_end,
    )  # fmt: skip


def backward(
    splats, outputs, v_renders, n_cameras=1, backgrounds=None, absgrad=True, tiles=(0, -1), tile_lists=None
):
    return torch.ops.blitzgs.rasterize_bwd(
        splats.values(), backgrounds, tile_lists or lists(splats, n_cameras), kept_by(outputs), v_renders,
        None, n_cameras, WIDTH, HEIGHT, 16, *tiles, absgrad, True,
    )  # fmt: skip


def gradients(splats, renderer, v_renders, v_alphas, backgrounds):
    """Gradients of sum(v * outputs) with respect to the four inputs and the backgrounds."""
    leaves = [t.detach().clone().requires_grad_() for t in (*splats.values(), backgrounds)]
    renders, alphas = renderer(leaves[:4], leaves[4])
    ((renders * v_renders).sum() + (alphas * v_alphas).sum()).backward()
    return [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("channels", [1, 3, 7])
@pytest.mark.parametrize(
    ("dtype", "image_error", "gradient_error"), [(torch.float64, 1e-12, 1e-10), (torch.float32, 2e-6, 1e-5)]
)
def test_image_and_gradients_match_the_definition(channels, dtype, image_error, gradient_error):
    splats = random_splats(180, WIDTH, HEIGHT, channels=channels, cameras=2, dtype=dtype)
    generator = torch.Generator().manual_seed(1)
    backgrounds = torch.rand(2, channels, generator=generator, dtype=torch.float64).to(dtype)
    v_renders = torch.randn(2, HEIGHT, WIDTH, channels, generator=generator, dtype=torch.float64)
    v_alphas = torch.randn(2, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    tile_lists = lists(splats, 2)

    def ours(values, background):
        return rasterize(
            *values, *tile_lists, n_cameras=2, width=WIDTH, height=HEIGHT, backgrounds=background
        )

    def dense(values, background):
        exact = Splats(*values, splats.depths.double(), splats.camera_ids)
        return by_definition(exact, WIDTH, HEIGHT, 2, background)[:2]

    exact = splats.to(torch.float64)
    renders, alphas = ours(splats.values(), backgrounds)
    true_renders, true_alphas, cut = by_definition(exact, WIDTH, HEIGHT, 2, backgrounds.double())
    clear = ~cut
    v_renders, v_alphas = v_renders * clear[..., None], v_alphas * clear
    assert clear.float().mean() > 0.95
    assert ((renders - true_renders).abs() * clear[..., None]).max() < image_error
    assert ((alphas - true_alphas).abs() * clear).max() < image_error
    found = gradients(splats, ours, v_renders.to(dtype), v_alphas.to(dtype), backgrounds)
    expected = gradients(exact, dense, v_renders, v_alphas, backgrounds.double())
    for a, b in zip(found, expected, strict=True):
        assert (a - b).abs().max() <= gradient_error * b.abs().max()


def test_gradcheck():
    """Of the colours and, alone, of the opacity of an image."""
    splats = random_splats(8, 9, 8, channels=2, dtype=torch.float64, smallest=2, opacity=(0.1, 0.9), seed=4)
    tile_lists = lists(splats, width=9, height=8)
    leaves = [t.requires_grad_() for t in (*splats.values(), torch.rand(1, 2, dtype=torch.float64))]

    def image(*values):
        return rasterize(*values[:4], *tile_lists, n_cameras=1, width=9, height=8, backgrounds=values[4])

    # Steps small enough that no pixel crosses the cut at 1/255.
    assert torch.autograd.gradcheck(image, leaves, eps=1e-7, atol=1e-5, rtol=1e-4)


def test_absolute_gradients_sum_each_pixels_gradient():
    splats = random_splats(30, WIDTH, HEIGHT, dtype=torch.float64, smallest=4)
    v_renders = torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.float64)
    patch = (slice(None), slice(11, 19), slice(10, 22))  # across a corner of four tiles
    v_renders[patch] = torch.randn(8, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    expected = torch.zeros(30, 2, dtype=torch.float64)
    outputs = forward(splats)
    for _, row, column in v_renders.any(-1).nonzero().tolist():
        one = torch.zeros_like(v_renders)
        one[0, row, column] = v_renders[0, row, column]
        expected += backward(splats, outputs, one)[0].abs()
    found = backward(splats, outputs, v_renders)
    assert (found[4] > 0).sum() > 10
    torch.testing.assert_close(found[4], expected, rtol=1e-10, atol=1e-12)
    assert backward(splats, outputs, v_renders, absgrad=False)[4].shape == (0, 2)

    means2d = splats.means2d.clone().requires_grad_()
    told = []
    renders, _ = rasterize(
        means2d, *splats.values()[1:], *lists(splats), n_cameras=1, width=WIDTH, height=HEIGHT,
        store_absgrad=told.append,
    )  # fmt: skip
    renders.backward(v_renders)
    (absolute,) = told
    assert torch.equal(absolute, found[4])
    assert torch.equal(means2d.grad, found[0])


def test_last_ids_and_tile_work():
    splats = random_splats(400, WIDTH, HEIGHT, smallest=3, opacity=(0.5, 1.0))
    entries, offsets = lists(splats)
    _, transmittances, last_ids, tile_work, *_ = forward(splats)
    tiles_x, _ = tile_counts(WIDTH, HEIGHT, 16)
    lengths = offsets.diff()
    assert (tile_work <= lengths).all()
    assert (tile_work < lengths).any()  # some tile ended early
    for tile, work in enumerate(tile_work.tolist()):
        y, x = tile // tiles_x * 16, tile % tiles_x * 16
        last = last_ids[0, y : y + 16, x : x + 16]
        assert last.max() <= work
        # Entries past tile_work change nothing: drop them and render again.
        shorter = entries[offsets[tile] : offsets[tile] + work]
        alone = torch.zeros_like(offsets)
        alone[tile + 1 :] = work
        again = torch.ops.blitzgs.rasterize_fwd(
            *splats.values(), None, shorter, alone, 1, WIDTH, HEIGHT, 16, tile, tile + 1
        )
        assert torch.equal(again[2][0, y : y + 16, x : x + 16], last)
        assert again[3][tile] == work
        # The last composited entry is needed: without it the pixel's transmittance is another.
        if work > 0:
            pixel = (last == last.max()).nonzero()[0]
            cut = alone.clamp(max=int(last.max()) - 1)
            less = torch.ops.blitzgs.rasterize_fwd(
                *splats.values(), None, shorter, cut, 1, WIDTH, HEIGHT, 16, tile, tile + 1
            )
            where = (0, y + pixel[0], x + pixel[1])
            assert less[1][where] > transmittances[where]


def test_tile_ranges_make_up_the_whole_image_bit_for_bit():
    splats = random_splats(900, WIDTH, HEIGHT, cameras=2)
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(0))
    v_renders = torch.randn(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    whole = forward(splats, 2, backgrounds=backgrounds)
    v_whole = backward(splats, whole, v_renders, 2, backgrounds)
    pieces = [
        forward(splats, 2, backgrounds=backgrounds, tile_begin=a, tile_end=b)
        for a, b in [(0, 5), (5, 17), (17, 24)]
    ]
    for output in range(4):
        assert torch.equal(sum(piece[output] for piece in pieces), whole[output])
    for piece in pieces:
        unowned = piece[1] == 0
        assert unowned.any()
        assert not piece[0][unowned].any()
        assert not piece[2][unowned].any()
    v_parts = [
        backward(splats, whole, v_renders, 2, backgrounds, tiles=t) for t in [(0, 5), (5, 17), (17, 24)]
    ]
    for parts, total in zip(zip(*v_parts, strict=True), v_whole, strict=True):
        torch.testing.assert_close(sum(parts), total, rtol=1e-4, atol=1e-4 * float(total.abs().max()))


def test_public_function_masks_unowned_alphas():
    splats = random_splats(300, WIDTH, HEIGHT)
    options = {"n_cameras": 1, "width": WIDTH, "height": HEIGHT}
    _, whole = rasterize(*splats.values(), *lists(splats), **options)
    _, first = rasterize(*splats.values(), *lists(splats), **options, tile_begin=0, tile_end=6)
    _, second = rasterize(*splats.values(), *lists(splats), **options, tile_begin=6, tile_end=12)
    assert torch.equal(first + second, whole)
    assert not first[:, 32:].any()


def test_batch_position_and_threads_change_no_bit():
    splats = random_splats(1200, WIDTH, HEIGHT, cameras=3)
    v_renders = torch.randn(3, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))

    def images_and_gradients():
        outputs = forward(splats, 3)
        return *outputs[:4], *backward(splats, outputs, v_renders, n_cameras=3)

    results = on_threads(images_and_gradients)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
    single = splats.camera_ids == 1
    alone = Splats(*(t[single] for t in vars(splats).values()))
    alone.camera_ids = torch.zeros_like(alone.camera_ids)
    outputs = forward(alone)
    assert torch.equal(outputs[0][0], results[0][0][1])
    v_alone = backward(alone, outputs, v_renders[1:2])
    for a, b in zip(v_alone, results[0][4:], strict=True):
        assert torch.equal(a, b[single])


SCALAR_SCRIPT = """
import sys, torch
from tests.ops.test_rasterize import scalar_case
torch.save(scalar_case(), sys.argv[1])
"""


def scalar_case():
    """Return images and their gradients, and those of the loss."""
    results = []
    for channels in (3, 4, 6):
        splats = random_splats(700, WIDTH, HEIGHT, channels=channels, smallest=0.1, largest=80, seed=channels)
        v_renders = torch.randn(1, HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(1))
        outputs = forward(splats)
        results += [*outputs, *backward(splats, outputs, v_renders)]
    x, targets, masks = images((1, 60, 50))
    return [*results, *photometric_fwd_bwd(x, targets, masks, torch.ones(1), torch.ones(1))]


def test_scalar_code_gives_the_same_bits(tmp_path):
    environment = {**os.environ, "BLITZGS_NO_AVX2": "1", "PYTHONPATH": str(ROOT)}
    path = tmp_path / "scalar.pt"
    subprocess.run(
        [sys.executable, "-c", SCALAR_SCRIPT, str(path)], check=True, env=environment, cwd=ROOT, timeout=120
    )
    torch.testing.assert_close(torch.load(path), scalar_case(), rtol=0, atol=0)


def test_zero_splats_and_empty_lists():
    splats = random_splats(0, WIDTH, HEIGHT)
    backgrounds = torch.tensor([[0.1, 0.2, 0.3]])
    outputs = forward(splats, backgrounds=backgrounds)
    assert torch.equal(outputs[0], backgrounds.expand(1, HEIGHT, WIDTH, 3))
    assert (outputs[1] == 1).all()
    assert [t.shape for t in backward(splats, outputs, outputs[0])] == [(0, 2), (0, 3), (0,), (0, 3), (0, 2)]
    hidden = random_splats(3, WIDTH, HEIGHT)
    hidden.opacities[:] = 1 / 300
    outputs = forward(hidden)
    assert not outputs[0].any()
    assert not any(t.any() for t in backward(hidden, outputs, torch.ones_like(outputs[0])))


def test_a_splat_that_is_not_finite_leaves_the_others_alone():
    splats = random_splats(40, WIDTH, HEIGHT)
    tile_lists = lists(splats)
    clean = torch.ops.blitzgs.rasterize_fwd(*splats.values(), None, *tile_lists, 1, WIDTH, HEIGHT, 16, 0, -1)
    victim = int(tile_lists[0][0])
    others = tile_lists[0] != victim
    kept = torch.tensor([int(others[: int(end)].sum()) for end in tile_lists[1]])
    expected = torch.ops.blitzgs.rasterize_fwd(
        *splats.values(), None, tile_lists[0][others], kept, 1, WIDTH, HEIGHT, 16, 0, -1
    )
    assert not torch.equal(clean[0], expected[0])
    for column in ("means2d", "conics", "opacities"):
        broken = Splats(*(t.clone() for t in vars(splats).values()))
        getattr(broken, column)[victim] = float("nan")
        found = torch.ops.blitzgs.rasterize_fwd(
            *broken.values(), None, *tile_lists, 1, WIDTH, HEIGHT, 16, 0, -1
        )
        assert torch.equal(found[0], expected[0])
        gradients = backward(broken, found, torch.ones_like(found[0]), tile_lists=tile_lists)
        assert all(torch.isfinite(t).all() for t in gradients)


def test_errors_name_the_value():
    splats = random_splats(3, WIDTH, HEIGHT)
    tile_lists = lists(splats)
    options = {"n_cameras": 1, "width": WIDTH, "height": HEIGHT}
    with pytest.raises(RuntimeError, match=r"colors must have shape \[3, \*\], got \[2, 3\]"):
        rasterize(*splats.values()[:3], splats.colors[:2], *tile_lists, **options)
    with pytest.raises(RuntimeError, match=r"backgrounds must have shape \[1, 3\], got \[2, 3\]"):
        rasterize(*splats.values(), *tile_lists, **options, backgrounds=torch.zeros(2, 3))
    with pytest.raises(RuntimeError, match=r"tile_offsets must have shape \[13\], got \[12\]"):
        rasterize(*splats.values(), tile_lists[0], tile_lists[1][:-1], **options)
    message = "colors must be a torch.Tensor, got NoneType"
    refused(TypeError, message, rasterize, *splats.values()[:3], None, *tile_lists, **options)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda listed, offsets: (listed, offsets + 1), "tile_offsets must ascend from 0 to at most the"),
        (lambda listed, offsets: (listed, offsets - 1), "tile_offsets must ascend"),
        (lambda listed, offsets: (listed, offsets.flip(0)), "tile_offsets must ascend"),
        (lambda listed, offsets: (listed + 1, offsets), "isect_splats must be numbers of the 20 splats"),
        (lambda listed, offsets: (listed - 20, offsets), "isect_splats must be numbers of the 20 splats"),
    ],
)
def test_lists_of_other_splats_are_refused(change, message):
    splats = random_splats(20, WIDTH, HEIGHT)
    changed = change(*lists(splats))
    with pytest.raises(RuntimeError, match=message):
        rasterize(*splats.values(), *changed, n_cameras=1, width=WIDTH, height=HEIGHT)


def test_a_gradient_buffer_gives_its_zeros_once():
    means2d, zeros = torch.ones(5, 2), torch.zeros(5, 12)
    gradients = GradientBuffer(zeros)
    assert gradients.take(means2d) is zeros
    for others in (gradients, GradientBuffer(torch.zeros(0, 12))):  # taken by a tile, or not written
        taken = others.take(means2d)
        assert taken is not zeros and taken.shape == (5, 12) and not taken.any()
    assert GradientBuffer(torch.zeros(0, 12)).take(means2d[:0]).shape == (0, 12)
    assert GradientBuffer(zeros).take(means2d[:3]).data_ptr() == zeros.data_ptr()


@pytest.mark.parametrize("capacity", [5, 9])
def test_a_table_of_gradients_is_found_again_behind_autograd(capacity):
    buffer, found = torch.rand(capacity, 12), []

    class Projected(torch.autograd.Function):
        @staticmethod
        def forward(ctx, means):
            return means[:, :2].clone(), means[:, :3].clone(), means[:, 0].clone(), means[:, :3].clone()

        @staticmethod
        def backward(ctx, *v_columns):
            found.append(gradient_table_of(v_columns))

    class Composited(torch.autograd.Function):
        @staticmethod
        def forward(ctx, *columns):
            return columns[0].sum()

        @staticmethod
        def backward(ctx, v_sum):
            return gradient_columns(GradientBuffer(buffer).take(torch.zeros(5, 2)))

    def composite(used=None, hook=None):
        columns = Projected.apply(torch.ones(5, 3, requires_grad=True))
        if hook is not None:
            columns[1].register_hook(hook)
        image = Composited.apply(*columns)
        (image if used is None else image + columns[used].sum()).backward()
        return found.pop()

    table = composite()
    assert table.data_ptr() == buffer.data_ptr()
    assert torch.equal(table, buffer[:5])
    assert all(composite(used) is None for used in range(4))  # a second use of the splats
    assert composite(hook=lambda v_conics: 2 * v_conics) is None


def test_columns_of_no_table_are_not_one():
    table = torch.zeros(5, 12)
    means2d, conics, opacities, colors = gradient_columns(table)
    assert gradient_table_of((means2d, conics.clone(), opacities, colors)) is None
    assert gradient_table_of((means2d, conics, opacities, None)) is None
    assert gradient_table_of((colors[:, :2], conics, opacities, colors)) is None
    assert gradient_table_of((means2d[:3], conics, opacities, colors)) is None
    assert gradient_table_of([column[1:] for column in gradient_columns(table)]) is None
    assert gradient_table_of([column.clone() for column in gradient_columns(table)]) is None


def test_the_images_do_not_depend_on_a_backward_pass_to_follow():
    splats = random_splats(100, WIDTH, HEIGHT)
    grid = 1, WIDTH, HEIGHT, 16, 0, -1
    plain, prepared = (
        torch.ops.blitzgs.rasterize_fwd(*splats.values(), None, *lists(splats), *grid, True, follows)
        for follows in (False, True)
    )
    torch.testing.assert_close(plain[:4], prepared[:4], rtol=0, atol=0)
    assert plain[6].shape == prepared[6].shape == (0, 12)  # the CPU returns no packed splats


@pytest.mark.parametrize("absgrad", [False, True])
def test_opcheck(absgrad):
    splats = random_splats(6, WIDTH, HEIGHT)
    values = [t.requires_grad_() for t in splats.values()]
    backgrounds = torch.rand(1, 3, requires_grad=True)
    tile_lists = lists(splats)
    arguments = (*values, backgrounds, *tile_lists, 1, WIDTH, HEIGHT, 16, 0, -1)
    torch.library.opcheck(torch.ops.blitzgs.rasterize_fwd, arguments)
    torch.library.opcheck(torch.ops.blitzgs.rasterize_fwd, (*arguments, False, True))
    with torch.no_grad():
        outputs = forward(splats)
        torch.library.opcheck(
            torch.ops.blitzgs.rasterize_bwd,
            ([t.detach() for t in values], None, tile_lists, kept_by(outputs), outputs[0], None,
             1, WIDTH, HEIGHT, 16, 0, -1, absgrad, False),
        )  # fmt: skip
