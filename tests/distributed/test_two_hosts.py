# SPDX-License-Identifier: Apache-2.0
"""Two torchrun agents on one machine act as two hosts; one is killed, and both resume."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from blitzgs.distributed.group import Ranks
from blitzgs.runs import files as run_files
from tests.training.tiny import OVERRIDES, as_flags, write_tiny_capture

ROOT = Path(__file__).parents[2]
SETTINGS = (
    *OVERRIDES,
    "schedule.iterations=1500",
    "population.max_gaussians=500",
    "log.pictures=0",
    "log.checkpoint_seconds=1",
    "ranks.timeout_seconds=20",
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def start_host(port, arguments, output):
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1"]
    command += ["--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{port}", "--rdzv-id=run", "train.py"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command + arguments, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT
    )


def lose(host):
    """End an agent and its workers at once, as a host that loses power."""
    if host.poll() is not None:
        return
    agent = psutil.Process(host.pid)
    for process in [*agent.children(recursive=True), agent]:
        process.kill()
    host.wait()


def free_port():
    with socket.socket() as chosen:
        chosen.bind(("127.0.0.1", 0))
        return chosen.getsockname()[1]


def test_a_host_is_lost_and_both_resume(tmp_path):
    data, out = tmp_path / "data", tmp_path / "run"
    write_tiny_capture(data)
    arguments = ["--data", str(data), "--out", str(out), "--resume", "--device", "cpu"]
    arguments += as_flags("config=defaults", *SETTINGS)
    hosts = []
    try:
        # The first agent serves the rendezvous, so the second one is killed.
        port = free_port()
        with open(tmp_path / "first", "wb") as first, open(tmp_path / "second", "wb") as second:
            hosts = [start_host(port, arguments, first)]
            time.sleep(2)
            hosts.append(start_host(port, arguments, second))
        deadline = time.monotonic() + 180
        while len(list((out / "checkpoints").glob("checkpoint_*"))) < 2:
            assert time.monotonic() < deadline and hosts[0].poll() is None, (tmp_path / "first").read_text()
            time.sleep(0.1)
        lose(hosts[1])
        deadline = time.monotonic() + 90
        while "Ending the job" not in (text := (tmp_path / "first").read_text()) and hosts[0].poll() is None:
            assert time.monotonic() < deadline, text
            time.sleep(0.2)
        text = (tmp_path / "first").read_text()
        assert "rank" in text and ("has stopped reporting" in text or "connection" in text)
        lose(hosts[0])  # where torchrun still waits for the other host
        saved = run_files.restore(out, Ranks()).progress.step
        assert 0 < saved < 1500

        port = free_port()
        with open(tmp_path / "third", "wb") as third:
            hosts = [start_host(port, arguments, third)]
            time.sleep(2)
            hosts.append(start_host(port, arguments, subprocess.DEVNULL))
        for host in hosts:
            assert host.wait(300) == 0, (tmp_path / "third").read_text()
    finally:
        for host in hosts:
            if host.poll() is None:
                lose(host)
    text = (tmp_path / "third").read_text()
    assert "resumed from checkpoint_" in text and f"after {saved:,} steps" in text
    assert run_files.restore(out, Ranks()).progress.step == 1500
