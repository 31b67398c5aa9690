# SPDX-License-Identifier: Apache-2.0
"""The page in a headless Chromium, with models rendered on the CPU."""

import contextlib
import json
import math
import re
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra view is not installed")

from blitzgs.cli.train import live_page
from blitzgs.cli.view import photographs
from blitzgs.distributed.group import Ranks
from blitzgs.runs.folder import open_run
from blitzgs.training.trainer import Trainer
from blitzgs.view.draw import Drawer
from blitzgs.viewer.paths import from_json
from blitzgs.viewer.studio import Studio, open_model
from blitzgs.viewer.visitor import EYE_HEIGHT
from blitzgs.viewer.world import SCALE, looking
from tests.browser import Browser, wait_for
from tests.helpers import export_ply
from tests.training.tiny import tiny_config, tiny_scene


def settled(studio):
    """Wait until the one visitor sees a picture of full quality of what is asked for; return the visitor."""
    wait_for(lambda: studio.page.visitors, 60, "the page is open")
    visitor = next(iter(studio.page.visitors.values()))
    time.sleep(0.4)  # the camera is still

    def sharp():
        shown = visitor.shown
        return shown is not None and shown.ask.scale == 1.0 and shown.ask.version == visitor.version

    wait_for(sharp, 60, "a picture of full quality")
    return visitor


def picture(browser):
    """Return the page without its panel and the figures."""
    return browser.screenshot()[160:560, 20:760].astype(int)


def drawn(studio, browser):
    """Wait until the page shows a picture of full quality; return it."""
    settled(studio)
    time.sleep(0.6)  # the browser draws it
    return picture(browser)


@pytest.fixture(scope="module")
def studio(trained):
    data, folder = trained
    opened = open_model(folder, Ranks(), photographs(folder, data))
    with contextlib.closing(Studio(opened, port=0)) as studio:
        yield studio


@pytest.fixture(scope="module")
def browser(studio):
    with Browser(studio.page.url) as browser:
        settled(studio)
        yield browser


def test_pictures_take_their_share_of_a_training(tmp_path):
    trainer = Trainer(tiny_config(), *tiny_scene(), tmp_path, Ranks())
    with contextlib.closing(live_page(trainer.state, 0, "127.0.0.1")) as live:
        assert not live.wants()  # nobody looks
        live._last = SimpleNamespace()
        live.page.deliver = lambda *_: None
        before = time.monotonic()
        live.show(None, 0.3)
        assert live._allowed - before == pytest.approx(0.3 / 0.03, abs=0.5)


def test_a_port_in_use_does_not_end_a_training(tmp_path, capsys):
    trainer = Trainer(tiny_config(), *tiny_scene(), tmp_path, Ranks())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert live_page(trainer.state, taken.getsockname()[1], "127.0.0.1") is None
    assert "training goes on without the viewer" in capsys.readouterr().out


def test_the_page_shows_the_model(studio, browser):
    visitor = settled(studio)
    wait_for(lambda: picture(browser).std() > 3, 60, "the picture is on the page")
    assert "Gaussians in view" in browser.figures()
    length = float(re.search(r"([\d.]+) unit", browser.figures())[1])
    camera, unit = visitor.client.camera, visitor.exhibit.space.unit / SCALE
    high = 2 * unit * np.linalg.norm(camera.look_at - camera.position) * math.tan(visitor.stance.fov / 2)
    bar = browser.evaluate("document.querySelector('#blitzgs-figures div').offsetWidth")
    assert bar == pytest.approx(720 * length / high, rel=0.02)
    assert browser.errors() == []


def test_a_drag_turns_the_camera(studio, browser):
    visitor = settled(studio)
    before, place = drawn(studio, browser), visitor.stance.position
    browser.drag((300, 300), (420, 330))
    settled(studio)
    assert np.linalg.norm(visitor.stance.position - place) > 0.05
    wait_for(lambda: np.abs(picture(browser) - before).mean() > 2, 60, "another picture")


def test_a_control_changes_the_picture(studio, browser):
    visitor = settled(studio)
    before = drawn(studio, browser)
    box = browser.evaluate(
        """(() => {
          const field = [...document.querySelectorAll('input')].find(e => e.value === 'RGB');
          const box = field.getBoundingClientRect();
          return [box.x + box.width / 2, box.y + box.height / 2];
        })()"""
    )
    browser.click(*box)
    browser.press("depth")
    wait_for(lambda: visitor.settings.mode == "depth", 60, "the mode is chosen")
    settled(studio)
    wait_for(lambda: np.abs(picture(browser) - before).mean() > 5, 60, "another picture")
    assert "depth" in browser.figures()
    visitor.change(mode="RGB")
    assert browser.errors() == []


