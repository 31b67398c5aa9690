# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization` against the float64 reference: images, gradients, modes, meta, errors."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.utils.checkpoint
from hypothesis import given, settings
from hypothesis import strategies as st

import blitzgs
from blitzgs.ops import render
from blitzgs.ops.photometric import photometric_loss
from blitzgs.ops.project import RowRoom
from tests.helpers import (
    DEVICES,
    PARAMETERS,
    image_error,
    random_scene,
    reference_images,
    relative_error,
)

IMAGE_BOUND = {torch.float32: 1e-5, torch.float64: 1e-10}
GRADIENT_BOUND = {torch.float32: 1e-4, torch.float64: 1e-10}
DTYPES = [torch.float32, torch.float64]


def rasterize_scene(scene, **options):
    return blitzgs.rasterization(*scene.arguments(), **{"sh_degree": scene.sh_degree, **options})


def require_accurate(scene, backgrounds=None, **options):
    """Image, alpha and every gradient within the bounds, away from the cut pixels."""
    dtype = scene.means.dtype
    leaves = scene.leaves()
    if backgrounds is not None:
        backgrounds = backgrounds.to(dtype).requires_grad_()
    renders, alphas, _ = rasterize_scene(leaves, backgrounds=backgrounds, **options)
    expected = reference_images(
        leaves,
        backgrounds,
        render_mode=options.get("render_mode", "RGB"),
        antialiased=options.get("rasterize_mode") == "antialiased",
    )
    images = torch.stack([reference.image for reference in expected])
    coverage = torch.stack([reference.alpha for reference in expected])[..., None]
    cut = torch.stack([reference.cut for reference in expected])
    assert image_error(renders, images, cut) <= IMAGE_BOUND[dtype] * max(1.0, images.abs().max().item())
    assert image_error(alphas, coverage, cut) <= IMAGE_BOUND[dtype]

    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(images.shape, generator=generator, dtype=torch.float64) * ~cut[..., None]
    alpha_weights = torch.randn(coverage.shape, generator=generator, dtype=torch.float64) * ~cut[..., None]
    inputs = [getattr(leaves, name) for name in PARAMETERS] + ([] if backgrounds is None else [backgrounds])

    def gradients(image, alpha):
        loss = (image.double() * weights).sum() + (alpha.double() * alpha_weights).sum()
        return torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)

    names = [*PARAMETERS, "backgrounds"]
    pairs = zip(names, gradients(renders, alphas), gradients(images, coverage), strict=False)
    for name, actual, reference in pairs:
        assert relative_error(actual, reference) <= GRADIENT_BOUND[dtype], name


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_every_mode_against_the_reference(dtype, rasterize_mode, render_mode):
    backgrounds = torch.tensor([[0.2, 0.5, 0.9], [1.0, 0.0, 0.3]]) if "RGB" in render_mode else None
    scene = random_scene(n=60, width=24, height=20, dtype=dtype)
    require_accurate(scene, backgrounds, rasterize_mode=rasterize_mode, render_mode=render_mode)


