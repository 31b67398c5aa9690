# SPDX-License-Identifier: Apache-2.0
"""Keeps the images of a capture compressed in memory within a budget; threads decode them ahead.

There are two bounded caches, for compressed and for decoded images; both drop the entries that were used
longest ago. Decoded images take the memory that compressed ones leave. If processes share memory for all
decoded images (`shared_images`), it takes the place of both. The compressed form is the file
itself if the file needs no processing. An image that must be undistorted or downscaled is processed once
and kept as QOI, which is lossless. For an image of 1.9 megapixels, decoding the QOI takes 16 ms at full
size and 1 ms at a quarter; decoding, undistorting and averaging the JPEG again takes 22 and 16 ms, and
PNG 46 and 3 ms. Reduced images (`schedule.resolution`) are made once from the decoded ones, by the same
threads, and are kept beside them. Nothing is written to disk. The images do not depend on budgets, threads
or the order of calls.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.capture.cameras import Camera, Rectification
from blitzgs.capture.capture import Capture
from blitzgs.capture.image_files import (
    ImageFile,
    UInt8,
    apply_orientation,
    decode_mask,
    decode_rgb,
    quiet,
    read_whole,
    reduced,
    reduced_mask,
)
from blitzgs.capture.masks import FileCheck, misfit
from blitzgs.capture.shared_images import SharedImages
from blitzgs.formats import native
from blitzgs.util.errors import UserError, amount, located

K = TypeVar("K")
V = TypeVar("V")
DEFAULT_BUDGET = 4 << 30
_MAPS_KEPT = 4  # because those of a 12-megapixel image take 100 MB
# "image" or "mask", the camera, and the factor by which it is reduced.
_Key: TypeAlias = tuple[str, int, int]
# Columns and rows of `Rectification.maps`, and which pixels the lens has seen.
_Maps: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], UInt8]


@dataclass(frozen=True)
class ImageMemory:
    """The largest host memory that images have taken so far, its limits, and the number of decodings."""

    compressed_bytes: int  # bytes of compressed images
    compressed_budget: int  # limit of these bytes
    # Bytes of decoded images and masks, without those that a caller holds; in memory that several processes
    # share, those of all processes.
    decoded_bytes: int
    decoded_budget: int  # limit of these bytes at present; it may have been larger before (`ImageStore`)
    decoded: int  # number of decodings of images and masks

    def __str__(self) -> str:
        """Return the figures as text."""
        return (
            f"photographs held in host memory: {amount(self.compressed_bytes)} compressed (limit "
            f"{amount(self.compressed_budget)}), {amount(self.decoded_bytes)} decoded (limit "
            f"{amount(self.decoded_budget)}); {self.decoded:,} decodings"
        )


class BoundedCache(Generic[K, V]):
    """A least-recently-used cache with a budget of bytes; an entry larger than the budget is not stored."""

    def __init__(self, budget: int) -> None:
        """Hold at most `budget` bytes."""
        self.budget = budget  # the largest size, in bytes
        self.bytes = 0  # the size now
        self.most_bytes = 0  # the largest size so far
        self._entries: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K) -> V | None:
        """Return the entry and mark it as the most recently used; None if it is not stored."""
        with self._lock:
            if key not in self._entries:
                return None
            self._entries.move_to_end(key)
            return self._entries[key][0]

    def put(self, key: K, value: V, size: int, spare: bool = False) -> None:
        """Add or replace an entry of `size` bytes, dropping the oldest until all fit.

        A spare entry drops no other one, and is the first to be dropped.
        """
        with self._lock:
            if key in self._entries:
                self.bytes -= self._entries.pop(key)[1]
            if size > self.budget or (spare and self.bytes + size > self.budget):
                return
            while self.bytes + size > self.budget:
                self.bytes -= self._entries.popitem(last=False)[1][1]
            self._entries[key] = (value, size)
            self._entries.move_to_end(key, last=not spare)
            self.bytes += size
            self.most_bytes = max(self.most_bytes, self.bytes)

    def resize(self, budget: int) -> None:
        """Change the budget, dropping the oldest entries until the others fit."""
        with self._lock:
            self.budget = budget
            while self.bytes > budget:
                self.bytes -= self._entries.popitem(last=False)[1][1]


class PhotographError(UserError):
    """A photograph cannot be read; the message names the file."""


def has_mask(camera: Camera) -> bool:
    """Tell whether some pixels of a camera's image may not count."""
    return camera.mask_path is not None or camera.rectification.has_invalid


