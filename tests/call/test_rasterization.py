# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization` agrees with the float64 reference: images, gradients, modes."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import (
    DEVICES,
    PARAMETERS,
    image_error,
    random_scene,
    rasterize_scene,
    reference_images,
    relative_error,
)

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


@pytest.mark.parametrize("device", DEVICES)
def test_the_signs_of_scales_do_not_matter(device):
    scene = random_scene(n=60, width=24, height=20, device=device)
    scene.means *= 2.0  # some centres are outside of the images
    results = []
    for sign in (1.0, -1.0):
        leaves = replace(scene, scales=sign * scene.scales).leaves()
        image, _, meta = rasterize_scene(leaves)
        image.square().sum().backward()
        results.append([image, meta["radii"].float(), sign * leaves.scales.grad, leaves.means.grad])
    for expected, actual in zip(*results, strict=True):
        assert relative_error(actual, expected) < 1e-5


@pytest.mark.parametrize("device", DEVICES)
def test_a_call_does_not_depend_on_those_before(device):
    """The sizes of earlier calls decide the next call's first capacity, but not its results."""
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
