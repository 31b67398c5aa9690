# SPDX-License-Identifier: Apache-2.0
"""3D Tiles of a model: the tree against what its files hold by an independent reader of GLB.

Merged Gaussians, which its coarse tiles hold, against sums in float64, one cell after the other.
"""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from blitzgs.formats import gaussians as blocks
from blitzgs.formats.gaussians import MIP, Gaussians
from blitzgs.formats.proxies import merged, moments, shown
from blitzgs.formats.tiles import new_folder, upright, write_tiles
from blitzgs.formats.web_page import WebScene
from blitzgs.util.progress import ending_by_exception
from tests.helpers import glb_parts, read_glb, refused

LOD = "comment lod reference_distance 40.0 fork 2.0 levels 4 finest 3"
SCENE = WebScene(0.01, 1e4, 0.3, False, (0, 0, 0), (0, 0, 1), (20, -30, 30), (20, 20, 0), 0.9)


def city(count=6000, levels=True, degree=1):
    """A flat city: few wide Gaussians of level 0, many narrow ones of level 3, some far outside."""
    generator = torch.Generator().manual_seed(count)
    uniform = torch.rand(count, generator=generator)
    level = (uniform**0.5 * 4).floor()
    means = torch.rand(count, 3, generator=generator) * torch.tensor([40.0, 30, 4])
    means[::997] *= 50
    return Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=generator),
        scales=0.3 * torch.randn(count, 3, generator=generator) - 0.7 * level[:, None] - 1,
        opacities=torch.randn(count, generator=generator),
        sh=0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
        comments=[LOD] if levels else [],
        levels=level if levels else None,
    )


def nodes(node, parent=None):
    yield node, parent
    for child in node.get("children", []):
        yield from nodes(child, node)


def corners(volume):
    """Return the least and the largest corner of an axis-aligned box of 3D Tiles."""
    box = np.array(volume["box"])
    assert box.shape == (12,)
    axes = box[3:].reshape(3, 3)
    assert np.count_nonzero(axes - np.diag(np.diag(axes))) == 0 and (np.diag(axes) > 0).all()
    return box[:3] - np.diag(axes), box[:3] + np.diag(axes)


