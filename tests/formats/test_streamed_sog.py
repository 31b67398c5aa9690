"""Streamed SOG: the manifest against its published description, the chunks by gsply's reader."""

import json

import numpy as np
import pytest

from blitzgs.formats.streamed_sog import write_streamed_sog
from tests.formats.test_tiles import city

gsply = pytest.importorskip("gsply", reason="the extra formats is not installed")
pytest.importorskip("imagecodecs", reason="gsply reads SOG with imagecodecs")


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


def test_lods_have_the_trained_levels(tmp_path):
    model = city(1200)
    done = write_streamed_sog(tmp_path / "city", model, most=600)
    meta = json.loads((tmp_path / "city" / "lod-meta.json").read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == len(meta["counts"]) == 4
    # LOD n lacks the n finest levels.
    expected = [int((model.levels <= 3 - lod).sum()) for lod in range(4)]
    assert meta["counts"] == expected and meta["count"] == sum(expected)
    found, used = list(leaves(meta["tree"])), []
    seen = {lod: [] for lod in range(4)}
    for leaf in found:
        low, high = (np.array(leaf["bound"][name]) for name in ("min", "max"))
        for lod, place in leaf["lods"].items():
            used.append(place["file"])
            data = gsply.sogread(str(tmp_path / "city" / meta["filenames"][place["file"]]))
            assert place["offset"] == 0 and len(data.means) == place["count"] <= 600
            assert (data.means >= low - 1e-3).all() and (data.means <= high + 1e-3).all()
            seen[int(lod)].append(data.means)
    assert sorted(used) == list(range(len(meta["filenames"]))) and len(used) == done.tiles
    assert len(found) >= 2
    for lod, parts in seen.items():
        means = np.concatenate(parts)
        wanted = model.means[model.levels <= 3 - lod].numpy()
        assert len(means) == len(wanted)
        # 16 bits of the logarithm of each coordinate.
        for axis in range(3):
            error = np.abs(np.sort(means[:, axis]) - np.sort(wanted[:, axis]))
            assert (error <= 1e-3 * (1 + np.abs(np.sort(wanted[:, axis])))).all()
    assert done.gaussians == 1200
    assert not [path for path in (tmp_path / "city").rglob("*") if path.suffix in (".tmp", ".sog")]
