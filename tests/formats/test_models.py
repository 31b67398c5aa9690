# SPDX-License-Identifier: Apache-2.0
"""Every format against a reader that shares nothing with its writer, and damaged files of each."""

import io
import json
import os
import struct
import zipfile
import zlib
from dataclasses import replace

# The kernels of gsply would be compiled for half a minute; these files are small.
os.environ.setdefault("NUMBA_DISABLE_JIT", "1")

import numpy as np
import plyfile
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from blitzgs.formats import packed
from blitzgs.formats.gaussians import MIP, SH_C0, Gaussians
from blitzgs.formats.models import FORMATS, check_replaces, read_gaussians, with_degree
from blitzgs.runs.world import rotated_harmonics
from tests.helpers import glb_parts, refused, some_gaussians

gaussforge = pytest.importorskip("gaussforge")
gsply = pytest.importorskip("gsply")

PACKED = ("compressed-ply", "splat", "spz", "sog")
# Largest differences of: means, log scales, angle of the rotation, opacity, DC, other coefficients.
BOUNDS = {
    "compressed-ply": (0.02, 0.005, 0.01, 0.003, 0.006, 0.02),
    "splat": (1e-6, 1e-5, 0.03, 0.005, 0.015, 0),
    "spz": (1.3e-4, 0.04, 0.01, 0.003, 0.015, 0.01),
    "sog": (0.002, 0.05, 0.03, 0.003, 0.02, 0.05),
}


def written(tmp_path, name, model):
    path = tmp_path / f"a{FORMATS[name].suffix}"
    FORMATS[name].write(path, model)
    return path


def by_gaussforge(path, kind):
    content = gaussforge.GaussForge().read(path.read_bytes(), kind)["data"]
    n = content["numPoints"]

    def column(name, *shape):
        return torch.from_numpy(np.frombuffer(content[name], "<f4").reshape(n, *shape).copy())

    sh = torch.cat([column("colors", 1, 3), column("sh", -1, 3)], dim=1)
    return Gaussians(
        column("positions", 3), column("rotations", 4), column("scales", 3), column("alphas"), sh
    )


def splat_by_hand(path):
    rows = path.read_bytes()
    floats, octets = np.frombuffer(rows, "<f4").reshape(-1, 8), np.frombuffer(rows, "u1").reshape(-1, 32)
    shade = octets[:, 24:28] / 255
    return Gaussians(
        torch.from_numpy(floats[:, :3].copy()),
        torch.from_numpy((octets[:, 28:] - 128.0) / 128).float(),
        torch.from_numpy(np.log(floats[:, 3:6])),
        torch.from_numpy(np.log(shade[:, 3] / (1 - shade[:, 3]).clip(1e-6)).clip(-12)).float(),
        torch.from_numpy((shade[:, None, :3] - 0.5) / 0.28209479).float(),
    )


def turned(model):
    """Half a turn about x."""
    half = Rotation.from_quat([1, 0, 0, 0])
    quats = (half * Rotation.from_quat(np.roll(model.quats.numpy(), -1, axis=1))).as_quat()
    return replace(
        model,
        means=torch.from_numpy(half.apply(model.means.numpy())).float(),
        quats=torch.from_numpy(np.roll(quats, 1, axis=1)).float(),
        sh=rotated_harmonics(model.sh, torch.from_numpy(half.as_matrix())),
    )


def compare(found, model, bounds):
    order = cKDTree(found.means.numpy()).query(model.means.numpy())[1]
    assert sorted(order) == list(range(len(model)))
    found = found.rows(torch.from_numpy(order))
    angles = [Rotation.from_quat(np.roll(some.quats.numpy(), -1, axis=1)) for some in (found, model)]
    # Half a turn about an axis of its own leaves a Gaussian as it is.
    same = [Rotation.identity(), *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3))]
    differ = [(angles[0].inv() * angles[1] * turn).magnitude() for turn in same]
    assert np.min(differ, axis=0).max() <= bounds[2]
    pairs = [
        (found.means, model.means, bounds[0]),
        (found.scales, model.scales, bounds[1]),
        (found.opacities.sigmoid(), model.opacities.sigmoid(), bounds[3]),
        (found.sh[:, 0], model.sh[:, 0], bounds[4]),
    ]
    if bounds[5]:
        pairs.append((found.sh[:, 1:], model.sh[:, 1:], bounds[5]))
    for got, expected, bound in pairs:
        assert got.shape == expected.shape
        np.testing.assert_allclose(got.numpy(), expected.numpy(), atol=bound, rtol=0)


