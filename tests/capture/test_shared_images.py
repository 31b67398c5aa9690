# SPDX-License-Identifier: Apache-2.0
"""Images that the ranks of a host share, each decoded once; pictures that are written."""

import dataclasses
import os
import socket

import cv2
import numpy as np
import pytest
import torch

from blitzgs.capture.capture import load_capture
from blitzgs.capture.images import ImageStore, decoded_shapes
from blitzgs.capture.pictures import comparison, error_map, save_image, strip, to_uint8
from blitzgs.capture.shared_images import SharedImages, size_of
from blitzgs.training import inputs
from tests.capture.helpers import write_capture, write_image
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.training.tiny import tiny_config

pytestmark = pytest.mark.filterwarnings("ignore:all training cameras are in one place")
NAMES = [f"v{i:02d}.jpg" for i in range(12)]
SHAPES = {"a": (2, 3, 3), "b": (5, 7, 3), "c": (4, 4)}


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_what_one_puts_there_the_other_finds():
    one, offer = SharedImages.create(SHAPES)
    other = SharedImages.join(offer, SHAPES)
    for seed, (key, shape) in enumerate(SHAPES.items()):
        assert one.get(key) is None and other.get(key) is None
        one.put(key, noise(shape, seed))
    for seed, (key, shape) in enumerate(SHAPES.items()):
        np.testing.assert_array_equal(other.get(key), noise(shape, seed))
    assert other.bytes == one.size == 18 + 105 + 16
    del one
    np.testing.assert_array_equal(other.get("b"), noise(SHAPES["b"], 1))


def test_other_memory_is_refused():
    _one, offer = SharedImages.create(SHAPES)
    refused(OSError, "memory of another process", SharedImages.join, offer._replace(token=bytes(16)), SHAPES)
    refused(OSError, "not the memory of the same images", SharedImages.join, offer, SHAPES | {"d": (9, 9)})
    refused(OSError, r"fd/12345", SharedImages.join, offer._replace(path="/proc/self/fd/12345"), SHAPES)


def test_the_memory_ends_with_its_users():
    one, offer = SharedImages.create(SHAPES)
    assert os.path.exists(offer.path)
    del one
    assert not os.path.exists(offer.path)


def test_stores_with_shared_memory_return_the_same_images_and_decode_each_once(tmp_path):
    capture = load_capture(write_capture(tmp_path, NAMES))
    shared, offer = SharedImages.create(decoded_shapes(capture))
    stores = [
        ImageStore(capture, shared=shared),
        ImageStore(capture, shared=SharedImages.join(offer, decoded_shapes(capture))),
    ]
    alone = ImageStore(capture)
    for index in range(12):
        stores[index % 2].prefetch(range(index, 12))
        for store in stores:
            assert torch.equal(store.get(index), alone.get(index))
            assert store.mask(index) is None
    stores[0].prefetch(range(12))
    for store in stores:
        store.close()
        memory = store.memory()
        assert memory.decoded_bytes == 12 * 3 * 64 * 48 < memory.decoded_budget
        assert store.decoded.bytes == store.compressed.bytes == 0
    # Both may decode an image at the same time, but not one that the other has decoded.
    assert 12 <= sum(store.memory().decoded for store in stores) <= 24
    assert ImageStore(capture, shared=shared).get(3).sum() == alone.get(3).sum()


def test_turned_photographs_are_shared_too(tmp_path):
    capture = load_capture(write_capture(tmp_path, NAMES[:2]))
    turned = [dataclasses.replace(capture.cameras[0], orientation=3), capture.cameras[1]]
    stored = ImageStore(capture).get(0)
    capture = dataclasses.replace(capture, cameras=turned)
    shared, offer = SharedImages.create(decoded_shapes(capture))
    first = ImageStore(capture, shared=shared)
    second = ImageStore(capture, shared=SharedImages.join(offer, decoded_shapes(capture)))
    for store in (first, second):
        assert torch.equal(store.get(0), stored.flip(0, 1))
        assert torch.equal(store.get(1), ImageStore(capture).get(1))


