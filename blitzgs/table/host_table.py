# SPDX-License-Identifier: Apache-2.0
"""A table of Gaussians in host memory, whose columns a GPU can read and write."""

from __future__ import annotations

import contextlib
import math
import mmap
import weakref

import torch
from torch import Tensor

from blitzgs.ops.blocks import take_rows
from blitzgs.table.table import GROWTH, GaussianTable
from blitzgs.util.errors import UserError, amount
from blitzgs.util.memory import available_bytes


class HostMemoryError(UserError):
    """The host has too little memory for the table; the message names the sizes and a remedy."""


class HostTable(GaussianTable):
    """Columns in host memory that is reused while rows are added and removed; pinned if a GPU reads it.

    Pinning memory takes longer than filling it, so a changed column is copied into the memory of the old one.
    """

    def __init__(self, columns: dict[str, Tensor], pinned: bool) -> None:
        """Move the given columns, one by one, into memory that the table owns.

        `columns`: as for `GaussianTable`, on the CPU; the dictionary is emptied. `pinned`: whether a GPU will
        read and write the columns. HostMemoryError: the columns do not fit into the host's memory.
        """
        super().__init__(columns)
        self._pinned = pinned
        for name in list(columns):
            del columns[name]
            self._store_raw(name, self.columns[name])

    def _store_raw(self, name: str, tensor: Tensor) -> None:
        if not fits(self._memory.get(name), tensor, len(tensor)):
            # Free the old memory first, so that the host never holds both.
            self._memory.pop(name, None)
            self.columns[name] = tensor
            self._memory[name] = self._allocate(tensor, int(GROWTH * len(tensor)))
        self.columns[name] = self._memory[name][: len(tensor)].copy_(tensor)

    def _allocate(self, like: Tensor, rows: int) -> Tensor:
        """Allocate memory for rows like those of a tensor, on separate pages."""
        rows = max(1, rows)
        size = rows * like.element_size() * math.prod(like.shape[1:])
        available = available_bytes()
        if size > available:
            raise HostMemoryError(
                f"a column of {len(like):,} Gaussians needs {amount(size)} in the memory of the host, which "
                f"has {amount(available)} left: use more memory or hosts, or cap population.max_gaussians"
            )
        pages = mmap.mmap(-1, max(1, size), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        for advice in ("MADV_HUGEPAGE", "MADV_DONTFORK"):  # fewer pages to pin; a fork must not copy them
            with contextlib.suppress(AttributeError, OSError):
                pages.madvise(getattr(mmap, advice))
        view = memoryview(pages)
        memory = torch.frombuffer(view, dtype=torch.uint8, count=max(1, size))[:size]
        if self._pinned and size:
            address = memory.data_ptr()
            error = int(torch.cuda.cudart().cudaHostRegister(address, size, 0))
            if error:
                raise HostMemoryError(
                    f"{amount(size)} of the host's memory cannot be pinned (CUDA error {error}): use a host "
                    "with more memory, or cap population.max_gaussians"
                )
            weakref.finalize(view, _unpin, address, pages)
        return memory.view(like.dtype).view(rows, *like.shape[1:])

    def _reorder(self, name: str, order: Tensor) -> None:
        self._store(name, *take_rows([self[name]], order))


def fits(memory: Tensor | None, like: Tensor, rows: int) -> bool:
    """Tell whether memory can hold some rows of a column."""
    if memory is None or memory.dtype != like.dtype:
        return False
    return memory.shape[1:] == like.shape[1:] and len(memory) >= rows


def _unpin(address: int, _pages: mmap.mmap) -> None:
    """Unpin memory after its last tensor is deleted. Holding `_pages` keeps them mapped until then."""
    torch.cuda.cudart().cudaHostUnregister(address)
