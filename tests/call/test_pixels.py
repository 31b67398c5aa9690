# SPDX-License-Identifier: Apache-2.0
"""A list of pixels has the bits of the whole image, and its gradients."""

import pytest
import torch

from tests.helpers import BACKENDS, PARAMETERS, random_scene, rasterize_scene, relative_error

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
@pytest.mark.parametrize("backend", BACKENDS)
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
        leaves = [*(getattr(scene, name) for name in PARAMETERS), extra, backgrounds]
        gradients.append([leaf.grad for leaf in leaves])
    assert 0 < entries[1] < 0.6 * entries[0]
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    for whole, own in zip(*gradients, strict=True):
        assert relative_error(own, whole) < (1e-12 if backend[1] == torch.float64 else 1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
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
        ({"pixels": torch.zeros(3, 2).int(), "image_ids": torch.zeros(2).int()}, ValueError, r"\[M, 2\]"),
        (
            {"pixels": torch.tensor([[0, 0], [32, 5]]), "image_ids": torch.tensor([0, 1])},
            ValueError,
            r"pixel 1 is \(row, column\) = \(32, 5\) of image 1, outside 2 images of 32 x 40 px",
        ),
        ({"pixels": torch.zeros(3, 2).int(), "distributed": True}, ValueError, "distributed"),
    ],
)
def test_wrong_pixels_are_named(options, error, message):
    with pytest.raises(error, match=message):
        rasterize_scene(random_scene(), **options)
