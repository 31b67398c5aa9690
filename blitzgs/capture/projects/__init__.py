# SPDX-License-Identifier: Apache-2.0
"""Projects of photogrammetry programs as captures, one file for each program.

Here is what their readers have in common: their result, and safe parsing of XML, JSON and numbers.

All raise ValueError for what is damaged, missing or not supported; it names the file and the place in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from blitzgs.capture.cameras import Float64
from blitzgs.capture.lens import Lens
from blitzgs.capture.points import SourcePoints
from blitzgs.capture.world import WorldFrame
from blitzgs.util.errors import located

# Larger than the projects of a hundred thousand photographs.
_MAX_BYTES = 4 << 30

# A lens, or a function of the image's width and height if the file gives lengths as shares of them.
LensOf = Lens | Callable[[int, int], Lens]


@dataclass(frozen=True, eq=False)
class ProjectView:
    """A photograph with a pose: its name as the project writes it, lens, and world to camera [4, 4].

    The camera looks along +z, with x right and y down, and the centre of pixel (i, j) is (i + 0.5, j + 0.5).
    """

    name: str
    lens: LensOf
    world_to_camera: Float64


@dataclass(eq=False)
class Project:
    """The content of a project; `lost` counts photographs without a pose, `notes` say what has no effect."""

    views: list[ProjectView]
    points: SourcePoints | None = None
    frame: WorldFrame | None = None
    lost: int = 0
    notes: list[str] = field(default_factory=list)


def pose_of(camera_to_world: Float64, centre: Sequence[float] | Float64, where: str) -> Float64:
    """Return world to camera [4, 4] of a camera's axes in the world [3, 3] (as columns) and its centre."""
    check_rotation(camera_to_world, where)
    pose = np.eye(4)
    pose[:3, :3] = camera_to_world.T
    pose[:3, 3] = -camera_to_world.T @ np.asarray(centre)
    return pose


def check_rotation(matrix: Float64, where: str) -> None:
    """Refuse a matrix [3, 3] that is no rotation; one of NaN passes, and its view is dropped later."""
    if np.isnan(matrix).any():
        return
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4) or np.linalg.det(matrix) < 0:
        raise ValueError(f"{where}: no rotation: {np.round(matrix, 6).tolist()}; export the project again")


def numbers(value: Any, count: int | None, where: str) -> Float64:
    """Return numbers of a text or a JSON list (ValueError: they are not numbers, or not so many)."""
    words = value.split() if isinstance(value, str) else value
    try:
        if not isinstance(words, list) or any(isinstance(word, bool) for word in words):
            raise TypeError
        found = np.array([float(word) for word in words])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{where}: expected numbers, got {value!r:.60}") from error
    if count is not None and len(found) != count:
        raise ValueError(f"{where}: expected {count} numbers, got {len(found)}; export the project again")
    return found


def number(value: Any, where: str) -> float:
    """Return a finite number of a text or of JSON (ValueError: it is none)."""
    found = float(numbers([value.strip() if isinstance(value, str) else value], 1, where)[0])
    if not np.isfinite(found):
        raise ValueError(f"{where}: expected a finite number, got {value!r:.40}")
    return found


def size_of(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Return the size of an image in pixels (ValueError: it is no size)."""
    sides = [number(side, where) for side in (width, height)]
    if not all(1 <= side <= 1 << 20 and side == int(side) for side in sides):
        raise ValueError(f"{where}: {sides[0]:g} x {sides[1]:g} is no size of an image")
    return int(sides[0]), int(sides[1])


def made_lens(where: str, model: str, width: int, height: int, *params: float) -> Lens:
    """Return a lens; an error names the place."""
    with located(where):
        return Lens(model, width, height, tuple(float(value) for value in params))


def read_text(path: Path) -> str:
    """Return the text of a file of a project."""
    check_size(path)
    return path.read_bytes().decode("utf-8-sig", errors="replace")


def check_size(path: Path) -> None:
    """Refuse a file that is larger than any project."""
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"{path} is larger than {_MAX_BYTES:,} bytes: no project is")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file (ValueError: it is none; names the file and the place)."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no JSON ({error}); export the project again") from error


def entry(content: Any, key: str, kind: type | tuple[type, ...], where: str) -> Any:
    """Return a field of a JSON object (ValueError: it is missing, or of another kind)."""
    value = content.get(key) if isinstance(content, Mapping) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        found = "is missing" if value is None else f"is {value!r:.40}"
        raise ValueError(f"{where}: the field {key} {found}; export the project again")
    return value


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file.

    Entities are refused: a few lines of them expand to gigabytes or name other files, and no project has one.
    """
    check_size(path)
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise ValueError("it defines entities, which no project needs")

    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.buffer_text = True
    try:
        with open(path, "rb") as file:
            parser.ParseFile(file)
        return builder.close()
    except (expat.ExpatError, ValueError, AssertionError) as error:
        line = getattr(error, "lineno", parser.CurrentLineNumber)
        raise ValueError(
            f"{path}: line {line}: no readable XML ({error}); export the project again"
        ) from error
