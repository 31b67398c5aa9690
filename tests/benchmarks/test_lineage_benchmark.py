# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the lineage measures events and trainings, and reckons shares correctly."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_lineage  # noqa: E402

from tests.helpers import DEVICES  # noqa: E402
from tests.training.tiny import OVERRIDES, write_tiny_capture  # noqa: E402

pytest.importorskip("pyarrow")


def measured(tmp_path, device, *flags):
    path = tmp_path / "figures.json"
    bm_lineage.main([*flags, "--device", device, "--json", str(path)])
    return [list(row.values()) for row in json.loads(path.read_text())["rows"]]


@pytest.mark.parametrize("device", DEVICES)
def test_events_are_measured(tmp_path, device):
    rows = measured(tmp_path, device, "--gaussians", "2000", "--events", "3")
    assert [name for name, _ in rows] == [
        "event", "event, logged", "check behind 3 events", "check behind one event"
    ]  # fmt: skip
    assert all(ms > 0 for _, ms in rows)


@pytest.mark.parametrize("device", DEVICES)
def test_trainings_are_measured(tmp_path, device):
    write_tiny_capture(tmp_path / "capture")
    flags = ["--data", str(tmp_path / "capture"), "--images", "50", *(f"--{text}" for text in OVERRIDES)]
    rows = dict(measured(tmp_path, device, *flags, "--repeats", "2"))
    assert rows["density events"] == 2 and rows["size of the log, MB"] > 0
    assert rows["training without the log, s"] > 0 and rows["the check, ms"] > 0
    with pytest.raises(SystemExit):
        bm_lineage.main([*flags, "--images", "101"])


def test_shares_are_of_the_training_without_the_log():
    pairs = [
        (bm_lineage.Times(10.0, 0.0, [0.1, 0.1], 5, 0.0), bm_lineage.Times(10.2, 0.1, [0.1, 0.2], 5, 3.0)),
        (bm_lineage.Times(10.0, 0.0, [0.1, 0.1], 5, 0.0), bm_lineage.Times(10.0, 0.1, [0.1, 0.1], 5, 3.0)),
        (bm_lineage.Times(10.0, 0.0, [0.1, 0.1], 5, 0.0), bm_lineage.Times(9.9, 0.2, [0.1, 0.1], 5, 3.0)),
    ]
    rows = {row["figure"]: row["value"] for row in bm_lineage.figures(pairs)}
    assert rows["lost"] == "1.00% (1.00% to 3.00%)"
    assert rows["lost, in density events and the check"] == "2.00%"
    assert rows["the check, ms"] == pytest.approx(100)
