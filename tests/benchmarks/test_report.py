# SPDX-License-Identifier: Apache-2.0
"""Pages of figures match the results of one commit, and the record of GPU tests keeps what ran."""

import json
import subprocess
import sys
import time
from pathlib import Path

import gpu_record
import harness
import measure
import pytest
import report
import report_tables

PAGE = "before\n<!-- table: {0} -->\nold\n<!-- end: {0} -->\nafter\n"


def made(folder, name):
    return report.render_page(PAGE.format(name), report.load_results(folder))


def test_the_pages_match_the_results_in_the_repository(capsys):
    assert report.main(["--check"]) == 0, capsys.readouterr().err


def run(monkeypatch, benchmark, *flags):
    monkeypatch.setattr(sys, "argv", [str(Path(benchmark.__file__)), *map(str, flags)])
    monkeypatch.setenv("BLITZGS_COMMIT", "abc")
    benchmark.main()


def measure_with(monkeypatch, tmp_path, command):
    monkeypatch.setattr(measure, "COMMANDS", {"exchange": command, "quality": "python CAPTURE", "step_1": ""})
    gpus = {"exchange": 0, "quality": 0, "step_1": 4}
    monkeypatch.setattr(measure, "PLAN", tuple(measure.Job(*job) for job in gpus.items()))
    monkeypatch.setenv("BLITZGS_COMMIT", "abc")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folders = ["--work", str(tmp_path / "work"), "--results", str(tmp_path / "results")]
    return measure.main([*folders, "--gpus", "0", "--only", "exchange", "quality", "step_1"])


def test_one_command_measures_what_it_can_and_continues(tmp_path, monkeypatch, capsys):
    assert measure_with(monkeypatch, tmp_path, "python benchmarks/bm_nothing.py") == 1
    printed = capsys.readouterr().out
    assert f"exchange: FAILED, see {tmp_path}/work/exchange.log" in printed
    assert (
        "quality: not measured, needs a capture" in printed
        and "step_1: not measured, needs 4 GPUs" in printed
    )
    assert "bm_nothing.py" in (tmp_path / "work" / "exchange.log").read_text()
    flags = "--gaussians 2000 --ranks 1 2 --batch 1 --batches 1 --visits 1 --device cpu"
    good = f"python benchmarks/bm_exchange.py {flags}"
    measure_with(monkeypatch, tmp_path, good)
    assert "exchange: done" in capsys.readouterr().out
    # What the benchmark writes is what the report reads.
    page = made(tmp_path / "results", "exchange")
    assert f"`{good}`" in page and "commit abc" in page
    for line in ("| project | ", "| optimiser | ", "| **steps in a row** | ", "| MB between ranks | 0 | "):
        assert f"\n{line}" in page
    measure_with(monkeypatch, tmp_path, good)
    assert "exchange" not in capsys.readouterr().out
    path = tmp_path / "results" / "exchange.json"
    content = json.loads(path.read_text())
    content["results"][0]["status"] = "failed"
    path.write_text(json.dumps(content))
    assert not measure.is_measured(path)


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


FILES = {
    "good/test_counts.py": "def test_passes(): pass\n\n@pytest.mark.skip\ndef test_is_skipped(): pass\n\n"
    "def test_fails():\n    assert 2 + 2 == 5, 'no sum'\n",
    "good/test_not_collected.py": "import a_module_that_nobody_has\n",
    "killed/test_dies.py": "import os\n\ndef test_dies(): os.abort()\n",
    "killed/test_lives.py": "def test_lives(): pass\n",
    "test_alone.py": "def test_alone(): pass\n\n@pytest.mark.other\ndef test_other(): pass\n",
}
ABOUT = {
    "commit": "abc",
    "date": "2026-01-31",
    "environment": {
        "device": "a card", "memory_gb": 80.0, "gpus": 1, "driver": "580.1", "cuda": "13.0", "torch": "2.11",
        "python": "3.12",
    },
}  # fmt: skip


def write(folder, files):
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = other\n")
    for name, text in files.items():
        path = folder / "tests" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"import pytest\n\n{text}")


@pytest.fixture
def no_bench(monkeypatch):
    monkeypatch.setattr(gpu_record, "BENCHES", {})
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # they take most of pytest's start


