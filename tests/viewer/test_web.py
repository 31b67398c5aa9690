# SPDX-License-Identifier: Apache-2.0
"""The HTML file of a model in a headless Chromium, opened from the disk, against our own renderer."""

import json
import math
import re
import shutil

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.cli import main
from blitzgs.cli.export import MAX_MB
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import write_ply
from blitzgs.formats.selection import opacity_length
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.folder import open_run
from blitzgs.view.draw import Drawer, intrinsics
from blitzgs.view.look import Look
from blitzgs.view.views import viewmat
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.web import contributions, web_file
from blitzgs.viewer.world import World, looking
from tests.browser import Browser, wait_for
from tests.helpers import refused

WIDTH, HEIGHT = 160, 120
# The header of a model with octree levels; levels 2 and 3 end before the far half of the scene.
LOD = "comment lod reference_distance 8.0 fork 2.0 levels 4 finest 3"


def write_model(path, comments=(), degree=3, count=3000):
    """Write a cloud of thin, round, faint and opaque Gaussians with strong colours."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    sh = torch.cat([normal(count, 1, 3), 0.25 * normal(count, (degree + 1) ** 2 - 1, 3)], dim=1)
    write_ply(
        path, means=normal(count, 3), quats=normal(count, 4), scales=0.9 * normal(count, 3) - 3.5,
        opacities=2 * normal(count), sh=sh, comments=list(comments),
        levels=torch.randint(0, 4, (count,), generator=generator).float(),
    )  # fmt: skip
    return open_model(path, Ranks())


def show(browser, opened, folder):
    """Write a model as a page, and open it."""
    (folder / "m.html").write_text(web_file(opened, 10_000_000).text)
    browser.go((folder / "m.html").as_uri())


def views(opened):
    """Yield viewmat and K: from outside, and from the midst of the Gaussians with an off-centre lens."""
    world = World(opened.exhibit.space, (), opened.exhibit.box)
    start = world.start()
    yield world.viewmat(start), intrinsics(WIDTH, HEIGHT, start.fov)
    inside = looking(world.middle + 0.2 * (start.position - world.middle), world.middle, world.up, 1.0)
    yield world.viewmat(inside), np.array([[90.0, 0, 95], [0, 70, 40], [0, 0, 1]])


def shown(browser, pose, K, width=WIDTH, height=HEIGHT):  # noqa: N803
    """Return what the page shows of a view, [H, W, 3]."""
    view = f"{json.dumps(pose.tolist())}, {json.dumps(K.tolist())}, {width}, {height}"
    values = browser.evaluate(f"blitzgs.setCamera({view}).then(() => Array.from(blitzgs.pixels()))")
    return np.array(values).reshape(height, width, 4)[..., :3]


def rendered(opened, pose, K, width=WIDTH, height=HEIGHT, lod=True):  # noqa: N803
    drawer = Drawer(opened.subject, TileOwners(opened.ranks))
    return drawer.draw(Look(pose, K, width, height, lod=lod)).values.astype(int)


@pytest.fixture(scope="module")
def browser():
    with Browser("about:blank", 640, 480) as browser:
        yield browser


@pytest.mark.parametrize(
    ("comments", "degree"),
    [((), 3), (("comment SplatRenderMode: mip",), 1), ((LOD,), 0), ((LOD + " smooth",), 2)],
    ids=["classic", "antialiased", "levels", "smooth levels"],
)
def test_the_picture_is_that_of_our_renderer(browser, tmp_path, comments, degree):
    opened = write_model(tmp_path / "m.ply", comments, degree)
    show(browser, opened, tmp_path)
    for pose, K in views(opened):  # noqa: N806
        wanted, found = rendered(opened, pose, K), shown(browser, pose, K)
        assert wanted.std() > 20
        assert np.abs(found - wanted).mean() < 1.0
        assert np.quantile(np.abs(found - wanted), 0.999) < 12
        if opened.exhibit.lod:  # the levels matter here
            assert np.abs(wanted - rendered(opened, pose, K, lod=False)).mean() > 0.5
    assert browser.errors() == []


def test_a_long_name_stays_in_its_panel(browser, tmp_path):
    show(browser, write_model(tmp_path / f"{'x' * 200}.ply", count=30), tmp_path)
    assert browser.evaluate("((e) => e.scrollWidth <= e.clientWidth)(document.getElementById('panel'))")


def test_mouse_and_wheel_move_and_reset_goes_back(browser, tmp_path):
    opened = write_model(tmp_path / "m.ply", count=600)
    show(browser, opened, tmp_path)
    assert re.fullmatch(r"5\d\d of 5\d\d Gaussians", browser.evaluate("figures.textContent"))

    def picture():
        wait_for(lambda: "fps" not in browser.evaluate("figures.textContent"), 30, "the camera rests")
        return browser.screenshot()[:380].astype(int)

    def stance():
        return {name: np.array(value) for name, value in browser.evaluate("blitzgs.stance()").items()}

    first, start = picture(), stance()
    assert first.std() > 20
    browser.drag((300, 200), (380, 230))
    turned, now = picture(), stance()
    assert np.abs(turned - first).mean() > 3
    np.testing.assert_allclose(now["target"], start["target"])
    lengths = [np.linalg.norm(place["eye"] - place["target"]) for place in (start, now)]
    assert lengths[0] == pytest.approx(lengths[1])
    browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=300, y=200, deltaX=0, deltaY=-100)
    wait_for(lambda: np.linalg.norm(stance()["eye"] - stance()["target"]) < 0.9 * lengths[0], 10, "nearer")
    browser.evaluate("reset.click()")
    assert np.abs(picture() - first).mean() < 0.5
    touches = [{"x": 250, "y": 200}, {"x": 350, "y": 200}]
    browser.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=touches)
    touches = [{"x": 200, "y": 200}, {"x": 400, "y": 200}]
    browser.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=touches)
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    wait_for(lambda: np.linalg.norm(stance()["eye"] - stance()["target"]) < 0.7 * lengths[0], 10, "pinch")
    assert browser.errors() == []


def test_what_does_not_fit_is_left_out_and_stated(tmp_path):
    opened = write_model(tmp_path / "m.ply")
    whole = web_file(opened, 10_000_000)
    assert whole.left_out == "" and whole.of == 3000
    size = len(whole.text)
    fewer = web_file(opened, size - 40_000)
    assert fewer.gaussians == whole.gaussians and len(fewer.text) <= size - 40_000
    assert re.search(r"colours by direction beyond SH degree [012] of 3", fewer.left_out)
    least = web_file(opened, size - 170_000)
    assert len(least.text) <= size - 170_000 and least.gaussians < 0.8 * whole.gaussians
    left_out = whole.gaussians - least.gaussians
    assert f"{left_out:,} of {whole.gaussians:,} Gaussians" in least.left_out
    assert least.left_out in least.text
    refused(ValueError, "holds no Gaussian: choose a larger --max-mb", web_file, opened, 20_000)


def test_the_order_is_that_of_contributions(trained):
    opened = open_model(trained[1], Ranks())
    model, cameras = open_run(trained[1]).model(), opened.exhibit.cameras
    poses = np.stack([viewmat(camera, opened.exhibit.space) for camera in cameras])
    weights, _, _ = blitzgs.contributions(
        model.means, model.quats, model.scales.exp(), model.opacities.sigmoid(),
        torch.from_numpy(poses).float(), torch.from_numpy(np.stack([c.K for c in cameras])).float(),
        cameras[0].width, cameras[0].height,
    )  # fmt: skip
    found = contributions(opened.subject, cameras, Ranks())
    np.testing.assert_allclose(found, weights.sum(dim=0), rtol=1e-3, atol=1e-4)


def test_a_run_and_its_checkpoints_are_exported(browser, trained, tmp_path, capsys):
    file = tmp_path / "out" / "run.html"
    assert main(["export", str(trained[1]), "--html", str(file)]) == 0
    assert re.search(r"run.html: [\d,]+ of [\d,]+ Gaussians, 0.\d MB", capsys.readouterr().out)
    browser.go(file.as_uri())
    opened = open_model(trained[1], Ranks())
    camera = opened.exhibit.cameras[0]
    pose, K = viewmat(camera, opened.exhibit.space), np.asarray(camera.K)  # noqa: N806
    size = camera.width, camera.height
    assert np.abs(shown(browser, pose, K, *size) - rendered(opened, pose, K, *size)).mean() < 1.5
    checkpoint = max((trained[1] / "checkpoints").glob("checkpoint_*"))
    assert main(["export", str(checkpoint), "--html", str(file)]) == 0
    assert f"<title>{trained[1].name} {checkpoint.name}</title>" in file.read_text()
    assert browser.errors() == []


def test_gaussians_that_no_view_shows_are_counted(tmp_path, capsys):
    write_model(tmp_path / "m.ply")
    assert main(["export", str(tmp_path / "m.ply"), "--html", str(tmp_path / "m.html")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"m.html: 2,99\d of 3,000 Gaussians", printed)
    assert "the other Gaussians are too faint to be seen" in printed


def test_of_a_large_model_the_largest_gaussians_are_read(trained, tmp_path, monkeypatch, capsys):
    whole = open_model(trained[1], Ranks())
    ply, page = tmp_path / "a.ply", tmp_path / "a.html"
    assert main(["export", str(trained[1]), "--ply", str(ply)]) == 0
    size = opacity_length(whole.table["opacities"], whole.table["scales"])
    least = float(size.sort(descending=True).values[99])
    monkeypatch.setattr("blitzgs.cli.export._LEAST_BYTES", MAX_MB * 10_000)
    for source in (trained[1], ply):
        opened = open_model(source, Ranks(), most=100)
        table = opened.table
        assert len(table) == 100 and opened.unread == len(whole.table) - 100
        assert table["sh"].shape[1] == 1 and opened.exhibit.sh_degree == whole.exhibit.sh_degree
        found = opacity_length(table["opacities"], table["scales"])
        assert float(found.min()) + math.log(opened.subject.space.unit) == pytest.approx(
            least + math.log(whole.subject.space.unit), abs=1e-4
        )
        assert main(["export", str(source), "--html", str(page)]) == 0
        assert re.search(rf"a.html: \d+ of {len(whole.table):,} Gaussians", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("stated", "reason"),
    [
        ("8.0 fork 2.0 levels 4 finest 99999999999", "no run has these levels"),
        ("8.0 fork 2.0 levels 999999999 finest 3", "no run has these levels"),
        ("8.0 fork 2.0 levels 4 finest 3 least nan", "no run has these levels"),
        ("8.0 fork 1.0 levels 4 finest 3 smooth", "no run has these distances"),
        ("nan fork 2.0 levels 4 finest 3", "no run has these distances"),
        ("far fork 2.0 levels 4 finest 3", "could not convert"),
    ],
)
def test_a_header_with_impossible_levels_is_refused(tmp_path, stated, reason):
    line = f"comment lod reference_distance {stated}"
    message = f"m.ply: the header line '{line[:80]}.*export the file again: .*{reason}"
    refused(ValueError, message, write_model, tmp_path / "m.ply", (line,), 0, 20)


@pytest.mark.parametrize("up", ["comment up 1e200 0 0", "comment up 0 1e-200 0", "comment up 0 0 0"])
def test_an_upward_direction_without_a_length_is_none(tmp_path, up):
    assert write_model(tmp_path / "m.ply", (up,), 0, 20).exhibit.up is None


def test_wrong_flags_are_named(trained, tmp_path, failure):
    page, ply = ["--html", str(tmp_path / "a.html")], ["--ply", str(tmp_path / "a.ply")]
    for flags, reason in (
        ([*page, "--classic"], "--classic is not for --html"),
        ([*page, "--min-opacity", "0"], "--min-opacity is not for --html"),
        ([*ply, "--max-mb", "3"], "--max-mb is for --html"),
        (["--html", str(tmp_path / "a.txt")], "choose a --html that ends in .html"),
        ([*page, "--max-mb", "0.001"], "choose a larger --max-mb"),
    ):
        assert reason in failure("export", trained[1], *flags)
    assert list(tmp_path.iterdir()) == []
    mine = tmp_path / "a.html"
    mine.write_text("mine")
    assert main(["export", str(trained[1]), *page]) == 1
    assert mine.read_text() == "mine"
    shutil.copy(mine, tmp_path / "b.ply")
    assert "b.ply" in failure("export", tmp_path / "b.ply", *page[:1], tmp_path / "c.html")
