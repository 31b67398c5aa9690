# SPDX-License-Identifier: Apache-2.0
"""Fields of what other programs write: objects of JSON, texts of XML, cells of a row, by name.

All raise a ValueError that names the field; `blitzgs.util.errors.located` adds the file and the place in it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Fields = Mapping[str, Any]
# Larger than the projects of a hundred thousand photographs.
_MOST = 4 << 30


def read_bytes(path: Path, most: int = _MOST) -> bytes:
    """Return the content of a file (ValueError: it is larger than such files are)."""
    if path.stat().st_size > most:
        raise ValueError(f"{path} is larger than {most:,} bytes, which such a file never is")
    return path.read_bytes()


def read_text(path: Path, most: int = _MOST) -> str:
    """Return the text of a file in UTF-8, else in the letters of Windows; errors as `read_bytes`."""
    content = read_bytes(path, most)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def read_small(path: Path) -> str:
    """Return the text of a file of at most a megabyte."""
    return read_text(path, 1 << 20)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file (ValueError: it is none; says where)."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"no JSON ({error}); export it again") from error


def entry(content: Any, key: str, kind: type) -> Any:
    """Return a field of an object (ValueError: it is missing, or of another kind)."""
    value = content.get(key) if isinstance(content, Mapping) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        found = "is missing" if value is None else f"is {value!r:.40}"
        raise ValueError(f"the field {key} {found}; export it again")
    return value


def number(fields: Fields, key: str, default: float | None = None) -> float:
    """Return a field that must be a finite number (as text too), or a default (else ValueError)."""
    value = fields.get(key, default)
    try:
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise ValueError
        converted = float(value)
    except (ValueError, OverflowError):
        converted = math.nan
    if not math.isfinite(converted):
        shown = "null" if value is None else f"{value!r:.40}"
        raise ValueError(f"{key} must be a finite number, got {shown}")
    return converted


def numbers(fields: Fields, key: str, count: int) -> npt.NDArray[np.float64]:
    """Return `count` numbers, NaN too, of a list or a text with blanks (else ValueError)."""
    value = fields.get(key)
    words = value.split() if isinstance(value, str) else value
    try:
        if not isinstance(words, list) or any(isinstance(word, bool) for word in words):
            raise TypeError
        found = np.array([float(word) for word in words])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{key}: expected numbers, got {value!r:.60}") from error
    if len(found) != count:
        raise ValueError(f"{key}: expected {count} numbers, got {len(found)}; export it again")
    return found


def image_size(fields: Fields) -> tuple[int, int]:
    """Return the fields width and height, in pixels (ValueError: they are no size)."""
    width, height = number(fields, "width"), number(fields, "height")
    if not all(1 <= side <= 1 << 20 and side == int(side) for side in (width, height)):
        raise ValueError(f"{width:g} x {height:g} is no size of an image")
    return int(width), int(height)