def test_a_click_on_a_frustum_stands_there(studio, browser):
    visitor = settled(studio)
    world, start, middle = studio.page.world, studio.page.world.start(), studio.page.world.middle
    wanted = replace(start, position=middle + 2 * (start.position - middle))
    visitor.go(wanted, 5.0)
    wait_for(lambda: visitor._stance.is_near(wanted, 0.02, 0.01), 60, "the browser's own camera is there")
    settled(studio)
    camera, stance = visitor.client.camera, visitor.stance
    focal = 0.5 * camera.image_height / math.tan(camera.fov / 2)
    width = browser.evaluate("document.querySelector('canvas').getBoundingClientRect().width")
    for index in studio.page.frustums.indices:
        place = stance.rotation.T @ (world.centres[index] - stance.position)
        x, y = place[:2] / place[2] * focal * width / camera.image_width
        x, y = x + width / 2, y + 360
        if place[2] > 0 and 330 < x < width - 20 and 20 < y < 600:
            browser.click(x, y)
            try:
                wait_for(lambda: visitor.standing is not None, 3, "somebody stands")
                break
            except AssertionError:
                continue  # another thing is in front
    assert visitor.standing is not None
    settled(studio)
    wanted = world.stance(world.poses[visitor.standing], visitor.stance.fov)
    assert visitor.stance.is_near(wanted)
    wait_for(lambda: visitor._stance.is_near(wanted, 0.02, 0.01), 60, "the browser's own camera is there")
    name = studio.page.exhibit.cameras[visitor.standing].name
    wait_for(lambda: browser.place_of(f"Standing at {name}"), 60, "the panel names the photograph")


def test_photograph_and_render_are_compared(studio, browser):
    visitor = settled(studio)
    visitor.stand_at(0)
    pictures = {}
    for kind in ("off", "wipe", "side by side", "error"):
        visitor.change(comparison=kind)
        pictures[kind] = drawn(studio, browser)
        assert ("dB" in browser.figures()) == (kind != "off")
    for kind in ("wipe", "side by side", "error"):
        assert np.abs(pictures[kind] - pictures["off"]).mean() > 1, kind
    visitor.change(comparison="off")
    before = drawn(studio, browser)
    studio.page.exhibit.exposures[0] = np.array([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]])
    visitor.change(exposure=True)
    settled(studio)
    wait_for(lambda: picture(browser).mean() < before.mean(), 60, "a darker picture")
    visitor.change(exposure=False)


def test_a_path_is_saved(studio, browser):
    visitor = settled(studio)
    browser.press("Viewpoints and path")
    browser.press("Add viewpoint")
    browser.press("Back to the start")
    settled(studio)
    browser.press("Add viewpoint")
    wait_for(lambda: browser.place_of("2 viewpoints"), 60, "two viewpoints")
    browser.press("Save path")
    file = studio.page.exhibit.paths / "path.json"
    wait_for(file.exists, 60, "the path is written")
    path = from_json(file.read_text())
    assert len(path.keyframes) == 2
    assert json.loads(file.read_text())["camera_type"] == "perspective"
    place = visitor.world.capture_position(visitor.stance.position)
    np.testing.assert_allclose(
        path.keyframes[1].camera_to_world[:3, 3], place, atol=1e-3 * np.abs(place).max()
    )


def test_walking_is_at_eye_height(studio, browser):
    visitor = settled(studio)
    browser.press("walk")
    wait_for(lambda: visitor.motion == "walk", 60, "the motion is chosen")
    settled(studio)
    visitor.go(looking(visitor.world.middle + visitor.world.up, visitor.world.middle, visitor.world.up, 0.9))

    def height():
        down = visitor._sounding(visitor.stance, visitor.version, visitor.settings)
        depth = drawer.draw(down.look).values
        known = depth[depth > 0]
        return np.median(known) / visitor.exhibit.space.unit if len(known) else math.inf

    drawer = Drawer(studio._drawer._subject, studio._drawer._owners)  # its own draws at the same time
    wanted = EYE_HEIGHT * visitor.exhibit.space.extent
    wait_for(lambda: height() == pytest.approx(wanted, rel=0.2), 60, "the visitor stands on the ground")
    browser.press("orbit")
    wait_for(lambda: visitor.motion == "orbit", 60, "the motion is chosen")
    settled(studio)
    assert browser.errors() == []


