# SPDX-License-Identifier: Apache-2.0
import dataclasses
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from blitzgs.capture.capture import load_capture
from blitzgs.capture.image_files import decode_rgb, described, read_whole
from blitzgs.capture.images import BoundedCache, ImageStore
from tests.capture.helpers import smooth_image, write_capture, write_image
from tests.helpers import refused

pytestmark = pytest.mark.filterwarnings("ignore:all training cameras are in one place")
NAMES = [f"v{i:02d}.jpg" for i in range(12)]
IMAGE_BYTES = 3 * 64 * 48


@pytest.fixture
def capture(tmp_path):
    return load_capture(write_capture(tmp_path, NAMES))


def test_images_are_rgb_grey_ones_too(tmp_path):
    write_capture(tmp_path, ["a.png", "b.png"])
    grey = smooth_image(48, 64)[..., :1]
    write_image(tmp_path / "images" / "a.png", grey)
    shown = [ImageStore(load_capture(tmp_path)).get(index) for index in (0, 1)]
    assert all(image.dtype == torch.uint8 and not image.is_cuda for image in shown)
    np.testing.assert_array_equal(shown[0].numpy(), np.repeat(grey, 3, axis=2))
    np.testing.assert_array_equal(shown[1].numpy(), smooth_image(48, 64, seed=1))


def test_files_are_read_once_within_the_budget(capture):
    store = ImageStore(capture, decoded_bytes=0)
    before = [store.get(i).clone() for i in range(12)]
    for camera in capture.cameras:
        camera.image_path.unlink()
    assert all(torch.equal(store.get(i), before[i]) for i in range(12))
    refused(FileNotFoundError, NAMES[4], ImageStore(capture).get, 4)