@pytest.fixture
def model():
    """Values that the narrowest format holds: opacities off the ends, coefficients within +-1."""
    found = some_gaussians(300, 3)
    found.sh[:, 1:] = found.sh[:, 1:].clamp(-0.9, 0.9)
    found.opacities.clamp_(-4, 4)
    found.comments = [MIP, "comment offset 1.0 2.0 3.0"]
    return found


@pytest.mark.parametrize("name", PACKED)
def test_another_reader_finds_the_values(tmp_path, model, name):
    path = written(tmp_path, name, model)
    if name == "splat":  # gaussforge writes it only
        other = splat_by_hand(path)
    else:
        other = by_gaussforge(path, "compressed.ply" if name == "compressed-ply" else name)
    compare(turned(other) if name == "spz" else other, model, BOUNDS[name])
    found = read_gaussians(path)
    compare(found, model, BOUNDS[name])
    stated = {"compressed-ply": model.comments, "splat": []}.get(name, [MIP])
    assert found.comments == stated
    plain = read_gaussians(written(tmp_path, name, replace(model, comments=[])))
    assert plain.comments == []


class Pieces:
    """A model that comes in blocks of any size."""

    def __init__(self, model):
        self.model, self.degree, self.comments, self.has_levels = model, model.degree, model.comments, False

    def __len__(self):
        return len(self.model)

    def blocks(self):
        for first, last in ((0, 37), (37, 38), (38, 295), (295, 300)):
            yield self.model.rows(slice(first, last))


@pytest.mark.parametrize("name", PACKED)
def test_a_model_in_pieces_gives_the_same_file(tmp_path, model, name, monkeypatch):
    whole = written(tmp_path, name, model).read_bytes()
    monkeypatch.setattr(packed, "BLOCK", 256)
    assert written(tmp_path, name, Pieces(model)).read_bytes() == whole


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("name", PACKED)
def test_lower_degrees_and_single_gaussians(tmp_path, name, degree):
    model = some_gaussians(1 if degree == 1 else 5, degree, seed=3)
    found = read_gaussians(written(tmp_path, name, model))
    assert len(found) == len(model) and found.degree == (0 if name == "splat" else degree)
    for rows in (found, model):
        rows.means = rows.means.sort(dim=0).values
    np.testing.assert_allclose(found.means, model.means, atol=BOUNDS[name][0])
    refused(ValueError, "no Gaussian", written, tmp_path, name, some_gaussians(0, degree))


@pytest.mark.parametrize("name", PACKED)
def test_flat_gaussians_are_written_and_infinite_ones_are_not(tmp_path, name):
    model = some_gaussians(5, 1)
    flat = replace(model, scales=model.scales.clone())
    flat.scales[2, 1] = -torch.inf
    found = read_gaussians(written(tmp_path, name, flat))
    assert found.scales[2, 1] <= -10
    np.testing.assert_allclose(found.means, model.means, atol=0.02)
    for column in ("scales", "quats", "sh"):
        bad = replace(model, **{column: getattr(model, column).clone()})
        getattr(bad, column).view(5, -1)[3, 0] = torch.inf
        reason = f"{column} has NaN or infinite values in 1 Gaussians"
        refused(ValueError, reason, written, tmp_path, name, bad)


def test_the_palette_of_sog_is_nearest_to_what_shows_most(tmp_path):
    model = some_gaussians(12_000, 1)
    model.scales[:2_000] += 3
    model.opacities[:2_000] += 5
    found = read_gaussians(written(tmp_path, "sog", model))
    away = (found.sh - model.sh)[:, 1:].square().mean(dim=(1, 2)).sqrt()
    assert away[:2_000].mean() < 0.3 * away[2_000:].mean()


