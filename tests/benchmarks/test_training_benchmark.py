# SPDX-License-Identifier: Apache-2.0
"""The training benchmark runs a training and reads a profile correctly."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_training  # noqa: E402

from tests.distributed.rank_harness import run_ranks  # noqa: E402
from tests.helpers import DEVICES  # noqa: E402
from tests.training.tiny import OVERRIDES, write_tiny_capture  # noqa: E402


@pytest.mark.parametrize("device", DEVICES)
def test_a_training_is_measured(tmp_path, capsys, device):
    write_tiny_capture(tmp_path / "capture")
    path = tmp_path / "figures.json"
    flags = ["--data", str(tmp_path / "capture"), "--device", device, "--json", str(path)]
    settings = [f"--{text}" for text in OVERRIDES]
    bm_training.main([*flags, "--images", "20", "--steps", "50", "--profiled", "10", *settings])
    rows = {row["figure"]: row["value"] for row in json.loads(path.read_text())["rows"]}
    # Events after 20, 40 and 60 images.
    step, with_events = rows["a step without density events, ms"], rows["with them, one in 16.7 steps, ms"]
    event = rows["a density event, ms"]
    assert 0 < step < with_events == pytest.approx(step + event * 3 / 50)
    assert ("the main stream is busy" in rows) == (device == "cuda")
    assert "| a density event, ms |" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="the schedule ends after 100 images"):
        bm_training.main([*flags, "--images", "90", "--steps", "20", *settings])


def _measure(rank, arguments):
    bm_training.main(arguments)


def test_the_waits_of_two_ranks_are_measured(tmp_path):
    write_tiny_capture(tmp_path / "capture")
    path = tmp_path / "figures.json"
    settings = [f"--{text}" for text in OVERRIDES]
    flags = ["--data", str(tmp_path / "capture"), "--device", "cpu", "--json", str(path), *settings]
    run_ranks(_measure, 2, [*flags, "--images", "20", "--steps", "30", "--profiled", "0"], join=False)
    rows = {row["figure"]: row["value"] for row in json.loads(path.read_text())["rows"]}
    waits = {name: float(text[:-1]) for name, text in rows.items() if name.startswith("the host waits for")}
    assert {"the host waits for other ranks or the GPU, all_to_all"} <= set(waits)
    assert all(share > 0 for share in waits.values()) and sum(waits.values()) < 100


def test_figures_read_from_a_profiler_trace():
    def work(begin, end, name, stream=7):
        return {"cat": "kernel", "ts": begin, "dur": end - begin, "name": name, "args": {"stream": stream}}

    def call(name, length, thread):
        return {"cat": "cuda_runtime", "ts": 0, "dur": length, "name": name, "tid": thread}

    trace = [
        {"ph": "M", "name": "process_name"},
        work(0, 40, "void blitzgs::cuda::(anonymous namespace)::splats_kernel<3, (bool)1>(float const*)"),
        work(60, 80, "Memcpy DtoH (Device -> Pinned)"),
        work(70, 75, "beneath"),
        work(81, 100, "void blitzgs::cuda::(anonymous namespace)::barrier_kernel(ControlWords, long)"),
        work(30, 70, "elsewhere", stream=9),
        call("cudaLaunchKernel", 5, 1),
        call("cudaEventSynchronize", 25, 1),
        call("cudaStreamSynchronize", 90, 2),
    ]
    use = bm_training.stream_use(trace)
    assert use.exchanging == pytest.approx(0.19)
    assert use.busy == pytest.approx(0.79) and use.waiting == pytest.approx(0.25) and use.launches == 5
    assert use.gaps == {("splats_kernel", "Memcpy DtoH"): [20]}
    (gap,) = bm_training.longest_gaps(use, 2)
    assert gap == {"before": "splats_kernel", "after": "Memcpy DtoH", "us a step": 10, "times a step": 0.5}
    longest, second = bm_training.longest_kernels(use, 2, count=2)
    assert {longest["kernel"], second["kernel"]} == {"splats_kernel", "elsewhere"}
    assert longest["us a step"] == 20 and longest["times a step"] == 0.5
