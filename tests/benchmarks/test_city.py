# SPDX-License-Identifier: Apache-2.0
"""The city's benchmark: its arms, phases, deadline, and what the report makes of its JSON."""

import json
from pathlib import Path

import bm_city
import city_report
import city_run
import pytest
import report

from blitzgs.config.files import load_config
from tests.training.tiny import write_tiny_capture

ROOT = Path(__file__).resolve().parents[2]

# 26 steps of 4 images.
TINY = ["--gpus", "0", "--held-out", "2", "--scale", "0.004", "--log.every=8", "--data.threads=1"]


@pytest.fixture
def city(tmp_path, monkeypatch):
    monkeypatch.setenv("BLITZGS_COMMIT", "abc")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    folder = tmp_path / "a city"
    write_tiny_capture(folder)
    manifest = {"extent": 20.0, "views": 8, "width": 48, "height": 32}
    (folder / "city.json").write_text(json.dumps(manifest))
    (tmp_path / "log").write_text("8 of 8 images, 3 s\n/tmp/city: 8 images of 48 x 32, 4.5 s\n")
    return folder


def call(city, *flags):
    out = city.parent / "out"
    flags = [*TINY, *flags, "--json", str(city.parent / "city.json")]
    status = bm_city.main([str(city), "--out", str(out), *flags])
    return status, json.loads((city.parent / "city.json").read_text())


@pytest.mark.slow
def test_arms_ranks_and_popping_become_tables(city, capsys):
    flags = ["--arms", "full", "all_off", "--ranks", "1", "2", "--batch-sizes", "4", "8", "--popping", "3"]
    status, file = call(city, *flags, "--generation-log", str(city.parent / "log"))
    assert status == 0
    assert file["commit"] == "abc" and file["city"]["seconds"] == 4.5 and file["city"]["images"] == 8
    runs = file["results"]
    assert [(run["recipe"], run["ranks"], run["batch_size"]) for run in runs] == [
        ("full", 1, 4), ("full", 1, 8), ("all_off", 1, 4), ("full", 2, 4), ("full", 2, 8),
    ]  # fmt: skip
    for run in runs:
        assert run["finished"] and run["images"] == 104 and run["views"] == {"train": 6, "test": 2}
        assert 5 < run["psnr"] < 60 and len(run["host_peak_bytes"]) == run["ranks"]
        assert sum(phase["seconds"] for phase in run["phases"]) == pytest.approx(run["seconds"])
    assert [phase["on"] for phase in runs[0]["phases"]] == [
        "growth", "growth + mask", "LOD + mask", "LOD + mask", "LOD",
    ]  # fmt: skip
    assert {event["event"] for event in runs[0]["events"]} == set(city_run.EVENTS)
    assert [phase["on"] for phase in runs[2]["phases"]] == ["growth", "growth", "–", "–", "–"]
    assert ["popping" in run for run in runs] == [True, False, False, False, False]
    assert "<svg" in (city.parent / "out" / "popping" / "popping.svg").read_text()
    for name, rows_of in city_report.TABLES.items():
        assert rows_of(file), f"{name} is empty"
    page = report.render_page("<!-- table: city_ranks -->\n<!-- end: city_ranks -->\n", {"city_ranks": file})
    assert "\n| LOD gate and mask | 8 | 2 | " in page and "commit abc" in page
    # The same command trains nothing again.
    before = {path: path.stat().st_mtime_ns for path in (city.parent / "out" / "runs").iterdir()}
    assert call(city, *flags)[0] == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert "LOD gate and mask, 2 ranks" in capsys.readouterr().out


def test_a_run_is_evaluated_at_its_deadline(city, capsys):
    flags = ["--arms", "no_mask", "--seconds-per-run", "17", "--scale", "50", "--log.every=100"]
    status, file = call(city, *flags)
    (run,) = file["results"]
    assert status == 0 and not run["finished"] and run["status"] == "done"
    assert 0 < run["images"] < run["planned_images"] and run["psnr"] > 5
    assert f"(stopped at {run['images']:,} of 1,300,000 images)" in capsys.readouterr().out


def test_a_run_that_ends_early_leaves_what_is_known(city, capsys):
    status, file = call(city, "--arms", "full", "--popping", "3")
    (run,) = file["results"]
    assert status == 0 and run["finished"] and run["popping"]["frames"] == 3
    (path,) = (city.parent / "out" / "runs").iterdir()
    whole = json.loads(path.read_text())
    for missing in (["psnr", "ssim"], ["phases"], ["command", "environment", "finished"]):
        for name in missing:
            del whole[name]
        path.write_text(json.dumps(whole | {"status": "running"}))
        assert bm_city.main([str(city), "--out", str(city.parent / "out"), "--collect"]) == 0
        assert "Not done: city.full" in capsys.readouterr().out


def test_a_city_that_is_not_finished_is_refused(city, capsys):
    (city / "city.json").unlink()
    with pytest.raises(SystemExit):
        call(city)
    assert "wait until blitzgs synth has ended" in capsys.readouterr().err


def test_wrong_arguments_are_refused(city, capsys):
    with pytest.raises(SystemExit):
        call(city, "--held-out", "8")
    assert "--held-out must be below the number of views, 8, got 8" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        bm_city.main([str(city), "--out", str(city.parent / "empty"), "--collect"])
    assert "empty" in capsys.readouterr().err


def test_phases_divide_the_time_between_records():
    config = load_config(None, ["schedule.iterations=1000", "schedule.densify_until=400", "schedule.t1=0",
                                "schedule.t2=400", "view.lod=true"])  # fmt: skip
    # 100 images/s for 400 images, then 200.
    seconds = {200: 2.0, 400: 4.0, 600: 5.0, 800: 6.0}
    records = [{"event": "start", "t": 0}]
    for t, at in seconds.items():
        speed = {"images_per_second": t / at}
        records.append({"loss": 1.0, "t": t, "active": t / 10, "visible": 10.0, "gaussians": 1000} | speed)
    phases = city_run.phases_of(config, records, 1000, 7.0)
    assert [(phase["from"], phase["to"], phase["on"]) for phase in phases] == [
        (0, 400, "growth"), (400, 700, "LOD"), (700, 1000, "LOD"),
    ]  # fmt: skip
    assert [phase["seconds"] for phase in phases] == pytest.approx([4.0, 1.5, 1.5])
    assert [phase["median_images_per_second"] for phase in phases] == pytest.approx([100, 200, 200])
    assert phases[0]["active"] == pytest.approx(0.03) and phases[0]["visible"] == pytest.approx(0.01)
