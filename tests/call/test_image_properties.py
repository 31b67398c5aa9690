# SPDX-License-Identifier: Apache-2.0
"""Properties of every image: symmetries, limits and special cases."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import blitzgs
from blitzgs.reference.gaussians import rotation_matrices
from tests.helpers import DEVICES, PARAMETERS, random_scene, relative_error

GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")
seeds = st.integers(0, 10**6)
quickly = settings(max_examples=5, deadline=None, derandomize=True)


def image_of(scene, **options):
    return blitzgs.rasterization(*scene.arguments(), **{"sh_degree": scene.sh_degree, **options})[0]


def select(scene, index):
    for name in GAUSSIANS:
        setattr(scene, name, getattr(scene, name)[index])
    return scene


@pytest.mark.parametrize("device", DEVICES)
@quickly
@given(seed=seeds)
def test_the_order_of_the_gaussians_does_not_matter(device, seed):
    scene = random_scene(n=90, seed=seed, device=device)
    order = torch.randperm(90, generator=torch.Generator().manual_seed(seed))
    shuffled = select(random_scene(n=90, seed=seed, device=device), order)
    assert torch.equal(image_of(scene), image_of(shuffled))


@quickly
@given(seed=seeds)
def test_world_and_cameras_move_together(seed):
    scene = random_scene(n=60, seed=seed, dtype=torch.float64)
    scene.sh_degree, scene.colors = None, scene.colors[:, 0].abs()
    before = image_of(scene)
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(1, 4, generator=generator, dtype=torch.float64)
    R = rotation_matrices(quat)[0]
    shift = torch.randn(3, generator=generator, dtype=torch.float64) * 5
    scene.means = scene.means @ R.T + shift
    scene.quats = multiply_quaternions(quat / quat.norm(), scene.quats)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, shift
    scene.viewmats = scene.viewmats @ motion.inverse()
    assert (image_of(scene) - before).abs().median() < 1e-13
    assert ((image_of(scene) - before).abs() > 1e-10).double().mean() < 0.002  # flips at the cuts


def multiply_quaternions(p, q):
    (a, b, c, d), (w, x, y, z) = p.unbind(1), q.unbind(1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=1,
    )


@pytest.mark.parametrize("device", DEVICES)
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


@pytest.mark.parametrize("device", DEVICES)
def test_views_together_equal_views_alone(device):
    scene = random_scene(n=80, cameras=4, device=device).leaves()
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(4, scene.height, scene.width, 3, generator=generator).to(device)
    together = image_of(scene)
    (together * weights).sum().backward()
    gradients = {name: getattr(scene, name).grad for name in PARAMETERS}
    viewmats, Ks = scene.viewmats.detach(), scene.Ks
    sums = {name: torch.zeros_like(getattr(scene, name)) for name in GAUSSIANS}
    for view in range(4):
        single = random_scene(n=80, cameras=4, device=device).leaves()
        single.viewmats, single.Ks = viewmats[view : view + 1], Ks[view : view + 1]
        image = image_of(single)
        assert torch.equal(image[0], together[view])
        (image[0] * weights[view]).sum().backward()
        for name in GAUSSIANS:
            sums[name] += getattr(single, name).grad
    for name in GAUSSIANS:
        assert relative_error(gradients[name], sums[name]) < (1e-6 if device == "cpu" else 1e-5), name


@pytest.mark.parametrize("device", DEVICES)
def test_transparent_gaussians_change_no_bit(device):
    scene = random_scene(n=60, device=device)
    without = image_of(select(random_scene(n=60, device=device), torch.arange(0, 60, 2)))
    scene.opacities[1::2] = 0.0
    leaves = scene.leaves()
    image = image_of(leaves)
    assert torch.equal(image, without)
    image.sum().backward()
    assert all((getattr(leaves, name).grad[1::2] == 0).all() for name in GAUSSIANS)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n, cameras", [(0, 2), (0, 1), (3, 0)])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("packed", [True, False])
def test_empty_input_gives_the_background_and_zero_gradients(device, n, cameras, render_mode, packed):
    scene = random_scene(n=n, cameras=cameras, device=device).leaves()
    backgrounds = torch.full((cameras, 3), 0.25, device=device)
    renders, alphas, meta = blitzgs.rasterization(
        *scene.arguments(), sh_degree=3, backgrounds=backgrounds, render_mode=render_mode, packed=packed
    )
    assert renders.shape == (cameras, scene.height, scene.width, 3 if render_mode == "RGB" else 4)
    assert (renders[..., :3] == 0.25).all() and (alphas == 0).all() and (renders[..., 3:] == 0).all()
    renders.sum().backward()
    assert scene.means.grad is None or (scene.means.grad == 0).all()
