# SPDX-License-Identifier: Apache-2.0
"""Spreads work on the city over processes that share it without copying it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

import cv2

from blitzgs.util.processes import follow_parent

T = TypeVar("T")
_task: Callable[[int], Any]  # the task of the forked processes, which share this memory


def each(task: Callable[[int], T], count: int, processes: int) -> Iterator[T]:
    """Yield task(0), task(1), ..., task(count - 1), in this order.

    The processes are forked, so that `task` may hold gigabytes, as a closure does; only indices and results
    are sent. They end with this process, however it ends.

    Args:
        task: called in other processes, or in this one if there is only one.
        count: number of calls.
        processes: number of processes that share the calls.

    Raises:
        BrokenProcessPool: a process was killed, for example because memory ran out.
    """
    cv_threads = cv2.getNumThreads()
    # Every core runs a call of its own, and a forked process can neither use nor end OpenCV's threads.
    cv2.setNumThreads(1)
    try:
        if processes == 1:
            yield from map(task, range(count))
        else:
            yield from _forked(task, count, processes)
    finally:
        cv2.setNumThreads(cv_threads)


def _forked(task: Callable[[int], T], count: int, processes: int) -> Iterator[T]:
    global _task
    _task = task
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(min(processes, count), context, follow_parent) as pool:
        try:
            yield from pool.map(_call, range(count))
        except BaseException:
            pool.shutdown(cancel_futures=True)  # otherwise leaving the pool would first make every call
            raise


def _call(index: int) -> Any:
    return _task(index)
