# SPDX-License-Identifier: Apache-2.0
"""Cameras without photographs."""

import json
import shutil

import numpy as np
import pytest

from blitzgs.capture.own_cameras import read_cameras
from tests.training.tiny import tiny_scene, write_tiny_capture


def test_a_transforms_file_of_any_name_needs_no_photographs(tmp_path):
    matrix = np.eye(4)
    matrix[:3, 3] = 10, 20, 30
    frames = [{"file_path": "view/b", "transform_matrix": matrix.tolist()}]
    frames.append({"file_path": "view/a", "transform_matrix": np.eye(4).tolist(), "fl_x": 80})
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"w": 64, "h": 48, "fl_x": 50, "cx": 30, "cy": 20, "frames": frames}))
    first, second = read_cameras(file, np.array([10.0, 20.0, 30.0]))
    assert (first.name, second.name, second.width, second.height) == ("view/a", "view/b", 64, 48)
    np.testing.assert_allclose(second.K, [[50, 0, 30], [0, 50, 20], [0, 0, 1]])
    assert first.K[0, 0] == 80
    np.testing.assert_allclose(second.world_to_camera, np.diag([1, -1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(first.world_to_camera)[:3, 3], [-10, -20, -30], atol=1e-12)


def test_a_colmap_model_needs_no_photographs(tmp_path):
    write_tiny_capture(tmp_path)
    shutil.rmtree(tmp_path / "images")
    found, known = read_cameras(tmp_path / "sparse" / "0", np.zeros(3)), tiny_scene()[0].cameras
    assert [camera.name for camera in found] == [camera.name for camera in known]
    for camera, own in zip(found, known, strict=True):
        np.testing.assert_allclose(camera.K, own.K)
        np.testing.assert_allclose(camera.world_to_camera, own.world_to_camera, atol=1e-6)


def test_errors_name_the_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_cameras(tmp_path / "nowhere", np.zeros(3))
    with pytest.raises(FileNotFoundError, match="holds no capture"):
        read_cameras(tmp_path, np.zeros(3))
    file = tmp_path / "c.json"
    for text, reason in (
        ("{", "no JSON"),
        ('{"frames": []}', "has no cameras"),
        (
            '{"w": 4, "h": 4, "fl_x": 3, "frames": [{"file_path": "a"}]}',
            "frame 0: the field 'transform_matrix'",
        ),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=reason) as raised:
            read_cameras(file, np.zeros(3))
        assert str(file) in str(raised.value)
