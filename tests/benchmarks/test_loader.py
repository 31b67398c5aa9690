# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the host time around a step measures every part, before and after the first visits."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_loader  # noqa: E402


def test_every_part_is_measured(tmp_path, monkeypatch, capsys):
    path = tmp_path / "loader.json"
    flags = ["--views", "12", "--ranks", "2", "--steps", "6", "--json", str(path)]
    monkeypatch.setattr(sys, "argv", ["bm_loader.py", *flags])
    bm_loader.main()
    rows = json.loads(path.read_text())["rows"]
    assert len(rows) == 3 and all(row["first visits, us"] > 0 and row["later, us"] > 0 for row in rows)
    assert "12 views, 2 ranks" in capsys.readouterr().out
