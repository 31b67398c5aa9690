"""The page of a tileset in a headless Chromium, from the server of `blitzgs view`."""

import json
import threading

import numpy as np
import pytest

from blitzgs.cli.view import tiles_server
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import save_ply
from blitzgs.formats.tiles import write_tiles
from blitzgs.frame.ownership import TileOwners
from blitzgs.view.draw import Drawer
from blitzgs.view.look import Look
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.world import looking
from tests.browser import Browser, chromium, wait_for
from tests.formats.test_tiles import SCENE, city

needs_chromium = pytest.mark.skipif(
    chromium() is None, reason="Chromium is missing: install it (Debian: apt-get install chromium)"
)
WIDTH, HEIGHT = 320, 240
K = np.array([[280.0, 0, 160], [0, 280, 120], [0, 0, 1]])
UP = np.array([0.0, 0, 1])


def pose(eye, target=(20, 15, 0)):
    stance = looking(np.array(eye, float), np.array(target, float), UP, 1.0)
    matrix = np.eye(4)
    matrix[:3, :3] = stance.rotation.T
    matrix[:3, 3] = -stance.rotation.T @ stance.position
    return matrix


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Serve a small city and show it; yields the model, its folder and the browser."""
    folder, model = tmp_path_factory.mktemp("tiles"), city()
    write_tiles(folder / "city", model, np.eye(4), SCENE, "<city>", most=300)
    save_ply(folder / "city.ply", model)
    with tiles_server(folder / "city", "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        with Browser("about:blank", 640, 480) as browser:
            yield folder, browser, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def go(browser, url):
    browser.call("Page.navigate", url=url)
    wait_for(lambda: browser.evaluate("location.href") == url, 30, "the page is open")
    wait_for(lambda: browser.evaluate("typeof blitzgs !== 'undefined'"), 30, "the program runs")
    browser.evaluate("blitzgs.ready")


def settle(browser, view):
    call = f"blitzgs.settle({json.dumps(view.tolist())}, {json.dumps(K.tolist())}, {WIDTH}, {HEIGHT})"
    return browser.evaluate(call)


def pixels(browser):
    values = browser.evaluate("Array.from(blitzgs.pixels())")
    return np.array(values).reshape(HEIGHT, WIDTH, 4)[..., :3]


@needs_chromium
def test_nearer_views_load_more_tiles_and_farther_ones_show_fewer(shown):
    _, browser, url = shown
    go(browser, url)
    far = settle(browser, pose((20, -300, 150)))
    near = settle(browser, pose((20, 4, 5)))
    assert 0 < far["shown"] < near["shown"] and far["gaussians"] < near["gaussians"]
    assert set(far["uris"]) & set(near["uris"])  # coarse tiles stay
    assert near["bytes"] > far["bytes"] > 0
    assert pixels(browser).std() > 15
    again = settle(browser, pose((20, -300, 150)))
    assert sorted(again["uris"]) == sorted(far["uris"]) and again["bytes"] == near["bytes"]
    away = settle(browser, pose((20, -300, 150), (20, -600, 150)))
    assert away["shown"] < far["shown"]  # behind the camera
    assert browser.errors() == []


@needs_chromium
def test_with_all_tiles_the_picture_is_that_of_our_renderer(shown):
    folder, browser, url = shown
    go(browser, url + "?error=1e-9")
    opened = open_model(folder / "city.ply", Ranks())
    view = pose((20, -6, 9))
    state = settle(browser, view)
    space = opened.exhibit.space
    moved = view.copy()
    moved[:3, 3] = (view[:3, 3] + view[:3, :3] @ np.array(space.offset)) / space.unit
    drawer = Drawer(opened.subject, TileOwners(opened.ranks))
    wanted = drawer.draw(Look(moved, K, WIDTH, HEIGHT, lod=False)).values.astype(int)
    assert wanted.std() > 15 and state["gaussians"] > 4000
    assert np.abs(pixels(browser) - wanted).mean() < 1


@needs_chromium
def test_a_budget_is_kept_and_missing_tiles_are_said(shown):
    folder, browser, url = shown
    go(browser, url + "?budget=28000&error=0.01")
    first = settle(browser, pose((8, 8, 4), (2, 2, 1)))
    assert first["shown"] == first["wanted"] == 7  # pages of 4,096 Gaussians
    other = settle(browser, pose((32, 22, 4), (38, 28, 1)))
    assert other["shown"] == other["wanted"] == 7 and set(other["uris"]) != set(first["uris"])
    assert pixels(browser).std() > 5
    assert browser.errors() == []
    tileset = folder / "city" / "tileset.json"
    content = tileset.read_text()
    tileset.write_text(content.replace("tiles/000000.glb", "tiles/gone.glb"))
    try:
        browser.call("Page.reload")
        wait_for(lambda: any("gone.glb" in error for error in browser.errors()), 30, "the error is there")
    finally:
        tileset.write_text(content)


def test_damaged_folders_are_refused(tmp_path):
    folder = tmp_path / "city"
    write_tiles(folder, city(100), np.eye(4), SCENE, "x")
    good = (folder / "tileset.json").read_text()
    for text, reason in (
        (good[:200], "tileset.json is damaged"),
        ("[]", "tileset.json is damaged"),
        (good.replace("BlitzGS", "another"), "was not written by blitzgs export --tiles"),
    ):
        (folder / "tileset.json").write_text(text)
        with pytest.raises(ValueError, match=reason):
            tiles_server(folder, "127.0.0.1", 0)
    (folder / "tileset.json").write_text(good)
    with pytest.raises(OSError, match=r"cannot listen on 203\.0\.113\.1:0"):
        tiles_server(folder, "203.0.113.1", 0)
