# SPDX-License-Identifier: Apache-2.0
"""The report and the comparison, as data and in a headless Chromium that opens them from the disk."""

import json
import re
import shutil
import time
import warnings

import numpy as np
import pytest
import torch

from blitzgs.capture.world import GEO, GEOCENTRIC, WorldFrame
from blitzgs.cli import main
from blitzgs.report.gather import MAX_POINTS, _thinned
from blitzgs.report.report import MAX_BYTES, compare, differences, fitted, labels, report
from blitzgs.runs.evaluation import PARTS, Previews, preview_file
from blitzgs.runs.folder import open_run
from blitzgs.util.errors import kept_warnings
from tests.browser import Browser, wait_for
from tests.helpers import refused
from tests.training.tiny import OVERRIDES, as_flags, at_step, events_of, train, write_tiny_capture

HOSTILE = "</script><img src=x onerror=\"document.title='hit'\">&amp;\u2028.jpg"


def trained_run(data, folder, scale):
    """Train the tiny capture with the command line; 4 of its 8 views are held out."""
    flags = as_flags("config=defaults", *OVERRIDES, "data.split=2", f"schedule.scale={scale}")
    assert main(["train", "--data", str(data), "--out", str(folder), *flags]) == 0
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A capture and a short run of it."""
    data = tmp_path_factory.mktemp("capture")
    write_tiny_capture(data)
    return data, trained_run(data, tmp_path_factory.mktemp("runs") / "run", 0.4)


def data_of(text):
    """Return the data that a page's scripts read."""
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def copied(trained, folder, **changes):
    """Copy a run, and change its JSON files: name without suffix -> function of the content."""
    shutil.copytree(trained[1], folder)
    for name, change in changes.items():
        (file,) = [*folder.glob(f"{name}.json"), *folder.glob(f"evaluation/*/{name}.json")]
        file.write_text(json.dumps(change(json.loads(file.read_text()))))
    return folder


def test_a_training_writes_its_report(trained):
    folder = trained[1]
    text = (folder / "report.html").read_text()
    data, run = data_of(text), open_run(folder)
    (measured,) = run.metrics().values()
    assert [row[0] for row in data["views"]] == list(measured["views"])
    for name, *values in data["views"]:
        assert values == pytest.approx([measured["views"][name][m] for m in data["metrics"]], rel=1e-5)
    steps = [record for record in run.log() if "loss" in record]
    assert [p[0] for p in data["curves"]["loss"]] == [record["t"] for record in steps]
    assert [p[2] for p in data["curves"]["memory_bytes"]] == pytest.approx(
        [record["memory_bytes"] for record in steps], rel=1e-4
    )
    assert min(record["memory_bytes"] for record in steps) > 1e7
    assert data["curves"]["held_out"][-1][2] == pytest.approx(measured["psnr"], rel=1e-4)
    cameras = run.cameras()
    assert [p[2] for p in data["cameras"]["points"]] == [int(k in cameras.test) for k in range(8)]
    assert all(isinstance(p[3], float) for p in data["cameras"]["points"])
    assert data["cameras"]["trained_known"]
    assert data["config"] == (folder / "config.yaml").read_text()
    assert data["environment"]["torch"] == torch.__version__
    assert data["pictures"] and all(len(view["layers"]) == 3 for view in data["pictures"])
    # The stages add up to the time.
    summary = run.summary()
    apart = {name: data["stages"].pop(name) for name in ("setup", "evaluate", "final_checkpoint")}
    assert {"steps", "densify"} <= set(data["stages"]) and min(apart.values()) >= 0
    assert sum(data["stages"].values()) == pytest.approx(summary["seconds"], abs=0.05)
    # Nothing is loaded from elsewhere.
    outside = re.findall(
        r"""(?:src|href)\s*=\s*["'](?!data:|#)[^"']*|url\((?!data:)|@import|https?://[^"\s]*""", text
    )
    assert set(outside) <= {"http://www.w3.org/2000/svg"}