def ellipsoid_corners(attributes):
    """Return the box of the ellipsoids at 3 standard deviations, from what a file holds."""
    quats, scales = (attributes[f"KHR_gaussian_splatting:{name}"] for name in ("ROTATION", "SCALE"))
    axes = Rotation.from_quat(quats).as_matrix() * scales[:, None]
    reach = 3 * np.linalg.norm(axes, axis=2)
    return (attributes["POSITION"] - reach).min(axis=0), (attributes["POSITION"] + reach).max(axis=0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    model, path = city(), tmp_path_factory.mktemp("tiles") / "city"
    done = write_tiles(path, model, upright((0.0, -1.0, 0.0)), SCENE, "the city", most=300)
    return model, path, done, json.loads((path / "tileset.json").read_text())


def test_the_tileset_has_the_fields_of_3d_tiles_1_1(written):
    model, path, done, tileset = written
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["geometricError"] >= tileset["root"]["geometricError"] > 0
    assert set(tileset["extensionsUsed"]) == tileset["extensions"].keys() == {"3DTILES_content_gltf"}
    contents = tileset["extensions"]["3DTILES_content_gltf"]
    assert contents["extensionsUsed"] == contents["extensionsRequired"] == ["KHR_gaussian_splatting"]
    turn = np.array(tileset["root"]["transform"]).reshape(4, 4).T  # column by column
    np.testing.assert_allclose(turn @ [0, -1, 0, 1], [0, 0, 1, 1], atol=1e-12)
    uris = []
    for node, _ in nodes(tileset["root"]):
        assert node["refine"] == "REPLACE" and node["geometricError"] >= 0
        assert node.keys() <= {
            "boundingVolume", "geometricError", "refine", "content", "children", "transform",
        }  # fmt: skip
        uris.append(node["content"]["uri"])
    files = sorted(str(file.relative_to(path)) for file in path.rglob("*.glb"))
    assert sorted(uris) == files and len(files) == done.tiles > 20
    assert done.bytes == sum((path / file).stat().st_size for file in files)
    assert sorted(os.listdir(path)) == ["index.html", "tiles", "tileset.json"]
    assert "the city" in (path / "index.html").read_text()


def test_tiles_with_spz_inside_say_so_and_are_turned_back(tmp_path):
    gaussforge = pytest.importorskip("gaussforge")
    model = city(800, levels=False)
    done = write_tiles(tmp_path / "t", model, np.eye(4), SCENE, "the city", most=300, spz=True)
    assert sorted(os.listdir(tmp_path / "t")) == ["tiles", "tileset.json"]  # the page reads no SPZ
    assert not list(tmp_path.rglob("*.spz")) and done.bytes < 40 * 1.2 * len(model)
    tileset = json.loads((tmp_path / "t" / "tileset.json").read_text())
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    contents = tileset["extensions"]["3DTILES_content_gltf"]
    assert contents["extensionsUsed"] == contents["extensionsRequired"] == names
    found = []
    for node, _ in nodes(tileset["root"]):
        content, body = glb_parts(tmp_path / "t" / node["content"]["uri"])
        assert content["extensionsUsed"] == content["extensionsRequired"] == names
        (primitive,) = content["meshes"][0]["primitives"]
        inner = primitive["extensions"][names[0]]["extensions"][names[1]]
        view = content["bufferViews"][inner["bufferView"]]
        spz = gaussforge.GaussForge().read(body[view["byteOffset"] :][: view["byteLength"]], "spz")["data"]
        positions = np.frombuffer(spz["positions"], "<f4").reshape(-1, 3)
        place = content["accessors"][primitive["attributes"]["POSITION"]]
        assert place["count"] == len(positions) == node["content"]["extras"]["gaussians"]
        np.testing.assert_allclose(
            [place["min"], place["max"]], [positions.min(0), positions.max(0)], atol=1e-3
        )
        assert not any("bufferView" in accessor for accessor in content["accessors"])
        turn = np.array(content["nodes"][0]["matrix"]).reshape(4, 4).T[:3, :3]
        if "children" not in node:
            found.append(positions @ turn.T)
    x, y, z = model.means.numpy().T
    wanted = np.stack([x, z, -y], axis=1)  # +Z is +Y in glTF
    np.testing.assert_allclose(np.sort(np.concatenate(found), axis=0), np.sort(wanted, axis=0), atol=1e-3)


def test_tiles_with_spz_count_what_it_cannot_hold(tmp_path):
    pytest.importorskip("gsply")
    model = city(800, levels=False)
    model.sh.clamp_(-1, 1)
    model.means[3, 0], model.scales[4] = 3e7, 7.0
    done = write_tiles(tmp_path / "t", model, np.eye(4), SCENE, "the city", most=300, spz=True)
    assert done.gaussians == 799 and done.lost == (1, 1)
    tileset = json.loads((tmp_path / "t" / "tileset.json").read_text())
    held = 0
    for node, _ in nodes(tileset["root"]):
        content, _ = glb_parts(tmp_path / "t" / node["content"]["uri"])
        count = content["accessors"][0]["count"]
        assert count == node["content"]["extras"]["gaussians"]
        held += 0 if "children" in node else count
    assert held == 799 and np.abs(corners(tileset["root"]["content"]["boundingVolume"])).max() < 1e6


def test_errors_fall_and_volumes_hold_what_is_inside(written):
    _, path, _, tileset = written
    for node, parent in nodes(tileset["root"]):
        low, high = corners(node["boundingVolume"])
        if parent is not None:
            assert node["geometricError"] <= parent["geometricError"]
            outer_low, outer_high = corners(parent["boundingVolume"])
            assert (low >= outer_low - 1e-9).all() and (high <= outer_high + 1e-9).all()
        assert (node["geometricError"] > 0) == ("children" in node)
        inner = corners(node["content"]["boundingVolume"])
        assert (inner[0] >= low - 1e-9).all() and (inner[1] <= high + 1e-9).all()
        found = ellipsoid_corners(read_glb(path / node["content"]["uri"])[1])
        assert (found[0] >= inner[0]).all() and (found[1] <= inner[1]).all()
        # At 3.33 standard deviations, not more.
        assert (inner[1] - inner[0] <= 1.12 * (found[1] - found[0])).all()


def test_every_gaussian_is_in_one_leaf_with_its_values(written):
    model, path, _, tileset = written
    found = {}
    for node, _ in nodes(tileset["root"]):
        content, values = read_glb(path / node["content"]["uri"])
        assert len(values["POSITION"]) == node["content"]["extras"]["gaussians"] <= 300
        # The node turns +Z to +Y, and viewers turn +Y to +Z.
        np.testing.assert_allclose(content["nodes"][0]["rotation"], [-(0.5**0.5), 0, 0, 0.5**0.5])
        for index, mean in enumerate(values["POSITION"] if "children" not in node else []):
            assert found.setdefault(mean.tobytes(), (values, index))[0] is values
    leaves = {id(values): values for values, _ in found.values()}.values()
    assert len(found) == len(model) == sum(len(values["POSITION"]) for values in leaves)
    places = [found[mean.tobytes()] for mean in model.means.numpy()]

    def stored(name):
        return np.stack([values[name][index] for values, index in places])

    prefix = "KHR_gaussian_splatting:"
    quats = model.quats.double() / model.quats.double().norm(dim=1, keepdim=True)
    np.testing.assert_allclose(stored(prefix + "ROTATION"), quats[:, [1, 2, 3, 0]], atol=1e-6)
    np.testing.assert_allclose(stored(prefix + "SCALE"), model.scales.exp(), rtol=1e-6)
    np.testing.assert_allclose(stored(prefix + "OPACITY")[:, 0], model.opacities.sigmoid(), rtol=1e-5)
    for k, name in enumerate(("0_COEF_0", "1_COEF_0", "1_COEF_1", "1_COEF_2")):
        np.testing.assert_array_equal(stored(f"{prefix}SH_DEGREE_{name}"), model.sh[:, k])
    np.testing.assert_array_equal(stored("_LEVEL")[:, 0], model.levels)


def cover_times_area(values):
    """Return what Gaussians of a file hide, by another formula for the area, [N]."""
    a, b, c = values["KHR_gaussian_splatting:SCALE"].astype(float).T
    areas = np.sqrt(((a * b) ** 2 + (a * c) ** 2 + (b * c) ** 2) / 3)
    return values["KHR_gaussian_splatting:OPACITY"][:, 0] * areas


def test_parents_stand_for_their_children(tmp_path):
    # Opacities are low enough for covers below 1, and the model is antialiased: what is hidden is as much.
    model = city(3000, levels=False)
    model.opacities -= 3
    model.comments = [MIP]
    write_tiles(tmp_path / "t", model, np.eye(4), SCENE, "t", most=200)
    tileset, total, parents = json.loads((tmp_path / "t" / "tileset.json").read_text()), 0, 0
    for node, _ in nodes(tileset["root"]):
        values = read_glb(tmp_path / "t" / node["content"]["uri"])[1]
        total += len(values["POSITION"])
        if "children" not in node:
            continue
        parents += 1
        below = [read_glb(tmp_path / "t" / child["content"]["uri"])[1] for child in node["children"]]
        assert len(values["POSITION"]) <= sum(len(child["POSITION"]) for child in below) / 8
        weights = np.concatenate([cover_times_area(child) for child in below])
        assert values["KHR_gaussian_splatting:OPACITY"].max() < 0.9
        np.testing.assert_allclose(cover_times_area(values).sum(), weights.sum(), rtol=1e-4)
        for name in ("POSITION", "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"):
            own = cover_times_area(values) @ values[name].astype(float)
            wanted = weights @ np.concatenate([child[name] for child in below]).astype(float)
            np.testing.assert_allclose(own, wanted, rtol=1e-4, atol=1e-4 * np.abs(wanted).max())
    assert parents > 5 and len(model) < total <= 8 / 7 * len(model)


def test_blocks_and_processes_do_not_change_the_files(written, tmp_path, monkeypatch):
    model, path, done, _ = written
    monkeypatch.setattr(blocks, "BLOCK", 700)
    again = write_tiles(
        tmp_path / "t", model, upright((0.0, -1.0, 0.0)), SCENE, "the city", most=300, processes=2
    )
    assert again == done
    for file in [file for file in path.rglob("*") if file.is_file()]:
        assert file.read_bytes() == (tmp_path / "t" / file.relative_to(path)).read_bytes(), file


def test_a_crowd_at_one_place_and_one_gaussian_are_written(tmp_path):
    crowd = city(1000)
    crowd.means[:] = torch.tensor([1.0, 2.0, 3.0])
    assert write_tiles(tmp_path / "a", crowd, np.eye(4), SCENE, "a", most=100).gaussians == 1000
    root = json.loads((tmp_path / "a" / "tileset.json").read_text())["root"]
    assert "children" not in root and root["content"]["extras"]["gaussians"] == 1000
    one = city(2).rows(slice(0, 1))
    assert write_tiles(tmp_path / "b", one, np.eye(4), SCENE, "b").tiles == 1
    none = city(2).rows(slice(0, 0))
    refused(ValueError, "has no Gaussian", write_tiles, tmp_path / "c", none, np.eye(4), SCENE, "c")
    assert not (tmp_path / "c").exists()


def test_folders_with_files_are_kept(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("x")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path)
    for name in ("full", "file", "link"):
        reason = "is not an empty folder: remove it or choose another name"
        refused(FileExistsError, reason, write_tiles, tmp_path / name, city(100), np.eye(4), SCENE, "x")
    assert sorted(os.listdir(tmp_path)) == ["file", "full", "link"]
    (tmp_path / "empty").mkdir()
    write_tiles(tmp_path / "empty", city(100), np.eye(4), SCENE, "x")
    assert (tmp_path / "empty" / "tileset.json").exists()


def test_a_full_disk_or_bad_values_leave_nothing(tmp_path, monkeypatch):
    from blitzgs.formats import tiles

    def full(path, *_, **__):
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(tiles, "write_glb", full)
        with pytest.raises(OSError, match="No space left on device") as caught:
            write_tiles(tmp_path / "a", city(1000), np.eye(4), SCENE, "a", most=100)
        assert caught.value.filename == str(tmp_path / "a")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000}))
        reason = r"kB are needed for the files and a temporary copy, and 1.00 kB are"
        refused(OSError, reason, write_tiles, tmp_path / "a", city(1000), np.eye(4), SCENE, "a")
    bad = city(1000)
    bad.means[7, 0] = float("nan")
    reason = "means has NaN or infinite values in 1 Gaussians"
    refused(ValueError, reason, write_tiles, tmp_path / "a", bad, np.eye(4), SCENE, "a")
    assert os.listdir(tmp_path) == []


