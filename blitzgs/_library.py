# SPDX-License-Identifier: Apache-2.0
"""Loads the op libraries once, when `blitzgs.ops` is first imported."""

from __future__ import annotations

from pathlib import Path

import torch

from blitzgs import _fakes
from blitzgs._built import LIBRARY_DIR, REGISTRATION, schema_digest, source_digest
from blitzgs._torch import below_autograd

__all__ = ["below_autograd", "load_libraries", "schema_digest", "source_digest"]


def load_libraries() -> None:
    """Register the CPU kernels, and the CUDA kernels when this torch can use a GPU.

    ImportError: a library was not built, or was built before the list of ops changed; the message says how to
    build it.
    """
    _load(LIBRARY_DIR / "libblitzgs_cpu.so")
    if torch.cuda.is_available():
        _load(LIBRARY_DIR / "libblitzgs_cuda.so")


def _load(path: Path) -> None:
    if not path.exists():
        remedy = "Run `pip install .` (or `make build` in a checkout)"
        if path == LIBRARY_DIR / "libblitzgs_cuda.so":
            remedy += " with nvcc (CUDA toolkit) on the PATH, or hide the GPUs (CUDA_VISIBLE_DEVICES=)"
        raise ImportError(f"{path} is missing: the kernels are not built. {remedy}.")
    torch.ops.load_library(str(path))
    if REGISTRATION.exists() and schema_digest(path) != source_digest(REGISTRATION):
        raise ImportError(
            f"{path} was built before the ops changed (it does not match {REGISTRATION}): run `make build`"
        )


load_libraries()
_fakes.register()