def test_prepared_images_are_made_once_and_kept_without_loss(tmp_path):
    write_capture(tmp_path, NAMES[:3], model="SIMPLE_RADIAL", params=[60.0, 32.0, 24.0, -0.1])
    capture = load_capture(tmp_path, downscale=2)
    store = ImageStore(capture, decoded_bytes=0)
    first = [store.get(i) for i in range(3)]
    for camera in capture.cameras:
        camera.image_path.unlink()  # so that no image can be made again
    for i in (2, 0, 1, 1):
        assert torch.equal(store.get(i), first[i])
    assert 0 < store.compressed.bytes <= sum(image.numel() // 3 * 4 + 22 for image in first)


def test_prefetch_decodes_ahead_as_far_as_the_budget_goes(capture):
    store = ImageStore(capture, decoded_bytes=4 * IMAGE_BYTES, threads=2)
    store.prefetch(range(12))
    for i in range(4):
        store.get(i)
    assert store.memory().decoded == 4
    assert store.decoded.bytes == 4 * IMAGE_BYTES
    store.close()
    with pytest.raises(RuntimeError):
        store.get(5)


@pytest.mark.parametrize("spare", [0.5, 3.5, 20])
def test_decoded_images_take_what_compressed_ones_leave(capture, spare):
    files = sum(camera.image_path.stat().st_size for camera in capture.cameras)
    budget = files + int(spare * IMAGE_BYTES)
    store = ImageStore(capture, budget_bytes=budget)
    for i in range(12):
        store.get(i)
        assert store.decoded.bytes <= store.decoded.budget == budget // 4 + budget - store.compressed.bytes
    assert store.compressed.bytes == files
    kept = min(12, int((budget // 4 + budget - files) / IMAGE_BYTES))
    assert store.decoded.bytes == kept * IMAGE_BYTES
    for i in range(12 - kept, 12):
        store.get(i)
    assert store.memory().decoded == 12  # those used last were kept


def test_masks_and_images_are_decoded_ahead_together(tmp_path):
    write_capture(tmp_path, NAMES[:3], model="SIMPLE_RADIAL", params=[60.0, 32.0, 24.0, -0.1])
    capture = load_capture(tmp_path, undistort="mask")
    store = ImageStore(capture)
    store.prefetch([0, 2], masks=[0, 1, 2])
    wanted = [store.get(0), store.get(2), store.mask(0), store.mask(1), store.mask(2)]
    assert all(tensor is not None for tensor in wanted) and store.memory().decoded == 5


def test_two_thousand_images_stay_within_small_budgets(tmp_path):
    """Two rounds over a capture of 2,000 images in a shuffled order, decoded ahead as training does."""
    names = [f"v{i:04d}.jpg" for i in range(2000)]
    write_capture(tmp_path, names[:8])
    few = load_capture(tmp_path)
    capture = dataclasses.replace(few, cameras=[few.cameras[i % 8] for i in range(2000)])
    for i in range(2000):  # every image has a file of its own
        path = tmp_path / "images" / names[i]
        if i >= 8:
            os.link(few.cameras[i % 8].image_path, path)
        capture.cameras[i] = dataclasses.replace(few.cameras[i % 8], image_path=path)
    expected = [ImageStore(few).get(i) for i in range(8)]
    packed = 100 * (tmp_path / "images" / names[0]).stat().st_size
    store = ImageStore(capture, budget_bytes=packed, threads=3, decoded_bytes=20 * IMAGE_BYTES)
    order = [i for r in range(2) for i in np.random.default_rng(r).permutation(2000).tolist()]
    for begin in range(0, len(order), 4):
        store.prefetch(order[begin : begin + 12])
        for index in order[begin : begin + 4]:
            assert torch.equal(store.get(index), expected[index % 8])
        assert store.compressed.bytes <= packed and store.decoded.bytes <= 20 * IMAGE_BYTES
    memory = store.memory()
    assert 0.9 * packed < memory.compressed_bytes <= packed
    assert memory.decoded_bytes == memory.decoded_budget == 20 * IMAGE_BYTES
    # What is decoded ahead is not dropped before its use; a few images of the first round are still there.
    assert 3900 <= memory.decoded <= 4000
    assert f"; {memory.decoded:,} decodings" in str(memory)


def test_an_image_wanted_by_many_threads_is_decoded_once(capture, monkeypatch):
    store, gate = ImageStore(capture, threads=4), threading.Event()
    look = store.compressed.get

    def slow(key):
        gate.wait(5)
        return look(key)

    monkeypatch.setattr(store.compressed, "get", slow)
    with ThreadPoolExecutor(8) as pool:
        results = [pool.submit(store.get, 3) for _ in range(8)]
        store.prefetch([3])
        gate.set()
        assert all(torch.equal(r.result(), store.get(3)) for r in results)
    assert store.memory().decoded == 1


def test_a_delayed_thread_does_not_decode_an_image_twice(capture, monkeypatch):
    store, looked, others_done = ImageStore(capture), threading.Event(), threading.Event()
    look = store.decoded.get

    def held_up(key):
        found = look(key)
        if not looked.is_set():
            looked.set()
            others_done.wait(0.5)
        return found

    monkeypatch.setattr(store.decoded, "get", held_up)
    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(store.get, 3)
        assert looked.wait(5)
        fast = store.get(3)
        others_done.set()
        assert torch.equal(slow.result(), fast)
    assert store.memory().decoded == 1


@pytest.mark.parametrize("kept", [0, 1, 30, 0.5, 0.99])
def test_truncated_jpegs_are_named_and_never_shown_in_part(capture, kept):
    path = capture.cameras[2].image_path
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data)) if isinstance(kept, float) else kept])
    store = ImageStore(capture)
    store.prefetch(range(4))
    reason = r"(at byte \d+: truncated|cannot be decoded)" if kept else "the file is empty; copy it again"
    refused(ValueError, f"{NAMES[2]}: {reason}", store.get, 2)
    refused(ValueError, NAMES[2], store.get, 2)
    assert store.get(3).shape == (48, 64, 3)


