# SPDX-License-Identifier: Apache-2.0
"""Decoded images in memory that the processes of one host share, so that one of them decodes each image.

Every image has a fixed place. A process decodes an image there, or copies it there, and then sets its flag.
Two processes that decode the same image at the same time write the same bytes, so no process ever waits for
another one. The memory has no name in the file system: it is freed when the last process that uses it has
ended, however that happens.
"""

from __future__ import annotations

import math
import mmap
import os
import weakref
from collections.abc import Hashable, Mapping
from typing import NamedTuple

import numpy as np

from blitzgs.capture.image_files import UInt8
from blitzgs.formats import native

_TOKEN_BYTES, _ALIGNMENT = 16, 64


class SharedMemoryOffer(NamedTuple):
    """How other processes of the host find the memory of `SharedImages`."""

    path: str  # file under /proc that is this memory, while the process that made it lives
    # The first bytes of the memory. They tell it from another one that has the same path in another
    # container.
    token: bytes


class SharedImages:
    """The places of images in shared memory, and which of these images are decoded already."""

    def __init__(self, file: int, shapes: Mapping[Hashable, tuple[int, ...]]) -> None:
        """Map a file of `size_of(shapes)` bytes, and take over its descriptor."""
        weakref.finalize(self, os.close, file)
        self._bytes = np.frombuffer(mmap.mmap(file, 0), dtype=np.uint8)
        self._flags = self._bytes[_TOKEN_BYTES : _TOKEN_BYTES + len(shapes)]
        self._places: dict[Hashable, tuple[int, UInt8]] = {}
        self._found: dict[Hashable, UInt8] = {}  # the images whose flags this process has seen
        begin = _begin_of_images(len(shapes))
        for number, (key, shape) in enumerate(shapes.items()):
            end = begin + math.prod(shape)
            self._places[key] = (number, self._bytes[begin:end].reshape(shape))
            begin = _aligned(end)
        self._sizes = np.array([pixels.nbytes for _, pixels in self._places.values()], dtype=np.int64)

    @classmethod
    def create(cls, shapes: Mapping[Hashable, tuple[int, ...]]) -> tuple[SharedImages, SharedMemoryOffer]:
        """Make memory for uint8 images of these shapes (OSError: the system has none); images fill it up."""
        file = os.memfd_create("blitzgs-images")
        os.ftruncate(file, size_of(shapes))
        images = cls(file, shapes)
        token = os.urandom(_TOKEN_BYTES)
        images._bytes[:_TOKEN_BYTES] = np.frombuffer(token, dtype=np.uint8)
        return images, SharedMemoryOffer(f"/proc/{os.getpid()}/fd/{file}", token)

    @classmethod
    def join(cls, offer: SharedMemoryOffer, shapes: Mapping[Hashable, tuple[int, ...]]) -> SharedImages:
        """Map the memory that another process of the host made for the same shapes (OSError: no access)."""
        file = os.open(offer.path, os.O_RDWR)
        if os.fstat(file).st_size != size_of(shapes):
            os.close(file)
            raise OSError(f"{offer.path} is not the memory of the same images")
        images = cls(file, shapes)
        if images._bytes[:_TOKEN_BYTES].tobytes() != offer.token:
            raise OSError(f"{offer.path} is the memory of another process")
        return images

    def get(self, key: Hashable) -> UInt8 | None:
        """Return an image in shared memory; None if no process has put it there yet. Do not write to it."""
        found = self._found.get(key)  # a step asks for each of its images several times
        if found is None:
            number, pixels = self._places[key]
            # An array's element is read sooner, but only the function also orders what is read after it.
            if self._flags[number] and native.flag_is_set(self._flags, number):
                found = self._found[key] = pixels
        return found

    def place(self, key: Hashable) -> UInt8:
        """Return the place of an image, to make it there for `put`."""
        return self._places[key][1]

    def put(self, key: Hashable, pixels: UInt8) -> UInt8:
        """Copy an image to its place if it is not there, and return it there."""
        number, place = self._places[key]
        if pixels is not place:
            np.copyto(place, pixels)
        native.set_flag(self._flags, number)
        return place

    @property
    def bytes(self) -> int:
        """The size of the images that are there, put by any process."""
        return int(self._sizes[self._flags != 0].sum())

    @property
    def size(self) -> int:
        """The size of all images that have a place."""
        return int(self._sizes.sum())


def size_of(shapes: Mapping[Hashable, tuple[int, ...]]) -> int:
    """Return the bytes of memory that images of these shapes take."""
    return _begin_of_images(len(shapes)) + sum(_aligned(math.prod(shape)) for shape in shapes.values())


def _begin_of_images(count: int) -> int:
    return _aligned(_TOKEN_BYTES + count)


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
