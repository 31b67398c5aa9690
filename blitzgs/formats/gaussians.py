# SPDX-License-Identifier: Apache-2.0
"""Gaussians as files hold them, whole or block by block."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.util.errors import amount, check_tensors
from blitzgs.util.memory import available_bytes

# Writers take so many Gaussians at a time: 62 MB at SH degree 3.
BLOCK = 1 << 18
# Name of a header line that viewers look for (Brush, PlayCanvas and others).
MIP = "comment SplatRenderMode: mip"
# What a DC coefficient of 1 adds to a colour: the constant spherical harmonic.
SH_C0 = 0.28209479177387814
# Logarithm of a scale that float32 cannot hold.
_LARGEST_SCALE = 88.0
_COLUMNS = ("means", "quats", "scales", "opacities", "sh")


class GaussianSource(Protocol):
    """N Gaussians that need not be in memory at once."""

    @property
    def degree(self) -> int:
        """The spherical-harmonics degree."""

    @property
    def comments(self) -> list[str]:
        """Header lines, each "comment ..." or "obj_info ..."."""

    @property
    def has_levels(self) -> bool:
        """Whether the Gaussians have octree levels."""

    def __len__(self) -> int:
        """Return N."""

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians in order, at most `BLOCK` at a time; may be called again."""


@dataclass
class Gaussians:
    """N Gaussians as stored, float32 CPU tensors."""

    means: Tensor
    """[N, 3]."""
    quats: Tensor
    """[N, 4] w, x, y, z, unnormalised."""
    scales: Tensor
    """[N, 3] logarithms."""
    opacities: Tensor
    """[N] logits."""
    sh: Tensor
    """[N, K, 3], K = (degree + 1)^2; coefficient 0 is the DC."""
    normals: Tensor | None = None
    """[N, 3]; not used, kept so that a PLY file can be written again unchanged."""
    comments: list[str] = field(default_factory=list)
    """Header lines "comment ..." and "obj_info ..."."""
    levels: Tensor | None = None
    """[N] octree levels, where the file has them."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """The spherical-harmonics degree."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def has_levels(self) -> bool:
        """Whether the Gaussians have octree levels."""
        return self.levels is not None

    def rows(self, rows: Tensor | slice) -> Gaussians:
        """Return some of the Gaussians."""
        return replace(self, **{name: column[rows] for name, column in self._columns().items()})

    def _columns(self) -> dict[str, Any]:
        """Return the columns that there are, by name."""
        found = {name: getattr(self, name) for name in (*_COLUMNS, "normals", "levels")}
        return {name: column for name, column in found.items() if column is not None}

    def blocks(self) -> Iterator[Gaussians]:
        """Yield all Gaussians in order, at most `BLOCK` at a time."""
        for start in range(0, len(self), BLOCK):
            yield self.rows(slice(start, start + BLOCK))

    def sound(self) -> Tensor:
        """Tell which Gaussians have values that a viewer can show, bool [N]; see `check`."""
        bad = torch.zeros(len(self), dtype=torch.bool)
        for name in _COLUMNS:
            bad |= _bad_rows(name, getattr(self, name))
        return ~bad

    def check(self) -> None:
        """Check shapes and values.

        TypeError: a field is not a tensor. ValueError: shapes disagree, or a viewer cannot show a value: NaN,
        infinite.
        """
        n, k = len(self.means), self.sh.shape[1] if isinstance(self.sh, Tensor) and self.sh.ndim == 3 else 0
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, k, 3)}
        shapes |= {"normals": (n, 3), "levels": (n,)}
        given = self._columns()
        check_tensors(**given)
        for name, tensor in given.items():
            rows = _bad_rows(name, tensor)
            if bool(rows.any()):
                first = int(rows.nonzero()[0])
                raise ValueError(
                    f"{name} has NaN or infinite values in {int(rows.sum()):,} Gaussians, the first is "
                    f"number {first}: leave these Gaussians out"
                )
        if k not in (1, 4, 9, 16):
            raise ValueError(
                f"sh has the shape {list(self.sh.shape)}, expected [N, K, 3] with K = 1, 4, 9 or 16"
            )
        for name, tensor in given.items():
            if tuple(tensor.shape) != shapes[name]:
                raise ValueError(f"{name} has the shape {list(tensor.shape)}, expected {list(shapes[name])}")