@pytest.mark.parametrize("channels, per_view", [(1, False), (2, True), (3, True), (5, False), (33, False)])
def test_values_of_any_channel_count(channels, per_view):
    scene = random_scene(n=40, width=20, height=16)
    scene.sh_degree = None
    values = torch.rand(2, 40, channels, generator=torch.Generator().manual_seed(9))
    scene.colors = values if per_view else values[0]
    renders, _, _ = rasterize_scene(scene)
    for view in range(2):
        scene.colors = values[view] if per_view else values[0]
        reference = reference_images(scene)[view]
        assert image_error(renders[view], reference.image, reference.cut) <= 1e-5


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "ED"}], ids=str)
@pytest.mark.parametrize("with_sh", [True, False])
def test_sparse_gradients_are_the_dense_ones(device, options, with_sh):
    scene = random_scene(n=80, width=20, height=16, device=device)
    scene.means[::2] *= 8.0  # some are seen by no view
    if not with_sh:
        scene.sh_degree, scene.colors = None, scene.colors[:, 0]
    dense, sparse = scene.leaves(), scene.leaves()
    for leaves, flag in ((dense, False), (sparse, True)):
        rasterize_scene(leaves, sparse_grad=flag, **options)[0].square().sum().backward()
    sparse_names = ["means", "quats", "scales"]
    if with_sh and "render_mode" not in options:
        sparse_names += ["opacities", "colors"]
    for name in PARAMETERS:
        expected, actual = getattr(dense, name).grad, getattr(sparse, name).grad
        assert (actual is None) == (expected is None)
        if actual is None:
            continue
        assert actual.is_sparse == (name in sparse_names), name
        if actual.is_sparse:
            assert actual.coalesce().values().shape[0] < 80
            actual = actual.to_dense()
        assert relative_error(actual, expected) < 1e-6, name


@settings(max_examples=10, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 120),
    scale=st.floats(0.01, 0.6),
    degree=st.integers(0, 3),
    width=st.integers(1, 40),
    height=st.integers(1, 32),
)
def test_random_scenes_against_the_reference(seed, n, scale, degree, width, height):
    scene = random_scene(n=n, seed=seed, cameras=1, scale=scale, width=width, height=height)
    scene.sh_degree = degree
    require_accurate(scene)