def test_masks_are_shared_too(tmp_path):
    capture = load_capture(write_capture(tmp_path, NAMES[:2]))
    mask = tmp_path / "mask.png"
    write_image(mask, 255 * (noise((48, 64)) > 99).astype(np.uint8))
    cameras = [dataclasses.replace(camera, mask_path=mask) for camera in capture.cameras]
    capture = dataclasses.replace(capture, cameras=cameras)
    shapes = decoded_shapes(capture, [4])
    assert shapes["mask", 1, 4] == (12, 16)
    assert shapes["mask", 1, 1] == (48, 64) and size_of(shapes) > 2 * 4 * 48 * 64
    shared, _ = SharedImages.create(shapes)
    first, second = ImageStore(capture, shared=shared), ImageStore(capture, shared=shared)
    assert torch.equal(first.mask(1), ImageStore(capture).mask(1))
    assert torch.equal(second.mask(1), first.mask(1)) and second.memory().decoded == 0
    counted = first.mask(1).double().view(12, 4, 16, 4)
    assert torch.equal(second.mask(1, 4) != 0, counted.mean((1, 3)) >= 0.5)
    colours = first.get(1).double().view(12, 4, 16, 4, 3) * counted[..., None]
    means = colours.sum((1, 3)) / counted.sum((1, 3)).clamp(min=1)[..., None]
    assert (first.get(1, 4) - means).abs().max() <= 0.5 + 1e-4


def test_reduced_images_are_shared_too(tmp_path):
    capture = load_capture(write_capture(tmp_path, NAMES[:2]))
    shared, _ = SharedImages.create(decoded_shapes(capture, [4, 2]))
    first, second = ImageStore(capture, shared=shared), ImageStore(capture, shared=shared)
    for factor in (4, 2, 1):
        assert torch.equal(first.get(1, factor), ImageStore(capture).get(1, factor))
        assert torch.equal(second.get(1, factor), first.get(1, factor))
    assert first.memory().decoded == 1 and second.memory().decoded == 0


def _decode_all(ranks, folder, cache_bytes):
    config = tiny_config(f"data.path={folder}", f"data.cache_bytes={cache_bytes}")
    _, images = inputs.open_capture(config, ranks)
    sums = []
    for index in range(12):
        if index % ranks.world_size == ranks.rank:
            images.get(index)
    ranks.barrier()
    for index in range(12):
        sums.append(int(images.get(index).sum()))
    images.close()
    return images.memory().decoded, sums, images.compressed.budget


@pytest.mark.parametrize("shares", [True, False])
def test_ranks_decode_each_image_once_if_all_fit(tmp_path, shares):
    folder = write_capture(tmp_path, NAMES)
    needed = size_of(decoded_shapes(load_capture(folder)))
    cache = 2 * needed if shares else 2 * needed - 2
    results = run_ranks(_decode_all, 3, folder, cache)
    # A rank's own budget is too small for all, so some are decoded again.
    assert all(decoded == 4 if shares else decoded >= 12 for decoded, _, _ in results)
    assert all(sums == results[0][1] for _, sums, _ in results)
    left = cache - needed if shares else cache
    assert {budget for _, _, budget in results} == {left // 3}


def _refuse(*_args):
    raise OSError("no such memory")


def _decode_without(ranks, folder, refused, cache_bytes):
    if ranks.rank == refused:
        SharedImages.create = SharedImages.join = _refuse
    return _decode_all(ranks, folder, cache_bytes)


@pytest.mark.parametrize("refused", [0, 1])
def test_a_rank_without_access_decodes_for_itself(tmp_path, refused):
    folder = write_capture(tmp_path, NAMES)
    needed, cache = size_of(decoded_shapes(load_capture(folder))), 10_000_000
    results = run_ranks(_decode_without, 2, folder, refused, cache)
    assert [decoded for decoded, _, _ in results] == [12, 12]
    assert results[0][1] == results[1][1]
    # The memory that one rank has made is taken from the budget of both.
    left = cache if refused == 0 else cache - needed
    assert [budget for _, _, budget in results] == [left // 2] * 2


def _decode_on_unequal_hosts(ranks, folder):
    # Ranks 0 and 1 are on a host that has too little memory to share, ranks 2 to 4 on another one.
    first = ranks.rank < 2
    socket.gethostname = lambda: "first" if first else "second"
    ranks.local_world_size = 2 if first else 3
    return _decode_all(ranks, folder, 200_000 if first else 10_000_000)[0]


def test_hosts_may_have_different_numbers_of_ranks(tmp_path):
    decoded = run_ranks(_decode_on_unequal_hosts, 5, write_capture(tmp_path, NAMES))
    assert min(decoded[:2]) >= 12
    # Any rank of the second host may decode those 6 images that the ranks of the first one decode first.
    assert sum(decoded[2:]) >= 12 and max(decoded[2:]) <= 2 + 6


def test_saved_pictures_are_rgb_rounded_and_clamped(tmp_path):
    image = torch.tensor([[[1.5, 0.5, -1.0], [float("inf"), 0.0, 1.0]]])
    assert to_uint8(image).tolist() == [[[255, 128, 0], [255, 0, 255]]]
    save_image(tmp_path / "new" / "a.png", image)
    found = cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1]
    np.testing.assert_array_equal(found, to_uint8(image))
    whole = torch.randint(0, 256, (4, 5, 3), dtype=torch.uint8)
    save_image(tmp_path / "b.png", whole)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "b.png"))[..., ::-1], whole)


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (torch.full((2, 2, 3), float("nan")), ValueError, "image has NaN in 12 of 12 values"),
        (np.zeros((2, 2, 3)), TypeError, "image must be a torch.Tensor, got ndarray: convert it with"),
        ("a.jpg", TypeError, "image must be a torch.Tensor, got str"),
        (None, TypeError, "image must be a torch.Tensor, got NoneType"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path, image, error, message):
    refused(error, message, save_image, tmp_path / "a.png", image)
    assert not (tmp_path / "a.png").exists()


