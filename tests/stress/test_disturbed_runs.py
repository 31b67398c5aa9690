# SPDX-License-Identifier: Apache-2.0
"""Runs that are disturbed at random moments lose at most the checkpoint interval and end as if undisturbed.

BLITZGS_TRIALS sets how often each disturbance is tried, 20 by default.
"""

import contextlib
import os
import random
import resource
import shutil
import signal
import time

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files
from tests.distributed.rank_harness import CONTEXT
from tests.training.tiny import OVERRIDES, as_flags, steps_of, write_tiny_capture

TRIALS = int(os.environ.get("BLITZGS_TRIALS", "20"))
INTERVAL = 0.5
# Time for a step, for a save and for the scheduling of a busy machine.
SLACK = 1.0
SETTINGS = (
    *OVERRIDES, "schedule.iterations=3000", "population.max_gaussians=700",
    "log.tensorboard=true", "data.cache_bytes=0", f"log.checkpoint_seconds={INTERVAL}",
)  # fmt: skip

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def _train(arguments):
    os.setsid()
    torch.set_num_threads(1)
    from blitzgs.cli import main
    from blitzgs.training.events import save

    save.RETRY_SECONDS = 0.2
    raise SystemExit(main(arguments))


def start(data, out, *flags):
    settings = as_flags("config=defaults", *SETTINGS)
    process = CONTEXT.Process(
        target=_train, args=(["train", "--data", str(data), "--out", str(out), *settings, *flags],)
    )
    process.start()
    return process


def wait_for_first_checkpoint(process, out):
    while not list((out / "checkpoints").glob("checkpoint_*")):
        assert process.exitcode is None, f"ended early with {process.exitcode}"
        time.sleep(0.01)


def age_of_newest(out):
    """Seconds since the newest checkpoint was complete."""
    ages = []
    for path in (out / "checkpoints").glob("checkpoint_*/manifest.json"):
        with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
            ages.append(time.time() - path.stat().st_mtime)
    return min(ages)


def finish(data, out):
    process = start(data, out, "--resume")
    process.join(240)
    assert process.exitcode == 0
    return run_files.restore(out, Ranks()).table


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a capture, the table of an undisturbed run, and its seconds after the first checkpoint."""
    data, out = tmp_path_factory.mktemp("capture"), tmp_path_factory.mktemp("whole") / "run"
    write_tiny_capture(data)
    process = start(data, out)
    wait_for_first_checkpoint(process, out)
    begin = time.monotonic()
    process.join(240)
    assert process.exitcode == 0
    return data, run_files.restore(out, Ranks()).table, time.monotonic() - begin


def kill(process, data, out):
    os.kill(process.pid, signal.SIGKILL)
    lost = age_of_newest(out)
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert lost <= INTERVAL + SLACK
    return lost


def hang_up(process, data, out):
    os.kill(process.pid, signal.SIGHUP)
    process.join(60)
    assert process.exitcode == 0
    return 0.0


def fill_disk(process, data, out):
    """For two seconds, no file may get longer than 16 bytes, so every write fails."""
    soft, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (16, hard))
    process.join(2.0)
    if process.exitcode is None:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (soft, hard))
        process.join(240)
    assert process.exitcode == 0
    return 0.0


def take_photographs_away(process, data, out):
    aside = data / "images aside"
    (data / "images").rename(aside)
    try:
        process.join(60)
        # If the last batches were loaded before, the evaluation is the first to read a lost photograph.
        assert process.exitcode == 1
    finally:
        aside.rename(data / "images")
    return 0.0


def start_again(process, data, out):
    for flags in ((), ("--resume",)):
        second = start(data, out, *flags)
        second.join(120)
        assert second.exitcode == 1 or process.exitcode == 0
    process.join(240)
    assert process.exitcode == 0
    return 0.0


@pytest.mark.parametrize("disturb", [kill, hang_up, fill_disk, take_photographs_away, start_again])
def test_a_disturbed_run_ends_like_any_other(scene, tmp_path, disturb):
    data, expected, seconds = scene
    choice, worst = random.Random(disturb.__name__), 0.0
    for trial in range(TRIALS):
        own = shutil.copytree(data, tmp_path / f"data{trial}")
        out = tmp_path / f"run{trial}"
        while True:
            process = start(own, out)
            wait_for_first_checkpoint(process, out)
            time.sleep(choice.uniform(0, 0.7 * seconds))
            if process.exitcode is None:
                break
            # The run ended first: the machine was busier when the undisturbed run was timed.
            assert process.exitcode == 0
            seconds *= 0.7
            shutil.rmtree(out)
        worst = max(worst, disturb(process, own, out))
        found = finish(own, out)
        for name in expected:
            assert torch.equal(found[name], expected[name]), (trial, name)
        times = [record["t"] for record in steps_of(out)]
        assert times == sorted(set(times)) and times[-1] == 3000
        shutil.rmtree(out)
        shutil.rmtree(own)
    print(f"{disturb.__name__}: {TRIALS} trials, at most {worst:.2f} s lost")
