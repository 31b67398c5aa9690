# SPDX-License-Identifier: Apache-2.0
"""Files that a visitor makes on the page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from blitzgs.util.output import write_file

if TYPE_CHECKING:
    from blitzgs.viewer.visitor import Visitor


def save_beside(folder: Path, name: str, content: bytes | str) -> str:
    """Write a file into the folder for paths and screenshots; return what to tell the visitor."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / name, content)
    except OSError as error:
        return f"the file is in the browser's downloads; {folder} cannot be written: {error}"
    return f"saved as {folder / name}"


def note(visitor: Visitor, text: str) -> None:
    """Show a note on the visitor's page for some seconds."""
    visitor.client.add_notification("BlitzGS", text, auto_close_seconds=6.0)


def safe_name(text: str) -> str:
    """Return a text as the name of a file."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "view"