def test_unwritable_pictures_are_named(tmp_path):
    refused(ValueError, "a picture as '.unknown'", save_image, tmp_path / "a.unknown", torch.zeros(2, 2, 3))
    (tmp_path / "target.png").write_bytes(b"precious")
    (tmp_path / "link.png").symlink_to(tmp_path / "target.png")
    with pytest.raises(OSError, match="link.png is a symbolic link, which is not overwritten"):
        save_image(tmp_path / "link.png", torch.zeros(2, 2, 3))
    assert (tmp_path / "target.png").read_bytes() == b"precious"


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 1), (4, 5, 4), (1, 4, 5, 3)], ids=str)
def test_pictures_of_other_shapes_are_refused(tmp_path, shape):
    refused(ValueError, r"must be \[H, W, 3\], got", save_image, tmp_path / "a.png", torch.zeros(shape))


def test_error_map_runs_from_blue_to_red_and_masked_pixels_are_grey():
    target = torch.full((1, 4, 3), 100, dtype=torch.uint8)
    render = target.float() / 255 + torch.tensor([0.0, 0.1, 0.25, 0.6])[None, :, None]
    colors = error_map(render, target, torch.tensor([[1, 1, 1, 0]])).int()[0]
    assert colors[3].tolist() == [128, 128, 128]
    assert colors[2][0] > 100 > colors[2][2] and colors[0][0] < 100
    everywhere = error_map(render, target).int()[0]
    assert torch.equal(everywhere[2], everywhere[3])


def test_comparison_strip_holds_all_three(tmp_path):
    render, target = torch.rand(20, 30, 3), torch.randint(0, 256, (20, 30, 3), dtype=torch.uint8)
    save_image(tmp_path / "c.png", comparison(render, target))
    found = torch.from_numpy(cv2.imread(str(tmp_path / "c.png"))[..., ::-1].copy())
    assert found.shape == (44, 98, 3)
    np.testing.assert_array_equal(found[24:, :30], to_uint8(render))
    np.testing.assert_array_equal(found[24:, 34:64], target)
    np.testing.assert_array_equal(found[24:, 68:], error_map(render, target))
    assert (found[:24, :30] < 128).any(), "the label is drawn"
    assert all((found[:24, right - 4 : right] > 200).all() for right in (30, 64, 98)), "no label is cut off"
    refused(ValueError, "images of one height", strip, [render, render[:5]], ["a", "b"])


def test_code_that_imports_the_former_name_gets_the_same_modules():
    from blitzgs.scene.pictures import save_image as former

    assert former is save_image
