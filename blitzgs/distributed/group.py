# SPDX-License-Identifier: Apache-2.0
"""The ranks of a job: their devices, the collectives between them, and their common end on failure."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from blitzgs.distributed.shared_memory import LEAST_WORDS, SharedMemory, control_words, symmetric_words
from blitzgs.distributed.watchdog import BUSY_SECONDS, NoWatchdog, Watchdog, open_store
from blitzgs.util.errors import UserError

if TYPE_CHECKING:
    from blitzgs.config.fields import Transport

T = TypeVar("T")
ReduceOp = Literal["sum", "max"]
_REDUCE_OPS = {"sum": dist.ReduceOp.SUM, "max": dist.ReduceOp.MAX}
_TRANSPORTS: tuple[Transport, ...] = ("auto", "peer", "collective")

DEFAULT_TIMEOUT_SECONDS = 120.0
# The environment variables that configure torch's CUDA allocator, the present one and the one before it.
ALLOCATOR_VARIABLES = ("PYTORCH_ALLOC_CONF", "PYTORCH_CUDA_ALLOC_CONF")
# For the first collective, before which NCCL builds the communicator.
STARTUP_TIMEOUT_SECONDS = 300.0
# Most ranks that can share memory.
MAX_PEERS = 16


class MismatchError(UserError):
    """The ranks were started with different configurations, code or data."""


@dataclass
class Ranks:
    """One process's view of the job. With `world_size` 1 no process group exists and every call is local."""

    rank: int = 0  # index of this process, 0 <= rank < world_size
    world_size: int = 1  # number of processes M
    local_world_size: int = 1  # number of processes on this host
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))  # where this rank computes
    # The job ends if a rank does not arrive at a collective within this time.
    timeout_seconds: float = DEFAULT_TIMEOUT_SECONDS
    shares_gpu: bool = False  # several ranks of this host compute on one GPU
    # Ends the job if a rank waits for another for too long; collectives and other waits for ranks run in its
    # `Watchdog.waiting`, and long work on the host in its `Watchdog.working`.
    watchdog: Watchdog | NoWatchdog = field(default_factory=NoWatchdog)
    memory: SharedMemory | None = None  # memory that the ranks share; None: splats are sent by collectives
    transport: str = "none: one rank"  # describes for the log how splats are sent

    @classmethod
    def from_environment(
        cls,
        device: str = "auto",
        timeout_seconds: float = DEFAULT_TIMEOUT_SECONDS,
        transport: Transport = "auto",
        share_gpus: bool = False,
        tables_on_host: bool = False,
        lap: Callable[[str], None] = lambda _: None,
    ) -> Ranks:
        """Join the job that torchrun's environment describes: Gloo on the CPU, NCCL on CUDA.

        NCCL does not support two ranks on one GPU. If ranks share GPUs, Gloo is used for CUDA tensors too.

        Args:
            device: "auto" (CUDA when this torch has a GPU), "cpu", "cuda" or "cuda:INDEX".
            timeout_seconds: see the class.
            transport: how splats are sent between ranks: "peer" writes them to the other GPUs' memory,
                "collective" sends them by NCCL or Gloo, "auto" uses "peer" if it works and "collective"
                otherwise.
            share_gpus: if a host has fewer GPUs than ranks, let several ranks use one GPU, in turns; slow,
                for development.
            tables_on_host: whether collectives will carry tensors that are on the CPU although the ranks
                compute on CUDA.
            lap: called with the name of each part of this work at its end (`Laps.lap`).

        Returns:
            The ranks; without torchrun, or with a single process, an object with `world_size` 1.

        Raises:
            ValueError: the CUDA device does not exist, the transport is unknown, or `share_gpus` was set for
                ranks of several hosts.
            RuntimeError: the other ranks did not join, or "peer" was requested and is impossible.
        """
        if transport not in _TRANSPORTS:
            raise ValueError(f"transport must be one of {', '.join(_TRANSPORTS)}, not {transport!r}")
        world_size = int(os.environ.get("WORLD_SIZE", "1"))
        rank = int(os.environ.get("RANK", "0"))
        local_rank = int(os.environ.get("LOCAL_RANK", "0"))
        local_world_size = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        if share_gpus and local_world_size < world_size:
            # Hosts with enough GPUs would choose NCCL, and the others Gloo.
            raise ValueError(
                f"share_gpus is for the ranks of one host, but {local_world_size} of {world_size} are on this"
                " one; leave it out, and start no more processes per node than it has GPUs"
            )
        _share_cores(local_world_size)
        chosen, shared = resolve_device(device, local_rank, local_world_size, share_gpus)
        if chosen.type == "cuda":
            extend_memory_in_place()
        ranks = cls(
            rank=rank,
            world_size=world_size,
            local_world_size=local_world_size,
            device=chosen,
            timeout_seconds=timeout_seconds,
            shares_gpu=shared,
        )
        if chosen.type == "cuda":
            torch.cuda.set_device(chosen)
            torch.cuda.synchronize()
        lap("device")
        if world_size > 1:
            ranks._join(transport, tables_on_host, lap)
        return ranks

    def _join(self, transport: Transport, tables_on_host: bool, lap: Callable[[str], None]) -> None:
        # Torch reads these variables whenever it maps shared memory. Multicast would not be used.
        os.environ.setdefault("TORCH_SYMM_MEM_DISABLE_MULTICAST", "1")
        if self.shares_gpu:
            os.environ["TORCH_SYMM_MEM_ALLOW_OVERLAPPING_DEVICES"] = "1"
        nccl = self.device.type == "cuda" and not self.shares_gpu
        self.watchdog = watchdog = Watchdog(self.rank, self.world_size, self.timeout_seconds)
        watchdog.await_start()
        watchdog.timeout_seconds = STARTUP_TIMEOUT_SECONDS
        with watchdog.waiting("init_process_group"):
            dist.init_process_group(
                backend="gloo" if not nccl else "cpu:gloo,cuda:nccl" if tables_on_host else "nccl",
                store=open_store("group", self.rank == 0, STARTUP_TIMEOUT_SECONDS),
                rank=self.rank,
                world_size=self.world_size,
                timeout=timedelta(seconds=STARTUP_TIMEOUT_SECONDS),
                device_id=self.device if nccl else None,
            )
        self.barrier()
        watchdog.timeout_seconds = self.timeout_seconds
        # The libraries' own timeouts name only a socket or an operation. The watchdog's timeout is shorter:
        # it names a rank, and it waits for ranks that are busy on their host.
        margin = 2.0 * Watchdog.period_for(self.timeout_seconds) + 10.0
        dist.distributed_c10d._set_pg_timeout(
            timedelta(seconds=max(self.timeout_seconds, BUSY_SECONDS) + margin), dist.group.WORLD
        )
        lap("processes")
        self._choose_transport(transport, self.timeout_seconds + margin)
        lap("shared memory")

    def _choose_transport(self, transport: Transport, timeout_seconds: float) -> None:
        memory: SharedMemory | str = "not asked for"
        if transport != "collective":
            memory = connect(self, timeout_seconds)
        if isinstance(memory, SharedMemory):
            others = "ranks' memory on shared GPUs" if self.shares_gpu else "GPUs' memory"
            self.memory, self.transport = memory, f"peer: splats are written to the other {others}"
        elif transport == "peer":
            raise RuntimeError(f"transport peer is impossible: {memory}; use auto or collective")
        else:
            self.transport = f"collective ({dist.get_backend()}); peer memory: {memory}"

    def __enter__(self) -> Ranks:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the job; if an exception caused this, tell the other ranks its message."""
        if error is None:
            self.close()
        else:
            # Do not destroy the process group: that could wait for ranks that have ended.
            self.watchdog.report_failure(f"{type(error).__name__}: {error}")
            self.watchdog.stop()

    def close(self) -> None:
        """Leave the job. Safe to call twice."""
        self.watchdog.stop()
        self.watchdog = NoWatchdog()
        self.memory = None
        if self.world_size > 1 and dist.is_initialized():
            dist.destroy_process_group()

    def all_reduce(self, tensor: Tensor, op: ReduceOp = "sum") -> Tensor:
        """Reduce `tensor` over the ranks in place and return it; every rank gets the same bits."""
        if self.world_size > 1:
            with self.watchdog.waiting("all_reduce"):
                dist.all_reduce(tensor, op=_REDUCE_OPS[op])
        return tensor

    def exchange_counts(self, counts: Tensor) -> Tensor:
        """Exchange the numbers of items that the ranks will send each other.

        `counts`: int64 [M] or [M, C] on `device`; row m is what goes to rank m. Returns a tensor of the same
        shape: row m is what comes from rank m.
        """
        one_each = [1] * self.world_size
        return self.all_to_all(counts, one_each, one_each)

    def all_to_all(self, rows: Tensor, sent: Sequence[int], received: Sequence[int]) -> Tensor:
        """Send consecutive groups of rows, one to each rank, and return those received, by source rank.

        `rows`: [sum(sent), ...]; the rows for rank 0 first. `sent`: rows for each rank, M values. `received`:
        rows from each rank, M values (see `exchange_counts`). Returns [sum(received), ...].
        """
        if self.world_size == 1:
            return rows.clone()
        result = rows.new_empty((sum(received), *rows.shape[1:]))
        with self.watchdog.waiting("all_to_all"):
            dist.all_to_all_single(result, rows.contiguous(), list(received), list(sent))
        return result

    def all_gather(self, tensor: Tensor) -> list[Tensor]:
        """Gather tensors of one shape from all ranks, in rank order; for small tensors."""
        if self.world_size == 1:
            return [tensor.clone()]
        parts = [torch.empty_like(tensor) for _ in range(self.world_size)]
        with self.watchdog.waiting("all_gather"):
            dist.all_gather(parts, tensor.contiguous())
        return parts

    def all_gather_object(self, value: T) -> list[T]:
        """Gather a small picklable object from all ranks, in rank order."""
        if self.world_size == 1:
            return [value]
        parts: list[Any] = [None] * self.world_size
        with self.watchdog.waiting("all_gather_object"):
            dist.all_gather_object(parts, value)
        return parts

    def broadcast_object(self, value: T) -> T:
        """Return rank 0's `value` on every rank."""
        if self.world_size == 1:
            return value
        holder: list[Any] = [value]
        with self.watchdog.waiting("broadcast_object"):
            dist.broadcast_object_list(holder, device=self.device)
        result: T = holder[0]
        return result

    def barrier(self) -> None:
        """Wait for all ranks."""
        if self.world_size > 1:
            # An all-reduce whose result is read, because with NCCL only reading it waits for the other ranks.
            token = torch.zeros(1, device=self.device)
            with self.watchdog.waiting("barrier"):
                dist.all_reduce(token)
                token.item()

    def compare_across_ranks(self, fields: Mapping[str, object]) -> None:
        """Check that every rank has the same values: configuration, code version, data fingerprint.

        `fields`: name -> value; values are compared by their `repr`. MismatchError: on every rank, naming the
        first differing field, the ranks and their values.
        """
        mine = {name: repr(value) for name, value in fields.items()}
        everyone = self.all_gather_object((socket.gethostname(), mine))
        names = sorted({name for _, values in everyone for name in values})
        for name in names:
            holders: dict[str, list[int]] = {}
            for rank, (_, values) in enumerate(everyone):
                holders.setdefault(values.get(name, "(missing)"), []).append(rank)
            if len(holders) > 1:
                detail = "; ".join(
                    f"rank{'s' if len(ranks) > 1 else ''} {', '.join(map(str, ranks))}"
                    f" ({everyone[ranks[0]][0]}): {_shorten(value)}"
                    for value, ranks in holders.items()
                )
                raise MismatchError(
                    f"the ranks disagree on {name}: {detail}. Start every rank with the same configuration, "
                    "code and data."
                )


