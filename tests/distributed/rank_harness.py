# SPDX-License-Identifier: Apache-2.0
"""Runs a function on M ranks, with Gloo on the CPU and NCCL on M GPUs; with fewer GPUs, ranks share them.

A fork server imports once what ranks need, so CPU ranks start quickly; a CUDA context does not survive a
fork.
"""

import multiprocessing
import multiprocessing.connection
import os
import pickle
import re
import time
import traceback

import pytest
import torch
from torch.distributed import TCPStore

from blitzgs.distributed.group import Ranks

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["torch", "torch.distributed", "blitzgs.cli.train", "tests.training.tiny"])


def _child(function, rank, world_size, port, timeout_seconds, join, device, transport, arguments, pipe):
    torch.set_num_threads(1)
    os.environ.update(
        RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE=str(world_size), LOCAL_WORLD_SIZE=str(world_size),
        MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), TORCHELASTIC_USE_AGENT_STORE="True",
    )  # fmt: skip
    try:
        if join:
            with Ranks.from_environment(device, timeout_seconds, transport, share_gpus=True) as ranks:
                result = function(ranks, *pickle.loads(arguments))
        else:
            result = function(rank, *pickle.loads(arguments))
        pipe.send_bytes(pickle.dumps(("ok", result)))
    except BaseException:  # noqa: BLE001  (reported to the parent)
        pipe.send_bytes(pickle.dumps(("error", traceback.format_exc())))
        raise


class RankError(AssertionError):
    """A rank failed; `messages[rank]` is its traceback, or its exit code if there is none.

    `blame` is the message of the first failed rank to the others.
    """

    def __init__(self, messages, blame):
        self.blame = blame
        super().__init__("\n".join(f"--- rank {rank}\n{text}" for rank, text in messages.items()))
        self.messages = messages


def all_fail(text, function, *arguments):
    """Check that both of two ranks fail with a message that the regular expression matches."""
    with pytest.raises(RankError) as failure:
        run_ranks(function, 2, *arguments)
    assert len(failure.value.messages) == 2
    for message in failure.value.messages.values():
        assert re.search(text, message), message


def on_cuda(*world_sizes):
    """Parameters (world_size, device) for a test on CUDA; with fewer GPUs than ranks these share them."""
    gpus = torch.cuda.device_count()
    return [
        pytest.param(
            size,
            "cuda",
            id=f"cuda-{size}-shared" if 0 < gpus < size else f"cuda-{size}",
            marks=pytest.mark.cuda,
        )
        for size in world_sizes
    ]


def on_each_device(*world_sizes):
    """Parameters (world_size, device) for a test: on the CPU, and on CUDA where there is a GPU."""
    return [pytest.param(size, "cpu", id=f"cpu-{size}") for size in world_sizes] + on_cuda(*world_sizes)


# As many ranks as a host of eight GPUs has, on the CPU.
EIGHT = pytest.param(8, "cpu", id="cpu-8", marks=pytest.mark.slow)


def run_ranks(
    function,
    world_size,
    *arguments,
    timeout_seconds=120.0,
    limit=240.0,
    join=True,
    device="cpu",
    transport="auto",
    stuck=frozenset(),
):
    """Return [function(ranks, *arguments) of each rank]; raise RankError if any rank fails.

    With `join` false the function gets its rank's number and joins the job itself, as a command does. Ranks
    that are `stuck` are killed as soon as the others have ended.
    """
    # Like torchrun's agent, the parent holds the store, so that it outlives any rank.
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    # Plain pickles: multiprocessing's own would share the tensors' memory with the ranks.
    payload = pickle.dumps(arguments)
    context = CONTEXT if device == "cpu" else multiprocessing.get_context("spawn")
    processes, pipes = [], []
    for rank in range(world_size):
        receiver, sender = context.Pipe(duplex=False)
        job = (function, rank, world_size, store.port, timeout_seconds, join, device, transport, payload)
        process = context.Process(target=_child, args=(*job, sender))
        process.start()
        sender.close()
        processes.append(process)
        pipes.append(receiver)
    results, failures = [None] * world_size, {}
    waiting = dict(zip(pipes, range(world_size), strict=True))
    deadline = time.monotonic() + limit
    while waiting:
        if stuck.issuperset(waiting.values()):
            deadline = 0.0
        ready = multiprocessing.connection.wait(list(waiting), max(0.1, deadline - time.monotonic()))
        for pipe in ready or list(waiting):
            rank = waiting.pop(pipe)
            if not ready:
                processes[rank].kill()
                failures[rank] = "stopped by the test"
                continue
            try:
                status, value = pickle.loads(pipe.recv_bytes())
            except EOFError:
                processes[rank].join()
                status, value = "error", f"exit code {processes[rank].exitcode}"
            if status == "ok":
                results[rank] = value
            else:
                failures[rank] = value
                # As torchrun does, end the other ranks a short time after a rank has failed.
                deadline = min(deadline, time.monotonic() + 6)
    for process in processes:
        process.join(10)
    if failures:
        key = "blitzgs/0/watchdog/failure"
        raise RankError(failures, store.get(key).decode() if store.check([key]) else "")
    return results
