# SPDX-License-Identifier: Apache-2.0
"""Pages of figures match the results of one commit, and what benchmarks write is what the report reads."""

import json
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


def about(**results):
    environment = {"processor": "P", "threads": 2, "python": "3.12", "torch": "2.11", "device": "GPU"}
    return {
        "command": "python benchmarks/x.py",
        "commit": "abc",
        "environment": environment | {"cuda": "13"},
    } | results


def timing(total, peak=0.5):
    return {"forward": total / 4, "backward": 3 * total / 4, "total": total, "peak_gb": peak}


def render_file():
    stages = {"project": 0.25, "project_backward": 0.05}
    result = {"scene": "aerial 1M", "visible": 250_000, "rows": 260_000, "intersections": 1_500_000}
    modes = {"blitzgs": timing(1.0), "gsplat": timing(5.0, 2.0), "gsplat packed": timing(4.0, 1.0)}
    return about(results=[result | modes | {"stages": stages, "sparse": timing(1.5)}])


def step_file(views):
    ours = {"ms": {"other": 0.1, "total": 2.0}, "peak_gb": 3.0}
    theirs = {"ms": {"render": 9.0, "total": 13.0}, "peak_gb": 9.0}
    result = {"scene": "aerial 1M", "views": views, "blitzgs": ours, "gsplat + fused Adam": theirs}
    return about(results=[result])


def exchange_file():
    def rank(count, step):
        ms = {"project": step / 2, "alone": 1.1 * step, "step": step}
        traffic = {"splats": 3e6 * (count - 1), "gradients": 1e6 * (count - 1)}
        return {
            "ranks": count,
            "gaussians": 16_000_000,
            "ms": ms,
            "balance": {"measured": 1.0},
            "bytes per step": traffic,
        }

    return about(results=[rank(1, 8.0), rank(4, 2.5)])


@pytest.fixture
def results(tmp_path):
    files = {
        "render": render_file(),
        "step_1": step_file(1),
        "step_4": step_file(4),
        "exchange": exchange_file(),
    }
    for name, content in files.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return tmp_path


def quality_run(seed, psnr):
    measured = {"psnr": psnr, "ssim": 0.9, "psnr_corrected": psnr}
    about = {
        "capture": "park",
        "recipe": "aerial",
        "source": "configs/aerial.yaml",
        "settings": "1",
        "seed": seed,
        "status": "done",
        "commit": "abc",
    }
    end = {"images": 100, "seconds": 20.0, "gaussians": 2_000_000, "test": measured, "train": measured}
    size = {"peak_gaussians": 3_000_000, "peak_memory_bytes": 4_000_000_000, "images": 100}
    environment = {"processor": "P", "torch": "2.11", "device": "GPU", "cuda": "13"}
    return about | size | {"name": f"park.aerial.{seed}", "evaluations": [end], "environment": environment}


def test_quality_comes_from_its_collected_runs(results):
    runs = [quality_run(0, 30.0), quality_run(1, 29.0), quality_run(2, 31.0)]
    (results / "quality.json").write_text(json.dumps({"runs": runs}))
    page = made(results, "quality")
    assert (
        "| park | aerial | 100 | 3 | 30.00 (29.00) | 0.9000 (0.9000) | 20.0 (20.0) | 2.000 M (2.000 M) |"
        in page
    )
    opponent = quality_run(0, 28.0) | {"recipe": "mcmc", "source": "gsplat-mcmc", "commit": "def"}
    (results / "quality.json").write_text(json.dumps({"runs": [*runs, opponent]}))
    with pytest.raises(report.ReportError, match="is of commit abc and def"):
        report.load_results(results)


def made(folder, name):
    return report.render_page(PAGE.format(name), report.load_results(folder))


def test_the_pages_match_the_results_in_the_repository(capsys):
    assert report.main(["--check"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("render", "| 0.25 M | 0.25 / 0.75 / 1.00 | 0.50 | 1.00 / 3.00 / 4.00 | 1.00 | **4.00** |"),
        ("stages", "| aerial 1M | 0.26 M | 1.50 M | 0.25 | 0.050 |"),
        ("call", "| aerial 1M | 1.00 | 1.50 | 5.00 |"),
        ("step", "| aerial 1M | 4 | other 0.10 | **2.00** | render 9.00 | **13.00** | **6.50** |"),
        ("exchange", "| speed-up of steps in a row | 1.00 | 3.20 |"),
        ("exchange", "| MB between ranks | 0 | 12 |"),
        ("summary", "| step of 4 views on 4 GPUs, 16 M Gaussians | 2.50 ms | 1 GPU 8.00 ms | 3.2 |"),
        ("summary", "| its memory, aerial 1M | 0.50 GB | gsplat 1.00 GB | 2.0 |"),
    ],
)  # fmt: skip
def test_a_table_is_made_of_the_results(results, name, line):
    page = made(results, name)
    assert line in page and "old" not in page and "commit abc" in page
    assert page.startswith("before\n<!-- table:") and page.endswith(" -->\nafter\n")
    assert report.render_page(page, report.load_results(results)) == page


def test_a_table_without_results_names_its_command(results):
    (results / "step_4.json").unlink()
    page = made(results, "step")
    assert "python benchmarks/bm_step.py --views 4 --json benchmarks/results/step_4.json" in page
    assert "step_1" not in page and "13.00" not in page


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("step_1", {"commit": "def"}, "step_1.json is of commit def, render.json of abc"),
        ("step_1", {"commit": "abc+changes"}, "commit is abc\\+changes"),
        ("step_1", {"commit": "unknown"}, "BLITZGS_COMMIT"),
        ("other", {}, "no table is made of it"),
    ],
)
def test_results_that_do_not_belong_together_are_refused(results, name, change, message):
    (results / f"{name}.json").write_text(json.dumps(step_file(1) | change))
    with pytest.raises(report.ReportError, match=message):
        report.load_results(results)


def test_several_gpus_may_be_of_another_commit_than_the_ops_of_one(results):
    rows = {"title": "steps", "rows": [{"ranks": 2}], "commit": "def", "command": "c", "environment": {}}
    (results / "exchange.json").unlink(missing_ok=True)
    (results / "drop_in_full.json").write_text(json.dumps(rows))
    assert report.load_results(results)["drop_in_full"]["commit"] == "def"
    (results / "exchange.json").write_text(json.dumps(rows | {"commit": "abc"}))
    with pytest.raises(report.ReportError, match="exchange.json is of commit abc, drop_in_full.json of def"):
        report.load_results(results)


def test_a_table_that_nothing_makes_is_refused(results):
    with pytest.raises(report.ReportError, match="no table is called speed"):
        made(results, "speed")


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
    assert page.count("\n| ") == 6


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