def test_keys_move_a_visitor_who_flies(studio, browser):
    visitor = settled(studio)
    browser.press("fly")
    wait_for(lambda: visitor.motion == "fly", 60, "the motion is chosen")
    settled(studio)
    up = studio.page.world.up
    for code, direction in (("KeyW", np.cross(up, visitor.stance.rotation[:, 0])), ("KeyE", up)):
        before = visitor.stance.position
        browser.call("Input.dispatchKeyEvent", type="keyDown", code=code, key=code[-1].lower())
        wait_for(lambda at=before: np.linalg.norm(visitor.stance.position - at) > 0.3, 30, code)
        browser.call("Input.dispatchKeyEvent", type="keyUp", code=code, key=code[-1].lower())
        settled(studio)
        step = visitor.stance.position - before
        assert step @ direction > 0.95 * np.linalg.norm(step)
    browser.press("orbit")
    wait_for(lambda: visitor.motion == "orbit", 60, "the motion is chosen")


def test_a_ply_file_behind_a_token(trained, tmp_path):
    file = tmp_path / "model.ply"
    export_ply(open_run(trained[1]).model(), file)
    with contextlib.closing(Studio(open_model(file, Ranks()), host="0.0.0.0", port=0)) as studio:
        url = studio.page.url.replace("0.0.0.0", "127.0.0.1")
        with Browser(url) as browser:
            settled(studio)
            wait_for(lambda: picture(browser).std() > 5, 60, "the picture is on the page")
            text = "document.body.innerText"
            wait_for(lambda: "Keys: W A S D" in browser.evaluate(text), 20, "the help is there")
            assert browser.errors() == [] and "frustum" not in browser.evaluate(text)
        with Browser(url, 390, 844) as phone:  # most of which is not covered by the panel
            wait_for(phone.figures, 60, "the figures are there")
            at = "document.elementFromPoint(300, {}).closest('.mantine-Paper-root') !== null"
            wait_for(lambda: phone.evaluate(at.format(620)), 20, "the panel is there")
            wait_for(lambda: not phone.evaluate(at.format(480)), 5, "the panel is low")


def test_the_live_page_follows_a_training(tmp_path, monkeypatch):
    step = Trainer.step

    ends = threading.Event()

    def slow(self, number):
        if ends.is_set():
            raise KeyboardInterrupt
        time.sleep(0.02)
        step(self, number)

    def run():
        with contextlib.suppress(KeyboardInterrupt):
            trainer.train()

    monkeypatch.setattr(Trainer, "step", slow)
    settings = ("schedule.iterations=3000", "schedule.densify_until=90", "log.every=20")
    trainer = Trainer(tiny_config(*settings), *tiny_scene(), tmp_path, Ranks())
    live = live_page(trainer.state, 0, "127.0.0.1")
    trainer.watch(live)
    thread = threading.Thread(target=run, daemon=True)
    with Browser(live.page.url) as browser:
        thread.start()
        wait_for(browser.figures, 60, "a picture")
        wait_for(lambda: picture(browser).std() > 3, 60, "the picture is on the page")
        first = picture(browser)
        wait_for(lambda: np.abs(picture(browser) - first).mean() > 1, 60, "another picture")
        plots = "document.querySelectorAll('.uplot').length"
        wait_for(lambda: browser.evaluate(plots) == 3, 60, "three curves")
        browser.press_until("Pause", "Go on")

        def rests():
            before = trainer.state.progress.step
            time.sleep(1.0)
            return trainer.state.progress.step == before

        wait_for(rests, 60, "the training rests")
        at = trainer.state.progress.step
        browser.press("Save now")
        wait_for(lambda: list((tmp_path / "checkpoints").glob("checkpoint_*")), 60, "the model is saved")
        browser.press("Go on")
        wait_for(lambda: trainer.state.progress.step > at, 60, "the training goes on")
        assert browser.errors() == []
    live.page._server.stop()  # the viewer dies
    at = trainer.state.progress.step
    wait_for(lambda: trainer.state.progress.step > at + 5, 60, "the training goes on")
    ends.set()
    thread.join(timeout=20)
