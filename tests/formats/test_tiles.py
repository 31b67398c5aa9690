"""3D Tiles of a model: the tree against what its files hold by an independent reader of GLB."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from blitzgs.formats import gaussians as blocks
from blitzgs.formats.gaussians import Gaussians
from blitzgs.formats.tiles import new_folder, upright, write_tiles
from blitzgs.formats.web_page import WebScene
from blitzgs.util.progress import ending_by_exception
from tests.helpers import read_glb

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
    low, high = [], []
    for mean, (x, y, z, w), scale in zip(attributes["POSITION"], quats.astype(float), scales, strict=True):
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        covariance = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        covariance = covariance @ np.diag(scale.astype(float) ** 2) @ covariance.T
        reach = 3 * np.sqrt(np.diag(covariance))
        low.append(mean - reach)
        high.append(mean + reach)
    return np.min(low, axis=0), np.max(high, axis=0)


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
        assert node["refine"] == "ADD" and node["geometricError"] >= 0
        assert node.keys() <= {
            "boundingVolume", "geometricError", "refine", "content", "children", "transform",
        }  # fmt: skip
        if "content" in node:
            uris.append(node["content"]["uri"])
        assert "content" in node or node["children"]
    files = sorted(str(file.relative_to(path)) for file in path.rglob("*.glb"))
    assert sorted(uris) == files and len(files) == done.tiles > 20
    assert done.bytes == sum((path / file).stat().st_size for file in files)
    assert sorted(os.listdir(path)) == ["index.html", "tiles", "tileset.json"]
    assert "the city" in (path / "index.html").read_text()


def test_errors_fall_and_volumes_hold_what_is_inside(written):
    _, path, _, tileset = written
    for node, parent in nodes(tileset["root"]):
        low, high = corners(node["boundingVolume"])
        if parent is not None:
            assert node["geometricError"] <= parent["geometricError"]
            outer_low, outer_high = corners(parent["boundingVolume"])
            assert (low >= outer_low - 1e-9).all() and (high <= outer_high + 1e-9).all()
        if not node.get("children"):
            assert node["geometricError"] == 0
        if "content" in node:
            inner = corners(node["content"]["boundingVolume"])
            assert (inner[0] >= low - 1e-9).all() and (inner[1] <= high + 1e-9).all()
            found = ellipsoid_corners(read_glb(path / node["content"]["uri"])[1])
            assert (found[0] >= inner[0]).all() and (found[1] <= inner[1]).all()
            # At 3.33 standard deviations, not more.
            assert (inner[1] - inner[0] <= 1.12 * (found[1] - found[0])).all()


def test_levels_finer_than_those_of_an_octree_are_taken_together(written, tmp_path):
    model, path, done, tileset = written
    fine = dataclasses.replace(
        model,
        comments=["comment lod reference_distance 40.0 fork 1.189207115002721 levels 14 finest 13"],
        # Levels of 1 to 4, 5 to 8 and 9 to 12 are one each.
        levels=(4 * model.levels - torch.arange(len(model)) % 4).clamp(min=0),
    )
    again = write_tiles(tmp_path / "city", fine, upright((0.0, -1.0, 0.0)), SCENE, "the city", most=300)
    assert again.tiles == done.tiles
    other = json.loads((tmp_path / "city" / "tileset.json").read_text())
    pairs = list(zip(nodes(tileset["root"]), nodes(other["root"]), strict=True))
    errors = np.array([[old["geometricError"], new["geometricError"]] for (old, _), (new, _) in pairs])
    before, after = errors[errors[:, 0] > 0].T
    ratios = np.unique((after / before).round(6))
    # Levels reach by half a step farther than their number says: half an octave, or an eighth.
    assert set(ratios) <= {1.0, round(2**0.375, 6)} and len(ratios) > 0


def test_every_gaussian_is_in_one_tile_with_its_values(written):
    model, path, _, tileset = written
    found = {}
    for node, _ in nodes(tileset["root"]):
        if "content" not in node:
            continue
        content, values = read_glb(path / node["content"]["uri"])
        assert len(values["POSITION"]) == node["content"]["extras"]["gaussians"] <= 300
        # The node turns +Z to +Y, and viewers turn +Y to +Z.
        np.testing.assert_allclose(content["nodes"][0]["rotation"], [-(0.5**0.5), 0, 0, 0.5**0.5])
        for index, mean in enumerate(values["POSITION"]):
            assert found.setdefault(mean.tobytes(), (values, index))[0] is values
    assert len(found) == len(model)
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


def test_children_have_the_finer_levels_and_show_at_the_distance_of_the_gate(written):
    _, path, _, tileset = written
    angle = 16 * 2 * np.tan(np.pi / 6) / 1080  # of 16 pixels in a picture of 1080 rows and 60 degrees
    trained = 0
    for node, _ in nodes(tileset["root"]):
        if "content" not in node or not node.get("children"):
            continue
        finest = read_glb(path / node["content"]["uri"])[1]["_LEVEL"].max()
        below = [read_glb(path / uri)[1] for uri in contents_below(node)]
        # The gate shows level l up to d_0 f^(1/2 - l); level 0, up to any distance, is in classes of size.
        if all(values["_LEVEL"].min() > finest for values in below):
            trained += 1
            np.testing.assert_allclose(node["geometricError"] / angle, 40 * 2 ** (0.5 - (finest + 1)))
        else:
            assert finest == 0
            # What is missing is narrower than a tenth of a pixel where the error has 16.
            missing = max(sizes(values)[values["_LEVEL"][:, 0] == 0].max(initial=0) for values in below)
            assert missing <= 1.001 * node["geometricError"] * 0.1 / 16
    assert trained > 3


def contents_below(node):
    return [
        below["content"]["uri"]
        for child in node["children"]
        for below, _ in nodes(child)
        if "content" in below
    ]


def sizes(values):
    """Return opacity times the geometric mean of the two largest scales of Gaussians in a file."""
    scales = np.sort(values["KHR_gaussian_splatting:SCALE"].astype(float), axis=1)
    return values["KHR_gaussian_splatting:OPACITY"][:, 0] * np.sqrt(scales[:, 1] * scales[:, 2])


def test_without_levels_parents_have_what_shows_most(tmp_path):
    model = city(levels=False)
    write_tiles(tmp_path / "t", model, np.eye(4), SCENE, "t", most=300)
    tileset = json.loads((tmp_path / "t" / "tileset.json").read_text())
    total = 0
    for node, _ in nodes(tileset["root"]):
        if "content" not in node:
            continue
        values = read_glb(tmp_path / "t" / node["content"]["uri"])[1]
        assert "_LEVEL" not in values
        total += len(values["POSITION"])
        for uri in contents_below(node) if node.get("children") else []:
            missing = sizes(read_glb(tmp_path / "t" / uri)[1]).max()
            assert missing <= 1.001 * sizes(values).min()
            assert missing <= 1.001 * node["geometricError"] * 0.1 / 16
    assert total == len(model)


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
    contents = [node["content"] for node, _ in nodes(root) if "content" in node]
    assert sum(content["extras"]["gaussians"] for content in contents) == 1000
    one = city(2).rows(slice(0, 1))
    assert write_tiles(tmp_path / "b", one, np.eye(4), SCENE, "b").tiles == 1
    with pytest.raises(ValueError, match="has no Gaussian"):
        write_tiles(tmp_path / "c", city(2).rows(slice(0, 0)), np.eye(4), SCENE, "c")
    assert not (tmp_path / "c").exists()


def test_folders_with_files_are_kept(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("x")
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path)
    for name in ("full", "file", "link"):
        with pytest.raises(FileExistsError, match="is not an empty folder: remove it or choose another name"):
            write_tiles(tmp_path / name, city(100), np.eye(4), SCENE, "x")
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
        with pytest.raises(
            OSError, match=r"kB are needed for the files and a temporary copy, and 1.00 kB are"
        ):
            write_tiles(tmp_path / "a", city(1000), np.eye(4), SCENE, "a")
    bad = city(1000)
    bad.means[7, 0] = float("nan")
    with pytest.raises(ValueError, match="means has NaN or infinite values in 1 Gaussians"):
        write_tiles(tmp_path / "a", bad, np.eye(4), SCENE, "a")
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


def ready_for_long(*_: object) -> None:
    os.write(1, b"ready\n")  # at once: several processes share the pipe, and print writes twice
    time.sleep(20)


@pytest.mark.timeout(100)
def test_the_processes_of_a_killed_export_end_with_it():
    program = (
        "from blitzgs.formats.tiles import each_part\n"
        "from tests.formats.test_tiles import ready_for_long\n"
        "list(each_part(ready_for_long, None, None, 2, [0, 1]))\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.kill()
        process.stdout.read()  # ends when no process has it open


def test_up_turns_to_z():
    for up in ((0.0, 0.0, 1.0), (0.0, 0.0, -2.0), (0.3, -0.5, 0.1), (1.0, 0.0, 0.0)):
        turn = upright(up)[:3, :3]
        np.testing.assert_allclose(turn @ np.array(up) / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
