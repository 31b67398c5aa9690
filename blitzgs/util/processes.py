# SPDX-License-Identifier: Apache-2.0
"""What processes do that share the work of a command."""

import ctypes
import multiprocessing
import os
import signal

_PR_SET_PDEATHSIG = 1  # of prctl(2)


def follow_parent() -> None:
    """Make this process leave interrupts to the one that started it, and end with it, however that ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # it has ended before this process asked to know
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
