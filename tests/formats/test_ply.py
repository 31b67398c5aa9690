# SPDX-License-Identifier: Apache-2.0
"""PLY files, and the Gaussians that an export chooses."""

import json
import math
import resource
import warnings

import numpy as np
import plyfile
import pytest
import torch

from blitzgs.formats import gaussians as blocks
from blitzgs.formats import ply
from blitzgs.formats.ply import PlySource, read_ply, read_point_cloud, save_ply, write_ply
from blitzgs.formats.selection import Selected, Selection, read_polygon
from tests.helpers import refused, some_gaussians


def gaussians(n: int, degree: int) -> dict[str, torch.Tensor]:
    model = some_gaussians(n, degree)
    return {name: getattr(model, name) for name in ("means", "quats", "scales", "opacities", "sh")}


def inria_file(path, columns, normals=None, comments=()) -> None:
    """The layout as INRIA's training code writes it, through plyfile."""
    n, k = columns["sh"].shape[:2]
    rest = columns["sh"][:, 1:].transpose(1, 2).reshape(n, 3 * (k - 1))  # channel-major
    parts = [columns["means"], torch.zeros(n, 3) if normals is None else normals, columns["sh"][:, 0], rest]
    parts += [columns["opacities"][:, None], columns["scales"], columns["quats"]]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))] + ["opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    rows = np.empty(n, dtype=[(name, "f4") for name in names])
    for name, column in zip(names, torch.cat(parts, dim=1).numpy().T, strict=True):
        rows[name] = column
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], comments=list(comments)).write(path)


@pytest.mark.parametrize("n", [0, 1, 17])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_inria_files_are_read_right_and_written_back_byte_for_byte(tmp_path, degree, n):
    columns = gaussians(n, degree)
    if n:
        columns["means"][0] = torch.tensor([-0.0, 1e-45, 3e38])
    inria_file(tmp_path / "in.ply", columns)
    found = read_ply(tmp_path / "in.ply")
    for name, expected in columns.items():
        assert torch.equal(getattr(found, name), expected), name
    write_ply(tmp_path / "out.ply", **vars(found))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    write_ply(tmp_path / "direct.ply", **columns)
    assert (tmp_path / "direct.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh"])
def test_nan_is_read_and_not_written(tmp_path, name, value):
    columns = gaussians(4, 1)
    columns[name].view(4, -1)[2, 0] = value
    inria_file(tmp_path / "in.ply", columns)
    assert torch.equal(getattr(read_ply(tmp_path / "in.ply"), name).isfinite(), columns[name].isfinite())
    if math.isinf(value) and name == "opacities":  # an opacity of 1 has an infinite logit
        write_ply(tmp_path / "out.ply", **columns)
        return
    reason = f"{name} has NaN or infinite values in 1 Gaussians, the first is number 2"
    refused(ValueError, reason, write_ply, tmp_path / "out.ply", **columns)
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    ("path", "content", "error"),
    [
        ("thesis.ply", b"my thesis", FileExistsError),
        ("empty.ply", b"", None),
        ("old.ply", b"ply\nformat", None),
        ("folder/new.ply", None, FileNotFoundError),
        ("new.ply", None, None),
    ],
)
def test_files_of_others_are_kept_and_no_folder_is_made(tmp_path, path, content, error):
    path = tmp_path / path
    if content is not None:
        path.write_bytes(content)
    if error is None:
        write_ply(path, **gaussians(2, 0))
        assert path.read_bytes().startswith(b"ply")
        return
    refused(error, "choose another", write_ply, path, **gaussians(2, 0))
    assert not path.parent.exists() if content is None else path.read_bytes() == content


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh"])
def test_an_argument_that_is_no_tensor_is_named(tmp_path, name):
    columns = gaussians(2, 0)
    columns[name] = columns[name].numpy()
    reason = f"{name} must be a torch.Tensor, got ndarray: convert it"
    refused(TypeError, reason, write_ply, tmp_path / "out.ply", **columns)


