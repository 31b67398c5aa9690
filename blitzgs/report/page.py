# SPDX-License-Identifier: Apache-2.0
"""Puts data, styles and scripts into one HTML file that needs no network.

Whatever comes from a run's files is passed to the script as JSON, which makes text of it: names of
photographs and warnings may hold anything.
"""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from blitzgs.formats.web_page import check_replaces_page
from blitzgs.util.output import write_file

MAX_BYTES = 10_000_000
_ROOM_FOR_NOTES = 1000


def page(
    title: str, scripts: tuple[str, ...], data: Mapping[str, Any], look: Mapping[str, str] | None = None
) -> str:
    """Return a page.

    Args:
        title: of the browser's tab.
        scripts: names of files in `assets`, in their order.
        data: what the scripts read; numbers that JSON lacks become null.
        look: "html", a page with the model in 3D, and "note", a sentence about it; None: there is none.
    """
    assets = files("blitzgs.report") / "assets"
    values = {
        "@TITLE@": html.escape(title.encode("utf-8", "replace").decode()),
        "@STYLE@": (assets / "style.css").read_text(encoding="utf-8"),
        "@SCRIPT@": "\n".join((assets / name).read_text(encoding="utf-8") for name in scripts),
        "@DATA@": _json(data),
        "@LOOK@": _json(look),
    }
    # Split first, so that nothing in a value is taken for a place.
    parts = re.split("(@[A-Z]+@)", (assets / "page.html").read_text(encoding="utf-8"))
    return "".join(values.get(part, part) for part in parts)


def fitted(
    title: str, scripts: tuple[str, ...], data: dict[str, Any], look: Mapping[str, str] | None = None
) -> str:
    """Return a page of at most `MAX_BYTES`: the look in 3D is left out first, then pictures, and it says so.

    Raises:
        ValueError: the page is larger without either.
    """
    pictures, notes = data["pictures"], list(data["left_out"])
    room = MAX_BYTES - _ROOM_FOR_NOTES - len(page(title, scripts, data | {"pictures": []}).encode())
    if room < 0:
        raise ValueError(f"the page would have more than {MAX_BYTES / 1e6:g} MB without any picture")
    sizes = np.cumsum([0, *(len(_json(picture)) + 1 for picture in pictures)])
    if look is not None and sizes[-1] + len(_json(look)) > room:
        look = None
        notes.append("The model in 3D is left out to keep this file small.")
    fitting = int((sizes <= room).sum()) - 1
    if fitting < len(pictures):
        notes.append(f"{len(pictures) - fitting} pictures are left out to keep this file small.")
    return page(title, scripts, data | {"pictures": pictures[:fitting], "left_out": notes}, look)


def write_page(path: Path, text: str) -> None:
    """Write a page.

    Raises:
        FileExistsError: the file exists and is no page of ours.
        OSError: it cannot be written.
    """
    check_replaces_page(path)
    write_file(path, text, sync=False)


def _json(value: object) -> str:
    # "<" cannot end the script element that holds the text.
    return json.dumps(_finite(value), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(part) for part in value]
    return value
