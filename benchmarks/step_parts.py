# SPDX-License-Identifier: Apache-2.0
"""Times the parts of a training step, on the host and on the device."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch.profiler import record_function

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


class TracedParts:
    """Marks named parts of steps, so that `trace` counts the work of each.

    Attributes:
        names: of the parts, in the order in which they began.
    """

    def __init__(self) -> None:
        """Begin without parts."""
        self.names: dict[str, None] = {}

    def __call__(self, name: str) -> record_function:
        """Return the context of a part."""
        self.names[name] = None
        return record_function(name)


def trace(
    run: Callable[[], object], steps: int, device: torch.device, parts: TracedParts | None = None
) -> tuple[list[dict[str, Any]], float, str]:
    """Run some steps under torch's profiler.

    Args:
        run: takes the steps.
        steps: their number.
        device: the device they run on.
        parts: marks the parts of the steps.

    Returns:
        Per step, for each part and at the end for all: number of torch ops (those called by other ops
        included), launches of kernels, waits of the host; the kernels' time in a step, in milliseconds; and a
        table of the kernels, or on the CPU the ops, that take most time.
    """
    cuda = device.type == "cuda"
    activities = [torch.profiler.ProfilerActivity.CPU]
    if cuda:
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profile:
        run()
        if cuda:
            torch.cuda.synchronize()
    found, names = profile.key_averages(), {} if parts is None else parts.names
    on_host = [e for e in profile.events() if e.device_type == torch.autograd.DeviceType.CPU]
    spans = {name: [e.time_range for e in on_host if e.name == name] for name in names}
    rows = [
        {"part": name, **_counts([e for e in on_host if any(_within(e.time_range, s) for s in own)], steps)}
        for name, own in spans.items()
    ]
    # The device has events for the parts too, whose time is that of their kernels.
    kernels = [e for e in found if e.device_type == torch.autograd.DeviceType.CUDA and e.key not in names]
    kernel_ms = sum(e.self_device_time_total for e in kernels) / 1e3 / steps
    rows.append({"part": "all", **_counts(on_host, steps)})
    sort_by = "self_device_time_total" if cuda else "self_cpu_time_total"
    table = found.table(sort_by=sort_by, row_limit=40, max_name_column_width=70)
    return rows, kernel_ms, table


def _counts(events: Sequence[Any], steps: int) -> dict[str, float]:
    """Return per step how many events of the host are torch ops, launches and waits."""
    names = [event.name for event in events]
    return {
        "torch ops": sum("::" in name for name in names) / steps,
        "launches": sum("Launch" in name for name in names) / steps,
        "waits": sum(name in _WAITS for name in names) / steps,
    }


def _within(span: Any, whole: Any) -> bool:
    return bool(whole.start <= span.start and span.end <= whole.end)
