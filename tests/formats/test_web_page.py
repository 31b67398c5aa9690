# SPDX-License-Identifier: Apache-2.0
"""The HTML file with a model: what is in it, read back without its own code."""

import base64
import json
import re
import zlib

import numpy as np
import pytest

from blitzgs.formats.web_page import (
    BLOCK,
    HARMONIC,
    WebScene,
    WebSplats,
    check_replaces_page,
    estimated_bytes,
    packed,
    web_page,
)

SCENE = WebScene(0.01, 100.0, 0.3, False, (0.1, 0.2, 0.3), (0, 0, 1), (0, -3, 1), (0, 0, 0), 0.8)


def some_splats(count=700, degree=2):
    random = np.random.default_rng(0)

    def normal(*shape):
        return random.normal(size=shape).astype(np.float32)

    sh = 0.2 * normal(count, (degree + 1) ** 2, 3)
    opacities = random.uniform(0, 1, count).astype(np.float32)
    levels = random.integers(0, 5, count).astype(np.uint8)
    return WebSplats(normal(count, 3), normal(count, 4), normal(count, 3) - 4, opacities, sh, levels)


def rotations(quats):
    """Return the matrices [N, 3, 3] of quaternions w, x, y, z by their products with the basis vectors."""
    w, v = quats[:, :1], quats[:, 1:]
    columns = []
    for basis in np.eye(3):
        t = 2 * np.cross(v, basis)
        columns.append(basis + w * t + np.cross(v, t))
    return np.stack(columns, axis=2)


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
    box, sizes, tints = (reader.ranges() for _ in range(3))
    low, high = reader.planes(3).astype(int), reader.planes(3).astype(int)
    means = box[..., 0] + box[..., 1] * (low + 256 * high)
    assert np.abs(means.T - splats.means).max() <= 0.51 * box[..., 1].max()
    for ranges, wanted in ((sizes, splats.scales), (tints, splats.sh[:, 0])):
        found = ranges[..., 0] + ranges[..., 1] * reader.planes(3)
        assert np.abs(found.T - wanted).max() <= 0.51 * ranges[..., 1].max()
    words = np.ascontiguousarray(reader.planes(4).T).view("<u4")[:, 0]
    three = np.stack([words & 1023, words >> 10 & 1023, words >> 20 & 1023], 1) / 1023 * 2 - 1
    three /= 2**0.5
    quats = np.zeros((len(splats), 4))
    largest = np.sqrt(1 - (three**2).sum(1))
    for row, (others, place) in enumerate(zip(three, words >> 30, strict=True)):
        quats[row] = np.insert(others, place, largest[row])
    unit = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    assert np.abs(rotations(quats) - rotations(unit)).max() < 5e-3
    assert np.abs(reader.planes(1)[0] / 255 - splats.opacities).max() < 0.51 / 255
    np.testing.assert_array_equal(reader.planes(1)[0], splats.levels)
    rest = reader.planes(24).view(np.int8) * HARMONIC
    assert np.abs(rest.T.reshape(-1, 8, 3) - splats.sh[:, 1:]).max() <= 0.51 * HARMONIC
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
    with pytest.raises(FileExistsError, match="blitzgs did not write it"):
        check_replaces_page(file)
    file.write_text(web_page(some_splats(5, 0), SCENE, "t"))
    check_replaces_page(file)
