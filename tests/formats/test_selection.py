import json

import numpy as np
import pytest
import torch

from blitzgs.formats import gaussians as blocks
from blitzgs.formats.selection import Selected, Selection, read_polygon
from tests.formats.models import some_gaussians

ORIGIN = (500_000.0, 4_600_000.0, 100.0)


def chosen(model, origin=(0.0, 0.0, 0.0), kept=None, score=None, **conditions):
    """The rows that a selection keeps, by their means."""
    found = Selected(model, Selection(**conditions), origin, kept, score)
    means = torch.cat([block.means for block in found.blocks()])
    assert len(found) == len(means)
    return [int((model.means == mean).all(dim=1).nonzero()) for mean in means]


@pytest.fixture
def model(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 16)
    return some_gaussians(50, 3, levels=True)


def test_conditions_by_brute_force(model):
    places = model.means.double().numpy() + ORIGIN
    box = np.array([places.min(axis=0), np.median(places, axis=0)])
    expected = [i for i in range(50) if all(box[0, k] <= places[i, k] <= box[1, k] for k in range(3))]
    assert chosen(model, ORIGIN, box=box) == expected != []
    opacities = 1 / (1 + np.exp(-model.opacities.double().numpy()))
    assert chosen(model, min_opacity=0.5) == [i for i in range(50) if opacities[i] >= 0.5]
    assert chosen(model, levels=(1, 2)) == [i for i in range(50) if 1 <= model.levels[i] <= 2]
    kept = torch.arange(50) % 3 == 0
    assert chosen(model, kept=kept) == list(range(0, 50, 3))
    score = torch.randn(50, generator=torch.Generator().manual_seed(1))
    both = [i for i in range(50) if kept[i]]
    assert chosen(model, kept=kept, score=score, most=5) == sorted(sorted(both, key=lambda i: -score[i])[:5])
    size = opacities * np.exp(model.scales.double().numpy()).max(axis=1)
    assert chosen(model, most=7) == sorted(np.argsort(-size)[:7])
    assert chosen(model, most=60) == list(range(50))


def test_a_polygon_with_a_notch(model):
    # Axis-aligned, so that membership is simple: a square without its upper right quarter.
    corners = np.array([[-3, -3], [3, -3], [3, 0], [0, 0], [0, 3], [-3, 3]], dtype=np.float64)
    x, z = model.means[:, 0].numpy(), model.means[:, 2].numpy()
    inside = (np.abs(x) < 3) & (np.abs(z) < 3) & ~((x > 0) & (z > 0))
    found = chosen(model, ORIGIN, polygon=corners + [ORIGIN[0], ORIGIN[2]], axes=(0, 2))
    assert found == inside.nonzero()[0].tolist() != []


def test_the_degree_is_cut_and_never_raised(model):
    found = Selected(model, Selection(sh_degree=1))
    assert found.degree == 1 and found.has_levels
    assert torch.equal(torch.cat([block.sh for block in found.blocks()]), model.sh[:, :4])
    assert Selected(some_gaussians(3, 1), Selection(sh_degree=3)).degree == 1


def test_an_empty_choice_is_refused(model):
    with pytest.raises(ValueError, match="no Gaussian meets"):
        Selected(model, Selection(box=np.array([[90.0] * 3, [91.0] * 3])))
    with pytest.raises(ValueError, match="no octree levels"):
        Selected(some_gaussians(3, 0), Selection(levels=(0, 1)))


def test_polygons_of_files(tmp_path):
    path, ring = tmp_path / "region", [[0, 0], [2, 0], [1, 5]]
    polygon = {"type": "Polygon", "coordinates": [[[x, y, 7] for x, y in ring]]}
    for text in (
        "# region\n0 0\n2, 0\n\n1 5\n",
        json.dumps(polygon),
        json.dumps({"type": "FeatureCollection", "features": [{"geometry": polygon}]}),
    ):
        path.write_text(text)
        np.testing.assert_array_equal(read_polygon(path), ring)
    for text in (
        "0 0\n1 1\n",
        "0 0\nx y\n1 1\n",
        "0 0\n1 1\nnan 2\n",
        "{",
        '{"type": "Point"}',
        "0 0 0\n" * 4,
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match="region cannot be read as a polygon"):
            read_polygon(path)