HARMS = {"lost": lambda size: b"", "zeros": bytes, "others": np.random.default_rng(0).bytes}


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize(("begin", "end"), [(0.4, 0.6), (0.8, 0.9), (0.5, 1.0)])
def test_jpegs_with_lost_or_overwritten_blocks_are_refused(tmp_path, harm, begin, end):
    write_capture(tmp_path, NAMES[:1], width=320, height=240)
    capture = load_capture(tmp_path)
    path = capture.cameras[0].image_path
    data = path.read_bytes()
    begin, end = int(begin * len(data)), int(end * len(data))
    path.write_bytes(data[:begin] + HARMS[harm](end - begin) + data[end:])
    refused(ValueError, rf"{NAMES[0]}: at byte \d+: .*(truncated|damaged)", ImageStore(capture).get, 0)


@pytest.mark.parametrize("option", [None, "PROGRESSIVE", "OPTIMIZE", "RST_INTERVAL", "444", "411", "440"])
@pytest.mark.parametrize("size", [(1, 1), (37, 53), (64, 96)])
def test_every_kind_of_whole_jpeg_passes(tmp_path, option, size):
    options = [cv2.IMWRITE_JPEG_QUALITY, 90]
    if option in ("444", "411", "440"):
        sampling = getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{option}")
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    elif option:
        options += [getattr(cv2, f"IMWRITE_JPEG_{option}"), 1]
    for pixels in (smooth_image(*size), smooth_image(*size)[..., 0]):
        ok, data = cv2.imencode(".jpg", pixels, options)
        path = tmp_path / "a.jpg"
        path.write_bytes(data.tobytes() + b"trailing bytes")
        assert decode_rgb(read_whole(path)).shape == (*size, 3)
        path.write_bytes(data.tobytes()[:-2])
        refused(ValueError, "end marker is missing", read_whole, path)


def test_a_frame_of_motion_jpeg_has_no_huffman_tables(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, smooth_image(48, 64))
    data = path.read_bytes()
    expected = decode_rgb(described(data, "a.jpg"))
    while (at := data.find(b"\xff\xc4")) >= 0:
        data = data[:at] + data[at + 2 + int.from_bytes(data[at + 2 : at + 4]) :]
    path.write_bytes(data)
    np.testing.assert_array_equal(decode_rgb(read_whole(path)), expected)
    path.write_bytes(data[:-100] + data[-2:])
    refused(ValueError, "image data end before the last block", read_whole, path)


def test_a_file_that_changed_its_size_is_refused(capture):
    write_image(capture.cameras[0].image_path, smooth_image(20, 30))
    refused(ValueError, "is 30 x 20 now but was 64 x 48", ImageStore(capture).get, 0)


def test_bounded_cache_drops_the_least_recently_used():
    cache = BoundedCache(10)
    for key, size in (("a", 4), ("b", 4)):
        cache.put(key, key, size)
    assert cache.get("a") == "a"
    cache.put("c", "c", 4)
    assert (cache.get("a"), cache.get("b"), cache.get("c"), cache.bytes) == ("a", None, "c", 8)
    cache.put("a", "a2", 2)
    assert (cache.get("a"), cache.bytes) == ("a2", 6)
    cache.put("big", "big", 11)
    assert cache.get("big") is None and cache.bytes == 6


def test_reduced_images_are_made_once_from_images_that_are_decoded_once(capture):
    store = ImageStore(capture)
    store.prefetch(range(12), factor=4)
    found = [store.get(i, 4) for i in range(12)]
    whole = [store.get(i) for i in range(12)]
    assert store.memory().decoded == 12
    assert store.decoded.bytes == 12 * (IMAGE_BYTES + IMAGE_BYTES // 16)
    for small, image in zip(found, whole, strict=True):
        means = image.double().view(12, 4, 16, 4, 3).mean((1, 3))
        assert small.shape == (12, 16, 3) and (small - means).abs().max() <= 0.5
    assert store.get(3, 4).data_ptr() == found[3].data_ptr()


def test_whole_images_leave_their_memory_to_reduced_ones(capture):
    """With room for all reduced images but not for all whole ones, no image is decoded a third time."""
    store = ImageStore(capture, decoded_bytes=6 * IMAGE_BYTES, threads=1)
    for _ in range(3):
        for index in range(12):
            assert store.get(index, 2).shape == (24, 32, 3)
        assert store.memory().decoded == 12
    assert store.decoded.bytes <= 6 * IMAGE_BYTES