@pytest.mark.parametrize("name", ["spz", "sog", "splat"])
def test_files_of_the_other_package_are_read(tmp_path, model, name):
    path = tmp_path / f"a{FORMATS[name].suffix}"
    if name == "spz":
        for version in (3, 4):
            gsply.write_spz(path, packed._gsdata(turned(model)), version=version)
            compare(read_gaussians(path), model, (2e-4, *BOUNDS["spz"][1:]))
    else:
        (unit,) = packed.unit_blocks(with_degree(model, 0) if name == "splat" else model)
        columns = {"positions": unit.means, "rotations": unit.quats, "scales": unit.scales}
        columns |= {"alphas": unit.opacities, "colors": unit.sh[:, 0], "sh": unit.sh[:, 1:]}
        content = {name: column.contiguous().numpy().tobytes() for name, column in columns.items()}
        meta = {"shDegree": unit.degree, "sourceFormat": "ply"}
        content |= {"numPoints": len(unit), "extras": {}, "meta": meta}
        path.write_bytes(gaussforge.GaussForge().write(content, name)["data"])
        compare(read_gaussians(path), model, BOUNDS[name])


def test_spz_keeps_far_positions_and_small_gaussians(tmp_path):
    model = some_gaussians(50, 0)
    model.means *= 3000
    found = read_gaussians(written(tmp_path, "spz", model))
    assert (found.means - model.means).abs().max() <= float(model.means.abs().max()) / 2**22
    model.means, model.scales = model.means / 3000, model.scales - 6
    found = read_gaussians(written(tmp_path, "spz", model))
    assert (found.means - model.means).abs().max() <= float(model.scales.median().exp()) / 16


def test_a_far_gaussian_does_not_round_the_others_in_spz(tmp_path):
    """Its position has the range of the file's, whose steps would be 1 m."""
    model = some_gaussians(200, 0)
    near, step = model.means.clone(), float(model.scales.median().exp())
    # As far as the steps that others need allow, it stays.
    for far, left_out in ((1e4, 0), (3e6, 1)):
        model.means[7, 2] = far
        lost = FORMATS["spz"].write(tmp_path / "a.spz", model)
        assert lost.left_out == left_out
        assert bool(FORMATS["spz"].told(lost)) == bool(left_out)
        others = torch.arange(200) != 7
        found, kept = read_gaussians(tmp_path / "a.spz"), others | (left_out == 0)
        assert len(found) == int(kept.sum())
        away = (found.means - model.means[kept]).abs().amax(dim=1)
        assert away.max() <= step / 8
    assert (near[others] == model.means[others]).all()
    model.means[:100] = 1e8  # which are not few
    refused(ValueError, "coordinates up to 4,194,304", FORMATS["spz"].write, tmp_path / "a.spz", model)


def test_what_a_format_cannot_say_is_told(model):
    with_levels = some_gaussians(3, 1, levels=True)
    assert not FORMATS["ply"].unstated(replace(with_levels, comments=[MIP]))
    assert "colours that depend on the view" in FORMATS["splat"].unstated(some_gaussians(3, 1))[0]
    for name, format_ in FORMATS.items():
        told = " ".join(format_.unstated(replace(with_levels, comments=[MIP])))
        assert ("antialiased" in told) == (name in ("splat", "glb")), name
        assert ("octree levels" in told) == (name not in ("ply", "glb")), name


@pytest.mark.parametrize("name", ["spz", "splat"])
def test_gaussians_beyond_the_ranges_of_a_format_are_told(tmp_path, name):
    path, kind = tmp_path / "a", FORMATS[name]
    model = some_gaussians(9, 1)
    model.sh[:, 0].clamp_(max=1)
    model.sh[:, 1:].clamp_(-1, 1)
    assert kind.write(path, model) == (0, 0) and not kind.told(packed.Lost())
    model.scales[0, 1], model.sh[1:3, 0, 2], model.sh[4, 3, 1] = 7.0, 4.0, -1.1
    model.scales[5], model.scales[6, 0] = -12.0, -12.0  # the thickness of a disc may be rounded
    lost = kind.write(path, model)
    assert lost == (5 if name == "spz" else 2, 0)
    (told,) = kind.told(lost)
    assert f"{lost.cut} Gaussians were cut to that" in told
    if name == "splat":
        assert splat_by_hand(path).sh[1, 0, 2] * SH_C0 == pytest.approx(0.5)
        return
    found = read_gaussians(path)
    assert found.sh[4, 3, 1] == -1
    assert f"{found.scales[5, 0].exp():.6f} to {found.scales[0, 1].exp():.0f} units" in told
    assert f"{0.5 + SH_C0 * found.sh[1, 0, 2]:.2f} of white" in told


