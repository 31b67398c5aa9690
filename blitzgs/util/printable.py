# SPDX-License-Identifier: Apache-2.0
"""Text for a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return a text in which characters that steer a terminal, as a file's name may have them, are \xNN."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