def test_the_plan_is_seen_from_above(trained):
    run = open_run(trained[1])
    points = np.array([p[:2] for p in data_of(report(trained[1]))["cameras"]["points"]])
    poses = [camera.world_to_camera for camera in run.cameras().cameras]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    size = np.ptp(centres, axis=0).max()
    flat = np.linalg.norm(points[:, None] - points[None], axis=2)
    space = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    assert (flat <= space + 1e-3 * size).all()
    assert flat.max() > 0.5 * size


def test_the_plan_is_in_metres_where_gps_gave_the_world(trained, tmp_path):
    folder = copied(trained, tmp_path / "run")
    plain = data_of(report(folder))["cameras"]
    (folder / GEO).write_text(json.dumps(WorldFrame(GEOCENTRIC, scale=2.0).as_json()))
    metres = data_of(report(folder))["cameras"]
    assert (plain["unit"], metres["unit"]) == ("unit", "m")
    np.testing.assert_allclose(
        [p[:2] for p in metres["points"]], [[2 * x for x in p[:2]] for p in plain["points"]], atol=0.02
    )
    (folder / GEO).write_text("{")
    data = data_of(report(folder))
    assert data["cameras"] == plain and GEO in json.dumps(data)


def test_measured_training_views_are_coloured_too(trained, tmp_path):
    folder = copied(trained, tmp_path / "run")
    (at_the_end,) = folder.glob("evaluation/*/trained.json")
    at_the_end.unlink()  # which colours them, too
    before = data_of(report(folder))["cameras"]
    assert [p[3] is not None for p in before["points"]] == [bool(p[2]) for p in before["points"]]
    arguments = ["eval", str(folder), "--data", str(trained[0]), "--split", "train", "--pictures", "0"]
    assert main(arguments) == 0
    after = data_of(report(folder))
    views = open_run(folder).metrics()["train"]["views"]
    assert after["cameras"]["trained_known"] and not before["trained_known"]
    for *_, held_out, psnr, name in after["cameras"]["points"]:
        assert held_out or psnr == pytest.approx(views[name]["psnr"], abs=0.006)
    assert len(after["views"]) == 4  # those of the held-out views


def test_names_and_warnings_cannot_become_markup(trained, tmp_path):
    def renamed(content):
        content["views"] = {HOSTILE: next(iter(content["views"].values()))}
        return content

    folder = copied(trained, tmp_path / "run", metrics=renamed)
    with open(folder / "log.jsonl", "a") as file:
        run = open_run(folder).log()[0]["run"]
        file.write(json.dumps({"t": 40, "run": run, "event": "warned", "warning": HOSTILE}) + "\n")
        file.write('{"t": 40, "run": NaN, "torn')
    text = report(folder)
    assert HOSTILE not in text and text.count("</script>") == 3
    data = data_of(text)
    assert data["views"][0][0] == HOSTILE
    assert [40, "warning", HOSTILE] in data["warnings"]


def test_an_unfinished_or_damaged_run_has_a_report(trained, tmp_path):
    folder = copied(trained, tmp_path / "run")
    (folder / "summary.json").unlink()
    (file,) = folder.glob("evaluation/*/metrics.json")
    file.write_text('{"views": [1')
    data = data_of(report(folder))
    assert "not finished" in data["subtitle"] and data["views"] == [] and data["pictures"] == []
    assert any(str(file) in sentence and "damaged" in sentence for sentence in data["left_out"])
    file.write_text(f'{{"views": {{"a": {{"psnr": {10**400}, "ssim": 0.5}}}}}}')  # no float is so large
    assert data_of(report(folder))["views"] == [["a", 0.5]]


