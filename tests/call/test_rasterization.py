# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization` agrees with the float64 reference, and refuses what no pinhole has."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import blitzgs
from blitzgs.runs.cameras import checked_camera
from tests.helpers import agree, image_error, random_scene, rasterize_scene, reference_images, refused

IMAGE_BOUND = {torch.float32: 1e-5, torch.float64: 1e-10}
GRADIENT_BOUND = {torch.float32: 1e-4, torch.float64: 1e-10}
DTYPES = [torch.float32, torch.float64]


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
    inputs = leaves.parameters() + ([] if backgrounds is None else [backgrounds])

    def gradients(image, alpha):
        loss = (image.double() * weights).sum() + (alpha.double() * alpha_weights).sum()
        return torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)

    agree(gradients(renders, alphas), gradients(images, coverage), GRADIENT_BOUND[dtype])


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


@settings(max_examples=10, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6), n=st.integers(1, 120), scale=st.floats(0.01, 0.6), degree=st.integers(0, 3),
    width=st.integers(1, 40), height=st.integers(1, 32),
)  # fmt: skip
def test_random_scenes_against_the_reference(seed, n, scale, degree, width, height):
    scene = random_scene(n=n, seed=seed, cameras=1, scale=scale, width=width, height=height)
    scene.sh_degree = degree
    require_accurate(scene)


def test_the_signs_of_scales_do_not_matter(device):
    scene = random_scene(n=60, width=24, height=20, device=device)
    scene.means *= 2.0  # some centres are outside of the images
    results = []
    for sign in (1.0, -1.0):
        leaves = replace(scene, scales=sign * scene.scales).leaves()
        image, _, meta = rasterize_scene(leaves)
        image.square().sum().backward()
        results.append([image, meta["radii"].float(), sign * leaves.scales.grad, leaves.means.grad])
    agree(*results, 1e-5)


def test_a_call_does_not_depend_on_those_before(device):
    """The sizes of earlier calls decide the next call's first capacity, but not its results."""
    few, many = (random_scene(n=n, width=33, height=17, device=device).leaves() for n in (5, 3000))

    def render(scene):
        image, _, meta = rasterize_scene(scene)
        gradients = torch.autograd.grad(image.sum(), scene.parameters())
        return image, gradients, {k: v for k, v in meta.items() if isinstance(v, torch.Tensor)}

    first = render(many)
    for scene in (few, many):
        image, gradients, meta = render(scene)
    assert torch.equal(image, first[0])
    assert all(torch.equal(meta[name], value) for name, value in first[2].items())
    agree(gradients, first[1], 1e-5)  # atomic sums are in no particular order


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
    assert all(gradient.isfinite().all() for gradient in leaves.gradients())


GOOD = [[40.0, 0.0, 16.0], [0.0, 42.0, 12.0], [0.0, 0.0, 1.0]]
ENTRIES = [(0, 1, 4.0), (1, 0, 4.0), (2, 0, 0.1), (2, 1, 0.1), (2, 2, 2.0), (2, 2, 0.0)]


def wrong(row, column, value):
    matrix = np.array(GOOD)
    matrix[row, column] = value
    return matrix


# Calls that take each way through the renderer: queued, in several groups of views, and without a look at
# what each view sees.
CALLS = {
    "rasterization": {}, "not packed": {"packed": False}, "40 views": {"views": 40},
    "another tile size": {"tile_size": 8}, "covars": {"covars": True}, "no Gaussians": {"count": 0},
    "nothing in sight": {"depth": -3.0}, "scenes": {"scenes": 2}, "raw_rasterization": {},
    "raw, 40 views": {"views": 40}, "contributions": {},
}  # fmt: skip


def render(name, matrices, device="cpu", count=5, depth=3.0, views=0, scenes=1, covars=False, **options):
    """Render Gaussians with the matrices, repeated until there are so many views."""
    torch.manual_seed(1)
    Ks = torch.from_numpy(np.stack(matrices)).float().to(device)  # noqa: N806
    Ks = Ks[torch.arange(max(views, len(Ks)), device=device).clamp(max=len(Ks) - 1)]  # noqa: N806
    means = torch.randn(count, 3, device=device) * 0.1
    quats, scales = torch.ones(count, 4, device=device), torch.full((count, 3), 0.1, device=device)
    opacities, colors = torch.full((count,), 0.5, device=device), torch.rand(count, 3, device=device)
    viewmats = torch.eye(4, device=device).repeat(len(Ks), 1, 1)
    viewmats[:, 2, 3] = depth
    if name == "contributions":
        return blitzgs.contributions(means, quats, scales, opacities, viewmats, Ks, 32, 24)[0]
    if name.startswith("raw"):
        raw = (means, quats, scales.log(), opacities.logit(), colors[:, None], None)
        return blitzgs.raw_rasterization(*raw, viewmats, Ks, 32, 24, **options)[0]
    given = [means, quats, scales, opacities, colors, viewmats, Ks]
    if scenes > 1:
        given = [tensor.expand(scenes, *tensor.shape).contiguous() for tensor in given]
    if covars:
        options["covars"] = torch.eye(3, device=device).repeat(count, 1, 1) * 0.01
    return blitzgs.rasterization(*given, 32, 24, **options)[0]


@pytest.mark.parametrize("name", CALLS)
def test_a_renderer_refuses_intrinsics_of_no_pinhole(name, device):
    good = np.array(GOOD)
    render(name, [good], device, **CALLS[name])
    for entry in ENTRIES:
        with pytest.raises(ValueError, match=r"Ks\[1\] must be \[\[fx, 0, cx\], .* got"):
            render(name, [good, wrong(*entry)], device, **CALLS[name])


