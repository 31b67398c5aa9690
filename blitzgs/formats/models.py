# SPDX-License-Identifier: Apache-2.0
"""Models of Gaussians in the formats of other programs: which there are, and how each is read and written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from blitzgs.formats import packed
from blitzgs.formats.gaussians import Gaussians, GaussianSource, is_antialiased, triple_line, triple_of
from blitzgs.formats.glb import write_glb
from blitzgs.formats.ply import PlySource, read_ply, save_ply
from blitzgs.formats.sog import read_sog, write_sog
from blitzgs.util.errors import WRONG_CONTENT, located
from blitzgs.util.output import check_replaceable

_HEADER = 1 << 16


@dataclass(frozen=True)
class Format:
    """A format that models are written in, and most are read from."""

    title: str  # what it is
    suffix: str  # end of its files' names
    read: Callable[[Path], Gaussians] | None  # reads a file whole; None: it is not read
    # Writes a file block by block; it appears under its name only when it is complete. None: nothing is lost.
    write: Callable[[Path, GaussianSource], packed.Lost | None]
    starts: tuple[bytes, ...] = ()  # how its files begin, of which one is true; empty: nothing tells
    states: tuple[str, ...] = ()  # what its viewers find in the file besides the Gaussians
    harmonics: bool = True  # whether it holds SH coefficients beyond the DC
    quantised: bool = True  # whether positions are finer near the origin than float32 makes them
    ranges: str = ""  # to which `write` cuts values
    position: str = "coordinates in the file"  # what, plus the offset, are the model's coordinates

    def unstated(self, source: GaussianSource) -> list[str]:
        """Return what a viewer of the file will not know of a model, each a sentence without a full stop."""
        lost = []
        if is_antialiased(source) and "antialiasing" not in self.states:
            lost.append(
                f"{self.title} cannot say that the model is antialiased, so viewers show it too opaque: "
                "export with --classic"
            )
        if source.has_levels and "levels" not in self.states:
            lost.append(f"{self.title} has no octree levels: viewers show all Gaussians")
        if source.degree > 0 and not self.harmonics:
            lost.append(f"{self.title} holds one colour a Gaussian: colours that depend on the view are lost")
        return lost

    def told(self, lost: packed.Lost) -> list[str]:
        """Return what `write` has lost, each a sentence without a full stop."""
        lines = []
        if lost.cut:
            lines.append(f"{self.title} holds {self.ranges}: {lost.cut:,} Gaussians were cut to that")
        if lost.left_out:
            lines.append(
                f"{lost.left_out:,} Gaussians were left out: so far away that {self.title} would round the "
                "positions of all others"
            )
        return lines


# By the name of the flag of `blitzgs export`.
FORMATS = {
    "ply": Format(
        "PLY", ".ply", read_ply, save_ply, (b"ply",), ("antialiasing", "levels", "offset"), quantised=False
    ),
    "compressed-ply": Format(
        "compressed PLY", ".ply", packed.read_compressed_ply, packed.write_compressed_ply, (b"ply",),
        ("antialiasing", "offset"),
    ),
    "splat": Format(
        ".splat", ".splat", packed.read_splat, packed.write_splat,
        harmonics=False, ranges="colours up to white",
    ),
    "spz": Format(
        "SPZ", ".spz", packed.read_spz, packed.write_spz, (b"\x1f\x8b", b"NGSP"), ("antialiasing",),
        ranges="scales of 0.000045 to 379 units, colours to 1.44 of white and SH coefficients to 1",
        position="(x, -y, -z) of the coordinates in the file",
    ),
    "sog": Format("SOG", ".sog", read_sog, write_sog, (b"PK",), ("antialiasing",)),
    "glb": Format(
        "GLB", ".glb", None, write_glb, (b"glTF",), ("levels",), quantised=False,
        position="coordinates in the file, without the turn of its node,",
    ),
}  # fmt: skip


def check_replaces(path: Path, kind: Format) -> None:
    """Check the name of a file to write, and that no file of another format is replaced.

    ValueError: the name has another suffix than files of the format. FileExistsError: the file is not empty
    and no file of the format. OSError: it is no regular file.
    """
    check_replaceable(path, kind.starts, f" and is not a {kind.title} file")
    if path.suffix.lower() != kind.suffix:
        raise ValueError(f"{path}: the file will be {kind.title}: choose a name that ends in {kind.suffix}")


def format_of(path: Path) -> Format | None:
    """Return the format of a file by its beginning, else by the end of its name; None: neither tells."""
    with open(path, "rb") as file:
        start = file.read(_HEADER)
    if b" packed_position" in start.partition(b"end_header")[0]:
        return FORMATS["compressed-ply"] if start.startswith(b"ply") else None
    known = (kind for kind in FORMATS.values() if kind.starts and start.startswith(kind.starts))
    named = (kind for kind in FORMATS.values() if not kind.starts and path.suffix.lower() == kind.suffix)
    return next(known, None) or next(named, None)


def open_gaussians(path: Path, checked: bool = True) -> GaussianSource:
    """Open a model that any program wrote; one in INRIA's layout is read block by block, others at once.

    Without `checked`, the blocks have values that cannot be shown, which a `Selected` leaves out. ValueError,
    ImportError: see `read_gaussians`.
    """
    return PlySource(path, checked) if format_of(path) is FORMATS["ply"] else read_gaussians(path)


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a model that any program wrote: PLY (INRIA's layout or compressed), SPZ, SOG or .splat.

    Where the format cannot state an offset, that of `offset_file` becomes a header line. SPZ needs the
    packages of `pip install "blitzgs[formats]"`. ValueError: the file is damaged, no model, or holds values
    that cannot be shown; names the file. ImportError: a package is missing; says which.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(
            f"{path} is a folder and no file of Gaussians: blitzgs export makes one of a run"
        )
    kind = format_of(path)
    if kind is None or kind.read is None:
        raise ValueError(f"{path} is no model: PLY, compressed PLY, SPZ, SOG and .splat files are read")
    found = kind.read(path)
    with located(str(path)):
        found.check()
    if "offset" not in kind.states and (offset := stated_offset(offset_file(path))):
        found.comments = [*found.comments, triple_line("offset", offset)]
    return found


def with_degree(model: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with another SH degree: coefficients are left out, or zero."""
    k = (degree + 1) ** 2
    sh = torch.zeros(len(model), k, 3)
    sh[:, : model.sh.shape[1]] = model.sh[:, :k]
    return replace(model, sh=sh)


def offset_file(path: Path) -> Path:
    """Return the file beside a model that states its offset, if `blitzgs export` wrote one."""
    return path.with_name(path.name + ".offset.json")


def stated_offset(path: Path) -> tuple[float, float, float] | None:
    """Return the offset in an `offset_file`; None: there is none, or another program wrote the file."""
    content = _stated(path)
    return None if content is None else content["offset"]


def system_of(path: Path, source: GaussianSource) -> str | None:
    """Return the reference system of a file's model, empty if it is unknown; None: it is not in the world."""
    content = _stated(offset_file(path))
    if content is None or content["offset"] != offset_of(source.comments):
        return None
    return content["crs"] if content["meaning"].startswith("world") else None


def _stated(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        x, y, z = (float(value) for value in content["offset"])
        texts = {name: str(content[name]) for name in ("file", "meaning")}
        return {**texts, "offset": (x, y, z), "crs": str(content.get("crs", ""))}
    except (OSError, *WRONG_CONTENT):
        return None


def offset_of(comments: list[str]) -> tuple[float, float, float]:
    """Return the offset that `blitzgs export` writes into a header; zero: there is none."""
    return triple_of(comments, "offset") or (0.0, 0.0, 0.0)
