# SPDX-License-Identifier: Apache-2.0
"""Starts what a process needs of the GPU's driver before torch asks for it, without the GIL."""

from __future__ import annotations

import ctypes
from contextlib import suppress


def initialise_nvml() -> None:
    """Initialise NVML, which torch's first shared memory needs; with several GPUs it may take seconds."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libnvidia-ml.so.1").nvmlInit_v2()


def make_context(local_rank: int) -> None:
    """Make the CUDA context of a rank's GPU, which torch then uses. Without a GPU nothing happens."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return
    count, device, context = ctypes.c_int(), ctypes.c_int(), ctypes.c_void_p()
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) or not count.value:
        return
    if not driver.cuDeviceGet(ctypes.byref(device), local_rank % count.value):
        driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
