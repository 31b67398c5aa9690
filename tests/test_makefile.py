# SPDX-License-Identifier: Apache-2.0
"""`make demo` can be repeated."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_a_second_demo_continues_the_first(tmp_path):
    def train_command():
        command = ["make", "-n", "demo", f"DEMO={tmp_path}", f"VENV={tmp_path / 'venv'}"]
        lines = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return next(
            line for line in lines.replace("\\\n", " ").split("\n") if f"--out {tmp_path}/run" in line
        )

    assert "--resume" not in train_command()
    (tmp_path / "run" / "checkpoints" / "checkpoint_000001").mkdir(parents=True)
    assert "--resume" in train_command()
