# SPDX-License-Identifier: Apache-2.0
"""Files for browsers, read back without their writers: GLB, streamed SOG, the HTML file with a model."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from blitzgs.formats import gaussians as blocks
from blitzgs.formats import glb
from blitzgs.formats.glb import write_glb
from blitzgs.formats.streamed_sog import write_streamed_sog
from blitzgs.formats.web_page import (
    BLOCK,
    HARMONIC,
    WebScene,
    check_replaces_page,
    estimated_bytes,
    packed,
    web_page,
)
from tests.formats.test_tiles import city
from tests.helpers import read_glb, refused, some_gaussians

SCENE = WebScene(0.01, 100.0, 0.3, False, (0.1, 0.2, 0.3), (0, 0, 1), (0, -3, 1), (0, 0, 0), 0.8)


def some_splats(count=700, degree=2):
    return some_gaussians(count, degree, levels=True)


class Reader:
    def __init__(self, data, count):
        self.data, self.count, self.at = zlib.decompress(data), count, 0

    def ranges(self, axes=3):
        blocks = -(-self.count // BLOCK)
        values = np.frombuffer(self.data, "<f4", 2 * blocks * axes, self.at).reshape(axes, blocks, 2)
        self.at += values.nbytes
        return np.repeat(values, BLOCK, axis=1)[:, : self.count]

    def planes(self, number):
        values = np.frombuffer(self.data, np.uint8, number * self.count, self.at)
        self.at += values.nbytes
        return values.reshape(number, self.count)


def test_all_values_come_back():
    splats = some_splats()
    reader = Reader(packed(splats), len(splats))
    scales, sh = splats.scales.numpy(), splats.sh.numpy()
    box, sizes, tints = (reader.ranges() for _ in range(3))
    low, high = reader.planes(3).astype(int), reader.planes(3).astype(int)
    means = box[..., 0] + box[..., 1] * (low + 256 * high)
    assert np.abs(means.T - splats.means.numpy()).max() <= 0.51 * box[..., 1].max()
    for ranges, wanted in ((sizes, scales), (tints, sh[:, 0])):
        found = ranges[..., 0] + ranges[..., 1] * reader.planes(3)
        assert np.abs(found.T - wanted).max() <= 0.51 * ranges[..., 1].max()
    words = np.ascontiguousarray(reader.planes(4).T).view("<u4")[:, 0]
    three = np.stack([words & 1023, words >> 10 & 1023, words >> 20 & 1023], 1) / 1023 * 2 - 1
    three /= 2**0.5
    quats = np.zeros((len(splats), 4))
    largest = np.sqrt(1 - (three**2).sum(1))
    for row, (others, place) in enumerate(zip(three, words >> 30, strict=True)):
        quats[row] = np.insert(others, place, largest[row])
    found, wanted = (Rotation.from_quat(np.roll(some, -1, axis=1)) for some in (quats, splats.quats))
    assert (found.inv() * wanted).magnitude().max() < 5e-3
    assert np.abs(reader.planes(1)[0] / 255 - splats.opacities.sigmoid().numpy()).max() < 0.51 / 255
    np.testing.assert_array_equal(reader.planes(1)[0], splats.levels.numpy())
    rest = reader.planes(24).view(np.int8) * HARMONIC
    assert np.abs(rest.T.reshape(-1, 8, 3) - sh[:, 1:]).max() <= 0.51 * HARMONIC
    assert reader.at == len(reader.data)


def test_a_zero_quaternion_is_the_identity():
    splats = some_splats(3, 0)
    splats.quats[:] = 0
    reader = Reader(packed(splats), 3)
    for _ in range(3):
        reader.ranges()
    reader.planes(12)
    words = np.ascontiguousarray(reader.planes(4).T).view("<u4")[:, 0]
    assert (words >> 30 == 0).all()
    assert np.abs((words[:, None] >> np.array([0, 10, 20]) & 1023) - 511.5).max() <= 0.5


def test_the_page_has_everything_in_it_and_no_address():
    splats = some_splats()
    page = web_page(splats, SCENE, "<script>alert(1)</script>", "Left out: <b>7</b>.")
    assert "<script>alert(1)" not in page and "&lt;b&gt;7" in page
    assert not re.search(r"""(src|href)=(?!"data:)|https?://|@import""", page)
    assert "{{" not in page
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', page)[1])
    assert (scene["count"], scene["degree"], scene["background"]) == (700, 2, [0.1, 0.2, 0.3])
    model = re.search(r'id="model">(.*?)</script>', page)[1]
    assert base64.b64decode(model) == packed(splats)


def test_sizes_are_estimated():
    splats = some_splats(100_000, 1)
    exact = len(packed(splats)) * 4 / 3
    assert abs(estimated_bytes(splats) - exact) < 0.02 * exact


