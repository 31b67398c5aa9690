# SPDX-License-Identifier: Apache-2.0
"""The benchmark of gsplat's loop: our parts train to the same quality as torch's."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from tests.training.tiny import write_tiny_capture  # noqa: E402


def test_the_loop_learns_with_each_arm(tmp_path, capsys):
    pytest.importorskip("gsplat", reason="needs gsplat's strategies")
    import bm_drop_in

    write_tiny_capture(tmp_path / "tiny")
    arguments = [str(tmp_path / "tiny"), "--steps", "60", "--arms", "import", "four", "--device", "cpu"]
    arguments += ["--one-thread"]
    one, four = bm_drop_in.main([*arguments, "--profile", "--json", str(tmp_path / "found.json")])
    assert one["Gaussians"] == four["Gaussians"]
    assert abs(one["PSNR, dB"] - four["PSNR, dB"]) < 0.5
    printed = capsys.readouterr().out
    assert (
        "gsplat's loop, 60 steps of tiny, autograd in one thread" in printed
        and "four: work of a step" in printed
    )
    assert all(part in printed for part in ("render", "backward", "optimisers", "strategy, after"))
    assert (tmp_path / "found.json").exists()
