# SPDX-License-Identifier: Apache-2.0
"""Ends a job in which a rank no longer arrives at collectives, and names that rank.

Each rank publishes what it is doing in the job's key-value store, from a thread of its own. A rank that has
waited in a collective for long reads what the others published, and prints which of them have not arrived.
After the timeout it exits, or earlier if a rank no longer publishes; torchrun then ends the job. A rank that
raises publishes its error first, so that the others print its message instead of a message about a closed
socket; ranks that wait for it end at once. A rank that works on its host for long, for example on a slow
disk, announces this, and the others wait for it as long as it keeps publishing. All this begins before the
ranks join: a rank that fails earlier, or never starts, is named too.
"""

from __future__ import annotations

import atexit
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch.distributed import PrefixStore, TCPStore  # type: ignore[attr-defined]

from blitzgs.util.errors import UserError, printable

EXIT_STUCK = 75  # EX_TEMPFAIL: a restart may help
# How long a rank waits at least for the others to start, which includes importing torch from a slow disk.
START_SECONDS = 120.0
# How long a rank continues to wait after another rank has reported a failure.
GRACE_SECONDS = 4.0
# How long a rank waits until it names those that have not arrived.
PATIENCE_SECONDS = 20.0
# How long a rank waits for one that no longer publishes, which a long call into C++ may keep it from.
SILENCE_SECONDS = 60.0
# Longest time that ranks wait for a rank that keeps publishing and has announced its work.
BUSY_SECONDS = 3600.0


def open_store(name: str, host: bool, timeout_seconds: float) -> PrefixStore:
    """Connect to the job's key-value store at MASTER_ADDR and MASTER_PORT.

    Keys have a prefix of `name` and the number of the restart: torchrun keeps the store over restarts, and a
    new rank must not read the addresses of the rank that it replaces.

    `name`: name of this use of the store. `host`: whether this process serves the store if torchrun's agent
    does not. `timeout_seconds`: for connecting and waiting. UserError: the store cannot be had.
    """
    held_by_agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    try:
        store = TCPStore(
            address,
            port,
            is_master=host and not held_by_agent,
            wait_for_workers=False,
            multi_tenant=True,
            timeout=timedelta(seconds=timeout_seconds),
        )
    except RuntimeError as error:
        raise UserError(
            f"no way to {address}:{port} (MASTER_ADDR, MASTER_PORT) within {timeout_seconds:.0f} s: has the "
            f"host of rank 0 started and not ended, and can it be reached? ({str(error).splitlines()[0]})"
        ) from error
    return PrefixStore(f"blitzgs/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}/{name}", store)


def report_early_failure(message: str) -> None:
    """Publish why this process of a job ends, if it has not joined it yet; see `Watchdog.report_failure`."""
    rank = int(os.environ["RANK"])
    store = open_store("watchdog", host=rank == 0, timeout_seconds=5)
    store.compare_set("failure", "", f"rank {rank} failed: {message}")
    time.sleep(1.0)  # the store may end with this process: let the others read it


def early_failure() -> str | None:
    """Return why a process of this job has failed, for one that has not joined it yet; None: none is known.

    UserError: torchrun's store has ended.
    """
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        return None  # rank 0 serves the store, and only when it joins
    # Work of hours shall not end because the network or a busy host is slow for once.
    store = open_store("watchdog", host=False, timeout_seconds=60)
    return str(store.get("failure").decode()) if store.check(["failure"]) else None


@dataclass(frozen=True)
class _Report:
    """The latest report of a rank."""

    calls: int  # number of collectives entered
    name: str  # name of the last one
    stamp: float  # when it was published, seconds since 1970 by the rank's own clock
    busy: str  # the work on its host, or an empty string


class NoWatchdog:
    """Takes the place of a `Watchdog` in a process that waits for no other process; it does nothing."""

    def waiting(self, name: str) -> AbstractContextManager[None]:
        """See `Watchdog.waiting`, also for `working`."""
        return nullcontext()

    working = waiting

    def stop(self, message: str = "") -> None:
        """See `Watchdog.stop`, and `Watchdog.report_failure`."""

    report_failure = stop