def test_two_thousand_held_out_views_stay_below_ten_megabytes():
    source = "x" * 333_333  # of a picture that hardly compresses, in base64
    picture = {"name": "a", "note": "", "layers": [{"label": part, "src": source} for part in PARTS]}
    rows = [[f"{k:05d}.jpg", *np.random.default_rng(k).random(4)] for k in range(2000)]
    content = {"views": rows, "pictures": [picture] * 16, "left_out": ["Before."]}
    text = fitted("a", ("parts.js", "report.js"), content, {"html": "x" * 4_000_000, "note": ""})
    data = data_of(text)
    assert len(text.encode()) <= MAX_BYTES == 10_000_000
    assert len(data["views"]) == 2000 and 8 < len(data["pictures"]) < 11
    assert data["left_out"] == [
        "Before.",
        "The model in 3D is left out to keep this file small.",
        f"{16 - len(data['pictures'])} pictures are left out to keep this file small.",
    ]
    refused(ValueError, "without any picture", fitted, "a", (), content | {"views": "x" * MAX_BYTES})


def test_long_curves_are_thinned_to_means():
    loss = _thinned([(k, float(k), 0.5 + 0.1 * (-1) ** k) for k in range(10_000)])
    assert len(loss) <= MAX_POINTS and loss[-1][0] == 9_999
    assert [p[2] for p in loss] == pytest.approx([0.5] * len(loss), abs=0.01)


def test_only_pages_of_ours_are_replaced(trained, tmp_path, failure):
    file = tmp_path / "mine.html"
    file.write_text("<p>precious</p>")
    for command in (["report", str(trained[1])], ["compare", str(trained[1]), str(trained[1])]):
        assert "mine.html exists" in failure(*command, "--out", file)
    assert file.read_text() == "<p>precious</p>"
    assert main(["report", str(trained[1])]) == 0  # over that of the training
    assert "two runs" in failure("compare", trained[1])
    assert main(["report", str(tmp_path)]) == 1


def test_a_report_that_fails_does_not_fail_the_training(trained, tmp_path, monkeypatch, capsys):
    def fails(*_):
        raise KeyError("a fault")

    monkeypatch.setattr("blitzgs.report.report.report", fails)
    flags = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.2")
    with pytest.warns(UserWarning, match="the report was not written"):
        assert main(["train", "--data", str(trained[0]), "--out", str(tmp_path / "run"), *flags]) == 0
    assert "report:" not in capsys.readouterr().out  # it does not point to a file that is not there


def test_warnings_come_into_the_log(tmp_path, monkeypatch):
    with pytest.warns(UserWarning, match="inverted"), kept_warnings() as texts:
        warnings.warn("masks may be inverted", stacklevel=1)
    assert texts == ["masks may be inverted"]
    at_step(monkeypatch, 3, lambda trainer: trainer.warned.extend(texts * 2))
    _, summary = train(tmp_path, "schedule.iterations=20")
    assert summary["warnings"] == texts
    assert [event["warning"] for event in events_of(tmp_path, "warned")] == texts


def test_previews_are_those_of_the_best_and_worst_views_of_all_ranks(tmp_path):
    rng = np.random.default_rng(0)
    psnr = dict(enumerate((20 + 10 * rng.random(40)).tolist()))
    image = torch.rand(20, 30, 3)
    parts = [Previews(tmp_path, {5, 6}) for _ in range(3)]
    for index, value in psnr.items():
        parts[index % 3].add(index, value, image, (image * 255).to(torch.uint8), None)
    files = [entry for rank, part in enumerate(parts) for entry in part.files(psnr, rank == 0)]
    ordered = sorted(psnr, key=psnr.get)
    chosen = {*ordered[:4], *ordered[-4:], 5, 6}
    folder = tmp_path / "previews"
    wanted = {preview_file(folder, index, part) for index in chosen for part in PARTS}
    assert {path for path, _ in files} == wanted | {folder / "views.json"}
    assert json.loads(dict(files)[folder / "views.json"]) == sorted(chosen)


def test_differences_and_labels(trained, tmp_path):
    a, b = {"x": {"y": 1, "z": [1]}, "w": None}, {"x": {"y": 2, "z": [1]}, "v": 3}
    assert differences([a, b]) == [["x.y", "1", "2"], ["w", "None", "–"], ["v", "–", "3"]]
    one, two = tmp_path / "a" / "run", tmp_path / "b" / "run"
    assert labels([one, two]) == ["a/run", "b/run"]
    assert labels([one, one]) == ["run (1)", "run (2)"]