def decoded_shapes(capture: Capture, factors: Iterable[int] = ()) -> dict[Hashable, tuple[int, ...]]:
    """Return the shapes of all decoded images and masks, also reduced ones, by the keys of `ImageStore`."""
    shapes: dict[Hashable, tuple[int, ...]] = {}
    for factor in (1, *factors):
        for index, camera in enumerate(capture.cameras):
            height, width = camera.height // factor, camera.width // factor
            shapes["image", index, factor] = (height, width, 3)
            if has_mask(camera):
                shapes["mask", index, factor] = (height, width)
    return shapes


class ImageStore:
    """Decoded images and masks of a capture's cameras, by index; any thread may call any method."""

    def __init__(
        self,
        capture: Capture,
        budget_bytes: int = DEFAULT_BUDGET,
        threads: int = 4,
        decoded_bytes: int | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        shared: SharedImages | None = None,
    ) -> None:
        """Read nothing yet.

        Args:
            budget_bytes: limit of the compressed images in memory.
            threads: number of threads that decode ahead.
            decoded_bytes: limit of the decoded images in memory; None: a quarter of `budget_bytes`, and
                what the compressed images leave of `budget_bytes`.
            background: RGB in [0, 1] that images with an alpha channel are composited over.
            shared: memory for `decoded_shapes` of the capture that other processes use too. All images stay
                decoded there, and none is kept in this process. None: they are kept in this process.
        """
        if not hasattr(capture, "cameras"):
            raise TypeError(f"capture must be a Capture, as load_capture returns it, got {capture!r}")
        self.capture, self._shared = capture, shared
        self._background = background if capture.has_alpha else None
        self.compressed: BoundedCache[Path | int, Any] = BoundedCache(budget_bytes)
        self._decoded_bytes = decoded_bytes
        self.decoded: BoundedCache[_Key, UInt8] = BoundedCache(self._decoded_budget())
        self._maps = lru_cache(_MAPS_KEPT)(_maps)
        self._maps_lock = threading.Lock()
        self._pending: dict[_Key, Future[UInt8]] = {}
        self._pending_lock = threading.Lock()
        self._budget_lock = threading.Lock()
        self._times_decoded = 0
        self._check: FileCheck | None = None
        self._whole_jpegs: set[Path] = set()  # that were read; their check takes half as long as decoding
        self._pool = ThreadPoolExecutor(max(1, threads), thread_name_prefix="blitzgs-images")
        self._quiet = contextlib.ExitStack()
        self._quiet.enter_context(quiet())

    def get(self, index: int, factor: int = 1) -> Tensor:
        """Return a camera's image, uint8 RGB [height, width, 3] on the CPU. It is shared: do not write to it.

        Args:
            index: the camera.
            factor: by which the image is `reduced`.

        Raises:
            ValueError: the file is damaged or its size changed; names it.
            OSError: the file cannot be read.
        """
        return torch.from_numpy(self._result(("image", index, factor)))

    def mask(self, index: int, factor: int = 1) -> Tensor | None:
        """Return which pixels count, uint8 0 or 1 [height, width]; None: all. Shared: do not write to it.

        A pixel that mixes counted and excluded pixels of the file is excluded. `reduced_mask` says which
        pixels of a reduced image count.
        """
        if not has_mask(self.capture.cameras[index]):
            return None
        return torch.from_numpy(self._result(("mask", index, factor)))

    def prefetch(self, indices: Iterable[int], masks: Iterable[int] = (), factor: int = 1) -> None:
        """Start to decode what is needed next, in order, as much as the memory for decoded images holds.

        Args:
            indices: cameras whose images are needed.
            masks: cameras whose masks are needed, if they have one.
            factor: by which images and masks are reduced.
        """
        wanted = [("mask", index, 1) for index in masks if has_mask(self.capture.cameras[index])]
        planned, budget = 0, self.room()
        for kind, index, channels in [*wanted, *(("image", index, 3) for index in indices)]:
            camera = self.capture.cameras[index]
            planned += channels * (camera.width // factor) * (camera.height // factor)
            if planned > budget:
                return
            self._submit((kind, index, factor))

    def memory(self) -> ImageMemory:
        """Return the memory that images have taken so far."""
        decoded = self.decoded.most_bytes if self._shared is None else self._shared.bytes
        return ImageMemory(
            self.compressed.most_bytes, self.compressed.budget, decoded, self.room(), self._times_decoded
        )

    def check_files(self, indices: Iterable[int]) -> FileCheck:
        """Start to check the files of these cameras in the background, those of held-out views first.

        As soon as one is found to be damaged, `get` and `mask` raise its error for every image: a training
        then ends at its beginning, and not when it comes to that image.
        """
        test = set(self.capture.test)
        order = sorted(indices, key=lambda index: index not in test)
        self._check = FileCheck([self.capture.cameras[index] for index in order], self._whole_jpegs)
        return self._check

    def close(self) -> None:
        """Stop the threads; images whose decoding has not begun are not decoded."""
        if self._check is not None:
            self._check.close()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._quiet.close()

    def room(self) -> int:
        """Return the limit of the bytes of decoded images at present."""
        # All images have a place in shared memory, so there this limit is never reached.
        return self.decoded.budget + (0 if self._shared is None else self._shared.size)

    def _decoded_budget(self) -> int:
        if self._decoded_bytes is not None:
            return self._decoded_bytes
        budget = self.compressed.budget
        return budget // 4 + budget - self.compressed.bytes

    def _result(self, key: _Key) -> UInt8:
        if self._check is not None and self._check.damage is not None:
            raise ValueError(self._check.damage)
        found = self._submit(key)
        return found.result() if isinstance(found, Future) else found

    def _submit(self, key: _Key) -> UInt8 | Future[UInt8]:
        """Return the images that are decoded or waiting to be decoded."""
        # An image that is no longer pending is decoded. Both lists are looked up under one lock; otherwise a
        # thread that is delayed between the two look-ups would decode the image again.
        with self._pending_lock:
            if key in self._pending:
                return self._pending[key]
            found = self._found(key)
            if found is not None:
                return found
            future = self._pending[key] = self._pool.submit(self._produce, key)
            return future

    def _found(self, key: _Key) -> UInt8 | None:
        return self.decoded.get(key) if self._shared is None else self._shared.get(key)

    def _produce(self, key: _Key) -> UInt8:
        kind, index, factor = key
        try:
            if factor == 1:
                return self._whole(kind, index)
            # Another process may have reduced it since the look-up.
            found = self._found(key)
            return self._keep(key, self._reduce(kind, index, factor)) if found is None else found
        finally:
            with self._pending_lock:
                del self._pending[key]

    def _whole(self, kind: str, index: int, spare: bool = False) -> UInt8:
        """Return an "image" or "mask" of the full size from memory, or decode it here and keep it."""
        key = (kind, index, 1)
        found = self._found(key)  # another process may have decoded it since the look-up
        if found is not None:
            return found
        with self._pending_lock:
            self._times_decoded += 1
        pixels = self._make_image(index) if kind == "image" else self._make_mask(index)
        return self._keep(key, pixels, spare)

    def _reduce(self, kind: str, index: int, factor: int) -> UInt8:
        masked = has_mask(self.capture.cameras[index])
        mask = self._whole("mask", index, spare=True) if masked else None
        if kind == "image":
            return reduced(self._whole("image", index, spare=True), mask, factor)
        assert mask is not None  # nobody asks for the mask of another camera
        return reduced_mask(mask, factor)

    def _keep(self, key: _Key, pixels: UInt8, spare: bool = False) -> UInt8:
        if self._shared is not None:
            return self._shared.put(key, pixels)
        with self._budget_lock:  # so that no thread restores a budget of before another one's image
            self.decoded.resize(self._decoded_budget())
        self.decoded.put(key, pixels, pixels.nbytes, spare)
        return pixels

    def _read(self, path: Path) -> ImageFile:
        file: ImageFile | None = self.compressed.get(path)
        if file is None:
            file = self._read_whole(path)
            if self._shared is None:  # an image in shared memory stays decoded
                self.compressed.put(path, file, len(file.data))
        return file

    def _read_whole(self, path: Path) -> ImageFile:
        file = read_whole(path)
        if file.header["format"] == "JPEG":
            self._whole_jpegs.add(path)
        return file

    def _make_image(self, index: int) -> UInt8:
        camera = self.capture.cameras[index]
        lens = camera.rectification.lens
        if camera.rectification.is_identity and (lens.width, lens.height) == (camera.width, camera.height):
            # Pixels that are turned later must not be there, even for a moment: another process may have put
            # the image there meanwhile.
            shared = self._shared if camera.orientation == 1 else None
            place = None if shared is None else shared.place(("image", index, 1))
            return self._decode(camera, self._read(camera.image_path), place)
        packed = self.compressed.get(index)
        if packed is not None:
            return _uint8(native.decode_qoi(packed))
        pixels = self._decode(camera, self._read_whole(camera.image_path))
        if not camera.rectification.is_identity:
            columns, rows, _ = self._maps_of(camera.rectification)
            # Linear interpolation blurs by up to a pixel, and is two times as fast.
            is_halved = 2 * camera.width <= camera.rectification.lens.width
            how = cv2.INTER_LINEAR if is_halved else cv2.INTER_CUBIC
            pixels = _uint8(cv2.remap(pixels, columns, rows, how, borderMode=cv2.BORDER_REPLICATE))
        pixels = _shrunk(pixels, camera)
        if self._shared is None:
            packed = native.encode_qoi(pixels)
            self.compressed.put(index, packed, len(packed))
        return pixels

    def _make_mask(self, index: int) -> UInt8:
        camera = self.capture.cameras[index]
        lens = camera.rectification.lens
        if camera.mask_path is None:
            mask = np.ones((lens.height, lens.width), dtype=np.uint8)
        else:
            mask = self._file_mask(camera, camera.mask_path)
        if not camera.rectification.is_identity:
            columns, rows, seen = self._maps_of(camera.rectification)
            mask = _uint8(cv2.remap(mask, columns, rows, cv2.INTER_NEAREST)) * seen
        if mask.shape == (camera.height, camera.width):
            return mask
        return _uint8(_shrunk(mask * np.uint8(255), camera) == 255)

    def _file_mask(self, camera: Camera, path: Path) -> UInt8:
        lens = camera.rectification.lens
        with located("the mask"):
            mask = decode_mask(self._read(path))
        stored = (lens.width, lens.height) if camera.orientation < 5 else (lens.height, lens.width)
        if (mask.shape[1], mask.shape[0]) == stored:
            mask = apply_orientation(mask, camera.orientation)
        height, width = mask.shape
        if (problem := misfit(camera, width, height)) is not None:  # the file has changed
            raise ValueError(problem)
        if (width, height) != (lens.width, lens.height):  # the mask has another resolution
            mask = _uint8(cv2.resize(mask, (lens.width, lens.height), interpolation=cv2.INTER_NEAREST))
        return mask

    def _decode(self, camera: Camera, file: ImageFile, place: UInt8 | None = None) -> UInt8:
        lens, path = camera.rectification.lens, camera.image_path
        pixels = apply_orientation(decode_rgb(file, self._background, place), camera.orientation)
        if pixels.shape[:2] != (lens.height, lens.width):
            raise ValueError(
                f"{path} is {pixels.shape[1]} x {pixels.shape[0]} now but was {lens.width} x {lens.height} "
                "when the capture was loaded"
            )
        return pixels

    def _maps_of(self, plan: Rectification) -> _Maps:
        with self._maps_lock:  # so that two threads do not make the same ones, which takes seconds
            return self._maps(plan)


def _maps(plan: Rectification) -> _Maps:
    columns, rows, seen = plan.maps()
    return columns, rows, seen.astype(np.uint8)


def _uint8(pixels: npt.ArrayLike) -> UInt8:
    return np.asarray(pixels, dtype=np.uint8)


def _shrunk(pixels: UInt8, camera: Camera) -> UInt8:
    if pixels.shape[:2] == (camera.height, camera.width):
        return pixels
    return _uint8(cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
