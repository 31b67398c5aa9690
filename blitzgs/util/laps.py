# SPDX-License-Identifier: Apache-2.0
"""Measures the consecutive parts of a work."""

from __future__ import annotations

import time

import psutil


class Laps:
    """The seconds of consecutive parts.

    Attributes:
        seconds: of each part so far, in order.
    """

    def __init__(self, since_start: bool = False) -> None:
        """Begin the first part now, or (`since_start`) at the start of this process."""
        self.seconds: dict[str, float] = {}
        self._last = psutil.Process().create_time() if since_start else time.time()

    def lap(self, name: str) -> None:
        """End a part, which is called `name`, and begin the next one."""
        now = time.time()
        self.seconds[name] = self.seconds.get(name, 0.0) + max(0.0, now - self._last)
        self._last = now

    def text(self) -> str:
        """Return all parts in a line."""
        parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in self.seconds.items())
        return f"set-up {sum(self.seconds.values()):.1f} s: {parts}"