def test_no_file_of_another_format_is_replaced(tmp_path):
    for name, format_ in FORMATS.items():
        path = tmp_path / f"{name}{format_.suffix}"
        check_replaces(path, format_)
        refused(ValueError, "choose a name that ends in", check_replaces, tmp_path / "a.txt", format_)
        if format_.starts:
            path.write_bytes(b"mine")
            refused(FileExistsError, "choose another name", check_replaces, path, format_)


def gz(*parts):
    return zlib.compress(b"".join(parts), wbits=31)


def spz_header(count=10, version=3, degree=0, bits=12, magic=0x5053474E):
    return struct.pack("<IIIBBBB", magic, version, count, degree, bits, 0, 0)


def zipped(change, source):
    """A copy of an archive with changed parts: name -> bytes, or None to leave it out."""
    out = io.BytesIO()
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            part = change.get(entry, old.read(entry))
            if part is not None:
                new.writestr(entry, part)
    return out.getvalue()


def damaged_sogs(path):
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        picture = archive.read("quats.webp")

    def changed(**fields):
        return zipped({"meta.json": json.dumps(meta | fields)}, path)

    wide = picture[:21] + struct.pack("<I", 0x3FFF | 0x3FFF << 14) + picture[25:]
    return {
        "cut off": (path.read_bytes()[:-200], "is damaged"),
        "no meta": (zipped({"meta.json": None}, path), "has no meta.json"),
        "meta no JSON": (zipped({"meta.json": b"{"}, path), "meta.json"),
        "no picture": (zipped({"quats.webp": None}, path), "has no quats.webp"),
        "count too large": (changed(count=10**12), r"1,000,000,000,000 Gaussians: reading them takes"),
        "count above the pictures'": (changed(count=meta["count"] + 5000), r"pixels for 5,\d+ Gaussians"),
        "count no number": (changed(count="1"), "names '1' Gaussians"),
        "short codebook": (changed(scales=meta["scales"] | {"codebook": [0.0] * 9}), "codebook of scales"),
        "NaN in a codebook": (
            changed(sh0=meta["sh0"] | {"codebook": [float("nan")] * 256}), "codebook of sh0"),
        "a field is missing": (changed(means={}), "lacks a field"),
        "a path out of the archive": (changed(quats={"files": ["../../etc/passwd"]}), "has no ../../etc"),
        "picture too wide": (zipped({"quats.webp": wide}, path), "16384 x 16384 pixels"),
        "picture no WebP": (zipped({"quats.webp": b"GIF89a" * 30}, path), "is no lossless WebP"),
        "bomb": (zipped({"quats.webp": bytes(30 << 20)}, path), "inflates to 31,457,280 bytes"),
    }  # fmt: skip


def damaged_plys(path):
    good = path.read_bytes()
    return {
        "cut off": (good[:-1], "is cut off"),
        "no end of header": (good[:300], "does not end|ends inside the header"),
        "count too large": (good.replace(b"vertex 300", b"vertex 99999999999"), "do not fit 99,999,999,999"),
        "chunks missing": (good.replace(b"chunk 2", b"chunk 1"), "1 chunks of 18 numbers"),
        "properties missing": (good.replace(b"property float max_b\n", b""), "2 chunks of 17 numbers"),
        "SH of no degree": (good.replace(b"property uchar f_rest_44\n", b""), "44 f_rest properties"),
        "NaN": (good.replace(good[(at := good.index(b"end_header\n") + 11) : at + 4], b"\0\0\xc0\x7f", 1),
                "means has NaN"),
    }  # fmt: skip