def test_a_page_replaces_only_a_page(tmp_path):
    file = tmp_path / "a.html"
    check_replaces_page(file)
    file.write_text("<html>mine</html>")
    refused(FileExistsError, "blitzgs did not write it", check_replaces_page, file)
    file.write_text(web_page(some_splats(5, 0), SCENE, "t"))
    check_replaces_page(file)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_reader_of_the_specification_finds_the_values(tmp_path, monkeypatch, degree):
    monkeypatch.setattr(blocks, "BLOCK", 7)  # three blocks
    model = some_gaussians(20, degree, levels=degree == 2)
    model.comments = ["comment SplatRenderMode: mip", "comment offset 1.0 2.0 3.0"]
    write_glb(tmp_path / "a.glb", model)
    content, found = read_glb(tmp_path / "a.glb")
    assert content["asset"]["extras"] == {"comments": model.comments}
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    extension = content["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"

    np.testing.assert_array_equal(found["POSITION"], model.means.numpy())
    accessor = content["accessors"][0]
    np.testing.assert_array_equal(np.float32(accessor["min"]), model.means.numpy().min(axis=0))
    np.testing.assert_array_equal(np.float32(accessor["max"]), model.means.numpy().max(axis=0))
    np.testing.assert_allclose(found["KHR_gaussian_splatting:SCALE"], np.exp(model.scales.numpy()), rtol=1e-6)
    opacities = 1 / (1 + np.exp(-model.opacities.numpy().astype(np.float64)))
    np.testing.assert_allclose(found["KHR_gaussian_splatting:OPACITY"][:, 0], opacities, rtol=1e-6)
    # scipy's quaternions are x, y, z, w, as those of glTF.
    expected = Rotation.from_quat(np.roll(model.quats.numpy(), -1, axis=1)).as_matrix()
    quats = found["KHR_gaussian_splatting:ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(quats).as_matrix(), expected, atol=1e-6)
    k = 0
    for d in range(degree + 1):
        for n in range(2 * d + 1):
            name = f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{n}"
            np.testing.assert_array_equal(found[name], model.sh[:, k].numpy())
            k += 1
    colors = np.clip(0.5 + 0.28209479 * model.sh[:, 0].numpy(), 0, 1)
    np.testing.assert_allclose(found["COLOR_0"][:, :3], colors, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found["COLOR_0"][:, 3], opacities, atol=0.5 / 255 + 1e-6)
    assert ("_LEVEL" in found) == (degree == 2)
    if degree == 2:
        np.testing.assert_array_equal(found["_LEVEL"][:, 0], model.levels.numpy())


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 1, 0), (0.3, -0.9, 0.2)])
def test_the_node_turns_the_models_up_to_plus_y(tmp_path, up):
    write_glb(tmp_path / "a.glb", some_gaussians(3, 0), up)
    content, _ = read_glb(tmp_path / "a.glb")
    turned = Rotation.from_quat(content["nodes"][0]["rotation"]).apply(np.array(up) / np.linalg.norm(up))
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)


def test_what_no_viewer_could_show_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    refused(ValueError, "has no Gaussian", write_glb, path, some_gaussians(0, 0))
    bad = some_gaussians(3, 0)
    bad.scales[1, 1] = 200
    refused(ValueError, "scales has NaN or infinite values in 1 Gaussians", write_glb, path, bad)
    bad = some_gaussians(3, 0)
    bad.means[2, 0] = torch.nan
    refused(ValueError, r"means has NaN.*number 2", write_glb, path, bad)
    monkeypatch.setattr(glb, "_LARGEST", (1 << 20) + 100)
    refused(ValueError, "a GLB file holds 4: choose", write_glb, path, some_gaussians(3, 3))
    assert not list(tmp_path.iterdir())
    path.write_bytes(b"ply\n")
    refused(FileExistsError, "not a GLB file", write_glb, path, some_gaussians(3, 0))


def leaves(node):
    low, high = (np.array(node["bound"][name]) for name in ("min", "max"))
    assert (low < high).all() and ("lods" in node) != ("children" in node)
    if "lods" in node:
        yield node
        return
    assert len(node["children"]) == 2
    inner = [node["children"][i]["bound"] for i in (0, 1)]
    np.testing.assert_allclose(low, np.minimum(inner[0]["min"], inner[1]["min"]))
    np.testing.assert_allclose(high, np.maximum(inner[0]["max"], inner[1]["max"]))
    for child in node["children"]:
        yield from leaves(child)


def test_lods_stand_for_each_other(tmp_path):
    gsply = pytest.importorskip("gsply", reason="the extra formats is not installed")
    pytest.importorskip("imagecodecs", reason="gsply reads SOG with imagecodecs")
    model = city(1200)
    done = write_streamed_sog(tmp_path / "city", model, most=600)
    meta = json.loads((tmp_path / "city" / "lod-meta.json").read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == len(meta["counts"]) == 4
    assert meta["counts"][0] == 1200 and meta["count"] == sum(meta["counts"])
    assert 1200 / 8 < meta["counts"][1] < 1200 / 2 and meta["counts"][3] < 1200 / 16
    found, used = list(leaves(meta["tree"])), []
    seen = {lod: [] for lod in range(4)}
    for leaf in found:
        low, high = (np.array(leaf["bound"][name]) for name in ("min", "max"))
        assert list(leaf["lods"]) == ["0", "1", "2", "3"]
        for lod, place in leaf["lods"].items():
            used.append(place["file"])
            data = gsply.sogread(str(tmp_path / "city" / meta["filenames"][place["file"]]))
            assert place["offset"] == 0 and len(data.means) == place["count"] <= 600
            assert place["count"] <= leaf["lods"][str(max(0, int(lod) - 1))]["count"]
            assert (data.means >= low - 1e-3).all() and (data.means <= high + 1e-3).all()
            seen[int(lod)].append(data.means)
    assert sorted(used) == list(range(len(meta["filenames"]))) and len(used) == done.tiles
    assert len(found) >= 2
    assert [sum(map(len, parts)) for parts in seen.values()] == meta["counts"]
    # 16 bits of the logarithm of each coordinate.
    means, wanted = np.sort(np.concatenate(seen[0]), axis=0), np.sort(model.means.numpy(), axis=0)
    assert (np.abs(means - wanted) <= 1e-3 * (1 + np.abs(wanted))).all()
    assert done.gaussians == 1200
    assert not [path for path in (tmp_path / "city").rglob("*") if path.suffix in (".tmp", ".sog")]
