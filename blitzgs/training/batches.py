# SPDX-License-Identifier: Apache-2.0
"""The photographs of each step's batch, decoded and uploaded ahead of the step that needs them."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

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
        targets: uint8 [B, H, W, 3].
        masks: uint8 [B, H, W], 0 = pixel left out; None when no view of the batch has a mask.
    """

    indices: list[int]
    targets: Tensor
    masks: Tensor | None


class BatchLoader:
    """Serves the batches of consecutive steps; a thread stays some batches ahead.

    On CUDA, images go through pinned memory and a stream of their own, so that uploads overlap the kernels.
    """

    def __init__(
        self, images: Images, train: list[int], sampler: BatchSampler, device: torch.device, ahead: int
    ) -> None:
        """Prepare to serve.

        Args:
            images: the photographs.
            train: camera of each of the sampler's views.
            sampler: chooses the views of each step.
            device: where the batches go.
            ahead: batches to prepare beyond the one asked for; 0 works in the calling thread's time.
        """
        self._images = images
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
                self._images.prefetch(indices)
                self._pending[ahead] = self._worker.submit(self._load, indices)
        batch, uploaded = self._pending.pop(step).result()
        if uploaded is not None:
            stream = torch.cuda.current_stream(self._device)
            stream.wait_event(uploaded)
            for tensor in (batch.targets, batch.masks):
                if tensor is not None:
                    tensor.record_stream(stream)
        return batch

    def close(self) -> None:
        """Stop the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _load(self, indices: list[int]) -> tuple[Batch, torch.cuda.Event | None]:
        targets = torch.stack([self._images.get(index) for index in indices])
        masks = stack_masks([self._images.mask(index) for index in indices], targets)
        if self._stream is None:
            return Batch(indices, targets, masks), None
        with torch.cuda.stream(self._stream):
            on_device = targets.pin_memory().to(self._device, non_blocking=True)
            if masks is not None:
                masks = masks.pin_memory().to(self._device, non_blocking=True)
            uploaded = torch.cuda.Event()
            uploaded.record(self._stream)
        return Batch(indices, on_device, masks), uploaded


def stack_masks(masks: list[Tensor | None], targets: Tensor) -> Tensor | None:
    """Stack the masks of a batch; a view without one counts everywhere. None when no view has one."""
    if all(mask is None for mask in masks):
        return None
    whole = torch.ones(targets.shape[1:3], dtype=torch.uint8)
    return torch.stack([whole if mask is None else mask for mask in masks])