def test_a_killed_export_leaves_no_tileset(tmp_path):
    program = (
        "import sys, time, pathlib, numpy as np\n"
        "from blitzgs.formats import tiles\n"
        "from tests.formats.test_tiles import city, SCENE\n"
        "tiles.write_file = lambda *a: (print('ready', flush=True), time.sleep(60))\n"
        "tiles.write_tiles(pathlib.Path(sys.argv[1]), city(500), np.eye(4), SCENE, 'x', most=100)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "t")], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
    assert not (tmp_path / "t").exists() and not list(tmp_path.rglob("tileset.json"))
    left = list(tmp_path.iterdir())
    with new_folder(tmp_path / "t") as folder:
        assert len(left) == 1 and not left[0].exists()
        with pytest.raises(KeyError), new_folder(tmp_path / "t"):
            raise KeyError(folder.stat())  # a folder in use is not removed
        (folder / "x").write_text("x")
    assert (tmp_path / "t" / "x").exists()


def test_an_export_that_is_told_to_end_leaves_nothing(tmp_path):
    for number in (signal.SIGTERM, signal.SIGHUP):
        before = signal.signal(number, signal.SIG_DFL)  # pytest's workers and other tests may have set one
        try:
            with pytest.raises(SystemExit), ending_by_exception(), new_folder(tmp_path / "t"):
                os.kill(os.getpid(), number)
                time.sleep(10)
            assert list(tmp_path.iterdir()) == [] and signal.getsignal(number) == signal.SIG_DFL
        finally:
            signal.signal(number, before)


def ready_for_long(_: object) -> None:
    os.write(1, b"ready\n")  # at once: several processes share the pipe, and print writes twice
    time.sleep(20)


@pytest.mark.timeout(100)
def test_the_processes_of_a_killed_export_end_with_it():
    program = (
        "from blitzgs.formats.tiles import workers\n"
        "from tests.formats.test_tiles import ready_for_long\n"
        "with workers(2) as run:\n"
        "    list(run(ready_for_long, [0, 1]))\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
        process.stdout.read()  # ends when no process has it open


def test_up_turns_to_z():
    for up in ((0, 0, 1), (0, 0, -2), (0.3, -0.5, 0.1), (1, 0, 0)):
        turn = upright(up)[:3, :3]
        np.testing.assert_allclose(turn @ np.array(up) / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)


BOX = np.array([[0.0, 0, 0], [40, 30, 4]])


def covariances_of(model):
    turns = Rotation.from_quat(np.roll(model.quats.double().numpy(), -1, axis=1)).as_matrix()
    return turns @ (np.exp(2 * model.scales.double().numpy())[:, :, None] * turns.transpose(0, 2, 1))


def area(covariance):
    """Return the root of a third of the sum of squared products of two semi-axes."""
    a, b, c = np.linalg.eigvalsh(covariance)
    return math.sqrt((a * b + a * c + b * c) / 3)


@pytest.mark.parametrize("antialiased", [True, False])
def test_cells_have_the_moments_of_their_gaussians(antialiased):
    model = city(1500)
    rows, edge = merged(moments(model), 100, BOX, antialiased)
    assert 40 < len(rows) <= 100 and 1 < edge < 40
    blur = 0 if antialiased else 0.3 * edge**2
    means, covariances = model.means.double().numpy(), covariances_of(model)
    opacities, sh = model.opacities.double().sigmoid().numpy(), model.sh.double().flatten(1).numpy()
    # Cells are cubes of the box, of which the longest side is 2; outside they grow with the distance.
    places = (means - BOX.mean(axis=0)) / 20
    far = np.abs(places) > 1
    places[far] = np.sign(places[far]) * (1 + np.log(np.abs(places[far])))
    cells = defaultdict(list)
    for row, place in enumerate((places - places.min(axis=0)) / (edge / 20)):
        cells[tuple(np.floor(place))].append(row)
    assert len(cells) == len(rows)
    for (_, inside), row in zip(sorted(cells.items()), rows, strict=True):
        w = np.array([opacities[i] * area(covariances[i] + blur * np.eye(3)) for i in inside])
        mean = w @ means[inside] / w.sum()
        away = means[inside] - mean
        spread = np.einsum("n,ni,nj->ij", w, away, away) + np.einsum("n,nij->ij", w, covariances[inside])
        spread /= w.sum()
        cover = w.sum() / area(spread + blur * np.eye(3))
        np.testing.assert_allclose(row[:3], mean, rtol=1e-5, atol=1e-5)
        scale = np.abs(spread).max()
        np.testing.assert_allclose(row[3:9], spread[np.triu_indices(3)], rtol=1e-4, atol=2e-6 * scale)
        np.testing.assert_allclose(row[9], cover, rtol=1e-4)
        np.testing.assert_allclose(row[10:], w @ sh[inside] / w.sum(), rtol=1e-4, atol=1e-6)


def test_a_gaussian_alone_stays_and_covers_widen():
    model = city(50)
    rows = moments(model)
    same, edge = merged(rows, 50, BOX, True)
    assert len(same) == 50 and edge < 0.01
    again = shown(same, ["comment x"])
    order = model.means[:, 0].argsort()
    back = again.means[:, 0].argsort()
    torch.testing.assert_close(again.means[back], model.means[order])
    torch.testing.assert_close(again.sh[back], model.sh[order])
    torch.testing.assert_close(again.opacities[back], model.opacities[order], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        covariances_of(again)[back.numpy()], covariances_of(model)[order.numpy()], rtol=1e-3, atol=1e-5
    )
    assert again.comments == ["comment x"] and again.levels is None
    for cover, wider, opacity in ((0.4, 1, 0.4), (1.5, 1.5**0.5, 0.999), (7.0, 1.38, 0.999)):
        rows[:, 9] = cover
        found = shown(rows, [])
        np.testing.assert_allclose(
            found.scales.sort(dim=1).values, model.scales.sort(dim=1).values + math.log(wider), atol=2e-3
        )
        np.testing.assert_allclose(found.opacities.sigmoid(), opacity, rtol=1e-5)


def test_any_number_of_cells_is_kept_and_invisible_gaussians_are_merged():
    model = city(300)
    model.opacities[:] = -200.0
    for most in (1, 7):
        rows, _ = merged(moments(model), most, BOX, True)
        assert 1 <= len(rows) <= most and np.isfinite(rows).all()
        shown(rows, []).check()
    least = merged(moments(model), 300, BOX, True, 5.0)
    assert least[1] == pytest.approx(5.0) and len(least[0]) < 300
    one_place = model.means.clone()
    model.means[:] = one_place[0]
    assert len(merged(moments(model), 300, BOX, True)[0]) == 1
    # Lengths whose squares float32 does not hold.
    model.means[1], model.scales[2] = 1e30, 60.0
    for rows in (moments(model), merged(moments(model), 7, BOX, True)[0]):
        shown(rows, []).check()