def test_comments_and_normals_survive_the_round_trip(tmp_path):
    columns = gaussians(5, 1)
    comments = ["made by hand", "with  blanks ", "obj"]
    inria_file(tmp_path / "in.ply", columns, torch.randn(5, 3), comments)
    found = read_ply(tmp_path / "in.ply")
    assert found.comments[0] == "comment made by hand"
    write_ply(tmp_path / "out.ply", **vars(found))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_offset_is_added_in_float64(tmp_path):
    columns = gaussians(4, 0)
    offset = np.array([123456.789, -2.0, 0.1])
    columns["scales"][:] = 0
    with warnings.catch_warnings(action="error"):
        write_ply(tmp_path / "a.ply", **columns, offset=offset)
    expected = (columns["means"].double().numpy() + offset).astype(np.float32)
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means.numpy(), expected)
    columns["scales"][:] = -3
    with pytest.warns(UserWarning, match=r"rounds positions by up to 0.00391: .*comment offset X Y Z"):
        write_ply(tmp_path / "a.ply", **columns, offset=offset)


def test_other_orders_missing_normals_ascii_and_big_endian_are_read(tmp_path):
    columns = gaussians(6, 1)
    inria_file(tmp_path / "in.ply", columns)
    rows = plyfile.PlyData.read(tmp_path / "in.ply")["vertex"].data
    names = [n for n in reversed(rows.dtype.names) if n not in ("nx", "ny", "nz")]
    other = np.empty(6, dtype=[(n, "f8" if n == "opacity" else "f4") for n in names])
    for name in names:
        other[name] = rows[name]
    for text, order in ((True, "="), (False, ">"), (False, "<")):
        element = plyfile.PlyElement.describe(other, "vertex")
        plyfile.PlyData([element], text=text, byte_order=order).write(tmp_path / "other.ply")
        found = read_ply(tmp_path / "other.ply")
        for name, expected in columns.items():
            assert torch.allclose(getattr(found, name), expected, atol=1e-6), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:-1], "it claims 3 vertices of at least 68 bytes each"),
        (lambda d: d + b"x", "1 bytes are left after the last record"),
        (lambda d: d.replace(b"vertex 3", b"vertex 99999999999999999"), "claims 99999999999999999 vertices"),
        (lambda d: d.replace(b"ply", b"plx", 1), "the first line is not 'ply'"),
        (lambda d: d.replace(b"1.0", b"2.0"), "unknown format line"),
        (lambda d: d.replace(b"float opacity", b"half opacity"), "bad property line 'property half opacity'"),
        (lambda d: d.replace(b"float opacity", b"float opaqueness"), "properties opacity are missing"),
        (lambda d: d.replace(b"float rot_1", b"float rot_0"), "property rot_0 comes twice"),
        (lambda d: d.replace(b"end_header", b"the_end"), "unknown header line 'the_end'"),
        (lambda d: d.replace(b"element vertex", b"element face"), "no vertex element"),
        (lambda d: b"", "the file ends inside the header"),
    ],
)
def test_damaged_files_are_named_with_the_reason(tmp_path, change, message):
    inria_file(tmp_path / "in.ply", gaussians(3, 0))
    bad = tmp_path / "bad.ply"
    bad.write_bytes(change((tmp_path / "in.ply").read_bytes()))
    refused(ValueError, f"bad.ply.*{message}", read_ply, bad)


def test_shapes_are_checked_and_no_file_appears(tmp_path):
    columns = gaussians(3, 0) | {"quats": torch.zeros(2, 4)}
    refused(ValueError, r"quats .* \[2, 4\], expected \[3, 4\]", write_ply, tmp_path / "a.ply", **columns)
    columns = gaussians(3, 0) | {"sh": torch.zeros(3, 5, 3)}
    refused(ValueError, "K = 1, 4, 9 or 16", write_ply, tmp_path / "a.ply", **columns)
    assert list(tmp_path.iterdir()) == []


