# SPDX-License-Identifier: Apache-2.0
"""Timing for the benchmarks: medians by device events, and the copy bandwidth that floors refer to."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch


def median_ms(
    function: Callable[..., Any], inputs: Sequence[tuple[Any, ...]], repeats: int = 30, warm_up: int = 5
) -> float:
    """Return the median milliseconds of ``function(*inputs[i])``, rotating among the input sets.

    The sets together must be larger than the last-level cache; otherwise the cache is measured.
    """
    cuda = any(torch.is_tensor(x) and x.is_cuda for x in _flatten(inputs))
    for i in range(warm_up):
        function(*inputs[i % len(inputs)])
    times = []
    for i in range(repeats):
        arguments = inputs[i % len(inputs)]
        if cuda:
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            torch.cuda._sleep(
                200_000
            )  # keeps the device busy while the work is queued, so that there are no gaps between launches
            start.record()
            function(*arguments)
            end.record()
            end.synchronize()
            times.append(start.elapsed_time(end))
        else:
            begin = time.perf_counter()
            function(*arguments)
            times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times)


class Clock:
    """Time between marks on the device."""

    def __init__(self) -> None:
        self.marks: list[tuple[str, torch.cuda.Event]] = []
        self.mark("")

    def mark(self, stage: str) -> None:
        """End a stage."""
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self.marks.append((stage, event))

    def stages(self) -> list[tuple[str, float]]:
        """Return name and time of each stage, in order."""
        torch.cuda.synchronize()
        return [(name, begin.elapsed_time(end))
                for (_, begin), (name, end) in zip(self.marks, self.marks[1:], strict=False)]  # fmt: skip


def _flatten(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return [leaf for item in value for leaf in _flatten(item)]
    return [value]


def copy_bandwidth(device: torch.device | str, megabytes: int = 2048) -> float:
    """Return the GB/s (read plus written) of a device-to-device copy."""
    source = torch.empty(megabytes << 20, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    milliseconds = median_ms(lambda a, b: b.copy_(a), [(source, target)], repeats=10)
    return 2 * source.numel() / milliseconds / 1e6
