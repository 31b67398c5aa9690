# SPDX-License-Identifier: Apache-2.0
"""Shows a model at rest: opens it, and draws what the visitors of its page ask for."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.config.files import changed
from blitzgs.distributed.group import Ranks
from blitzgs.formats.gaussians import Gaussians, joined, up_of
from blitzgs.formats.models import offset_of, open_gaussians
from blitzgs.formats.selection import Selected, Selection
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs import run_files
from blitzgs.runs.cameras import stored_cameras
from blitzgs.runs.folder import open_run, subject_of
from blitzgs.runs.source import largest_of_run, open_source
from blitzgs.runs.world import config_of_file, load_world_frame, subject_of_file
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.util.errors import located
from blitzgs.view.draw import Drawer
from blitzgs.view.views import Space
from blitzgs.view.visible import Subject, table_of
from blitzgs.viewer.page import Page
from blitzgs.viewer.world import Exhibit

Photograph = Callable[[int], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Opened:
    """A model on its device, ready to be shown, without `unread` Gaussians (`open_model`)."""

    exhibit: Exhibit
    subject: Subject
    ranks: Ranks
    unread: int = 0

    @property
    def table(self) -> GaussianTable:
        """The Gaussians."""
        return table_of(self.subject.gaussians)

    @property
    def bytes(self) -> int:
        """Memory that the Gaussians take on the device."""
        return sum(self.table[name].nbytes for name in (*PARAMETERS, "level", "id"))


def open_model(
    path: Path,
    ranks: Ranks,
    photograph: Photograph | None = None,
    paths: Path | None = None,
    most: int | None = None,
) -> Opened:
    """Open the folder of a run, a checkpoint in it, or a file of Gaussians.

    Args:
        photograph: returns the photograph of a camera of the run; None: there are none.
        paths: folder for camera paths and screenshots; None: RUN/paths, or the folder of the file.
        most: Gaussians to read. Of a larger model, these are those of the largest opacity times length,
            without colours by direction; None: all.

    Raises:
        FileNotFoundError: there is no such file, or no run or checkpoint in the folder.
        ValueError: the file is damaged.
    """
    if path.is_file():
        return _open_file(path, ranks, paths or path.parent, most)
    path, checkpoint = run_files.run_and_checkpoint(path)
    source = None if most is None else open_source(path, checkpoint)
    if source is None or most is None or len(source) <= most:
        model = open_run(path).model(str(ranks.device), checkpoint)
        count, degree = len(model), model.sh_degree
    else:
        model = largest_of_run(source, most, ranks.device)
        count, degree = len(source), source.degree
    subject = subject_of(model)
    stored = stored_cameras(path)
    exhibit = Exhibit(
        title=path.resolve().name + (f" {checkpoint}" if checkpoint else ""),
        space=model.space,
        sh_degree=degree,
        background=subject.options.background,
        levels=bool((model.level > 0).any()),
        lod=model.lod is not None,
        smooth=model.lod is not None and model.lod.gate.smooth,
        box=box_of(model.means),
        cameras=stored.cameras,
        test=stored.test,
        photograph=photograph if stored.cameras else None,
        exposures=_exposures(model.exposures, stored.train),
        paths=paths or path / "paths",
        frame=load_world_frame(path),
    )
    return Opened(exhibit, subject, ranks, count - len(model))


def _exposures(found: Tensor | None, train: Sequence[int]) -> dict[int, npt.NDArray[np.float64]]:
    """Return the exposures of photographs by their cameras; empty if there are none, or those of others."""
    if found is None or len(found) != len(train):
        return {}
    return dict(zip(train, found.double().cpu().numpy(), strict=True))


def _open_file(path: Path, ranks: Ranks, paths: Path, most: int | None) -> Opened:
    source = open_gaussians(path)
    if len(source) == 0:
        raise ValueError(f"{path} holds no Gaussians")
    count, full_degree = len(source), source.degree
    if most is not None and count > most:
        source = Selected(source, Selection(most=most, sh_degree=0))
    found = source if isinstance(source, Gaussians) else joined(list(source.blocks()))
    box = box_of(found.means)
    middle, extent = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0])) / 2
    # Centred, so that float32 resolves the positions of a georeferenced model as finely as the file does.
    space = Space.of(middle + np.array(offset_of(found.comments)), max(extent, 1e-6))
    config = changed(config_of_file(found), "model", near=1e-3)
    with located(str(path)):
        subject = subject_of_file(found, config, space, ranks)
    lod = subject.lod
    exhibit = Exhibit(
        title=path.name,
        space=space,
        sh_degree=full_degree,
        background=subject.options.background,
        levels=found.levels is not None,
        lod=lod is not None,
        smooth=lod is not None and lod.gate.smooth,
        box=(box - middle) / space.unit,
        up=up_of(found.comments),
        paths=paths,
    )
    return Opened(exhibit, subject, ranks, count - len(found))


def box_of(means: Tensor) -> npt.NDArray[np.float64]:
    """Return the corners of a box that holds nearly all means and some room around, float64 [2, 3]."""
    some = means[:: max(1, len(means) // 100_000)].double().cpu()
    low, high = (torch.quantile(some, share, dim=0).numpy() for share in (0.01, 0.99))
    room = 0.15 * (high - low).max() + 1e-6
    return np.stack([low - room, high + room])


class Studio:
    """Draws for the visitors of a page until it is closed."""

    def __init__(self, opened: Opened, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start the page and the thread that draws; errors are those of `Page`."""
        self._drawer = Drawer(opened.subject, TileOwners(opened.ranks))
        count, size = len(opened.table), opened.bytes / 1e6
        memory = f"{count:,} in all &middot; {size:,.0f} MB"
        self.page = Page(opened.exhibit, host, port, memory=lambda: memory)  # the page
        self.drawn = 0  # number of pictures so far
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._draw, daemon=True, name="viewer studio")
        self._thread.start()

    def _draw(self) -> None:
        page = self.page
        while not self._ends.is_set():
            page.woken.clear()
            ask = page.next_ask()
            if ask is None:
                # Look again soon: a camera that rests for a while gets a finer picture.
                page.woken.wait(0.05 if page.visitors else 1.0)
                continue
            try:
                picture = self._drawer.draw(ask.look)
            except RuntimeError as error:  # most likely out of memory
                ask.visitor.failed(ask, str(error))
                continue
            self.drawn += 1
            if picture is not None:
                page.deliver(ask, picture)

    def close(self) -> None:
        """Stop drawing, and close the page."""
        self._ends.set()
        self.page.woken.set()
        self._thread.join(timeout=10)
        self.page.close()
