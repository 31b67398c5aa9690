# SPDX-License-Identifier: Apache-2.0
"""The flag `--viewer` of `blitzgs train`: a page that follows the training."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from blitzgs.training.state import TrainingState

if TYPE_CHECKING:
    from blitzgs.viewer.live import Live

DEFAULT_PORT = 8080


def add_live_page(parser: argparse.ArgumentParser) -> None:
    """Add the flags."""
    parser.add_argument(
        "--viewer",
        type=int,
        nargs="?",
        const=DEFAULT_PORT,
        metavar="PORT",
        help=f"show the training in the browser (default port: {DEFAULT_PORT}); needs the extra view",
    )
    parser.add_argument(
        "--viewer-host",
        default="127.0.0.1",
        metavar="HOST",
        help="address to listen on (default: %(default)s, this machine only)",
    )
    parser.add_argument(
        "--viewer-stay",
        action="store_true",
        help="after the training, keep the page open until Ctrl-C (default: it closes)",
    )


def say_where_to_look(args: argparse.Namespace) -> None:
    """Print whether the page of a finished training stays open."""
    if args.viewer is not None and args.viewer_stay:
        print("the viewer's page stays open (Ctrl-C ends)", flush=True)
    elif args.viewer is not None:
        print("the viewer's page is closed: see above, or train with --viewer-stay to keep it open")


def check_live_page(port: int | None) -> None:
    """Check that the page's package is installed, before any work (ImportError: it is not)."""
    if port is not None:
        from blitzgs.viewer.page import require_viser

        require_viser()


def live_page(state: TrainingState, port: int, host: str) -> Live | None:
    """Open the page of a training on rank 0, and print its address; None on other ranks.

    A page that cannot be opened is a message: the training goes on without it.
    """
    if state.ranks.rank != 0:
        return None
    from blitzgs.viewer.exhibit import Exhibit
    from blitzgs.viewer.live import Live
    from blitzgs.viewer.studio import box_of

    capture, images, options = state.capture, state.images, state.render_options
    exhibit = Exhibit(
        title=f"{state.folder.resolve().name} (training)",
        space=state.space,
        sh_degree=state.config.model.sh_degree,
        near=options.near_plane,
        far=options.far_plane,
        background=options.background,
        levels=state.progress.level_count > 1,
        lod=state.progress.level_count > 1,
        smooth=state.config.view.smooth,
        box=box_of(state.table["means"]),
        cameras=capture.cameras,
        test=capture.test,
        photograph=lambda index: np.asarray(images.get(index).numpy()),
        paths=state.folder / "paths",
        frame=capture.about.source.frame,
    )
    try:
        page = Live(exhibit, state.schedule.iterations, host, port)
    except OSError as error:
        print(f"{error}; training goes on without the viewer", flush=True)
        return None
    print(f"viewer: open {page.page.url}", flush=True)
    return page
