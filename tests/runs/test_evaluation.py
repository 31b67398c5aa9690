# SPDX-License-Identifier: Apache-2.0
"""Figures of a model, where its files come from, and its exports in world coordinates."""

import dataclasses
import json
import math
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import blitzgs
from blitzgs.capture.world import WorldFrame
from blitzgs.cli import main
from blitzgs.distributed.group import Ranks
from blitzgs.formats import gaussians as blocks
from blitzgs.formats.models import FORMATS
from blitzgs.formats.ply import read_ply
from blitzgs.reference.projection import rotation_matrices, sh_basis
from blitzgs.runs import checkpoint
from blitzgs.runs.evaluation import correct_colours, image_metrics, load_lpips
from blitzgs.runs.export import export
from blitzgs.runs.folder import open_run
from blitzgs.runs.source import open_source, source_of, up_of_run
from blitzgs.runs.world import in_world, rotated_harmonics
from tests.helpers import export_ply, refused, save_checkpoint, ssim_map


@pytest.mark.parametrize("masked", [False, True])
def test_metrics_match_plain_formulas(masked):
    g = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (37, 53, 3), generator=g, dtype=torch.uint8)
    render = target.float() / 255 + 0.3 * torch.randn(37, 53, 3, generator=g)
    mask = (torch.rand(37, 53, generator=g) > 0.3).to(torch.uint8) if masked else None
    counted = torch.ones(37, 53, dtype=torch.bool) if mask is None else mask.bool()
    clamped = render.clamp(0, 1)
    mse = ((clamped.double() - target.double() / 255) ** 2)[counted].mean().item()
    metrics = image_metrics(render, target, mask)
    assert metrics["psnr"] == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    expected = ssim_map(clamped[None], target[None].double() / 255)[0][counted].mean().item()
    assert metrics["ssim"] == pytest.approx(expected, abs=1e-5)
    assert image_metrics(target.float() / 255, target, mask)["psnr"] >= 100  # finite


def test_the_corrected_psnr_forgives_an_affine_change_of_colour_and_nothing_else():
    g = torch.Generator().manual_seed(1)
    clean = torch.rand(40, 30, 3, generator=g) * 0.5 + 0.2
    turned = clean @ torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.7]]).T + 0.04
    target = (turned * 255).round().byte()
    metrics = image_metrics(clean, target, None)
    # Only the photograph's rounding to 256 values remains: a twelfth of a squared step.
    assert metrics["psnr"] < 30 and metrics["psnr_corrected"] == pytest.approx(
        -10 * math.log10(1 / 255**2 / 12), abs=0.3
    )
    noise = 0.1 * torch.randn(40, 30, 3, generator=g)
    noisy = image_metrics(clean, (clean + noise).clamp(0, 1).mul(255).byte(), None)
    assert noisy["psnr"] <= noisy["psnr_corrected"] < noisy["psnr"] + 1

    pixels, wanted = torch.rand(500, 3, generator=g).double(), torch.rand(500, 3, generator=g).double()
    for constant in range(4):  # channels of a single colour, which say as much as the constant of the map
        pixels[:, :constant] = 0.7
        known = torch.cat([pixels[:, constant:], torch.ones(500, 1, dtype=torch.float64)], dim=1)
        expected = known @ torch.linalg.lstsq(known, wanted).solution
        torch.testing.assert_close(correct_colours(pixels, wanted), expected.clamp(0, 1))


def test_lpips_is_a_torchscript_module(tmp_path):
    class Distance(torch.nn.Module):
        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().mean()

    path = tmp_path / "lpips.pt"
    torch.jit.script(Distance()).save(str(path))
    metric = load_lpips(str(path))
    assert metric is not None
    assert float(metric(torch.zeros(1, 3, 4, 4), torch.ones(1, 3, 4, 4))) == 1.0
    refused(ValueError, r"missing.pt is not .*\(--lpips\)", load_lpips, str(tmp_path / "missing.pt"))


def test_a_checkpoint_is_streamed_with_its_pending_steps(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 100)
    model, streamed = open_run(trained[1]).model(), open_source(trained[1])
    whole = source_of(model, up_of_run(trained[1], model.space))
    assert len(streamed) == len(whole) == len(model) > 300 and streamed.comments == whole.comments
    sizes = [len(block) for block in streamed.blocks()]
    assert max(sizes) == 100 and sum(sizes) == len(model)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        found = torch.cat([getattr(block, name) for block in streamed.blocks()])
        expected = torch.cat([getattr(block, name) for block in whole.blocks()])
        assert torch.equal(found, expected), name
    export(streamed, streamed.space, FORMATS["ply"], tmp_path / "a.ply")
    export(whole, model.space, FORMATS["ply"], tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_a_damaged_checkpoint_is_passed_over(trained, tmp_path, failure):
    run = tmp_path / "run"
    shutil.copytree(trained[1], run)
    newest = max((run / "checkpoints").glob("checkpoint_*"))
    before = len(open_source(run))
    broken = run / "checkpoints" / "checkpoint_999999"
    shutil.copytree(newest, broken)
    (broken / "manifest.json").write_text("{}")
    with pytest.warns(UserWarning, match=f"checkpoint_999999 is damaged: .*; using {newest.name}"):
        assert len(open_source(run)) == before
    assert "damaged" in failure("export", broken, "--ply", tmp_path / "a.ply")
    assert main(["export", str(newest), "--ply", str(tmp_path / "a.ply")]) == 0
    assert len(read_ply(tmp_path / "a.ply")) == before


_EXPORT = """
import sys
from pathlib import Path
from blitzgs.formats.models import FORMATS
from blitzgs.formats.selection import Selected, Selection
from blitzgs.runs import checkpoint
from blitzgs.runs.export import export
from blitzgs.runs.source import open_source
source = open_source(Path(sys.argv[1]))
chosen = Selected(source, Selection(min_opacity=1e-9, sh_degree=0))
export(chosen, source.space, FORMATS[sys.argv[2]], Path(sys.argv[3]))
# Not `ru_maxrss`, which begins with the peak of the process that started this one.
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(len(source), 1024 * int(status["VmHWM"].split()[0]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ply", "glb"])
def test_fifty_million_gaussians_need_less_than_4_gb(trained, tmp_path, name):
    """The peak of two sizes; each Gaussian costs a few bytes beyond the blocks."""
    found = checkpoint.load(max((trained[1] / "checkpoints").glob("c*")), Ranks(), "cpu")
    peaks = {}
    for times in (250, 500):
        columns = {key: c.repeat(times, *[1] * (c.dim() - 1)) for key, c in found.columns.items()}
        run = tmp_path / str(times)
        save_checkpoint(run / "checkpoints", columns, found.state, Ranks())
        del columns
        command = [sys.executable, "-c", _EXPORT, str(run), name, str(run / f"a.{name}")]
        count, peak = subprocess.run(command, capture_output=True, check=True, text=True).stdout.split()
        peaks[int(count)] = int(peak)
        shutil.rmtree(run)
    (few, low), (many, high) = sorted(peaks.items())
    assert few > 2 * blocks.BLOCK
    each = max(0.0, (high - low) / (many - few))
    print(f"{low / 1e6:.0f} MB for {few:,}, {high / 1e6:.0f} MB for {many:,}: {each:.1f} bytes each")
    assert high + each * (50e6 - many) < 4e9


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
