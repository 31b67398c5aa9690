# SPDX-License-Identifier: Apache-2.0
"""Decodes and uploads the photographs of each batch ahead of the step that needs them."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from blitzgs.capture.images import ImageStore
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.tiles import LOSS_HALO, TileRanges
from blitzgs.ops.host import current_stream
from blitzgs.ops.projection_types import Views
from blitzgs.training.sampler import BatchSampler
from blitzgs.view.views import VIEW_NUMBERS, ViewSet, unpack_views


@dataclass(frozen=True)
class Batch:
    """One step's views and photographs on the device."""

    indices: list[int]  # the B cameras of the batch, as indices into the capture
    views: Views  # the same cameras as the renderer takes them, at the resolution of the step
    # uint8 [B, H, W, 3]; on several ranks, undefined outside the pixels that this rank's loss reads.
    targets: Tensor
    masks: Tensor | None  # uint8 [B, H, W], 0 = excluded pixel; None when no view of the batch has a mask
    samples: Tensor  # float32 [B], number of values in a view's mean: 3 x its pixels that count, at least 1
    ranges: TileRanges | None  # the tiles of each rank; None on one rank
    backgrounds: Tensor | None = None  # float32 [B, 3], random; None: the colour of the render options


# Batches that are uploaded beyond the requested one.
AHEAD = 3
# Photographs are decoded further ahead than batches are uploaded: for every batch that is uploaded ahead,
# those of this number of later batches. Decoding one takes as long as several steps on a fast GPU.
_DECODED_AHEAD = 4
# A view of which masks exclude a larger share is counted in `BatchLoader.views_masked`.
MAX_MASKED = 0.95


@dataclass
class _Plan:
    """What is known about a batch before its photographs are decoded; see `Batch`."""

    indices: list[int]
    ranges: TileRanges | None
    rows: list[tuple[int, int]]  # the pixel rows [y0, y1) of each view that this rank needs
    reduction: int  # by which factor the photographs are reduced
    backgrounds: Tensor | None  # float64 [B, 3]
    is_prefetched: bool = False  # whether its photographs are being decoded
    loading: Future[tuple[Batch, _Slot]] | None = None


# The part of a view's photograph that a batch needs: pixel rows, the mask, and `Batch.samples`.
_Photograph = tuple[np.ndarray | None, Tensor | None, float]


