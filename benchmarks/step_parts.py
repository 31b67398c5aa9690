# SPDX-License-Identifier: Apache-2.0
"""Times the parts of a training step, on the host and on the device."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

# Names of the calls in which the host waits for CUDA.
_WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize", "cudaMemcpy")


class Parts:
    """The times of named parts of steps.

    Between two parts nothing waits for the device, so a part's device time is what lies between its begin and
    its end on the device: its kernels, and pauses in which the device has nothing to do because the host is
    late. If the host's times of all parts add up to the time of a step, the host limits it.
    """

    def __init__(self, device: torch.device) -> None:
        """Time parts on a device."""
        self._cuda = device.type == "cuda"
        self._host: dict[str, float] = defaultdict(float)
        self._events: list[tuple[str, Any, Any]] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the time of the block to the part `name`."""
        begin = self._mark()
        start = time.perf_counter()
        yield
        self._host[name] += time.perf_counter() - start
        self._events.append((name, begin, self._mark()))

    def rows(self, steps: int) -> list[dict[str, Any]]:
        """Return the times of each part per step, in milliseconds."""
        device: dict[str, float] = defaultdict(float)
        if self._cuda:
            torch.cuda.synchronize()
            for name, begin, end in self._events:
                device[name] += begin.elapsed_time(end)
        rows = [
            {"part": name, "host, ms": spent / steps * 1e3, "device, ms": device[name] / steps}
            for name, spent in self._host.items()
        ]
        total = {key: sum(row[key] for row in rows) for key in ("host, ms", "device, ms")}
        return [*rows, {"part": "all", **total}]

    def _mark(self) -> Any:
        if not self._cuda:
            return None
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


def trace(run: Callable[[], object], steps: int, device: torch.device) -> tuple[dict[str, Any], str]:
    """Run some steps under torch's profiler.

    Args:
        run: takes the steps.
        steps: their number.
        device: the device they run on.

    Returns:
        Per step: number of torch ops (those called by other ops included), launches of kernels, waits of the
        host, and the kernels' time; and a table of the kernels, or on the CPU the ops, that take most time.
    """
    cuda = device.type == "cuda"
    activities = [torch.profiler.ProfilerActivity.CPU]
    if cuda:
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profile:
        run()
        if cuda:
            torch.cuda.synchronize()
    found = profile.key_averages()
    on_device = [e for e in found if e.device_type == torch.autograd.DeviceType.CUDA]
    calls = {e.key: e.count for e in found if e.device_type == torch.autograd.DeviceType.CPU}
    counts = {
        "torch ops": sum(count for key, count in calls.items() if "::" in key),
        "launches": sum(count for key, count in calls.items() if "Launch" in key),
        "waits": sum(count for key, count in calls.items() if key in _WAITS),
        "kernels, ms": sum(e.self_device_time_total for e in on_device) / 1e3,
    }
    sort_by = "self_device_time_total" if cuda else "self_cpu_time_total"
    table = found.table(sort_by=sort_by, row_limit=40, max_name_column_width=70)
    return {key: value / steps for key, value in counts.items()}, table
