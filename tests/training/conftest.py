# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.cli import main
from tests.training.tiny import OVERRIDES, write_tiny_capture


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Use one thread in the tests of this folder, which compare bits and have tiny models."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A capture and a short run of it, made by the command line."""
    data, folder = tmp_path_factory.mktemp("capture"), tmp_path_factory.mktemp("runs") / "run"
    write_tiny_capture(data)
    flags = [f"--{text}" for text in ("config=defaults", *OVERRIDES)]
    assert main(["train", "--data", str(data), "--out", str(folder), "--schedule.scale=0.4", *flags]) == 0
    return data, folder
