"""The benchmark of tiles: what a flight loads, against the whole model."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import bm_tiles  # noqa: E402

from blitzgs.formats.tiles import write_tiles  # noqa: E402
from tests.formats.test_tiles import SCENE, city  # noqa: E402


def test_nearer_frames_load_more_and_small_errors_show_everything(tmp_path, capsys):
    write_tiles(tmp_path / "city", city(3000), np.eye(4), SCENE, "city", most=200)
    arguments = [str(tmp_path / "city"), "--frames", "3", "--width", "96", "--errors", "1e-9", "8", "32"]
    bm_tiles.main([*arguments, "--device", "cpu", "--json", str(tmp_path / "found.json")])
    assert "3,000 Gaussians" in capsys.readouterr().out
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    assert len(rows) == 9
    exact, coarse, coarser = ([row for row in rows if row["pixel_error"] == e] for e in (1e-9, 8, 32))
    # Everything that the camera can see is everything that the picture shows.
    assert all(row["psnr"] is None or row["psnr"] > 80 for row in exact)
    for fine, less, least in zip(exact, coarse, coarser, strict=True):
        assert fine["gaussians"] >= less["gaussians"] >= least["gaussians"] > 0
        assert fine["bytes"] >= less["bytes"] and less["loaded_bytes"] >= less["bytes"]
    assert coarse[0]["gaussians"] < exact[0]["gaussians"] == 3000
    assert coarse[0]["psnr"] == pytest.approx(coarse[0]["psnr"]) and 5 < coarse[0]["psnr"] < 80
    assert coarse[-1]["distance"] < coarse[0]["distance"]