@pytest.mark.parametrize("packed", [True, False])
def test_absgrad_and_the_gradient_of_means2d(packed):
    scene = random_scene(n=25, cameras=1, width=12, height=9, dtype=torch.float64).leaves()
    renders, _, meta = rasterize_scene(scene, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    reference = reference_images(scene)[0]
    weights = torch.randn(9, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (renders[0] * weights).sum().backward()
    signed = torch.zeros(25, 2, dtype=torch.float64)
    absolute = torch.zeros_like(signed)
    for pixel in (reference.image * weights).sum(dim=-1).reshape(-1):
        gradient = torch.autograd.grad(pixel, reference.splats.means2d, retain_graph=True)[0]
        signed[reference.splats.ids] += gradient
        absolute[reference.splats.ids] += gradient.abs()
    actual, actual_absolute = meta["means2d"].grad, meta["means2d"].absgrad
    rows = (meta["gaussian_ids"],) if packed else (slice(None),)
    actual, actual_absolute = (t if packed else t[0] for t in (actual, actual_absolute))
    assert relative_error(actual, signed[rows]) < 1e-10
    assert relative_error(actual_absolute, absolute[rows]) < 1e-10


def test_packed_and_dense_meta_say_the_same():
    scene = random_scene(n=50, cameras=3)
    scene.means[::2] *= 6.0  # some are seen by no view
    image, alpha, packed = rasterize_scene(scene, packed=True)
    dense_image, dense_alpha, dense = rasterize_scene(scene, packed=False)
    assert torch.equal(image, dense_image) and torch.equal(alpha, dense_alpha)
    cameras, gaussians = packed["camera_ids"], packed["gaussian_ids"]
    assert 0 < len(cameras) < 150
    assert dense["camera_ids"] is None and dense["gaussian_ids"] is None
    for name, shape in {
        "radii": (3, 50, 2),
        "means2d": (3, 50, 2),
        "depths": (3, 50),
        "conics": (3, 50, 3),
        "opacities": (3, 50),
        "tiles_per_gauss": (3, 50),
    }.items():
        assert dense[name].shape == shape, name
        assert torch.equal(dense[name][cameras, gaussians], packed[name]), name
    rows = cameras * 50 + gaussians
    assert torch.equal(dense["flatten_ids"].long(), rows[packed["flatten_ids"].long()])
    assert torch.equal(dense["isect_ids"], packed["isect_ids"])
    invisible = torch.ones(3, 50, dtype=torch.bool)
    invisible[cameras, gaussians] = False
    assert (dense["radii"][invisible] == 0).all()


@pytest.mark.parametrize("device", DEVICES)
def test_a_call_does_not_depend_on_those_before(device):
    """What calls before needed decides how much room the next one's rows get first."""
    few, many = (random_scene(n=n, width=33, height=17, device=device).leaves() for n in (5, 3000))

    def render(scene):
        image, _, meta = rasterize_scene(scene)
        gradients = torch.autograd.grad(image.sum(), [getattr(scene, name) for name in PARAMETERS])
        return image, gradients, {k: v for k, v in meta.items() if isinstance(v, torch.Tensor)}

    first = render(many)
    for scene in (few, many):
        image, gradients, meta = render(scene)
    assert torch.equal(image, first[0])
    assert all(torch.equal(meta[name], value) for name, value in first[2].items())
    for gradient, expected in zip(gradients, first[1], strict=True):
        assert relative_error(gradient, expected) < 1e-5  # atomic sums are in no particular order


def second_derivative_of_a_gradient(scene):
    image, _, _ = rasterize_scene(scene)
    (gradient,) = torch.autograd.grad(image.square().sum(), scene.means, create_graph=True)
    gradient.sum().backward()


def second_derivative_of_a_linear_loss(scene):
    image, alphas, _ = rasterize_scene(scene)
    (gradient,) = torch.autograd.grad(image.sum() + alphas.sum(), scene.colors, create_graph=True)
    torch.autograd.grad(gradient.sum(), scene.means)


def hessian(scene):
    def loss(means):
        return rasterize_scene(replace(scene, means=means))[0].sum()

    torch.autograd.functional.hessian(loss, scene.means.detach())


def second_derivative_of_the_loss_function(scene):
    image = torch.rand(1, 20, 20, 3, device=scene.means.device, requires_grad=True)
    loss = photometric_loss(image, torch.zeros_like(image))
    (gradient,) = torch.autograd.grad(loss.sum(), image, create_graph=True)
    gradient.sum().backward()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "differentiate_twice",
    [
        second_derivative_of_a_gradient,
        second_derivative_of_a_linear_loss,
        hessian,
        second_derivative_of_the_loss_function,
    ],
)
def test_a_second_derivative_is_refused(device, differentiate_twice):
    scene = random_scene(n=6, width=8, height=8, device=device).leaves()
    for _ in range(2):  # on CUDA the second call is queued
        with pytest.raises(RuntimeError, match="has first derivatives only"):
            differentiate_twice(scene)


def test_a_gradient_with_a_graph_may_be_used_as_a_value():
    scene = random_scene(n=20).leaves()
    expected, created = (
        torch.autograd.grad(rasterize_scene(scene)[0].square().sum(), scene.means, create_graph=graph)[0]
        for graph in (False, True)
    )
    assert torch.equal(created, expected)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}], ids=str)
def test_images_may_be_changed_in_place(device, options):
    """As gsplat's trainer does with the pixels outside of a mask."""
    scene = random_scene(n=40, device=device)
    mask = torch.rand(2, 32, 40, generator=torch.Generator().manual_seed(0)).to(device) > 0.3
    gradients = []
    for in_place in (True, False):
        leaves = scene.leaves()
        renders, _, _ = rasterize_scene(leaves, **options)
        if in_place:
            renders[~mask] = 0
        else:
            renders = renders * mask[..., None]
        renders.square().sum().backward()
        gradients.append([getattr(leaves, name).grad for name in PARAMETERS])
    for name, actual, expected in zip(PARAMETERS, *gradients, strict=True):
        assert relative_error(actual, expected) < 1e-5, name


