# SPDX-License-Identifier: Apache-2.0
"""The photographs of each step's batch, decoded and uploaded ahead of the step that needs them."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from blitzgs.distributed.ownership import LOSS_REACH, TileOwners, TileRanges
from blitzgs.pipeline import Views
from blitzgs.training.sampler import BatchSampler
from blitzgs.training.views import VIEW_NUMBERS, ViewSet, unpack_views


class Images(Protocol):
    """What training reads of an image store (`blitzgs.scene.image_store.ImageStore`)."""

    def get(self, index: int) -> Tensor:
        """Return an image, uint8 [H, W, 3]."""

    def mask(self, index: int) -> Tensor | None:
        """Return the image's mask, uint8 [H, W] with 0 = excluded; None: there is none."""

    def prefetch(self, indices: list[int]) -> None:
        """Decode images in the background."""


@dataclass(frozen=True)
class Batch:
    """One step's views and photographs on the device.

    Attributes:
        indices: cameras of the capture, B of them.
        views: the same as the renderer takes them.
        targets: uint8 [B, H, W, 3]; on several ranks, anything beyond what this rank's loss reads.
        masks: uint8 [B, H, W], 0 = pixel left out; None when no view of the batch has a mask.
        samples: float32 [B], values that a view's mean is over: 3 x its pixels that count, at least 1.
        ranges: who composites which tiles; None on one rank.
    """

    indices: list[int]
    views: Views
    targets: Tensor
    masks: Tensor | None
    samples: Tensor
    ranges: TileRanges | None


class _Slot:
    """Where one batch is put together and uploaded from; on CUDA, memory that is used again and again.

    Attributes:
        uploaded: on CUDA, the upload of the newest batch.
        read: on CUDA, the end of the work that reads that batch.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._memory: dict[str, tuple[Tensor, Tensor]] = {}
        if device.type == "cuda":
            self.uploaded, self.read = torch.cuda.Event(), torch.cuda.Event()

    def reserve(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return host memory to fill and the device memory that it is for; one and the same on the CPU."""
        if self._device.type != "cuda":
            tensor = torch.empty(shape, dtype=dtype)
            return tensor, tensor
        memory = self._memory.get(name)
        if memory is None or memory[0].shape != shape:
            memory = (
                torch.empty(shape, dtype=dtype, pin_memory=True),
                torch.empty(shape, dtype=dtype, device=self._device),
            )
            self._memory[name] = memory
        return memory