class _Slot:
    """Memory in which batches are assembled and from which they are uploaded, one after the other.

    On the CPU, host memory and device memory are the same.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._shape = (0, 0, 0, False)
        if device.type == "cuda":
            # After the upload of the newest batch, and after all work that reads it.
            self.uploaded, self.consumed = torch.cuda.Event(), torch.cuda.Event()

    def reserve(self, shape: tuple[int, int, int, bool]) -> None:
        """Reserve memory for batches with so many views, height, width, and with masks or not."""
        if shape == self._shape:
            return
        count, height, width, masked = shape
        on_gpu = self._device.type == "cuda"
        # Views as `ViewSet.write` writes them, each view's samples, each view's background; photographs;
        # 0 = excluded pixel.
        numbers = torch.empty(count * (VIEW_NUMBERS + 4), dtype=torch.float32, pin_memory=on_gpu)
        pixels = torch.empty((count, height, width, 3), dtype=torch.uint8, pin_memory=on_gpu)
        included = torch.empty((masked * count, height, width), dtype=torch.uint8, pin_memory=on_gpu)
        self._host = numbers, pixels, included
        copies = (torch.empty_like(part, device=self._device) for part in self._host)
        self._on_device = list(copies if on_gpu else self._host)
        self._shape = shape
        of_host, self.pixels, self.included = (part.numpy() for part in self._host)
        parts = [count * VIEW_NUMBERS, count * (VIEW_NUMBERS + 1)]
        self.views, self.samples, self.backgrounds = np.split(of_host, parts)
        numbers, self._targets, included = self._on_device
        self._masks = included if masked else None
        views, self._samples, backgrounds = numbers.tensor_split(parts)
        self._views, self._backgrounds = unpack_views(views, width, height), backgrounds.view(count, 3)

    def upload(self, rows: list[tuple[int, int]]) -> None:
        """Upload from the first to the last needed pixel row; `rows` has those of each view, [y0, y1)."""
        if self._device.type != "cuda":
            return
        height = self._shape[1]
        needed = [view * height + y for view, (y0, y1) in enumerate(rows) if y0 < y1 for y in (y0, y1)]
        some = slice(needed[0], needed[-1]) if needed else slice(0)
        for place, (host, on_device) in enumerate(zip(self._host, self._on_device, strict=True)):
            if place == 1:  # of the photographs
                host, on_device = host.flatten(0, 1)[some], on_device.flatten(0, 1)[some]
            on_device.copy_(host, non_blocking=True)

    def batch(self, plan: _Plan) -> Batch:
        """Return the batch that was assembled in this memory."""
        backgrounds = None if plan.backgrounds is None else self._backgrounds
        parts = self._views, self._targets, self._masks, self._samples
        return Batch(plan.indices, *parts, plan.ranges, backgrounds)


class BatchLoader:
    """Returns the batches of consecutive steps; a thread prepares some batches ahead.

    On CUDA, images are uploaded from pinned memory on a separate stream, so that uploads overlap the kernels.
    A batch is valid until the next one is requested; its memory is then used again.
    """

    def __init__(
        self,
        images: ImageStore,
        views: ViewSet,
        train: list[int],
        sampler: BatchSampler,
        device: torch.device,
        ahead: int = AHEAD,
        owners: TileOwners | None = None,
        random_background: bool = False,
    ) -> None:
        """Prepare to upload `ahead` batches beyond the requested one; the photographs of more are decoded.

        With `owners`, this rank decodes and uploads only the pixel rows that its tiles' loss reads.
        `random_background`: each view has a random colour behind everything.
        """
        self._images, self._views, self._owners = images, views, owners
        self._sample_counts: dict[tuple[int, int], float] = {}  # by view and reduction
        self._masked: dict[int, bool] = {}  # of each view that was read, whether nearly all is masked
        # On several ranks, why this rank could not read the first of the photographs that it could not read.
        # It cannot stop alone in the middle of a step, so it continues and treats all pixels as masked.
        self.lost: str | None = None
        self.waited = 0.0  # seconds that the caller has waited for batches so far
        self._train, self._sampler, self._random_background = train, sampler, random_background
        self._device, self._ahead = device, ahead
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._plans: dict[int, _Plan] = {}  # by step
        # One slot is in use; the others hold batches that are ready or being prepared.
        self._free = deque(_Slot(device) for _ in range(ahead + 2))
        self._current: _Slot | None = None
        self._worker = ThreadPoolExecutor(1, "batches", self._use_stream)

    def get(self, step: int, last: int) -> Batch:
        """Return the batch of a step (0-based) and start to prepare the next ones, up to step `last` - 1."""
        stream = None if self._stream is None else current_stream(self._device)
        if self._current is not None:
            if stream is not None:
                self._current.consumed.record(stream)
            self._give_back(self._current)
            self._current = None  # in case the next batch cannot be loaded
        if self._owners is not None:
            self._owners.forget_before(step)
        if step in self._plans and self._plans[step].reduction != self._sampler.reduction(step):
            self._drop(step)  # the pace of the run has changed since
        for later in range(step, max(step + 1, min(step + (1 + _DECODED_AHEAD) * self._ahead + 1, last))):
            plan, is_near = self._plans.get(later), later <= step + self._ahead
            if plan is None:
                plan = self._plans[later] = self._plan(later)
                if not is_near and self._has_room(later - step, plan):
                    self._prefetch(plan)
            if is_near and plan.loading is None:
                if not plan.is_prefetched:  # there was no room for its photographs before
                    self._prefetch(plan)
                plan.loading = self._worker.submit(self._load, plan)
        begin, loading = time.perf_counter(), self._plans.pop(step).loading
        assert loading is not None
        batch, slot = loading.result()
        self.waited += time.perf_counter() - begin
        if stream is not None:
            stream.wait_event(slot.uploaded)
        self._current = slot
        return batch

    @property
    def views_masked(self) -> tuple[int, int]:
        """Of how many views a mask excludes more than `MAX_MASKED`, and how many were read so far."""
        return sum(self._masked.values()), len(self._masked)

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _use_stream(self) -> None:
        if self._stream is not None:
            torch.cuda.set_stream(self._stream)

    def _plan(self, step: int) -> _Plan:
        indices = [self._train[view] for view in self._sampler.batch(step)]
        reduction = self._sampler.reduction(step)
        backgrounds = self._sampler.backgrounds(step) if self._random_background else None
        width, height = self._views.size(indices, reduction)
        if self._owners is None:
            return _Plan(indices, None, [(0, height)] * len(indices), reduction, backgrounds)
        # This is done in the caller's thread and not in the other one, and always as many steps ahead: at
        # this point all ranks know the same costs. Those of another resolution belong to another number of
        # tiles, and are not used.
        ranges = self._owners.plan(step, indices, width, height, halo=LOSS_HALO)
        return _Plan(indices, ranges, ranges.pixel_rows(self._owners.ranks.rank), reduction, backgrounds)

    def _drop(self, step: int) -> None:
        if (loading := self._plans.pop(step).loading) is not None:
            with contextlib.suppress(OSError, ValueError):
                self._give_back(loading.result()[1])

    def _prefetch(self, plan: _Plan) -> None:
        plan.is_prefetched = True
        needed = [index for index, (y0, y1) in zip(plan.indices, plan.rows, strict=True) if y0 < y1]
        self._images.prefetch(needed, plan.indices, plan.reduction)

    def _has_room(self, batches: int, plan: _Plan) -> bool:
        """Tell whether this number of batches takes at most half of the memory for decoded images."""
        width, height = self._views.size(plan.indices, plan.reduction)
        size = 4 * width * height * len(plan.indices)  # images and masks
        return 2 * batches * size <= self._images.room()

    def _load(self, plan: _Plan) -> tuple[Batch, _Slot]:
        # Read before taking a slot, so that an unreadable image does not occupy one.
        needed = zip(plan.indices, plan.rows, strict=True)
        photographs = [self._read(index, *rows, plan.reduction) for index, rows in needed]
        slot = self._free.popleft()
        try:
            return self._fill(slot, plan, photographs), slot
        except BaseException:  # give the slot back, or it would be missing from then on
            self._give_back(slot)
            raise

    def _give_back(self, slot: _Slot) -> None:
        assert slot not in self._free, "two batches would share this memory; this is a bug, please report it"
        self._free.append(slot)

    def _read(self, index: int, y0: int, y1: int, reduction: int) -> _Photograph:
        size = self._views.size([index], reduction)
        try:
            mask = self._images.mask(index, reduction)
            strip = self._images.get(index, reduction).numpy()[y0:y1] if y0 < y1 else None
        except (OSError, ValueError) as error:
            if self._owners is None:
                raise
            self.lost = self.lost or str(error)
            return None, torch.zeros(size[::-1], dtype=torch.uint8), 3.0 * math.prod(size)
        if (index, reduction) not in self._sample_counts:
            counted = math.prod(size) if mask is None else int((mask != 0).sum())
            self._masked.setdefault(index, counted < (1.0 - MAX_MASKED) * math.prod(size))
            self._sample_counts[index, reduction] = float(max(1, 3 * counted))
        return strip, mask, self._sample_counts[index, reduction]

    def _fill(self, slot: _Slot, plan: _Plan, photographs: list[_Photograph]) -> Batch:
        indices, rows = plan.indices, plan.rows
        count, (width, height) = len(indices), self._views.size(indices, plan.reduction)
        strips, masks, samples = zip(*photographs, strict=True)
        if self._stream is not None:
            slot.uploaded.synchronize()  # returns at once: this upload ended long ago
            self._stream.wait_event(slot.consumed)
        slot.reserve((count, height, width, any(mask is not None for mask in masks)))
        for view, (strip, (y0, y1)) in enumerate(zip(strips, rows, strict=True)):
            if strip is not None:
                slot.pixels[view, y0:y1] = strip
        for place, mask in zip(slot.included, masks, strict=False):  # no place where no view has a mask
            place[...] = 1 if mask is None else mask.numpy()
        self._views.write(indices, slot.views, plan.reduction)
        slot.samples[:] = samples
        if plan.backgrounds is not None:
            slot.backgrounds[:] = plan.backgrounds.flatten().numpy()
        slot.upload(rows)
        if self._stream is not None:
            slot.uploaded.record(self._stream)
        return slot.batch(plan)
