import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from blitzgs.formats import gaussians as blocks
from blitzgs.formats import glb
from blitzgs.formats.gaussians import Gaussians
from blitzgs.formats.glb import write_glb
from tests.formats.helpers import read_glb, some_gaussians


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
    with pytest.raises(ValueError, match="has no Gaussian"):
        write_glb(path, some_gaussians(0, 0))
    bad = some_gaussians(3, 0)
    bad.scales[1, 1] = 200
    with pytest.raises(ValueError, match="scales are not finite"):
        write_glb(path, bad)
    bad = some_gaussians(3, 0)
    bad.means[2, 0] = torch.nan
    with pytest.raises(ValueError, match=r"means has NaN.*number 2"):
        write_glb(path, bad)
    monkeypatch.setattr(glb, "_LARGEST", (1 << 20) + 100)
    with pytest.raises(ValueError, match="a GLB file holds 4: choose"):
        write_glb(path, some_gaussians(3, 3))
    assert not list(tmp_path.iterdir())
    path.write_bytes(b"ply\n")
    with pytest.raises(FileExistsError, match="not a GLB file"):
        write_glb(path, some_gaussians(3, 0))


def test_a_zero_quaternion_is_no_rotation(tmp_path):
    model = some_gaussians(2, 0)
    model.quats[0] = 0
    assert isinstance(model, Gaussians)
    write_glb(tmp_path / "a.glb", model)
    np.testing.assert_array_equal(
        read_glb(tmp_path / "a.glb")[1]["KHR_gaussian_splatting:ROTATION"][0], [0, 0, 0, 1]
    )
