# SPDX-License-Identifier: Apache-2.0
"""Ends a job whose ranks no longer move together, and says which rank is to blame.

Each rank publishes what it is doing in the job's key-value store, from a thread of its own. A rank that has
waited in a collective for longer than the timeout reads what the others published, prints which of them
never arrived, and exits; torchrun then ends the job. A rank that raises publishes its error first, so that
the others report the culprit's message and not a closed socket; those that wait for it end at once.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from datetime import timedelta

from torch._C._distributed_c10d import PrefixStore, TCPStore

EXIT_STUCK = 75  # EX_TEMPFAIL: a restart may help
# How long a rank goes on waiting when another is known to have failed.
GRACE_SECONDS = 4.0


def open_store(name: str, host: bool, timeout_seconds: float) -> PrefixStore:
    """Connect to the job's key-value store, where MASTER_ADDR and MASTER_PORT say.

    Keys carry `name` and the number of the restart: torchrun keeps the store over restarts, and a new rank
    must not find the addresses of the one it replaces.

    Args:
        name: of this use of the store.
        host: whether this process serves the store when torchrun's agent does not.
        timeout_seconds: for connecting and waiting.
    """
    held_by_agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    store = TCPStore(
        os.environ["MASTER_ADDR"],
        int(os.environ["MASTER_PORT"]),
        is_master=host and not held_by_agent,
        wait_for_workers=False,
        multi_tenant=True,
        timeout=timedelta(seconds=timeout_seconds),
    )
    return PrefixStore(f"blitzgs/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}/{name}", store)


class Watchdog:
    """The progress of one rank, published every few seconds and checked against the other ranks'.

    Args:
        rank: this rank.
        world_size: number of ranks.
        timeout_seconds: longest wait inside one collective.
    """

    def __init__(self, rank: int, world_size: int, timeout_seconds: float) -> None:
        self.rank = rank
        self.world_size = world_size
        self.timeout_seconds = timeout_seconds
        self.period = self.period_for(timeout_seconds)
        # A connection of its own: the process group's may block inside a collective.
        self.store = open_store("watchdog", host=False, timeout_seconds=30)
        self.lock = threading.Lock()
        self.calls = 0
        self.name = "start"
        self.waiting_since: float | None = None
        self.stopping = threading.Event()
        self.thread = threading.Thread(target=self._run, name="blitzgs-watchdog", daemon=True)
        self._publish()
        self.thread.start()

    @staticmethod
    def period_for(timeout_seconds: float) -> float:
        """Seconds between two looks at the clock."""
        return min(2.0, timeout_seconds / 5)

    def enter(self, name: str) -> None:
        """Note that this rank waits in a collective."""
        self.calls += 1
        self.name = name
        self.waiting_since = time.monotonic()

    def leave(self) -> None:
        """Note that the collective is done."""
        self.waiting_since = None

    def report_failure(self, message: str) -> None:
        """Publish why this rank is about to end, for the others to quote; the first of the job counts."""
        try:
            with self.lock:
                self.store.compare_set("failure", "", f"rank {self.rank} failed: {message}")
        except RuntimeError:
            pass  # the store's host ended first; our own traceback remains

    def stop(self) -> None:
        """Stop watching."""
        self.stopping.set()
        self.thread.join(timeout=5)

    def diagnose(self, name: str) -> str:
        """Say which rank broke the collective `name`, as far as the store knows."""
        # The culprit's own message may still be on its way.
        for _ in range(10):
            failure = self._first_failure()
            if failure:
                return f"rank {self.rank}: {name} failed because {failure}"
            if self.stopping.wait(0.2):
                break
        try:
            late = self._late_ranks()
        except RuntimeError:
            return f"rank {self.rank}: {name} failed and the job's store is gone (its host process ended)"
        if late:
            return f"rank {self.rank}: {name} failed; {late}"
        return f"rank {self.rank}: {name} failed; another rank ended or lost its connection"

    def _first_failure(self) -> str | None:
        try:
            with self.lock:
                if self.store.check(["failure"]):
                    return str(self.store.get("failure").decode())
        except RuntimeError:
            return None
        return None

    def _late_ranks(self) -> str:
        """List the ranks that have entered fewer collectives than this one, or stopped publishing."""
        late = []
        with self.lock:
            for rank in range(self.world_size):
                if rank == self.rank or not self.store.check([f"progress/{rank}"]):
                    continue
                calls, name, stamp = json.loads(self.store.get(f"progress/{rank}"))
                silent = time.time() - stamp
                if silent > 3 * self.period + 1:
                    late.append(f"rank {rank} has not been heard of for {silent:.0f} s (last in {name})")
                elif calls < self.calls:
                    late.append(f"rank {rank} has not arrived (last collective: {name}, number {calls})")
        return "; ".join(late)

    def _publish(self) -> None:
        with self.lock:
            self.store.set(f"progress/{self.rank}", json.dumps([self.calls, self.name, time.time()]))

    def _run(self) -> None:
        while not self.stopping.wait(self.period):
            try:
                self._publish()
                since = self.waiting_since
                if since is None:
                    continue
                waited, limit = time.monotonic() - since, self.timeout_seconds
                # A rank that has failed comes to no collective any more; Gloo may yet say so itself.
                if waited > GRACE_SECONDS and self._first_failure():
                    limit = min(limit, GRACE_SECONDS)
                if waited > limit:
                    self._abort(f"waited {limit:.0f} s in {self.name}")
            except RuntimeError:
                return  # the store's host is gone; the collectives report that themselves

    def _abort(self, reason: str) -> None:
        blame = self._first_failure() or self._late_ranks() or "no rank is known to be late"
        message = f"rank {self.rank}: {reason}: {blame}. Ending the job."
        print(message, file=sys.stderr, flush=True)
        self.report_failure(message)
        # The main thread is inside a collective that cannot be interrupted.
        os._exit(EXIT_STUCK)
