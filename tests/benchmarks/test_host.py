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
    direct = {row["part"]: row["direct_grad, host us"] for row in written["steps"]}
    assert direct.keys() == steps.keys() and 20 < direct[count] < steps[count] / 2


@pytest.mark.parametrize("direct_grad", [False, True])
def test_the_trainer_whose_steps_are_measured_learns(direct_grad):
    trainer = bm_host.Trainer("cpu", direct_grad)
    before = {name: value.detach().clone() for name, value in trainer.params.items()}
    for _ in range(3):
        trainer.step()
    assert all(not value.equal(before[name]) for name, value in trainer.params.items())
