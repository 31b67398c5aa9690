# SPDX-License-Identifier: Apache-2.0
"""Extra signals, normals and median depths are those of the definition; so is a list of pixels."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.utils.checkpoint

import blitzgs
from blitzgs.reference import render
from blitzgs.reference.projection import normals, sh_colors, sh_values
from blitzgs.reference.render import composited_weights, median_splats
from tests.helpers import agree, image_error, random_scene, rasterize_scene, refused, relative_error

E = 5
# Largest error against float64, by dtype, of images and of gradients.
MOST = {torch.float64: (1e-9, 1e-7), torch.float32: (2e-4, 2e-3)}


def signals_of(scene, per_view=False, degree=None):
    shape = (len(scene.means), E) if degree is None else (len(scene.means), 16, E)
    shape = (len(scene.viewmats), *shape) if per_view else shape
    generator = torch.Generator().manual_seed(5)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(scene.means)


def definition(scene, signals, degree, view):
    """Colours, extra signals and normals of one view, [H, W, 3 + E + 3], depths [H, W, 1], by definition."""
    s = scene.to(torch.float64)
    viewmat = s.viewmats[view]
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    signals = signals.double().cpu()
    own = signals if degree is None else sh_values(s.means, signals, centre, degree)
    own = own[view] if own.dim() == 3 else own
    values = torch.cat([sh_colors(s.means, s.colors, centre, 3), own, normals(s.means, s.quats, centre)], 1)
    image = render(
        s.means, s.quats, s.scales, s.opacities, values, viewmat, s.Ks[view], s.width, s.height,
        render_mode="RGB+ED",
    )  # fmt: skip
    splats = image.splats
    geometry = (splats.means2d, splats.conics, splats.opacities, splats.depths)
    weights, _ = composited_weights(*geometry, s.width, s.height)
    median = median_splats(weights)
    depths = splats.depths[median.clamp(min=0)].masked_fill(median < 0, 0)
    # A pixel whose transmittance is close to 0.5 may have either of two neighbouring splats.
    before = 1 - (weights.cumsum(0) - weights)
    return image, depths[..., None], image.cut | ((before - 0.5).abs() < 1e-4).any(dim=0)


def images_of(scene, **options):
    image, alphas, meta = rasterize_scene(
        scene, render_mode="RGB+ED", return_normals=True, return_median=True, **options
    )
    parts = [image[..., :3], meta["render_extra_signals"], meta["normals"], image[..., 3:]]
    return torch.cat(parts, dim=-1), alphas, meta


@pytest.mark.parametrize("degree,per_view", [(None, False), (None, True), (2, False)])
def test_images_and_gradients_are_those_of_the_definition(backend, degree, per_view):
    device, dtype = backend
    scene = random_scene(cameras=2, seed=3).to(dtype, device)
    scene.quats[:4] = 0  # the identity
    scene.quats[4:8] *= 1e18
    scene = scene.leaves()
    extra = signals_of(scene, per_view, degree).requires_grad_()
    ours, _, meta = images_of(scene, extra_signals=extra, extra_signals_sh_degree=degree)
    exact = replace(scene.to(torch.float64)).leaves()
    exact_extra = extra.detach().double().cpu().requires_grad_()
    loss, expected_loss = 0, 0
    for view in range(2):
        image, median, cut = definition(exact, exact_extra, degree, view)
        assert image_error(ours[view], image.image, cut) < MOST[dtype][0]
        assert image_error(meta["render_median"][view], median, cut) < MOST[dtype][0]
        assert (median > 0).any() and image.image[..., 8:11].abs().max() > 0.3
        v = torch.rand(*cut.shape, 13, generator=torch.Generator().manual_seed(view), dtype=torch.float64)
        v = v * ~cut[..., None]
        expected_loss = expected_loss + (torch.cat([image.image, median], -1) * v).sum()
        got = torch.cat([ours[view], meta["render_median"][view]], -1)
        loss = loss + (got * v.to(device, dtype)).sum()
    expected_loss.backward()
    loss.backward()
    agree([extra.grad, *scene.gradients()], [exact_extra.grad, *exact.gradients()], MOST[dtype][1])


@pytest.mark.parametrize("packed", [True, False])
def test_colours_keep_their_bits_and_layouts_agree(backend, packed):
    scene = random_scene().to(backend[1], backend[0])
    for mode in ("RGB", "RGB+D", "RGB+ED", "ED"):
        alone, alphas, _ = rasterize_scene(scene, render_mode=mode)
        for _ in range(2):  # on CUDA the second call is queued
            image, also, meta = rasterize_scene(
                scene, render_mode=mode, extra_signals=signals_of(scene), return_normals=True,
                return_median=True, packed=packed,
            )  # fmt: skip
            assert torch.equal(image, alone) and torch.equal(also, alphas)
            assert meta["render_extra_signals"].shape == (2, 32, 40, E)
            assert meta["render_extra_signals"].is_contiguous()
            assert meta["normals"].shape == (2, 32, 40, 3) and meta["render_median"].shape == (2, 32, 40, 1)


def test_batches_are_scenes_one_by_one():
    scene = random_scene(n=30, dtype=torch.float64)
    both = [torch.stack([t, t.flip(0)]) for t in scene.arguments()[:5]]
    cameras = [t.expand(2, *t.shape) for t in (scene.viewmats, scene.Ks)]
    sh = signals_of(scene, degree=2)  # shared by the scenes, as gsplat has it
    values = torch.stack([signals_of(scene), signals_of(scene).flip(0)])
    options = {"return_normals": True, "return_median": True, "sh_degree": 3}
    for extra, degree in ((values, None), (sh, 1)):
        _, _, meta = blitzgs.rasterization(
            *both, *cameras, 40, 32, extra_signals=extra, extra_signals_sh_degree=degree, **options
        )
        for number in range(2):
            own = extra if degree is not None else extra[number]
            _, _, one = blitzgs.rasterization(
                *(t[number] for t in both), scene.viewmats, scene.Ks, 40, 32, extra_signals=own,
                extra_signals_sh_degree=degree, **options,
            )  # fmt: skip
            for key in ("render_extra_signals", "normals", "render_median"):
                assert torch.equal(meta[key][number], one[key]), key


def around(function):
    return partial(torch.utils.checkpoint.checkpoint, function, use_reentrant=False)


def compiled(function):
    torch._dynamo.reset()
    return torch.compile(function, fullgraph=True, backend="aot_eager")


@pytest.mark.parametrize("transform", [around, compiled])
def test_checkpointing_and_compiling_change_nothing(device, transform):
    scene = random_scene(n=40, device=device)
    results = []
    for wrapped in (lambda function: function, transform):
        leaves = scene.leaves()
        extra = signals_of(scene, degree=1).requires_grad_()

        def images(means, quats, extra):
            found, _, meta = images_of(
                replace(scene, means=means, quats=quats), extra_signals=extra, extra_signals_sh_degree=1
            )
            return torch.cat([found, meta["render_median"]], dim=-1)

        image = wrapped(images)(leaves.means, leaves.quats, extra)
        image.square().sum().backward()
        results.append([image.detach(), leaves.means.grad, leaves.quats.grad, extra.grad])
    assert torch.equal(results[0][0], results[1][0])
    agree(*results, 1e-5)


def test_sparse_gradients_of_rotations_stay_sparse():
    gradients = []
    for sparse in (False, True):
        scene = random_scene(dtype=torch.float64).leaves()
        _, _, meta = rasterize_scene(
            scene, return_normals=True, extra_signals=signals_of(scene), sparse_grad=sparse
        )
        (meta["normals"].square().sum() + meta["render_extra_signals"].square().sum()).backward()
        assert scene.quats.grad.is_sparse == scene.means.grad.is_sparse == sparse
        gradients.append([t.grad.to_dense() for t in (scene.means, scene.quats, scene.scales)])
    agree(*gradients, 1e-12)


def test_backgrounds_are_behind_the_colours_and_if_given_behind_the_signals():
    scene = random_scene(n=8, dtype=torch.float64)
    extra, rows = signals_of(scene), torch.rand(2, 3 + E, dtype=torch.float64)
    options = {"extra_signals": extra, "render_mode": "RGB+D", "return_normals": True}
    dark, alphas, plain = rasterize_scene(scene, **options)
    rest = (1 - alphas) * rows[:, None, None]
    for given in (3, 3 + E):
        image, _, meta = rasterize_scene(scene, **options, backgrounds=rows[:, :given])
        assert relative_error(image[..., :3], dark[..., :3] + rest[..., :3]) < 1e-12
        behind = rest[..., 3:] if given > 3 else 0
        assert relative_error(meta["render_extra_signals"], plain["render_extra_signals"] + behind) < 1e-12
        assert torch.equal(image[..., 3], dark[..., 3]) and torch.equal(meta["normals"], plain["normals"])


@pytest.mark.parametrize("degree", [None, 1])
def test_gaussians_with_signals_that_are_not_finite_are_not_rendered(degree):
    scene = random_scene(dtype=torch.float64)
    extra = signals_of(scene, degree=degree)
    extra[7, ..., 2] = float("nan")
    if degree == 1:
        extra[9, 15] = float("inf")  # above the degree
    options = {"extra_signals": extra, "extra_signals_sh_degree": degree, "return_normals": True}
    with pytest.warns(RuntimeWarning, match="extra_signals"):
        image, _, meta = rasterize_scene(scene, **options)
    assert meta["non_finite"]["extra_signals"].tolist() == [7]
    kept = [i for i in range(60) if i != 7]
    rest = replace(
        scene, **{k: getattr(scene, k)[kept] for k in ("means", "quats", "scales", "opacities", "colors")}
    )
    expected, _, other = rasterize_scene(rest, **{**options, "extra_signals": extra[kept]})
    assert torch.equal(image, expected)
    assert torch.equal(meta["render_extra_signals"], other["render_extra_signals"])


def test_half_precision_signals_are_computed_in_full_precision():
    scene = random_scene()
    extra = signals_of(scene).bfloat16()
    _, _, half = rasterize_scene(scene, extra_signals=extra)
    _, _, full = rasterize_scene(scene, extra_signals=extra.float())
    assert torch.equal(half["render_extra_signals"], full["render_extra_signals"])


@pytest.mark.parametrize(
    "options,message",
    [
        ({"extra_signals": torch.zeros(59, 2)}, r"extra_signals must be \[..., N, E\]"),
        ({"extra_signals": torch.zeros(60, 0)}, "extra_signals must be"),
        ({"extra_signals": torch.zeros(60, 4090)}, "extra_signals must have 1 to 4089 channels, got 4090"),
        ({"extra_signals": torch.zeros(60, 3, 2), "extra_signals_sh_degree": 1}, "K of at least 4"),
        ({"extra_signals": torch.zeros(60, 16, 2), "extra_signals_sh_degree": 4}, "0 to 3, got 4"),
        ({"extra_signals": torch.zeros(60, 16, 2), "extra_signals_sh_degree": 1.0}, r"0 to 3, got 1\.0"),
        ({"return_normals": True, "covars": torch.eye(3).expand(60, 3, 3)}, "does not support covars"),
        ({"extra_signals_sh_degree": 1}, "extra_signals_sh_degree needs extra_signals"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    refused(ValueError, message, rasterize_scene, random_scene(), **options)


OPTIONS = {"render_mode": "RGB+ED", "return_normals": True, "return_median": True}
KEYS = ("render_extra_signals", "normals", "render_median")


def scene_of(backend):
    return random_scene(300, 3, 100, 75, scale=0.04).to(backend[1], backend[0])


def chosen_of(device, count=25):
    generator = torch.Generator().manual_seed(1)
    images = torch.randint(2, (count,), generator=generator)  # none of the last image
    pixels = torch.stack([torch.randint(20, 60, (count,), generator=generator) for _ in range(2)], dim=1)
    pixels[1] = pixels[0]
    images[1] = images[0]
    return pixels.to(device), images.to(device)


@pytest.mark.parametrize("packed", [True, False])
def test_pixels_and_gradients_are_those_of_the_image(backend, packed):
    pixels, images = chosen_of(backend[0])
    at = (images, *pixels.T)
    gradients, found, entries = [], [], []
    for options in ({}, {"pixels": pixels, "image_ids": images}):
        scene = scene_of(backend).leaves()
        extra = scene.means.detach().sin().requires_grad_()
        backgrounds = torch.full((3, 3), 0.3).to(scene.means).requires_grad_()
        image, alphas, meta = rasterize_scene(
            scene, **OPTIONS, extra_signals=extra, packed=packed, backgrounds=backgrounds, **options
        )
        parts = [image, alphas, *(meta[key] for key in KEYS)]
        entries.append(len(meta["flatten_ids"]))
        assert meta["isect_offsets"].shape == (3, 5, 7)
        if not options:
            parts = [part[at] for part in parts]
        found.append([part.detach() for part in parts])
        torch.stack([(part * (part.detach() + 1)).sum() for part in parts]).sum().backward()
        gradients.append([*scene.gradients(), extra.grad, backgrounds.grad])
    assert 0 < entries[1] < 0.6 * entries[0]
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    agree(*gradients, 1e-12 if backend[1] == torch.float64 else 1e-4)


def test_every_pixel_and_no_pixel(backend):
    scene = random_scene(cameras=1).to(backend[1], backend[0])
    image, alphas, _ = rasterize_scene(scene)
    rows, columns = torch.meshgrid(torch.arange(32), torch.arange(40), indexing="ij")
    everywhere = torch.stack([rows, columns], dim=-1).view(-1, 2).to(backend[0])
    some, own, meta = rasterize_scene(scene, pixels=everywhere)
    assert torch.equal(some, image.view(-1, 3)) and torch.equal(own, alphas.view(-1, 1))
    none, empty, meta = rasterize_scene(scene, pixels=everywhere[:0], **OPTIONS)
    assert none.shape == (0, 4) and empty.shape == (0, 1) and meta["normals"].shape == (0, 3)
    assert len(meta["flatten_ids"]) == 0


def test_other_tile_sizes():
    pixels, images = chosen_of("cpu")
    scene = scene_of(("cpu", torch.float32))
    for size in (8, 64):
        image, _, _ = rasterize_scene(scene, tile_size=size)
        some, _, _ = rasterize_scene(scene, tile_size=size, pixels=pixels, image_ids=images)
        assert torch.equal(some, image[(images, *pixels.T)])


@pytest.mark.parametrize(
    "options,error,message",
    [
        ({"pixels": torch.zeros(3, 2, dtype=torch.int64)}, ValueError, "pixels of 2 images need image_ids"),
        ({"image_ids": torch.zeros(3)}, ValueError, "image_ids need pixels"),
        (
            {"pixels": torch.zeros(3, 2), "image_ids": torch.zeros(3).int()},
            TypeError,
            "pixels must be a tensor",
        ),
        (
            {"pixels": torch.zeros(3, 2).int(), "image_ids": torch.zeros(2).int()},
            ValueError,
            r"\[M\] = \[3\]",
        ),
        (
            {"pixels": torch.zeros(3, 2).int(), "image_ids": [0, 1, 0]},
            TypeError,
            "image_ids must be a tensor",
        ),
        (
            {"pixels": torch.tensor([[0, 0], [32, 5]]), "image_ids": torch.tensor([0, 1])},
            ValueError,
            r"pixel 1 is \(row, column\) = \(32, 5\) of image 1, outside 2 images of 32 x 40 px",
        ),
        ({"pixels": torch.zeros(3, 2).int(), "distributed": True}, ValueError, "distributed"),
    ],
)
def test_wrong_pixels_are_named(options, error, message):
    refused(error, message, rasterize_scene, random_scene(), **options)


@pytest.mark.parametrize(
    "pixels,error,message",
    [
        ([[0, 0], [1, 1]], TypeError, "pixels must be a tensor of integers"),
        (torch.tensor([3, 4]), ValueError, r"pixels must be \[M, 2\] \(row, column\), got \[2\]"),
        (torch.zeros(3, 3).int(), ValueError, r"pixels must be \[M, 2\] \(row, column\), got \[3, 3\]"),
    ],
)
def test_wrong_pixels_of_a_single_image_are_named(pixels, error, message):
    refused(error, message, rasterize_scene, random_scene(cameras=1), pixels=pixels)
