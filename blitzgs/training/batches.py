# SPDX-License-Identifier: Apache-2.0
"""The photographs of each step's batch, decoded and uploaded ahead of the step that needs them."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from blitzgs.distributed.ownership import LOSS_REACH, TileOwners, TileRanges
from blitzgs.training.sampler import BatchSampler


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
    """One step's photographs on the device.

    Attributes:
        indices: cameras of the capture, B of them.
        targets: uint8 [B, H, W, 3]; on several ranks, zero beyond what this rank's loss reads.
        masks: uint8 [B, H, W], 0 = pixel left out; None when no view of the batch has a mask.
        samples: float32 [B], values that a view's mean is over: 3 x its pixels that count, at least 1.
        ranges: who composites which tiles; None on one rank.
    """

    indices: list[int]
    targets: Tensor
    masks: Tensor | None
    samples: Tensor
    ranges: TileRanges | None


class BatchLoader:
    """Serves the batches of consecutive steps; a thread stays some batches ahead.

    On CUDA, images go through pinned memory and a stream of their own, so that uploads overlap the kernels.
    """

    def __init__(
        self,
        images: Images,
        sizes: list[tuple[int, int]],
        train: list[int],
        sampler: BatchSampler,
        device: torch.device,
        ahead: int,
        owners: TileOwners | None = None,
    ) -> None:
        """Prepare to serve.

        Args:
            images: the photographs.
            sizes: width and height of each camera's image.
            train: camera of each of the sampler's views.
            sampler: chooses the views of each step.
            device: where the batches go.
            ahead: batches to prepare beyond the one asked for; 0 works in the calling thread's time.
            owners: divides the tiles of each batch; this rank then decodes and uploads only the pixel rows
                that its tiles' loss reads. None: everything.
        """
        self._images = images
        self._sizes = sizes
        self._owners = owners
        self._counts: dict[int, float] = {}
        self._train = train
        self._sampler = sampler
        self._device = device
        self._ahead = ahead
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._pending: dict[int, Future[tuple[Batch, torch.cuda.Event | None]]] = {}
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="batches")

    def get(self, step: int, last: int) -> Batch:
        """Return the batch of a step (0-based) and start on those that follow it, up to step `last` - 1."""
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
        batch, uploaded = self._pending.pop(step).result()
        if uploaded is not None:
            stream = torch.cuda.current_stream(self._device)
            stream.wait_event(uploaded)
            for tensor in (batch.targets, batch.masks, batch.samples):
                if tensor is not None:
                    tensor.record_stream(stream)
        return batch

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _divide(self, indices: list[int]) -> TileRanges | None:
        if self._owners is None:
            return None
        return self._owners.divide(indices, *self._sizes[indices[0]], reach=LOSS_REACH)

    def _rows(self, indices: list[int], ranges: TileRanges | None) -> list[tuple[int, int]]:
        """Pixel rows [y0, y1) of each view that this rank needs."""
        if ranges is None or self._owners is None:
            return [(0, self._sizes[index][1]) for index in indices]
        return [ranges.pixel_rows(self._owners.ranks.rank, view) for view in range(len(indices))]

    def _load(
        self, indices: list[int], ranges: TileRanges | None, rows: list[tuple[int, int]]
    ) -> tuple[Batch, torch.cuda.Event | None]:
        width, height = self._sizes[indices[0]]
        masks = [self._images.mask(index) for index in indices]
        samples = torch.tensor(
            [self._samples(index, mask) for index, mask in zip(indices, masks, strict=True)]
        )
        strips = [
            self._images.get(index)[y0:y1] if y0 < y1 else None
            for index, (y0, y1) in zip(indices, rows, strict=True)
        ]
        with torch.cuda.stream(self._stream):
            targets = torch.zeros(len(indices), height, width, 3, dtype=torch.uint8, device=self._device)
            for target, strip, (y0, y1) in zip(targets, strips, rows, strict=True):
                if strip is not None:
                    target[y0:y1] = self._upload(strip)
            whole = stack_masks(masks, width, height)
            batch = Batch(
                indices,
                targets,
                None if whole is None else self._upload(whole),
                self._upload(samples),
                ranges,
            )
            if self._stream is None:
                return batch, None
            uploaded = torch.cuda.Event()
            uploaded.record(self._stream)
        return batch, uploaded

    def _upload(self, tensor: Tensor) -> Tensor:
        if self._stream is None:
            return tensor
        return tensor.contiguous().pin_memory().to(self._device, non_blocking=True)

    def _samples(self, index: int, mask: Tensor | None) -> float:
        if index not in self._counts:
            width, height = self._sizes[index]
            counted = width * height if mask is None else int((mask != 0).sum())
            self._counts[index] = float(max(1, 3 * counted))
        return self._counts[index]


def stack_masks(masks: list[Tensor | None], width: int, height: int) -> Tensor | None:
    """Stack the masks of a batch; a view without one counts everywhere. None when no view has one."""
    if all(mask is None for mask in masks):
        return None
    whole = torch.ones(height, width, dtype=torch.uint8)
    return torch.stack([whole if mask is None else mask for mask in masks])