def test_intrinsics_that_are_not_finite_or_rounded_are_no_error(device):
    rounded = np.array(GOOD)
    rounded[0, 1], rounded[2, 2] = 1e-6, 1 + 1e-7
    assert torch.equal(
        render("rasterization", [rounded], device), render("rasterization", [np.array(GOOD)], device)
    )
    for name in ("rasterization", "covars"):
        with pytest.warns(RuntimeWarning, match="NaN"):
            render(name, [np.full((3, 3), math.nan)], device, **CALLS[name])


@pytest.mark.parametrize(("row", "column", "value"), ENTRIES)
def test_a_camera_refuses_intrinsics_of_no_pinhole(row, column, value):
    pose = np.eye(4)
    assert checked_camera("a", 32, 24, GOOD, pose).width == 32
    refused(ValueError, r"K must .*fx, 0, cx\]", checked_camera, "a", 32, 24, wrong(row, column, value), pose)


def test_a_pose_has_a_last_row():
    pose = np.eye(4)
    pose[3] = 1, 2, 3, 4
    refused(ValueError, "last row of .* must be 0, 0, 0, 1", checked_camera, "a", 32, 24, GOOD, pose)


GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")
seeds = st.integers(0, 10**6)
# The fixture `device` has no state that examples could share.
stateless = [HealthCheck.function_scoped_fixture]
quickly = settings(max_examples=5, deadline=None, derandomize=True, suppress_health_check=stateless)


def image_of(scene, **options):
    return rasterize_scene(scene, **options)[0]


def select(scene, index):
    return replace(scene, **{name: getattr(scene, name)[index] for name in GAUSSIANS})


@quickly
@given(seed=seeds)
def test_the_order_of_the_gaussians_does_not_matter(device, seed):
    scene = random_scene(n=90, seed=seed, device=device)
    order = torch.randperm(90, generator=torch.Generator().manual_seed(seed))
    assert torch.equal(image_of(scene), image_of(select(scene, order)))


@quickly
@given(seed=seeds)
def test_world_and_cameras_move_together(seed):
    scene = random_scene(n=60, seed=seed, dtype=torch.float64)
    scene.sh_degree, scene.colors = None, scene.colors[:, 0].abs()
    before = image_of(scene)
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(1, 4, generator=generator, dtype=torch.float64)
    rotation = Rotation.from_quat(quat[0], scalar_first=True)
    R = torch.from_numpy(rotation.as_matrix())
    shift = torch.randn(3, generator=generator, dtype=torch.float64) * 5
    scene.means = scene.means @ R.T + shift
    turned = rotation * Rotation.from_quat(scene.quats, scalar_first=True)
    scene.quats = torch.from_numpy(turned.as_quat(scalar_first=True))
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, shift
    scene.viewmats = scene.viewmats @ motion.inverse()
    assert (image_of(scene) - before).abs().median() < 1e-13
    assert ((image_of(scene) - before).abs() > 1e-10).double().mean() < 0.002  # flips at the cuts


@quickly
@given(seed=seeds, exponent=st.integers(-20, 20))
def test_a_world_scaled_by_a_power_of_two_gives_the_same_bits(device, seed, exponent):
    scene = random_scene(n=60, seed=seed, device=device)
    before = image_of(scene, near_plane=0.25)
    factor = 2.0**exponent
    scene.means, scene.scales = scene.means * factor, scene.scales * factor
    scene.viewmats[:, :3, 3] *= factor
    assert torch.equal(image_of(scene, near_plane=0.25 * factor, far_plane=math.inf), before)


@quickly
@given(seed=seeds, tile_size=st.sampled_from([4, 8, 16, 32, 64]))
def test_tiles_change_no_bit(seed, tile_size):
    scene = random_scene(n=60, seed=seed, width=45, height=33)
    assert torch.equal(image_of(scene, tile_size=tile_size), image_of(scene))


def test_views_together_equal_views_alone(device):
    scene = random_scene(n=80, cameras=4, device=device).leaves()
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(4, scene.height, scene.width, 3, generator=generator).to(device)
    together = image_of(scene)
    (together * weights).sum().backward()
    parts = scene.leaves()
    for view in range(4):
        image = image_of(parts.view(view))
        assert torch.equal(image[0], together[view])
        (image[0] * weights[view]).sum().backward()
    agree(scene.gradients(), parts.gradients(), 1e-6 if device == "cpu" else 1e-5)


def test_transparent_gaussians_change_no_bit(device):
    scene = random_scene(n=60, device=device)
    without = image_of(select(scene, torch.arange(0, 60, 2)))
    scene.opacities[1::2] = 0.0
    leaves = scene.leaves()
    image = image_of(leaves)
    assert torch.equal(image, without)
    image.sum().backward()
    assert all((getattr(leaves, name).grad[1::2] == 0).all() for name in GAUSSIANS)


@pytest.mark.parametrize("n, cameras", [(0, 2), (0, 1), (3, 0)])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("packed", [True, False])
def test_empty_input_gives_the_background_and_zero_gradients(device, n, cameras, render_mode, packed):
    scene = random_scene(n=n, cameras=cameras, device=device).leaves()
    backgrounds = torch.full((cameras, 3), 0.25, device=device)
    renders, alphas, meta = rasterize_scene(
        scene, backgrounds=backgrounds, render_mode=render_mode, packed=packed
    )
    assert renders.shape == (cameras, scene.height, scene.width, 3 if render_mode == "RGB" else 4)
    assert (renders[..., :3] == 0.25).all() and (alphas == 0).all() and (renders[..., 3:] == 0).all()
    renders.sum().backward()
    assert scene.means.grad is None or (scene.means.grad == 0).all()