@pytest.fixture(scope="module")
def other(trained, tmp_path_factory):
    """A second, shorter run of the capture, and a page that compares both."""
    folder = trained_run(trained[0], tmp_path_factory.mktemp("other") / "short", 0.2)
    page = folder.parent / "compare.html"
    assert main(["compare", str(trained[1]), str(folder), "--out", str(page)]) == 0
    return folder, page


def test_a_comparison_has_what_differs(trained, other):
    data = data_of(compare([trained[1], other[0]]))
    rows = {row[0]: row[1:] for row in data["differences"]}
    assert rows["schedule.scale"] == ["0.4", "0.2"]
    runs = [open_run(folder) for folder in (trained[1], other[0])]
    psnr = data["metrics"].index("psnr")
    for name, values in data["views"]:
        for found, run in zip(values, runs, strict=True):
            (measured,) = run.metrics().values()
            assert found[psnr] == pytest.approx(measured["views"][name]["psnr"], rel=1e-5)
    shown = [layer["label"] for layer in data["pictures"][0]["layers"]]
    assert shown == ["photograph", "run, render", "short, render", "run, error", "short, error"]


def test_a_comparison_of_other_cameras_says_so(trained, tmp_path):
    run = tmp_path / "changed"
    shutil.copytree(trained[1], run)
    stored = json.loads((run / "cameras.json").read_text())

    def notes(**changes):
        cameras = [camera | changes.get("each", {}) for camera in stored["cameras"]]
        lists = {"cameras": cameras, "test": changes.get("test", stored["test"])}
        (run / "cameras.json").write_text(json.dumps(stored | lists))
        return " ".join(data_of(compare([trained[1], run]))["left_out"])

    assert notes() == ""
    for changes, differs in (
        ({"each": {"width": 9}}, "sizes of images"),
        ({"each": {"world_to_camera": np.eye(4).tolist()}}, "poses"),
        ({"test": stored["test"] + stored["train"][:1]}, "held-out views"),
        ({"each": {"name": "a.jpg"}}, "photographs, held-out views"),
    ):
        with pytest.warns(UserWarning, match=f"changed has other {differs} than run, so"):
            assert f"changed has other {differs} than run" in notes(**changes)


@pytest.fixture(scope="module")
def browser(trained):
    with Browser("about:blank") as browser:
        opened(browser, trained[1] / "report.html")
        yield browser


def opened(browser, page):
    """Open a page from the disk."""
    browser.call("Page.navigate", url=f"file://{page}")
    wait_for(
        lambda: browser.evaluate(
            f"location.pathname === {json.dumps(str(page))}"
            " && document.querySelectorAll('section').length > 3"
        ),
        30,
        "the page",
    )


def column(browser, section, number):
    return browser.evaluate(
        f"[...document.querySelectorAll('#{section} tbody tr')].map(r => r.children[{number}].textContent)"
    )


def test_the_report_opens_from_the_disk(browser):
    def counts():
        return browser.evaluate(
            "['.chart polyline', '.bar div', '.thumb', '.tile'].map(s => document.querySelectorAll(s).length)"
        )

    wait_for(lambda: counts()[0] >= 4 and min(counts()) >= 2, 30, "curves, stages and pictures")
    coloured = """(() => {
      const c = document.querySelector('canvas.plan');
      const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
      return d.some((v, k) => k % 4 === 3 && v > 0);
    })()"""
    assert browser.evaluate(coloured)
    assert browser.screenshot().std() > 10
    assert browser.errors() == []


def test_a_click_on_a_title_sorts_the_table(browser):
    first = [float(text) for text in column(browser, "views", 1)]
    assert first == sorted(first)
    browser.evaluate("document.querySelectorAll('#views th button')[1].click()")
    assert [float(text) for text in column(browser, "views", 1)] == sorted(first, reverse=True)
    browser.evaluate("document.querySelectorAll('#views th button')[0].click()")
    names = column(browser, "views", 0)
    assert names == sorted(names)


