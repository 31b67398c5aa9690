# SPDX-License-Identifier: Apache-2.0
"""The benchmarks are programs beside the package: their folder is where they find each other."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from tests.training.tiny import write_tiny_capture  # noqa: E402


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The tiny capture, in a folder of its own."""
    folder = tmp_path_factory.mktemp("benchmarks") / "capture"
    write_tiny_capture(folder)
    return folder