class Watchdog:
    """Publishes the progress of one rank every few seconds, and compares it with that of the other ranks."""

    def __init__(self, rank: int, world_size: int, timeout_seconds: float) -> None:
        """Begin to watch; `timeout_seconds`: longest wait inside one collective."""
        self.rank = rank
        self.world_size = world_size
        self.timeout_seconds = timeout_seconds
        self.period = self.period_for(timeout_seconds)
        self.start_seconds = max(START_SECONDS, timeout_seconds)
        # A separate connection, because the process group's may block inside a collective.
        self.store = open_store("watchdog", rank == 0, self.start_seconds)
        self.lock = threading.Lock()
        self.calls = 0
        self.name = "start"
        self.busy = ""
        self.waiting_since: float | None = None
        # Of each rank: its last stamp, and when it was new here.
        self._heard: dict[int, tuple[float, float]] = {}
        self._announced = 0.0
        self._excused = 0.0  # when a late rank was last seen at work
        self.stopping = threading.Event()
        self.thread = threading.Thread(target=self._run, name="blitzgs-watchdog", daemon=True)
        self._publish()
        self.thread.start()
        # A process that ends without leaving its job would be aborted if the thread is inside the store then.
        atexit.register(self.stop)

    @staticmethod
    def period_for(timeout_seconds: float) -> float:
        """Return the seconds between two checks of the clock."""
        return min(2.0, timeout_seconds / 5)

    def await_start(self) -> None:
        """Wait until all ranks have made their watchdog (UserError: one has failed, or has not come)."""
        keys = {rank: f"progress/{rank}" for rank in range(self.world_size)}
        begin, told = time.monotonic(), False
        while True:
            try:
                with self.lock:
                    if self.store.check(list(keys.values())):
                        return
                    missing = [str(rank) for rank, key in keys.items() if not self.store.check([key])]
            except RuntimeError as error:
                text = "the job's store is gone: the process that served it has ended"
                raise UserError(f"rank {self.rank} has not begun, because {text}") from error
            if failure := self._first_failure():
                raise UserError(f"rank {self.rank} has not begun, because {failure}")
            waited = time.monotonic() - begin
            text = f"has waited {waited:.0f} s for ranks that have not started: {', '.join(missing)}"
            if waited > self.start_seconds:
                raise UserError(
                    f"rank {self.rank} {text}. Look for their errors in the output of their hosts; if they "
                    "are only slow, raise ranks.timeout_seconds"
                )
            if waited > PATIENCE_SECONDS and not told:
                told = True
                print(f"rank {self.rank}: {text}", file=sys.stderr, flush=True)
            time.sleep(0.2)

    @contextmanager
    def waiting(self, name: str) -> Iterator[None]:
        """Note, while the context lasts, that this rank waits for other ranks.

        Enter it for collectives, and to wait for this rank's device, which may itself be waiting for other
        ranks. A rank that has entered fewer of these contexts than another is called late, so all ranks must
        enter the same ones. UserError: the work in the context failed because of the rank that the message
        names; RuntimeError: that rank is not known. If this rank is out of memory, its own
        `torch.OutOfMemoryError` is raised instead, and its message is for the other ranks.
        """
        self.calls += 1
        self.name = name
        self.waiting_since = time.monotonic()
        try:
            yield
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            self.waiting_since = None
            if blame := self.diagnose():
                raise UserError(f"rank {self.rank}: {name} failed{blame}") from error
            text = f"rank {self.rank}: {name} failed; another rank ended or lost its connection ({error})"
            raise RuntimeError(text) from error
        finally:
            self.waiting_since = None

    @contextmanager
    def working(self, what: str) -> Iterator[None]:
        """Announce to the other ranks, while the context lasts, with what this rank is busy on its host."""
        before, self.busy = self.busy, what
        self._try_to_publish()
        try:
            yield
        finally:
            self.busy = before
            self._try_to_publish()

    def report_failure(self, message: str) -> None:
        """Publish why this rank is about to end; the others print the first such message of the job."""
        try:
            with self.lock:
                self.store.compare_set("failure", "", f"rank {self.rank} failed: {message}")
        except RuntimeError:
            pass  # the store's host ended first; our own traceback remains

    def stop(self) -> None:
        """Stop watching."""
        atexit.unregister(self.stop)
        self.stopping.set()
        self.thread.join(timeout=5)

    def diagnose(self) -> str:
        """Return which rank broke a collective, as the end of a sentence; empty: the store does not say."""
        # The failed rank's message may not have arrived yet, and a live rank publishes within one period.
        for _ in range(10 + int(5 * self.period)):
            with suppress(RuntimeError):
                self._listen()
            if failure := self._first_failure():
                return f" because {failure}"
            if self.stopping.wait(0.2):
                break
        try:
            late = self._late_ranks()
        except RuntimeError:
            return " and the job's store is gone (its host process ended)"
        return f"; {late}" if late else ""

    def _first_failure(self) -> str | None:
        try:
            with self.lock:
                if self.store.check(["failure"]):
                    return str(self.store.get("failure").decode())
        except RuntimeError:
            return None
        return None

    def _listen(self) -> dict[int, _Report]:
        """Read the other ranks' reports, and note which reports are new."""
        reports = {}
        with self.lock:
            for rank in range(self.world_size):
                if rank != self.rank and self.store.check([f"progress/{rank}"]):
                    reports[rank] = _Report(*json.loads(self.store.get(f"progress/{rank}")))
        for rank, report in reports.items():
            # Measure by this host's clock, because the clocks of other hosts may be wrong.
            if rank not in self._heard or self._heard[rank][0] != report.stamp:
                self._heard[rank] = (report.stamp, time.monotonic())
        return reports

    def _is_silent(self, rank: int) -> bool:
        return self._silence(rank) > 1.5 * self.period

    def _silence(self, rank: int) -> float:
        return time.monotonic() - self._heard[rank][1]

    def _late_ranks(self) -> str:
        """List the ranks that have entered fewer collectives than this one, or stopped publishing."""
        late = []
        for rank, report in self._listen().items():
            if self._is_silent(rank):
                silent = f"has stopped reporting {self._silence(rank):.0f} s ago"
                late.append(f"rank {rank} {silent}: it was killed or its host is gone")
            elif report.calls < self.calls:
                doing = report.busy or f"last collective: {report.name}, number {report.calls}"
                late.append(f"rank {rank} has not arrived ({doing})")
        return "; ".join(late)

    def _waits_for_work(self) -> bool:
        """Tell whether some ranks are late, and all of them work on their host."""
        reports = self._listen()
        late = [report for report in reports.values() if report.calls < self.calls]
        return bool(late) and all(report.busy for report in late) and not any(map(self._is_silent, reports))

    def _publish(self) -> None:
        content = json.dumps([self.calls, self.name, time.time(), self.busy])
        with self.lock:
            self.store.set(f"progress/{self.rank}", content)

    def _try_to_publish(self) -> None:
        # Where the store's host ended first, the next collective says so.
        with suppress(RuntimeError):
            if not self.stopping.is_set():  # else torch would print a trace of C++ each time
                self._publish()

    def _run(self) -> None:
        last = time.monotonic()
        while not self.stopping.wait(self.period):
            last, before = time.monotonic(), last
            if last - before > self.period + PATIENCE_SECONDS / 2:
                # The host has stopped this process, perhaps the whole job, and now continues it.
                self._excused = last
                self._heard = {rank: (stamp, last) for rank, (stamp, _) in self._heard.items()}
            try:
                self._publish()
                since = self.waiting_since
                if since is None:
                    continue
                self._listen()
                waited, limit = time.monotonic() - since, self.timeout_seconds
                # A failed rank will not arrive at any collective. Gloo may still report that first.
                if waited > GRACE_SECONDS and self._first_failure():
                    limit = min(limit, GRACE_SECONDS)
                elif any(self._silence(rank) > SILENCE_SECONDS for rank in self._heard):
                    limit = min(limit, SILENCE_SECONDS)
                if limit < waited < BUSY_SECONDS and not self._first_failure() and self._waits_for_work():
                    self._excused = time.monotonic()
                # A rank that has finished its work needs some time to arrive and to publish that.
                if time.monotonic() - max(since, self._excused) > limit:
                    self._abort(f"waited {limit:.0f} s in {self.name}")
                if waited > min(limit, PATIENCE_SECONDS) and (late := self._late_ranks()):
                    self.announce(late, waited)
            except RuntimeError:
                # Collectives need no store: they go on, and report themselves what fails.
                self.stopping.set()
                if self.calls > 0:
                    print(
                        f"rank {self.rank}: the job's store cannot be reached (was torchrun killed?): "
                        f"process {os.getpid()} works on without it, and SIGTERM stops it",
                        file=sys.stderr,
                        flush=True,
                    )

    def announce(self, late: str, waited: float) -> None:
        """Print about once a minute which ranks this one waits for."""
        if time.monotonic() - self._announced > 60:
            self._announced = time.monotonic()
            text = f"rank {self.rank}: has waited {waited:.0f} s in {self.name}: {late}"
            print(printable(text), file=sys.stderr, flush=True)

    def _abort(self, reason: str) -> None:
        blame = self._first_failure() or self._late_ranks() or "no rank is known to be late"
        message = f"{reason}: {blame}"
        print(printable(f"rank {self.rank}: {message}. Ending the job."), file=sys.stderr, flush=True)
        self.report_failure(message)
        # The main thread is inside a collective that cannot be interrupted.
        os._exit(EXIT_STUCK)