def check_memory(holds: str, count: int, degree: int, copies: int = 2) -> None:
    """Refuse a number of Gaussians that the free memory cannot hold so often; readers need it twice.

    `holds`: what has them, as the beginning of the sentence, for example "FILE holds". ValueError: it cannot;
    names both amounts.
    """
    needed = copies * 4 * count * (11 + 3 * (degree + 1) ** 2)
    free = available_bytes()
    if needed > free:
        raise ValueError(
            f"{holds} {count:,} Gaussians: reading them takes {amount(needed)} of memory or more, and "
            f"{amount(free)} are free"
        )


def joined(parts: list[Gaussians]) -> Gaussians:
    """Return parts of a model, at least one, as one; normals are left out."""
    names = parts[0]._columns().keys() - {"normals"}
    columns: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], normals=None, **columns)


def is_antialiased(source: GaussianSource) -> bool:
    """Tell whether the Gaussians are to be shown with the compensation of the screen-space blur."""
    return any(line.strip() == MIP for line in source.comments)


def triple_line(name: str, values: Iterable[float]) -> str:
    """Return the header line that `triple_of` reads."""
    x, y, z = (float(value) for value in values)
    return f"comment {name} {x!r} {y!r} {z!r}"


def triple_of(comments: list[str], name: str) -> tuple[float, float, float] | None:
    """Return the numbers of a header line "comment NAME X Y Z"; None: there is none.

    BlitzGS writes "offset", to be added to the means; "background", the RGB in [0, 1] behind the model; and
    "up", the upward direction.
    """
    for line in comments:
        words = line.split()
        if words[:2] == ["comment", name] and len(words) == 5:
            with suppress(ValueError):  # another program's
                x, y, z = (float(word) for word in words[2:])
                if all(map(math.isfinite, (x, y, z))):
                    return x, y, z
    return None


def up_of(comments: list[str]) -> tuple[float, float, float] | None:
    """Return the upward direction that a header states; None: it states none."""
    up = triple_of(comments, "up")
    # The square of a length beyond these is no number.
    return up if up and 1e-100 < max(map(abs, up)) < 1e100 else None


def _bad_rows(name: str, tensor: Tensor) -> Tensor:
    """Tell which rows no viewer can show, bool [N]: not finite; scales may be 0, opacities 0 or 1."""
    bad = ~tensor.isfinite()
    if name == "opacities":
        bad = tensor.isnan()
    if name == "scales":
        bad = ~(tensor < _LARGEST_SCALE)
    return bad.flatten(1).any(dim=1) if bad.dim() > 1 else bad


def unit_quats(quats: Tensor) -> Tensor:
    """Return unit quaternions, float64 [N, 4]; a zero quaternion becomes the identity."""
    unit = quats.double().clone()
    unit[~unit.any(dim=1), 0] = 1
    unit /= unit.abs().amax(dim=1, keepdim=True)
    return unit / torch.linalg.vector_norm(unit, dim=1, keepdim=True)


def degree_of(rest: int, path: Path) -> int:
    """Return the SH degree of a PLY file with so many properties f_rest (ValueError: none has them)."""
    degree = {0: 0, 9: 1, 24: 2, 45: 3}.get(rest)
    if degree is None:
        raise ValueError(f"{path}: {rest} f_rest properties fit no SH degree (0, 9, 24 or 45 do)")
    return degree


def without_largest(quats: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Return all components but the largest of unit quaternions [N, 4], and its place, int64 [N].

    The components, int64 [N, 3], have so many bits: 0 stands for -sqrt(1/2).
    """
    largest = quats.abs().argmax(dim=1, keepdim=True)
    turned = quats * quats.gather(1, largest).sign()
    others, most = turned[torch.arange(4)[None] != largest].reshape(-1, 3), (1 << bits) - 1
    return ((others * 2**0.5 + 1) / 2 * most).round().clamp(0, most).long(), largest[:, 0]


def with_largest(shares: npt.NDArray[np.float32], largest: npt.NDArray[Any]) -> Tensor:
    """Return unit quaternions [N, 4] from what `without_largest` says, its components divided by the most."""
    others = (shares - 0.5) * 2**0.5
    quats = np.empty((len(others), 4), np.float32)
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    return torch.from_numpy(quats)