def test_a_wipe_changes_the_picture(browser):
    browser.evaluate("document.querySelector('.stage').scrollIntoView()")
    time.sleep(0.3)
    box = browser.evaluate("(() => { const b = document.querySelector('.stage').getBoundingClientRect();"
                           "return [b.x, b.y, b.width, b.height]; })()")  # fmt: skip
    x, y, width, height = box
    y = min(y + height / 2, 700)

    def share():
        return float(browser.evaluate("document.querySelector('.wipe').value"))

    browser.click(x + 0.1 * width, y)
    before, at = browser.screenshot().astype(int), share()
    browser.drag((x + 0.1 * width, y), (x + 0.9 * width, y))
    after = browser.screenshot().astype(int)
    assert at == pytest.approx(10, abs=1) and share() == pytest.approx(90, abs=1)
    assert np.abs(after - before)[:, int(x + 0.2 * width) : int(x + 0.8 * width)].mean() > 1
    browser.press("Side by side")
    assert browser.evaluate("document.querySelectorAll('.beside img').length") == 3
    browser.press("Wipe")
    assert browser.errors() == []


@pytest.mark.slow
def test_the_model_is_shown_in_three_dimensions(browser):
    browser.evaluate("document.querySelector('#look button').click()")
    browser.evaluate("document.querySelector('#look').scrollIntoView()")

    def shown():
        box = browser.evaluate("(() => { const b = document.querySelector('.look').getBoundingClientRect();"
                               "return [b.x, b.y, b.width, b.height].map(Math.round); })()")  # fmt: skip
        x, y, width, _ = box
        return browser.screenshot()[y + 20 : y + 350, x + 20 : x + width - 20].astype(int)

    wait_for(lambda: shown().std() > 3, 60, "the model")
    before = shown()
    x, y = browser.evaluate("(() => { const b = document.querySelector('.look').getBoundingClientRect();"
                            "return [b.x + b.width / 2, b.y + 150]; })()")  # fmt: skip
    browser.drag((x, y), (x + 120, y))
    wait_for(lambda: np.abs(shown() - before).mean() > 1, 60, "another picture")
    assert browser.errors() == []


def test_both_pages_fit_a_phone(trained, other, browser):
    size = {"height": 720, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", width=390, **size)
    for page in (trained[1] / "report.html", other[1]):
        opened(browser, page)
        assert browser.evaluate("document.documentElement.scrollWidth") <= 390
        assert browser.errors() == []
    browser.call("Emulation.setDeviceMetricsOverride", width=1280, **size)


def test_hostile_names_are_shown_as_they_are(trained, tmp_path, browser):
    def renamed(content):
        content["cameras"] = [
            camera | {"name": f"{k}{HOSTILE}"} for k, camera in enumerate(content["cameras"])
        ]
        return content

    def measured(content):
        names = [f"{k}{HOSTILE}" for k in open_run(trained[1]).cameras().test]
        content["views"] = dict(zip(names, content["views"].values(), strict=True))
        return content

    def widths(kind):
        return browser.evaluate(f"[...document.querySelectorAll('{kind}')].map(e => e.offsetWidth)")

    folder = copied(trained, tmp_path / ("x" * 200), cameras=renamed, metrics=measured)
    page = tmp_path / "compare.html"
    assert main(["compare", str(trained[1]), str(folder), "--out", str(page)]) == 0
    opened(browser, page)
    assert sum(widths("#figures th")) <= browser.evaluate("innerWidth")
    assert main(["report", str(folder)]) == 0
    opened(browser, folder / "report.html")
    assert widths(".thumb") and set(widths(".thumb")) == {118}
    assert HOSTILE in column(browser, "views", 0)[0]
    time.sleep(0.3)
    assert browser.evaluate("document.title") == f"{folder.name} · report"
    assert browser.evaluate("document.querySelectorAll('img[src=x]').length") == 0
    assert browser.errors() == []
