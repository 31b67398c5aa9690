# SPDX-License-Identifier: Apache-2.0
"""Tiles of the viewer and their tileset."""

import json
import re
import socket
import threading

import numpy as np
import pytest

from blitzgs.capture.world import WorldFrame, enu_frame, geodetic
from blitzgs.cli import main
from blitzgs.cli.view import tiles_server
from blitzgs.distributed.group import Ranks
from blitzgs.formats.packed import write_splat
from blitzgs.formats.ply import save_ply
from blitzgs.formats.tiles import write_tiles
from blitzgs.runs.folder import open_run
from blitzgs.viewer.studio import open_model
from blitzgs.viewer.web import open_city, to_globe
from tests.browser import Browser, wait_for
from tests.formats.test_tiles import SCENE, city, nodes
from tests.helpers import read_glb, refused
from tests.viewer.test_parts import camera_at
from tests.viewer.test_web import rendered

WIDTH, HEIGHT, MIDDLE = 320, 240, (20, 15, 0)
K = np.array([[280.0, 0, 160], [0, 280, 120], [0, 0, 1]])


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Serve a small city and show it; yields the model, its folder and the browser."""
    folder, model = tmp_path_factory.mktemp("tiles"), city()
    write_tiles(folder / "city", model, np.eye(4), SCENE, "<city>", most=300)
    save_ply(folder / "city.ply", model)
    with (
        Browser("about:blank", 640, 480) as browser,
        tiles_server(folder / "city", "127.0.0.1", 0) as server,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, browser, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def settle(browser, view):
    call = f"blitzgs.settle({json.dumps(view.tolist())}, {json.dumps(K.tolist())}, {WIDTH}, {HEIGHT})"
    return browser.evaluate(call)


def pixels(browser):
    values = browser.evaluate("Array.from(blitzgs.pixels())")
    return np.array(values).reshape(HEIGHT, WIDTH, 4)[..., :3]


def test_nearer_views_load_more_tiles_and_farther_ones_show_fewer(shown):
    _, browser, url = shown
    browser.go(url)
    far = settle(browser, camera_at((20, -1500, 900), MIDDLE))
    near = settle(browser, camera_at((20, 4, 5), MIDDLE))
    assert 0 < far["shown"] < near["shown"] and far["gaussians"] < near["gaussians"]
    assert not set(far["uris"]) & set(near["uris"])  # fine tiles replace coarse ones
    assert near["bytes"] >= far["bytes"] > 0  # the page's own first view may have loaded tiles before
    assert pixels(browser).std() > 15
    again = settle(browser, camera_at((20, -1500, 900), MIDDLE))
    assert sorted(again["uris"]) == sorted(far["uris"]) and again["bytes"] == near["bytes"]
    away = settle(browser, camera_at((20, -1500, 900), (20, -3000, 900)))
    assert away["shown"] < far["shown"]  # behind the camera
    assert browser.errors() == []


def test_with_all_tiles_the_picture_is_that_of_our_renderer(shown):
    folder, browser, url = shown
    browser.go(url + "?error=1e-9")
    opened = open_model(folder / "city.ply", Ranks())
    view = camera_at((20, -6, 9), MIDDLE)
    state = settle(browser, view)
    space = opened.exhibit.space
    moved = view.copy()
    moved[:3, 3] = (view[:3, 3] + view[:3, :3] @ np.array(space.offset)) / space.unit
    wanted = rendered(opened, moved, K, WIDTH, HEIGHT, lod=False)
    assert wanted.std() > 15 and state["gaussians"] > 4000
    assert np.abs(pixels(browser) - wanted).mean() < 1


def test_a_budget_is_kept_and_missing_tiles_are_said(shown):
    folder, browser, url = shown
    browser.go(url + "?budget=28000&error=0.01")
    first = settle(browser, camera_at((8, 8, 4), (2, 2, 1)))
    assert first["shown"] < first["wanted"] <= 7  # pages of 4,096 Gaussians
    other = settle(browser, camera_at((32, 22, 4), (38, 28, 1)))
    assert other["shown"] < other["wanted"] <= 7 and set(other["uris"]) != set(first["uris"])
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

    browser.call("Page.navigate", url=(folder / "city" / "index.html").as_uri())
    said = "document.getElementById('message')?.textContent"
    wait_for(lambda: "blitzgs view" in (browser.evaluate(said) or ""), 30, "the disk is no server")


def test_damaged_folders_are_refused(tmp_path):
    folder = tmp_path / "city"
    write_tiles(folder, city(100), np.eye(4), SCENE, "x")
    good = (folder / "tileset.json").read_text()
    for text, reason in (
        (good[:200], "tileset.json is damaged"),
        ("[]", "tileset.json is damaged"),
        (good.replace("BlitzGS", "another"), "has no page of blitzgs export --tiles"),
    ):
        (folder / "tileset.json").write_text(text)
        refused(ValueError, reason, tiles_server, folder, "127.0.0.1", 0)
    (folder / "tileset.json").write_text(good)
    refused(
        OSError, r"cannot listen on 203\.0\.113\.1:0 \(Cannot assign", tiles_server, folder, "203.0.113.1", 0
    )
    refused(OSError, r"\(ports are 0 to 65535\): choose", tiles_server, folder, "127.0.0.1", 99999)


def test_requests_that_make_no_sense_are_not_told(tmp_path, capfd):
    write_tiles(tmp_path / "city", city(100), np.eye(4), SCENE, "x")
    with tiles_server(tmp_path / "city", "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for path, answer in (("/%00", b""), ("/../../etc/passwd", b"404"), ("/tileset.json", b"200")):
            with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as connection:
                connection.sendall(f"GET {path} HTTP/1.1\r\nConnection: close\r\n\r\n".encode())
                assert connection.makefile("rb").readline()[9:12] == answer
        server.shutdown()
    assert capfd.readouterr() == ("", "")


def contents(folder):
    tileset = json.loads((folder / "tileset.json").read_text())
    found = [node["content"]["uri"] for node, _ in nodes(tileset["root"]) if "children" not in node]
    return tileset, np.concatenate([read_glb(folder / uri)[1]["POSITION"] for uri in found])


def test_a_run_is_written_as_tiles(trained, tmp_path, capsys):
    _, run = trained
    folder = tmp_path / "city"
    assert (
        main(["export", str(run), "--tiles", str(folder), "--processes", "1", "--tile-gaussians", "50"]) == 0
    )
    model = open_run(run).model()
    out = capsys.readouterr().out
    assert re.search(rf"city: {len(model):,} Gaussians in \d+ tiles, \d+\.\d MB", out)
    assert f"blitzgs view {folder}" in out
    tileset, positions = contents(folder)
    wanted = model.means.double().numpy() * model.space.unit
    np.testing.assert_allclose(np.sort(positions, axis=0), np.sort(wanted, axis=0), rtol=1e-6, atol=1e-6)
    # The page begins where `blitzgs view` does, in the unit of the capture.
    view, scene = tileset["extras"]["view"], open_city(run).scene
    assert view["eye"] == list(scene.eye) and view["near"] == scene.near > 0
    far = np.linalg.norm(np.array(view["eye"]) - view["target"])
    assert 0.1 * model.space.extent < far / model.space.unit < 10 * model.space.extent


@pytest.mark.parametrize("offset", [(5.0, 6.0, 7.0), (5e5, 4.6e6, 0.0)])
def test_streamed_sog_has_the_coordinates_of_other_files(tmp_path, capsys, offset):
    model, far = city(200), offset[0] > 100
    x, y, z = offset
    model.comments.append(f"comment offset {x} {y} {z}")
    save_ply(tmp_path / "m.ply", model)
    command = ["export", str(tmp_path / "m.ply"), "--streamed-sog", str(tmp_path / "s"), "--processes", "1"]
    assert main(command) == 0
    meta = json.loads((tmp_path / "s" / "0_0" / "meta.json").read_text())["means"]
    ends = np.array([meta["mins"], meta["maxs"]])
    wanted = np.stack([model.means.numpy().min(axis=0), model.means.numpy().max(axis=0)])
    wanted = wanted if far else wanted + offset
    np.testing.assert_allclose(np.sign(ends) * np.expm1(abs(ends)), wanted, rtol=1e-5)
    stated = tmp_path / "s.offset.json"
    assert stated.exists() == far == (f"as {stated} says" in capsys.readouterr().out)
    assert not far or json.loads(stated.read_text())["offset"] == list(offset)


def test_a_file_is_written_as_tiles_and_flags_choose(tmp_path, capsys, failure):
    save_ply(tmp_path / "m.ply", city(800))
    flags = ["--tiles", str(tmp_path / "t"), "--crop", "0", "0", "-9", "20", "99", "99", "--processes", "1"]
    assert main(["export", str(tmp_path / "m.ply"), *flags]) == 0
    means = city(800).means.numpy()
    inside = (means[:, 0] <= 20) & (means[:, 1] <= 99) & (means[:, 2] <= 99)
    _, positions = contents(tmp_path / "t")
    assert len(positions) == inside.sum() and positions[:, 0].max() <= 20
    write_splat(tmp_path / "m.splat", city(800))
    flags = ["--tiles", str(tmp_path / "s"), "--processes", "1"]
    assert main(["export", str(tmp_path / "m.splat"), *flags]) == 0
    _, positions = contents(tmp_path / "s")
    np.testing.assert_allclose(np.sort(positions, axis=0), np.sort(means, axis=0), rtol=1e-6)
    large = city(800)
    large.scales[4] = 7.0
    save_ply(tmp_path / "large.ply", large)
    flags = ["--tiles", str(tmp_path / "spz"), "--spz-tiles", "--processes", "1"]
    assert main(["export", str(tmp_path / "large.ply"), *flags]) == 0
    assert "SPZ holds scales of 0.000045 to 379 units" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "m.splat"), "--streamed-sog", str(tmp_path / "sog")]) == 0
    assert "sog is streamed SOG, which SuperSplat shows" in failure("view", tmp_path / "sog")
    for flags, reason in (
        (["--tiles", str(tmp_path / "t")], "is not an empty folder"),
        (["--tiles", str(tmp_path / "u"), "--max-mb", "3"], "--max-mb is not for --tiles"),
        (["--ply", str(tmp_path / "u.ply"), "--processes", "3"], "--processes is for --tiles"),
        (["--ply", str(tmp_path / "u.ply"), "--data", "nope"], "--data is for --clean"),
        (["--streamed-sog", str(tmp_path / "u"), "--spz-tiles"], "--spz-tiles is for --tiles"),
    ):
        assert reason in failure("export", tmp_path / "m.ply", *flags)
    (tmp_path / "cut.ply").write_bytes((tmp_path / "m.ply").read_bytes()[:-100])
    assert main(["export", str(tmp_path / "cut.ply"), "--tiles", str(tmp_path / "u")]) == 1
    assert "cut.ply" in capsys.readouterr().err and not (tmp_path / "u").exists()


def test_a_georeferenced_run_lies_on_the_globe(trained, tmp_path):
    pytest.importorskip("pyproj", reason="the extra geo is not installed")
    import pyproj

    easting, northing = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(8.5, 47.3)
    frame = WorldFrame("EPSG:32632", translation=np.array([easting, northing, 400.0]), source="geo.json")
    matrix = to_globe(frame, np.zeros(3))
    np.testing.assert_allclose(geodetic(matrix[:3, 3]), [47.3, 8.5, 400.0], atol=1e-6)
    # To first order east, north and up, turned by the convergence, stretched by the zone's scale and height.
    turned = enu_frame(47.3, 8.5, 400.0, "").rotation.T @ matrix[:3, :3]
    convergence = np.radians(-0.5 * np.sin(np.radians(47.3)))
    scale = (1 + 400 / 6.38e6) / (0.9996 * (1 + ((easting - 500_000) / 6.37e6) ** 2 / 2))
    east = [scale * np.cos(convergence), -scale * np.sin(convergence), 0]
    np.testing.assert_allclose(np.abs(turned[:, 0]), np.abs(east), atol=3e-6)
    np.testing.assert_allclose(turned[:, 2], [0, 0, 1], atol=1e-5)
    place = geodetic((matrix @ [300.0, 200.0, 5.0, 1.0])[:3])
    expected = pyproj.Transformer.from_crs(32632, 4326, always_xy=True).transform(
        easting + 300, northing + 200
    )
    np.testing.assert_allclose(place[:2], expected[::-1], atol=1e-7)  # 1 cm
    # An ENU frame of its own: no map projection.
    local = enu_frame(47.3, 8.5, 400.0, "gps")
    np.testing.assert_allclose(to_globe(local, np.zeros(3))[:3, :3], local.rotation, atol=1e-7)
    # In feet, heights too.
    place = np.array([6_126_548.0, 2_008_012.0, 400 * 3937 / 1200])
    feet = to_globe(WorldFrame("EPSG:2227", translation=place, source="geo.json"), np.zeros(3))
    assert geodetic(feet[:3, 3])[2] == pytest.approx(400, abs=1e-3)
    np.testing.assert_allclose(np.linalg.norm(feet[:3, :3], axis=0), 1200 / 3937, rtol=2e-4)
    refused(ValueError, "a file: ", to_globe, WorldFrame("EPSG:99999999", source="a file"), np.zeros(3))


def test_geo_json_of_a_run_is_used(trained, tmp_path):
    pytest.importorskip("pyproj", reason="the extra geo is not installed")
    _, run = trained
    local = enu_frame(47.3, 8.5, 400.0, "gps")
    (run / "geo.json").write_text(json.dumps(local.as_json()))
    try:
        model = open_city(run)
        expected = local.to_world(model.offset)
        np.testing.assert_allclose(model.transform()[:3, 3], expected, atol=1e-4)
    finally:
        (run / "geo.json").unlink()
    assert abs(open_city(run).transform()[:3, 3]).max() == 0