def damaged_spzs(path):
    good = path.read_bytes()
    body = bytes(10 * 20)
    return {
        "cut off": (good[: len(good) // 2], "is cut off"),
        "no gzip": (b"\x1f\x8b" + bytes(50), "is damaged"),
        "other magic": (gz(spz_header(magic=1), body), "no SPZ file"),
        "other version": (gz(spz_header(version=9), body), "no SPZ file"),
        "degree 7": (gz(spz_header(degree=7), body), "SH degree 7"),
        "bits 99": (gz(spz_header(bits=99), body), "fractional_bits 99"),
        "count too large": (gz(spz_header(count=0xFFFFFFFF), body), "4,294,967,295 Gaussians"),
        "count larger than can be": (gz(spz_header(count=100_000), body), "cannot hold 100,000 Gaussians"),
        "fewer bytes": (gz(spz_header(count=11), body), "200|216 of 236|is cut off"),
        "bomb": (gz(spz_header(), bytes(30 << 20)), "inflates to more than"),
        "bomb in a second part": (gz(spz_header(), body) + gz(bytes(30 << 20)), "inflates to more than"),
        "only a header": (b"NGSP" + bytes(4), "is cut off"),
    }


def damaged_splats(path):
    good = bytearray(path.read_bytes())
    nan = struct.pack("<f", float("nan"))
    return {
        "cut off": (bytes(good[:-1]), "no multiple of 32"),
        "NaN position": (bytes(good[:32] + nan + good[36:]), "means has NaN.*number 1"),
        "NaN scale": (bytes(good[:44] + nan + good[48:]), "Gaussian 1 has the scale"),
        "negative scale": (bytes(good[:12] + struct.pack("<f", -1) + good[16:]), "Gaussian 0 has the scale"),
    }


DAMAGED = {
    "compressed-ply": damaged_plys, "splat": damaged_splats, "spz": damaged_spzs, "sog": damaged_sogs
}  # fmt: skip


def test_comments_keep_their_letters(tmp_path, model):
    lines = ["comment Größe \u2028", os.fsdecode(b"comment Gr\xf6\xdfe"), "obj_info a"]
    for name in ("ply", "compressed-ply"):
        path = written(tmp_path, name, replace(model, comments=lines))
        assert read_gaussians(path).comments == lines
        path.write_bytes(path.read_bytes().replace(b"a\nelement", b"a\r\nelement"))
        assert read_gaussians(path).comments == lines
    content, _ = glb_parts(written(tmp_path, "glb", replace(model, comments=lines)))
    assert content["asset"]["extras"]["comments"][:2] == [lines[0], "comment Gr??e"]


@pytest.mark.parametrize("name", PACKED)
def test_damaged_files_are_refused_with_name_and_reason(tmp_path, model, name):
    path = written(tmp_path, name, model)
    for content, reason in DAMAGED[name](path).values():
        path.write_bytes(content)
        refused(ValueError, f"{path}.*({reason})", read_gaussians, path)


@pytest.mark.parametrize("name", PACKED)
def test_random_damage_gives_a_model_or_an_error(tmp_path, model, name):
    path = written(tmp_path, name, model)
    good, rng = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(30):
        content = bytearray(good)
        for place in rng.integers(len(good), size=8):
            content[place] = rng.integers(256)
        path.write_bytes(content[: rng.integers(1, len(good) + 1)] if rng.random() < 0.3 else content)
        try:
            read_gaussians(path).check()
        except ValueError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > 0


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.bin"
    for content in (b"", b"glTF", b"hello"):
        path.write_bytes(content)
        refused(ValueError, "is no model", read_gaussians, path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    refused(ValueError, "a.bin", read_gaussians, path)


def test_compressed_ply_has_the_layout_of_supersplat(tmp_path, model):
    data = plyfile.PlyData.read(written(tmp_path, "compressed-ply", model))
    assert [element.name for element in data.elements] == ["chunk", "vertex", "sh"]
    assert [element.count for element in data.elements] == [2, 300, 300]
    assert data.comments == ["SplatRenderMode: mip", "offset 1.0 2.0 3.0"]