def test_point_clouds_with_faces_and_without_colours(tmp_path):
    rows = np.array(
        [(1, 2, 3, 10, 20, 30)],
        dtype=[(n, "f8") for n in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")],
    )
    face = np.array([([0, 0, 0],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(rows, "vertex"), plyfile.PlyElement.describe(face, "face")]
    plyfile.PlyData(elements).write(tmp_path / "a.ply")
    cloud = read_point_cloud(tmp_path / "a.ply")
    positions, colors = cloud.positions, cloud.colors
    assert positions.tolist() == [[1, 2, 3]] and colors.tolist() == [[10, 20, 30]]
    bare = np.array([(1, 2, 3)], dtype=[(axis, "f8") for axis in "xyz"])
    plyfile.PlyData([plyfile.PlyElement.describe(bare, "vertex")]).write(tmp_path / "b.ply")
    assert read_point_cloud(tmp_path / "b.ply").colors.tolist() == [[128, 128, 128]]


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(
    ("values", "expected"),
    [([(0, 127.6, 255), (1, 2, 3)], [[0, 128, 255], [1, 2, 3]]), ([(0, 0.5, 1)], [[0, 128, 255]]), ([], [])],
)
def test_colours_as_floats_are_bytes_if_one_is_above_1_and_else_fractions(tmp_path, kind, values, expected):
    rows = np.zeros(len(values), [(n, kind) for n in ("x", "y", "z", "red", "green", "blue")])
    for row, colour in zip(rows, values, strict=True):
        row["red"], row["green"], row["blue"] = colour
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    assert read_point_cloud(tmp_path / "a.ply").colors.tolist() == expected


@pytest.mark.parametrize(("kind", "red"), [("u2", 30_000), ("i4", -1), ("f4", float("nan")), ("f8", -0.5)])
def test_colours_that_are_no_bytes_or_fractions_are_refused(tmp_path, kind, red):
    types = [(n, "f8") for n in "xyz"] + [(c, kind) for c in ("red", "green", "blue")]
    rows = np.array([(1, 2, 3, red, 0, 0)], dtype=types)
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    refused(ValueError, "a.ply: a point has the colour", read_point_cloud, tmp_path / "a.ply")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "model.ply"
    write_ply(path, **gaussians(5, 1))
    before = path.read_bytes()
    # Past the limit every write fails, as on a full disk.
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        refused(OSError, "model.ply cannot be written: File too large", write_ply, path, **gaussians(5000, 3))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["model.ply"]
    refused(OSError, "/proc", write_ply, "/proc/model.ply", **gaussians(1, 0))


def test_blocks_of_a_file_are_its_rows(tmp_path, monkeypatch):
    model = some_gaussians(250, 2, levels=True)
    save_ply(tmp_path / "m.ply", model)
    monkeypatch.setattr(ply, "BLOCK", 100)
    source = PlySource(tmp_path / "m.ply")
    assert (len(source), source.degree, source.has_levels) == (250, 2, True)
    for _ in range(2):
        found = list(source.blocks())
        assert [len(block) for block in found] == [100, 100, 50]
        for name in ("means", "quats", "scales", "opacities", "sh", "levels"):
            assert torch.equal(torch.cat([getattr(block, name) for block in found]), getattr(model, name))
    content = bytearray((tmp_path / "m.ply").read_bytes())
    width = 4 * (17 + 24 + 1)
    content[-100 * width : 4 - 100 * width] = np.float32("nan").tobytes()
    (tmp_path / "m.ply").write_bytes(content)
    refused(ValueError, r"m\.ply, from Gaussian 100 on: means .* first is number 50", list, source.blocks())
    (tmp_path / "m.ply").write_bytes(content[:-10])
    refused(ValueError, r"m\.ply", PlySource, tmp_path / "m.ply")


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
    far = Selection(box=np.array([[90.0] * 3, [91.0] * 3]))
    message = r"no Gaussian meets .* the model is from \(-?[0-9.]+, .*\) to \("
    refused(ValueError, message, Selected, model, far)
    refused(ValueError, "no octree levels", Selected, some_gaussians(3, 0), Selection(levels=(0, 1)))


def test_polygons_of_files(tmp_path):
    path, ring = tmp_path / "region", [[0, 0], [2, 0], [1, 5]]
    polygon = {"type": "Polygon", "coordinates": [[[x, y, 7] for x, y in ring]]}
    for text in (
        "# region\n0 0\n2, 0\n\n1 5\n",
        json.dumps(polygon),
        json.dumps({"type": "FeatureCollection", "features": [{"geometry": polygon}]}),
        "\ufeff" + json.dumps(polygon),
    ):
        path.write_text(text)
        np.testing.assert_array_equal(read_polygon(path), ring)
    bad = ("0 0\n1 1\n", "0 0\nx y\n1 1\n", "0 0\n1 1\nnan 2\n", "{", '{"type": "Point"}', "0 0 0\n" * 4)
    two = json.dumps({"type": "FeatureCollection", "features": [{"geometry": polygon}] * 2})
    parts = polygon["coordinates"]
    qgis, apart = (json.dumps({"type": "MultiPolygon", "coordinates": [parts] * n}) for n in (1, 2))
    path.write_text(qgis)
    np.testing.assert_array_equal(read_polygon(path), ring)
    for text in (*bad, two, apart):
        path.write_text(text)
        refused(ValueError, "region cannot be read as a polygon", read_polygon, path)
