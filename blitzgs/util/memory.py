# SPDX-License-Identifier: Apache-2.0
"""How much memory this process may use, of its host or of its container or job (Linux, control groups 2)."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

_HOST = Path("/proc/meminfo")
_OWN_GROUP = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")


def host_bytes() -> int:
    """Return the bytes of memory that this host has, or that its container or job may use."""
    return min(_host("MemTotal"), *(limit for limit, _ in _limits()))


def available_bytes() -> int:
    """Return how many bytes can be allocated without swapping, and within the limits of container and job."""
    return max(0, min(_host("MemAvailable"), *(limit - used for limit, used in _limits())))


def _host(name: str) -> int:
    return 1024 * int(re.findall(rf"(?m)^{name}: +(\d+) kB", _HOST.read_text())[0])


def _limits() -> list[tuple[int, int]]:
    """Return limit and use of each group of this process, in bytes; the system frees caches of files."""
    found = [(1 << 62, 0)]  # no limit
    with suppress(OSError):
        own = re.search(r"(?m)^0::/(.*)$", _OWN_GROUP.read_text())
        group = _GROUPS / (own[1] if own else "")
        while group.is_relative_to(_GROUPS):
            with suppress(OSError, ValueError):  # the limit "max", or the host's root, which has none
                limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
                caches = re.findall(r"(?m)^(?:in)?active_file (\d+)$", (group / "memory.stat").read_text())
                found.append((limit, used - sum(map(int, caches))))
            group = group.parent
    return found
