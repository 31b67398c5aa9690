# SPDX-License-Identifier: Apache-2.0
"""Serves the folder of a tileset to a browser."""

from __future__ import annotations

import json
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from blitzgs.formats.tiles import PAGE, TILESET


class _Handler(SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *args: Any) -> None:
        """Print no line for each file."""

    def list_directory(self, path: Any) -> None:
        """Show no listing of a folder."""
        self.send_error(404, "File not found")


def tiles_server(folder: Path, host: str, port: int) -> ThreadingHTTPServer:
    """Return a server of a tileset's folder, not running yet; port 0: any free one.

    Raises:
        ValueError: the tileset is damaged, or another program wrote it.
        OSError: the address is not this machine's, or the port is in use.
    """
    try:
        tileset = json.loads((folder / TILESET).read_text(encoding="utf-8"))
        complete = tileset["asset"]["generator"] == "BlitzGS" and "view" in tileset["extras"]
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(
            f"{folder / TILESET} is damaged ({error}): write it again with blitzgs export"
        ) from error
    if not complete or not (folder / PAGE).is_file():
        raise ValueError(f"{folder} was not written by blitzgs export --tiles: open it with another viewer")
    try:
        return ThreadingHTTPServer((host, port), partial(_Handler, directory=str(folder)))
    except (OSError, OverflowError) as error:
        raise OSError(f"the viewer cannot listen on {host}:{port}: {error}") from error


def serve_tiles(folder: Path, host: str, port: int) -> int:
    """Serve until Ctrl-C; returns the exit status."""
    with tiles_server(folder, host, port) as server:
        print(f"{folder}: open http://{host}:{server.server_port} (Ctrl-C ends)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0