class BatchLoader:
    """Serves the batches of consecutive steps; a thread stays some batches ahead.

    On CUDA, images go through pinned memory and a stream of their own, so that uploads overlap the kernels. A
    batch is overwritten some steps later: it is valid until the next one is asked for.
    """

    def __init__(
        self,
        images: Images,
        views: ViewSet,
        train: list[int],
        sampler: BatchSampler,
        device: torch.device,
        ahead: int,
        owners: TileOwners | None = None,
    ) -> None:
        """Prepare to serve.

        Args:
            images: the photographs.
            views: all cameras.
            train: camera of each of the sampler's views.
            sampler: chooses the views of each step.
            device: where the batches go.
            ahead: batches to prepare beyond the one asked for; 0 works in the calling thread's time.
            owners: divides the tiles of each batch; this rank then decodes and uploads only the pixel rows
                that its tiles' loss reads. None: everything.
        """
        self._images = images
        self._views = views
        self._owners = owners
        self._counts: dict[int, float] = {}
        self._train = train
        self._sampler = sampler
        self._device = device
        self._ahead = ahead
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._pending: dict[int, Future[tuple[Batch, _Slot]]] = {}
        # One that is in use, and those that are ready or being made.
        self._free = deque(_Slot(device) for _ in range(ahead + 2))
        self._used: _Slot | None = None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="batches")

    def get(self, step: int, last: int) -> Batch:
        """Return the batch of a step (0-based) and start on those that follow it, up to step `last` - 1."""
        stream = None if self._stream is None else torch.cuda.current_stream(self._device)
        if self._used is not None:
            if stream is not None:
                self._used.read.record(stream)
            self._free.append(self._used)
            self._used = None  # in case the next batch cannot be loaded
        for ahead in range(step, max(step + 1, min(step + self._ahead + 1, last))):
            if ahead not in self._pending:
                indices = [self._train[view] for view in self._sampler.batch(ahead)]
                # Divided here and not in the thread: all ranks must know the same costs at this moment.
                ranges = self._divide(indices)
                rows = self._rows(indices, ranges)
                self._images.prefetch(
                    [index for index, (y0, y1) in zip(indices, rows, strict=True) if y0 < y1]
                )
                self._pending[ahead] = self._worker.submit(self._load, indices, ranges, rows)
        batch, slot = self._pending.pop(step).result()
        if stream is not None:
            stream.wait_event(slot.uploaded)
        self._used = slot
        return batch

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _divide(self, indices: list[int]) -> TileRanges | None:
        if self._owners is None:
            return None
        return self._owners.divide(indices, *self._views.size(indices), reach=LOSS_REACH)

    def _rows(self, indices: list[int], ranges: TileRanges | None) -> list[tuple[int, int]]:
        """Pixel rows [y0, y1) of each view that this rank needs."""
        if ranges is None or self._owners is None:
            return [(0, self._views.size([index])[1]) for index in indices]
        return [ranges.pixel_rows(self._owners.ranks.rank, view) for view in range(len(indices))]

    def _load(
        self, indices: list[int], ranges: TileRanges | None, rows: list[tuple[int, int]]
    ) -> tuple[Batch, _Slot]:
        count, (width, height) = len(indices), self._views.size(indices)
        masks = [self._images.mask(index) for index in indices]
        samples = [self._samples(index, mask) for index, mask in zip(indices, masks, strict=True)]
        strips = [
            self._images.get(index)[y0:y1] if y0 < y1 else None
            for index, (y0, y1) in zip(indices, rows, strict=True)
        ]
        slot = self._free.popleft()  # not before: images that cannot be read must not keep it
        if self._stream is not None:
            slot.uploaded.synchronize()  # the pinned memory is free, long since
            self._stream.wait_event(slot.read)
        with torch.cuda.stream(self._stream):
            pixels, targets = slot.reserve("targets", (count, height, width, 3), torch.uint8)
            for view, (strip, (y0, y1)) in enumerate(zip(strips, rows, strict=True)):
                if strip is not None:
                    pixels[view, y0:y1].copy_(strip)
                    _upload(targets[view, y0:y1], pixels[view, y0:y1])
            whole = stack_masks(masks, width, height)
            if whole is not None:
                counted, placed = slot.reserve("masks", (count, height, width), torch.uint8)
                _upload(placed, counted.copy_(whole))
                whole = placed
            numbers, constants = slot.reserve("constants", (count * (VIEW_NUMBERS + 1),), torch.float32)
            self._views.write(indices, numbers[:-count].numpy())
            numbers[-count:] = torch.tensor(samples)
            _upload(constants, numbers)
            if self._stream is not None:
                slot.uploaded.record(self._stream)
        views = unpack_views(constants[:-count], width, height)
        return Batch(indices, views, targets, whole, constants[-count:], ranges), slot

    def _samples(self, index: int, mask: Tensor | None) -> float:
        if index not in self._counts:
            width, height = self._views.size([index])
            counted = width * height if mask is None else int((mask != 0).sum())
            self._counts[index] = float(max(1, 3 * counted))
        return self._counts[index]


def _upload(device: Tensor, host: Tensor) -> None:
    if device.is_cuda:
        device.copy_(host, non_blocking=True)


def stack_masks(masks: list[Tensor | None], width: int, height: int) -> Tensor | None:
    """Stack the masks of a batch; a view without one counts everywhere. None when no view has one."""
    if all(mask is None for mask in masks):
        return None
    whole = torch.ones(height, width, dtype=torch.uint8)
    return torch.stack([whole if mask is None else mask for mask in masks])