def test_counts_hold_although_a_file_is_not_collected_and_a_process_dies(tmp_path, no_bench):
    write(tmp_path, FILES)
    record = gpu_record.Record(tmp_path / "gpu_record.json", ABOUT, resume=False)
    end = time.monotonic() + 100
    assert not gpu_record.make_record(record, [tmp_path / "tests"], "not other", tmp_path, end, jobs=2)
    content = json.loads((tmp_path / "gpu_record.json").read_text())
    assert content["complete"]
    tests = content["tests"]
    assert [tests[name] for name in gpu_record.COUNTS] == [3, 1, 2, 1]
    problems = {p["name"]: p["message"] for p in tests["problems"]}
    assert "no sum" in problems.pop("tests.good.test_counts.test_fails")
    assert "status -6" in problems.pop("test_dies.py")
    assert "a_module_that_nobody_has" in problems.popitem()[1] and not problems
    assert (
        content["rooms"]["tests/killed"]["state"] == "died"
        and content["rooms"]["tests/test_alone"]["passed"] == 1
    )
    lines = report_tables.SECTIONS["gpu_record"].lines(content)
    assert "| tests | 3 passed, 1 failed, 2 errors, 1 skipped in " in "\n".join(lines)
    assert "**GPU tests: 3 passed, 3 failed**, 1 skipped (a card" in report_tables.badge_lines(content)[0]


def test_a_run_that_is_cut_off_keeps_its_results_and_goes_on(tmp_path, no_bench):
    slow = "import time\n\ndef test_quick(): pass\n\ndef test_slow(): time.sleep(60 if {} else 0)\n"
    write(tmp_path, {"a/test_a.py": "def test_a(): pass\n", "b/test_b.py": slow.format(True)})
    path, tests = tmp_path / "gpu_record.json", [tmp_path / "tests"]
    record = gpu_record.Record(path, ABOUT, resume=False)
    assert not gpu_record.make_record(record, tests, "not other", tmp_path, time.monotonic() + 100, longest=5)
    content = json.loads(path.read_text())
    assert not content["complete"] and content["rooms"]["tests/b"]["state"] == "cut off"
    assert content["tests"]["passed"] == 2 and content["tests"]["failed"] == 0

    write(tmp_path, {"b/test_b.py": slow.format(False)})
    record = gpu_record.Record(path, ABOUT, resume=True)
    assert gpu_record.make_record(record, tests, "not other", tmp_path, time.monotonic() + 100)
    content = json.loads(path.read_text())
    assert content["complete"] and content["tests"]["passed"] == 3
    with pytest.raises(SystemExit, match=r"another commit \(abc, now def\)"):
        gpu_record.Record(path, ABOUT | {"commit": "def"}, resume=True)


def test_the_bench_is_a_row_for_each_scene_or_the_reason_why_not(tmp_path, monkeypatch):
    render = {"results": [{"scene": "aerial 1M", "blitzgs": {"total": 0.96, "peak_gb": 0.1}}]}
    step = {"results": [{"scene": "aerial 4M", "views": 4, "blitzgs": {"ms": {"total": 3.3}, "peak_gb": 4}}]}
    assert gpu_record.bench_rows("render", render) == [
        {"work": "render forward + backward, aerial 1M", "ms": 0.96, "peak_gb": 0.1}
    ]
    assert gpu_record.bench_rows("step", step)[0]["work"] == "training step of 4 views, aerial 4M"
    (tmp_path / "bm_broken.py").write_text("raise SystemExit('no such card')")
    monkeypatch.setitem(gpu_record.BENCHES, "step", (tmp_path / "bm_broken.py", "--views", "4"))
    (row,) = gpu_record.bench_rows("step", gpu_record.bench("step", tmp_path, time.monotonic() + 60))
    assert row == {"work": "step", "error": "no such card"}


def test_the_age_is_counted_in_commits_and_never_fails(tmp_path, monkeypatch, capsys):
    def git(*words):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout.strip()

    monkeypatch.setattr(harness, "ROOT", tmp_path)
    monkeypatch.setattr(gpu_record, "OLD", 2)

    def said():
        assert gpu_record.main(["--age", "--out", str(tmp_path)]) == 0
        return capsys.readouterr().out

    assert "there is none" in said() and "make gpu-record" in said()
    git("init")
    git("commit", "--allow-empty", "-m", "first")
    record = tmp_path / "gpu_record.json"
    record.write_text(json.dumps({"commit": git("rev-parse", "HEAD")}))
    assert "0 commits old" in said()
    for _ in range(3):
        git("commit", "--allow-empty", "-m", "more")
    assert "3 commits old" in said() and "at most 2 are meant" in said()
    record.write_text(json.dumps({"commit": "0123456789"}))
    assert "does not have" in said()