@pytest.mark.parametrize("device", DEVICES)
def test_sparse_gradients_pass_what_was_made_of_opacities_and_colours(device):
    """A sparse gradient can go neither through a sigmoid nor through a concatenation."""
    scene = random_scene(n=30, device=device)
    names = ("means", "quats", "scales")
    results = []
    for sparse in (False, True):
        leaves = scene.leaves()
        logits = scene.opacities.logit().requires_grad_()
        dc, rest = (part.detach().clone().requires_grad_() for part in scene.colors.split([1, 15], dim=1))
        called = replace(leaves, opacities=logits.sigmoid(), colors=torch.cat([dc, rest], 1))
        rasterize_scene(called, sparse_grad=sparse)[0].square().sum().backward()
        inputs = [*(getattr(leaves, name) for name in names), logits, dc, rest]
        assert [x.grad.is_sparse for x in inputs] == [sparse] * 3 + [False] * 3
        results.append([x.grad.to_dense() for x in inputs])
    for actual, expected in zip(*results, strict=True):
        assert relative_error(actual, expected) < 1e-5


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}], ids=str)
def test_checkpointing_recomputes_the_call(device, options):
    scene = random_scene(n=60, device=device)
    results = []
    for call in (lambda f, *a: f(*a), partial(torch.utils.checkpoint.checkpoint, use_reentrant=False)):
        for _ in range(3):  # on CUDA the room for rows is learnt from call to call
            leaves = scene.leaves()
            inputs = [getattr(leaves, name) for name in PARAMETERS]

            def image(*values):
                changed = replace(scene, **dict(zip(PARAMETERS, values, strict=True)))
                return rasterize_scene(changed, **options)[0]

            call(image, *inputs).square().sum().backward()
        results.append([x.grad for x in inputs])
    for name, actual, expected in zip(PARAMETERS, *results, strict=True):
        assert relative_error(actual, expected) < 1e-5, name


def test_nothing_is_queued_where_no_call_told_how_much_room_is_needed(monkeypatch):
    monkeypatch.setattr(render, "queue_rows", None)
    monkeypatch.setattr(render, "room_for", lambda *_: RowRoom())
    arguments = (*(None,) * 5, torch.eye(4)[None], *(None,) * 3, 8, 8, 16)
    assert render.render_queued(arguments, lambda rows: rows.colors, None, False) is None


@pytest.mark.parametrize("device", DEVICES)
def test_meta_may_be_changed_in_place(device):
    scene = random_scene(n=40, device=device).leaves()
    for _ in range(2):  # the second call has room for its rows
        _, _, meta = rasterize_scene(scene)
        for name in ("means2d", "conics", "depths", "opacities", "radii", "tiles_per_gauss"):
            meta[name].mul_(2)
    meta["means2d"].sum().backward()
    assert scene.means.grad.any()


def test_meta_read_late_is_differentiable_as_the_call_was():
    scene = random_scene(n=20).leaves()
    with torch.no_grad():
        _, _, constant = rasterize_scene(scene, packed=False)
    _, _, meta = rasterize_scene(scene, packed=False)
    with torch.no_grad():
        depths = meta["depths"]
    assert depths.requires_grad and not constant["depths"].requires_grad
    depths.sum().backward()
    assert scene.means.grad.any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("packed", [False, True])
def test_meta_lists_only_what_touches_a_tile(device, packed):
    """Not Gaussians whose colour is not finite, for which there is room in the lists."""
    scene = random_scene(n=90, cameras=2, width=50, height=37, device=device)
    scene.colors[::3, 0] = float("nan")
    _, _, meta = rasterize_scene(scene, packed=packed)
    listed = int(meta["tiles_per_gauss"].sum())
    assert 0 < listed == len(meta["flatten_ids"]) == len(meta["isect_ids"])
    rows = meta["flatten_ids"].long()
    gaussians = meta["gaussian_ids"][rows] if packed else rows % 90
    assert (gaussians % 3 != 0).all()


