# SPDX-License-Identifier: Apache-2.0
"""Pages of figures match the results of one commit, and what benchmarks write is what the report reads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_photometric  # noqa: E402
import harness  # noqa: E402
import report  # noqa: E402

from tests.helpers import needs_cuda  # noqa: E402

PAGE = "before\n<!-- table: {0} -->\nold\n<!-- end: {0} -->\nafter\n"


def made(folder, name):
    return report.render_page(PAGE.format(name), report.load_results(folder))


def test_the_pages_match_the_results_in_the_repository(capsys):
    assert report.main(["--check"]) == 0, capsys.readouterr().err


def run(monkeypatch, benchmark, *flags):
    monkeypatch.setattr(sys, "argv", [str(Path(benchmark.__file__)), *map(str, flags)])
    monkeypatch.setenv("BLITZGS_COMMIT", "abc")
    benchmark.main()


def test_a_benchmark_notes_what_the_report_needs(tmp_path, monkeypatch):
    size = ("--device", "cpu", "--height", 20, "--width", 30, "--repeats", 1)
    run(monkeypatch, bm_photometric, *size, "--json", tmp_path / "photometric.json")
    page = made(tmp_path, "photometric")
    command = "python benchmarks/bm_photometric.py --device cpu --height 20 --width 30 --repeats 1"
    assert f"`{command}`" in page and "| 1 view(s) of 30 × 20 | ms | byte floor, ms |" in page
    assert page.count("\n| ") == 5


def test_the_exchange_benchmark_writes_what_the_report_reads(tmp_path):
    flags = "--gaussians 2000 --ranks 2 --batch 1 --batches 1 --visits 1 --device cpu"
    path = tmp_path / "exchange.json"
    command = [sys.executable, "benchmarks/bm_exchange.py", *flags.split(), "--json", str(path)]
    subprocess.run(command, cwd=report.ROOT, env=os.environ | {"BLITZGS_COMMIT": "abc"}, check=True)
    page = made(tmp_path, "exchange")
    assert f"`python benchmarks/bm_exchange.py {flags}`" in page and "commit abc" in page
    for line in ("| project | ", "| optimiser | ", "| **steps in a row** | ", "| MB between ranks | 0 |"):
        assert f"\n{line}" in page


def test_the_commit_is_that_of_the_checkout(monkeypatch):
    monkeypatch.delenv("BLITZGS_COMMIT", raising=False)
    monkeypatch.setattr(harness, "_git", lambda *words: "" if words[0] == "status" else "0123456789")
    assert harness.commit() == "0123456789"
    monkeypatch.setattr(harness, "_git", lambda *words: "M file" if words[0] == "status" else "0123456789")
    assert harness.commit() == "0123456789+changes"


def test_a_copy_without_a_repository_has_no_commit(monkeypatch, tmp_path):
    monkeypatch.delenv("BLITZGS_COMMIT", raising=False)
    monkeypatch.setattr(harness, "ROOT", tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert harness.commit() == "unknown"


@pytest.mark.cuda
@needs_cuda
def test_render_and_step_write_what_the_report_reads(tmp_path, monkeypatch):
    import bm_render
    import bm_step
    from scenes import aerial

    monkeypatch.setattr(bm_render, "SCENES", {"aerial1": lambda: aerial(50_000, "cuda")})
    monkeypatch.setattr(bm_step, "GAUSSIANS", {"aerial1": 50_000})
    run(monkeypatch, bm_render, "--scenes", "aerial1", "--repeats", 2, "--json", tmp_path / "render.json")
    for views in (1, 4):
        flags = ("--scenes", "aerial1", "--views", views, "--repeats", 2)
        run(monkeypatch, bm_step, *flags, "--json", tmp_path / f"step_{views}.json")
    for name in ("render", "stages", "call", "step"):
        assert made(tmp_path, name).count("\n| ") >= 2
