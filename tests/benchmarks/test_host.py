# SPDX-License-Identifier: Apache-2.0
"""The benchmark of a call's host time measures every kind of call and writes them as JSON."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_host  # noqa: E402


def test_every_call_is_measured(tmp_path, monkeypatch, capsys):
    arguments = ["--device", "cpu", "--repeats", "3", "--json", str(tmp_path / "host.json")]
    monkeypatch.setattr(sys, "argv", ["bm_host.py", *arguments])
    bm_host.main()
    written = json.loads((tmp_path / "host.json").read_text())
    rows, steps = written["rows"], {row["part"]: row["host us"] for row in written["steps"]}
    assert [row["call"] for row in rows] == list(bm_host.CALLS)
    assert all(row["forward us"] > 0 and row["backward us"] > 0 for row in rows)
    assert "sparse, meta" in capsys.readouterr().out
    *parts, count = steps
    assert parts == ["render", "loss", "backward", "optimisers", "all"] and all(
        steps[name] > 0 for name in parts
    )
    assert count.startswith("torch's operations") and steps[count] > 20
    assert all(row["one optimiser, host us"] > 0 for row in written["steps"])


@pytest.mark.parametrize("in_one", [False, True])
def test_the_trainer_whose_steps_are_measured_learns(in_one):
    trainer = bm_host.Trainer("cpu", in_one)
    before = {name: value.detach().clone() for name, value in trainer.params.items()}
    for _ in range(3):
        trainer.step()
    assert all(not value.equal(before[name]) for name, value in trainer.params.items())
