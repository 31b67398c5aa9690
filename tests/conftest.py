# SPDX-License-Identifier: Apache-2.0
import os
import signal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: it says how OpenMP threads wait

import cv2  # noqa: F401 - before pycolmap, whose own libpng and zlib it would call
import pytest
import torch

from blitzgs.cli import main
from tests.helpers import BACKENDS, DEVICES
from tests.training.tiny import OVERRIDES, as_flags, write_tiny_capture

# Folders of tests with tiny trainings.
_TRAININGS = ("config", "report", "runs", "spawn", "training")

# Of `lineage_run`: density events at 20, 40, 60 and 80; the gate judges from 60 on, a checkpoint lies at 50.
LINEAGE = (
    "population.lineage=true", "population.grad_threshold=1e-3", "population.importance=true",
    "schedule.t1=40", "schedule.t2=90", "schedule.gate_from=60", "schedule.checkpoint_every=50",
    "log.keep_checkpoints=9",
)  # fmt: skip


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Skip the tests that need a CUDA device where there is none."""
    for item in items:
        if item.get_closest_marker("cuda") and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(scope="session", autouse=True)
def signals_as_in_a_terminal():
    """The tests may have been started with ignored signals, as by nohup or as a shell's background job."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture(scope="module", autouse=True)
def one_thread(request):
    """Use one thread in the tests of trainings, which compare bits and have tiny models."""
    before = torch.get_num_threads()
    if request.path.parent.name in _TRAININGS:
        torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(params=DEVICES)
def device(request):
    """Run a test on the CPU and on the GPU."""
    return request.param


@pytest.fixture(params=BACKENDS)
def backend(request):
    """Run a test on each device, in each dtype of its kernels: (device, dtype)."""
    return request.param


@pytest.fixture
def failure(capsys):
    """Call a command that ends with status 1; return what it printed as its error."""

    def call(*arguments):
        assert main([str(argument) for argument in arguments]) == 1
        return capsys.readouterr().err

    return call


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The folder of the tiny capture."""
    folder = tmp_path_factory.mktemp("capture")
    write_tiny_capture(folder)
    return folder


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    """A capture and a short run of it, made by the command line."""
    data, folder = capture, tmp_path_factory.mktemp("runs") / "run"
    flags = as_flags("config=defaults", *OVERRIDES, "population.grad_threshold=2e-4", "schedule.scale=0.4")
    assert main(["train", "--data", str(data), "--out", str(folder), *flags]) == 0
    return data, folder


@pytest.fixture(scope="module")
def lineage_run(tmp_path_factory):
    """A folder with a capture and a run of it that has lineage."""
    folder = tmp_path_factory.mktemp("gate")
    write_tiny_capture(folder / "capture")
    flags = as_flags("config=defaults", *OVERRIDES, *LINEAGE)
    assert main(["train", "--data", str(folder / "capture"), "--out", str(folder / "run"), *flags]) == 0
    return folder
