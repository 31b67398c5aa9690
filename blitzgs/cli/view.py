# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs view`: look at a model in the browser."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from blitzgs.cli.arguments import DATA, DEVICE, MODEL, Commands, add_command
from blitzgs.config.files import changed, load_config
from blitzgs.distributed.group import Ranks, extend_memory_in_place, resolve_device
from blitzgs.formats.streamed_sog import META
from blitzgs.formats.tiles import PAGE, TILESET
from blitzgs.runs import run_files
from blitzgs.training.inputs import open_capture
from blitzgs.util.errors import WRONG_CONTENT, printable
from blitzgs.viewer.door import is_loopback, unheard

HELP = """\
Look at a model in the browser. MODEL is the folder of a run, a checkpoint in it, a file of Gaussians of any
program (PLY, compressed PLY, SPZ, SOG, .splat), or a folder that `blitzgs export --tiles` wrote: of this one,
the browser loads and draws what it needs.
The machine that holds the model renders, on its GPU or its CPU; the browser may be on another one:

  blitzgs view RUN                               # then open http://localhost:8080
  ssh -L 8080:localhost:8080 MACHINE blitzgs view RUN
  blitzgs view RUN --host 0.0.0.0                # prints an address with a token; without it nobody gets in

Needs the package viser: pip install "blitzgs[view]".
"""


ARGUMENTS = f"""{MODEL}{DATA}{DEVICE}
--port PORT  port to listen on; 0: any (default: %(default)s)
--host HOST  address to listen on (default: %(default)s, this machine only)
--paths DIR  folder for camera paths and screenshots (default: RUN/paths, or the folder of the file)
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    defaults: dict[str, Any] = {"device": "auto", "port": 8080, "host": "127.0.0.1"}
    add_command(commands, "view", run, summary, HELP, ARGUMENTS, {"--port": int}, **defaults)


def run(args: argparse.Namespace) -> None:
    """Show a model until Ctrl-C."""
    if (args.model / TILESET).is_file():
        serve_tiles(args.model, args.host, args.port)
        return
    if (args.model / META).is_file():
        raise ValueError(f"{args.model} is streamed SOG, which SuperSplat shows; blitzgs view needs --tiles")
    from blitzgs.viewer.page import require_viser

    require_viser()
    from blitzgs.viewer.studio import Studio, open_model

    extend_memory_in_place()
    device, _ = resolve_device(args.device, local_rank=0, local_world_size=1, share_gpus=False)
    ranks = Ranks(device=device)
    model: Path = args.model
    photograph = None
    if not model.is_file():
        folder, _ = run_files.run_and_checkpoint(model)
        run_files.check_is_run(folder)
        photograph = photographs(folder, args.data)
    studio = Studio(open_model(model, ranks, photograph, args.paths), args.host, args.port)
    print(f"{model}: open {studio.page.url} (Ctrl-C ends)", flush=True)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        print()
    finally:
        studio.close()


def photographs(folder: Path, data: Path | None) -> Callable[[int], npt.NDArray[np.uint8]] | None:
    """Return a function that reads the photographs of a run's cameras; None if the capture is not there."""
    try:
        config = load_config(folder / run_files.CONFIG)
        if data is not None:
            config = changed(config, "data", path=str(data))
        _, images = open_capture(config, Ranks(), "--data DIR")
    except (OSError, ValueError) as error:
        print(printable(f"no photographs to compare with: {error}"))
        return None
    return lambda index: np.asarray(images.get(index).numpy())


class _Handler(SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60  # seconds without a byte, after which a connection and its thread end

    def log_message(self, *args: Any) -> None:
        """Print no line for each file."""

    def list_directory(self, path: Any) -> None:
        """Show no listing of a folder."""
        self.send_error(404, "File not found")


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Let a browser that has gone, or a name that is none, end its own connection only."""


def tiles_server(folder: Path, host: str, port: int) -> ThreadingHTTPServer:
    """Return a server of a tileset's folder, not running yet; port 0: any free one.

    ValueError: the tileset is damaged, or another program's. OSError: it cannot listen at the address.
    """
    try:
        tileset = json.loads((folder / TILESET).read_text(encoding="utf-8"))
        complete = tileset["asset"]["generator"] == "BlitzGS" and "view" in tileset["extras"]
    except WRONG_CONTENT as error:
        remedy = "write it again with blitzgs export"
        raise ValueError(f"{folder / TILESET} is damaged ({error}): {remedy}") from error
    if not complete or not (folder / PAGE).is_file():
        raise ValueError(
            f"{folder} has no page of blitzgs export --tiles: it is another program's, or has SPZ inside "
            "(--spz-tiles), which CesiumJS shows"
        )
    try:
        return _Server((host, port), partial(_Handler, directory=str(folder)))
    except (OSError, OverflowError) as error:
        raise unheard(host, port, error) from error


def serve_tiles(folder: Path, host: str, port: int) -> None:
    """Serve until Ctrl-C."""
    with tiles_server(folder, host, port) as server:
        shown = "localhost" if is_loopback(host) else host
        print(f"{folder}: open http://{shown}:{server.server_port}/ (Ctrl-C ends)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