@pytest.mark.parametrize("device", DEVICES)
def test_meta_lists_are_sorted_and_consistent(device):
    scene = random_scene(n=90, cameras=2, width=50, height=37, device=device)
    _, _, meta = rasterize_scene(scene, tile_size=8)
    assert (meta["tile_width"], meta["tile_height"]) == (7, 5)
    assert meta["isect_offsets"].shape == (2, 5, 7)
    assert meta["tiles_per_gauss"].sum() == len(meta["flatten_ids"]) == len(meta["isect_ids"])
    keys = meta["isect_ids"]
    assert (keys[1:] >= keys[:-1]).all()
    bits = (7 * 5).bit_length()
    tile, camera = (keys >> 32) & ((1 << bits) - 1), keys >> (32 + bits)
    assert torch.equal(camera, meta["camera_ids"][meta["flatten_ids"].long()])
    starts = meta["isect_offsets"].reshape(2, -1)
    for c in range(2):
        for t in (0, 17, 34):
            assert ((camera < c) | ((camera == c) & (tile < t))).sum() == starts[c, t]
    for name in ("width", "height", "tile_size", "n_cameras"):
        assert meta[name] == {"width": 50, "height": 37, "tile_size": 8, "n_cameras": 2}[name]


@pytest.mark.parametrize("device", DEVICES)
def test_a_value_that_is_not_finite_spreads_to_no_pixel(device):
    scene = random_scene(n=30, cameras=1, device=device)
    scene.sh_degree = None
    scene.colors = torch.rand(30, 3, device=device)
    scene.opacities[4] = 0.0
    expected, _, _ = rasterize_scene(scene)
    scene.opacities[4] = 0.9
    scene.colors[4, 1] = torch.nan
    leaves = scene.leaves()
    actual, _, _ = rasterize_scene(leaves)
    assert torch.equal(actual, expected)
    actual.sum().backward()
    assert all(getattr(leaves, name).grad.isfinite().all() for name in PARAMETERS)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"distributed": True}, "does not support distributed=True"),
        ({"camera_model": "fisheye"}, "does not support camera_model='fisheye'"),
        ({"with_ut": True}, "does not support with_ut=True"),
        ({"covars": torch.zeros(1)}, "does not support covars="),
        ({"radial_coeffs": torch.zeros(1)}, "does not support radial_coeffs="),
        ({"render_mode": "N"}, "render_mode must be one of"),
        ({"rasterize_mode": "fast"}, "rasterize_mode must be"),
        ({"sh_degree": None}, "colors must be"),
        (
            {"sh_degree": None, "colors": torch.zeros(3, 4)},
            r"colors must be \[N, D\] or \[C, N, D\] with N = 4",
        ),
        ({"colors": torch.zeros(2, 4, 16, 3)}, "per-view coefficients are not supported"),
        ({"means": torch.zeros(1, 4, 3)}, "leading batch dimensions are not supported"),
        ({"opacities": torch.zeros(1)}, r"opacities must be \[N\] = \[4\], got \[1\]"),
        ({"opacities": torch.zeros(4, 1)}, r"opacities must be \[N\]"),
        ({"backgrounds": torch.zeros(2, 3)}, r"backgrounds must be \[C, D\]"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(options, message):
    scene = random_scene(n=4, cameras=1)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
    arguments = {**dict(zip(names, scene.arguments(), strict=True)), "sh_degree": 3, **options}
    with pytest.raises(ValueError, match=message):
        blitzgs.rasterization(**arguments)


def test_an_array_of_another_library_is_refused_by_name():
    means, quats, *rest = random_scene(n=4, cameras=1).arguments()
    with pytest.raises(TypeError, match=r"quats must be a torch\.Tensor, got ndarray"):
        blitzgs.rasterization(means, quats.numpy(), *rest, sh_degree=3)


def test_arguments_without_effect_are_accepted():
    scene = random_scene(n=10, cameras=1)
    plain, _, _ = rasterize_scene(scene)
    same, _, _ = rasterize_scene(
        scene, channel_chunk=8, segmented=True, camera_model="pinhole", with_ut=False
    )
    assert torch.equal(plain, same)