def _share_cores(local_world_size: int) -> None:
    """Let torch use this process's share of the host's cores, if torchrun has set one thread for it.

    torchrun sets OMP_NUM_THREADS to 1 when it starts several processes and the variable is not set. The
    host's part of the set-up, such as finding the neighbours of the first Gaussians, would take many times as
    long, and trainings on CPUs would leave cores idle. Other values are the user's and stay.
    """
    is_by_torchrun = "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("OMP_NUM_THREADS") == "1"
    if is_by_torchrun and local_world_size > 1:
        torch.set_num_threads(max(1, len(os.sched_getaffinity(0)) // local_world_size))


def extend_memory_in_place() -> None:
    """Let torch's CUDA allocator extend its memory, unless the user has configured it; before its first use.

    A table that grows by some percent in each density event does not fit into the memory that its last copy
    has left, nor a frame of a viewer into that of a smaller one. By default, torch then asks CUDA for new
    memory for every column.
    """
    if not any(name in os.environ for name in ALLOCATOR_VARIABLES):
        os.environ[ALLOCATOR_VARIABLES[0]] = "expandable_segments:True"


def _shorten(text: str) -> str:
    return text if len(text) <= 200 else text[:197] + "..."


def resolve_device(
    device: str, local_rank: int, local_world_size: int, share_gpus: bool
) -> tuple[torch.device, bool]:
    """Return a rank's device, and whether ranks of its host share GPUs."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise ValueError(f"device must be auto, cpu, cuda or cuda:N, got {device!r}")
    chosen = torch.device(device)
    if chosen.type == "cpu":
        return chosen, False
    count = torch.cuda.device_count()
    # All ranks of a host get the same argument `device`, with an index or without.
    shared = share_gpus and local_world_size > (count if chosen.index is None else 1)
    if chosen.index is None:
        chosen = torch.device("cuda", local_rank % max(count, 1) if shared else local_rank)
    if count == 0:
        built = "sees no GPU" if torch.version.cuda else f"({torch.__version__}) is built for CPUs alone"
        raise ValueError(
            f"device {device}: this torch {built}; install one with CUDA and check `nvidia-smi`, or use "
            "--device cpu"
        )
    if chosen.index >= count:
        raise ValueError(
            f"local rank {local_rank} needs {chosen}, but this host has {count} CUDA devices; start fewer "
            "processes per node (torchrun --nproc-per-node), use --device cpu or, for development, let ranks "
            "share GPUs (--share-gpus)"
        )
    return chosen, shared


def connect(ranks: Ranks, timeout_seconds: float) -> SharedMemory | str:
    """Set up shared memory between all ranks, or return why that is impossible, the same on every rank.

    Collective.

    `ranks`: the ranks, joined. `timeout_seconds`: longest wait in a barrier.
    """
    location = (socket.gethostname(), ranks.device.index if ranks.device.type == "cuda" else None)
    locations = ranks.all_gather_object(location)
    obstacle, control = find_obstacle(locations, ranks), None
    if obstacle is None:
        try:
            words = control_words(ranks.world_size)
            control = symmetric_words(words, torch.int64, ranks.device).zero_()
        except RuntimeError as error:
            obstacle = f"rank {ranks.rank}: {error}"
    obstacles = [text for text in ranks.all_gather_object(obstacle) if text is not None]
    if obstacles or control is None:
        return obstacles[0]
    memory = SharedMemory(ranks.rank, ranks.world_size, ranks.device, control, timeout_seconds)
    memory.reserve(LEAST_WORDS)
    ranks.barrier()
    return memory


def find_obstacle(locations: list[tuple[str, Any]], ranks: Ranks) -> str | None:
    """Return why a rank cannot reach the others' memory; None if it can."""
    hosts, devices = {host for host, _ in locations}, [device for _, device in locations]
    mine = ranks.device.index
    if None in devices:
        return "not every rank computes on a GPU"
    if len(hosts) > 1:
        return f"the ranks are on {len(hosts)} hosts"
    if len(set(devices)) < len(devices) and not ranks.shares_gpu:
        return "some ranks see their GPU under the same number"
    if len(devices) > MAX_PEERS:
        return f"at most {MAX_PEERS} ranks can share memory, not {len(devices)}"
    for other in devices:
        if other != mine and not torch.cuda.can_device_access_peer(mine, other):
            return f"cuda:{mine} has no access to the memory of cuda:{other}"
    return None
