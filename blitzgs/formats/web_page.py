# SPDX-License-Identifier: Apache-2.0
"""A model and its viewer as one HTML file, which needs no server and no network.

The Gaussians are planes of bytes, one after the other, deflated and in base64. First come the ranges of each
block of 256 Gaussians, float32 (least, step): 3 of positions, 3 of log scales, 3 of colours. Then follow for
all Gaussians, a byte each: positions (3 low bytes, 3 high bytes), log scales (3), DC coefficients (3), the
unit quaternion (32 bits: the three smaller components in 10 bits each, then which one is left out),
opacity * 255, the octree level where there are levels, and the other SH coefficients as signed multiples of
`HARMONIC`, coefficient by coefficient.
"""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from blitzgs.formats.gaussians import Gaussians, unit_quats, without_largest
from blitzgs.util.output import check_replaceable

BLOCK = 256
# Value of one step of a quantised SH coefficient. Coefficients beyond 127 steps are cut off.
HARMONIC = 1 / 64
_PARTS = ("splat.vert", "sorter.js", "viewer.js", "file.js")
# Gaussians of which the size of all is estimated.
_SAMPLE = 1 << 16

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class WebLevels:
    """How views leave out Gaussians by their octree levels; see `blitzgs.view.gate.ModelGate`."""

    reach: list[float | None]  # distance up to which views keep each level; None: any; negative: none
    slope: float  # f / (f - 1) for levels that fade; 0: they are cut off
    most: float | None  # share of all Gaussians from which on a view has no gate; None: it always has
    least: float  # share of all Gaussians below which a view has no gate


@dataclass(frozen=True)
class WebScene:
    """What the page knows besides the Gaussians; lengths in the unit of the means."""

    near: float  # near plane
    far: float  # far plane
    blur: float  # screen-space blur, pixels squared
    antialiased: bool  # compensate that blur in the opacities
    background: tuple[float, float, float]  # RGB in [0, 1]
    up: tuple[float, float, float]  # upward direction
    eye: tuple[float, float, float]  # position of the first view
    target: tuple[float, float, float]  # point that it looks at, and that it turns about
    fov: float  # vertical field of view in radians
    lod: WebLevels | None = None  # octree levels; None: views leave out nothing


def check_replaces_page(path: Path) -> None:
    """Check that writing a page replaces no file of another program.

    FileExistsError: there is a file that is not empty and no page of ours. OSError: `path` is no regular
    file.
    """
    mark = b'<meta name="generator" content="BlitzGS">'
    check_replaceable(path, (mark,), ", and blitzgs did not write it")


def packed(splats: Gaussians) -> bytes:
    """Return the Gaussians as the page reads them, without base64; their order puts neighbours together."""
    blocks, sh = -(-len(splats) // BLOCK), splats.sh.numpy()
    places, box = _quantised(splats.means.numpy(), blocks, 65535)
    sizes, sizes_range = _quantised(splats.scales.numpy(), blocks, 255)
    tints, tints_range = _quantised(sh[:, 0], blocks, 255)
    planes: list[npt.NDArray[np.generic]] = [box, sizes_range, tints_range]
    planes += [places & 255, places >> 8, sizes, tints, _quaternion_bytes(splats)]
    planes.append(np.rint(splats.opacities.sigmoid()[:, None].double().numpy() * 255))
    if splats.levels is not None:
        planes.append(splats.levels[:, None].byte().numpy())
    rest = sh[:, 1:].reshape(len(splats), -1)
    planes.append(np.rint(rest / HARMONIC).clip(-127, 127).astype(np.int8).view(np.uint8))
    content = b"".join(
        (plane if plane.dtype == np.float32 else plane.astype(np.uint8).T).tobytes() for plane in planes
    )
    return zlib.compress(content, 6)


def _quantised(
    values: npt.NDArray[np.float32], blocks: int, steps: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Return codes [N, 3] of values [N, 3], and least value and step of each block, float32 [3, B, 2]."""
    filled = np.pad(values.astype(np.float64), ((0, blocks * BLOCK - len(values)), (0, 0)), mode="edge")
    by_block = filled.reshape(blocks, BLOCK, 3)
    least = by_block.min(axis=1).astype(np.float32)
    step = ((by_block.max(axis=1) - least) / steps).astype(np.float32)
    codes = (by_block - least[:, None]) / np.where(step > 0, step, 1)[:, None].astype(np.float64)
    codes = np.rint(codes).clip(0, steps).astype(np.int64).reshape(-1, 3)[: len(values)]
    return codes, np.stack([least.T, step.T], axis=-1)


def _quaternion_bytes(splats: Gaussians) -> Bytes:
    """Return the rotations as 4 bytes each, [N, 4]; a zero quaternion is the identity."""
    others, left_out = (part.numpy() for part in without_largest(unit_quats(splats.quats), 10))
    words = others[:, 0] | others[:, 1] << 10 | others[:, 2] << 20 | left_out << 30
    return np.asarray(words.astype("<u4").view(np.uint8).reshape(-1, 4))


def estimated_bytes(splats: Gaussians) -> int:
    """Estimate the size of the Gaussians in the file from some blocks of them."""
    blocks = -(-len(splats) // BLOCK)
    chosen = np.unique(np.linspace(0, blocks - 1, min(blocks, _SAMPLE // BLOCK)).astype(np.int64))
    rows = (chosen[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    some = splats.rows(torch.from_numpy(rows[rows < len(splats)]))
    return int(len(packed(some)) * 4 / 3 * len(splats) / max(1, len(some)))


@cache
def _part(name: str) -> str:
    return resources.files("blitzgs.formats").joinpath(f"web/{name}").read_text(encoding="utf-8")


def frame_bytes() -> int:
    """Return about how many bytes the page has besides the Gaussians."""
    return sum(len(_part(name)) for name in ("page.html", *_PARTS)) + 2000


def web_page(splats: Gaussians, scene: WebScene, title: str, left_out: str = "") -> str:
    """Return the page.

    `splats`: at least one Gaussian. `left_out`: what the file lacks of the model, for the reader of the page;
    empty: nothing.
    """
    known = asdict(scene) | {"count": len(splats), "degree": splats.degree, "harmonic": HARMONIC}
    return _filled(
        "file.js",
        title=as_html(title),
        left_out=as_html(left_out),
        # No text in a script element may look like a tag.
        scene=json.dumps(known, allow_nan=False).replace("<", "\\u003c"),
        model=base64.b64encode(packed(splats)).decode(),
    )


def tiles_page(title: str) -> str:
    """Return the page that shows the tileset beside it; see `blitzgs.formats.tiles`."""
    return _filled("tiles.js", title=as_html(title), left_out="", scene="{}", model="")


def as_html(text: str) -> str:
    """Return text as HTML; what is no UTF-8 in the name of a file becomes question marks."""
    return html.escape(text.encode("utf-8", "replace").decode())


def _filled(program: str, **fields: str) -> str:
    known = fields | {name: _part(name) for name in _PARTS} | {"program": _part(program)}
    return re.sub(r"\{\{(.+?)\}\}", lambda found: known[found[1]], _part("page.html"))
