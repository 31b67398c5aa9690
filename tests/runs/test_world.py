# SPDX-License-Identifier: Apache-2.0
"""A model in world coordinates: the same images, and exports that are right to the millimetre."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import blitzgs
from blitzgs.capture.world import WorldFrame
from blitzgs.cli import main
from blitzgs.reference.gaussians import rotation_matrices, sh_basis
from blitzgs.runs.export import export_ply
from blitzgs.runs.world import in_world, load_frame, rotated_harmonics, save_frame

TURN = Rotation.from_euler("xyz", [20, -50, 140], degrees=True).as_matrix()
FRAME = WorldFrame("EPSG:32633", 1.75, TURN, np.array([512_345.678, 5_012_345.678, 250.125]), "test")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_harmonics_show_the_same_colours(degree):
    random = torch.Generator().manual_seed(degree)
    sh = torch.randn(5, (degree + 1) ** 2, 3, generator=random)
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=random, dtype=torch.float64), dim=1
    )
    rotation = torch.from_numpy(TURN)
    before = torch.einsum("dk,nkc->dnc", sh_basis(directions, degree), sh.double())
    turned = rotated_harmonics(sh, rotation).double()
    after = torch.einsum("dk,nkc->dnc", sh_basis(directions @ rotation.T, degree), turned)
    torch.testing.assert_close(after, before, atol=5e-6, rtol=0)


def test_the_model_in_the_world_looks_the_same(trained):
    run = blitzgs.open_run(trained[1])
    model = run.model()
    # The tiny run is too short to have colours that depend on the direction.
    model = dataclasses.replace(model, sh=model.sh + 0.1 * torch.randn(model.sh.shape), sh_degree=3)
    world = in_world(model, FRAME)
    camera = run.cameras().cameras[0]
    pose = np.array(camera.world_to_camera)
    pose[:3, :3] = pose[:3, :3] @ TURN.T
    pose[:3, 3] *= FRAME.scale
    moved = dataclasses.replace(camera, world_to_camera=pose)
    assert (world.render(moved) - model.render(camera)).abs().max() < 2e-3
    rotations = rotation_matrices(torch.nn.functional.normalize(model.quats.double(), dim=1))
    turned = rotation_matrices(torch.nn.functional.normalize(world.quats.double(), dim=1))
    torch.testing.assert_close(turned, torch.from_numpy(TURN) @ rotations, atol=1e-6, rtol=0)
    shifted = in_world(model, dataclasses.replace(FRAME, rotation=np.eye(3)))
    assert shifted.means is model.means and shifted.sh is model.sh


def test_world_coordinates_survive_a_ply_to_the_millimetre(trained, tmp_path):
    """At 5e6 m, where neighbouring float32 numbers are half a metre apart."""
    model = blitzgs.open_run(trained[1]).model()
    space = model.space
    capture = model.means.double().numpy() * space.unit + np.array(space.offset)
    exact = FRAME.to_world(capture)
    exported = export_ply(in_world(model, FRAME), tmp_path / "m.ply", crs=FRAME.crs)
    content = json.loads((tmp_path / "m.ply.offset.json").read_text())
    assert content["crs"] == "EPSG:32633" and tuple(content["offset"]) == exported.offset
    vertices = PlyData.read(str(tmp_path / "m.ply"))["vertex"]
    stored = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    assert np.abs(stored + content["offset"] - exact).max() < 1e-3
    again = PlyData.read(str(tmp_path / "m.ply")).comments
    assert "offset {!r} {!r} {!r}".format(*content["offset"]) in again


def test_the_command_needs_to_know_the_world(trained, tmp_path, capsys):
    flags = ["--coordinates", "world"]
    assert main(["export", str(trained[1]), "--ply", str(tmp_path / "a.ply"), *flags]) == 1
    assert (
        "has no geo.json, so its place in the world is unknown: use blitzgs align" in capsys.readouterr().err
    )
    assert load_frame(trained[1]) is None
    path = save_frame(trained[1], FRAME)
    try:
        assert main(["export", str(trained[1]), "--ply", str(tmp_path / "a.ply"), *flags]) == 0
        assert json.loads((tmp_path / "a.ply.offset.json").read_text())["crs"] == "EPSG:32633"
    finally:
        path.unlink()
