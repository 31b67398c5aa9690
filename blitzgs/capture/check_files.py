# SPDX-License-Identifier: Apache-2.0
"""Checks photographs and masks for damage before they are needed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Container, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from blitzgs.capture.cameras import Camera
from blitzgs.capture.image_files import check_photograph, decode_mask, read_whole
from blitzgs.util.messages import warn

_THREADS = 16
# Returns what is wrong with photographs and their masks, as `damaged` does.
FindDamage = Callable[[Sequence[tuple[Path, Path | None]]], dict[int, str]]


def mask_error(error: Exception) -> ValueError:
    """Return an error that says that the file is a mask."""
    return ValueError(f"the mask {error}")


def read_mask_file(path: Path) -> None:
    """Decode a mask (ValueError: it is damaged; says that it is a mask)."""
    try:
        decode_mask(read_whole(path))
    except ValueError as error:
        raise mask_error(error) from error


def damaged(files: Sequence[tuple[Path, Path | None]]) -> dict[int, str]:
    """Return what is wrong with photographs and their masks, by index; those without damage are left out."""

    def problem(pair: tuple[Path, Path | None]) -> str | None:
        try:
            check_photograph(pair[0])
            if pair[1] is not None:
                read_mask_file(pair[1])
        except (OSError, ValueError) as error:
            return str(error)
        return None

    with ThreadPoolExecutor(_THREADS) as pool:
        return {i: text for i, text in enumerate(pool.map(problem, files)) if text is not None}


class FileCheck:
    """Checks the files of views one after the other in a thread of its own, while others are in use."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        order: Sequence[int],
        counted: Callable[[Camera], bool],
        whole: Container[Path],
    ) -> None:
        """Start to check files.

        `counted`: decodes a view's mask, and tells whether some pixel counts. `whole`: files of opaque
        photographs that others have checked meanwhile.
        """
        # What is wrong with the first damaged file that was found; None so far.
        self.damage: str | None = None
        self._cameras, self._order, self._counted, self._whole = cameras, order, counted, whole
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="blitzgs-check", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread; files that were not checked yet stay unchecked."""
        self._stop.set()
        self._thread.join()

    def wait(self) -> None:
        """Wait until all files are checked or one is damaged."""
        self._thread.join()

    def _run(self) -> None:
        blank = []
        for index in self._order:
            if self._stop.is_set():
                return
            camera = self._cameras[index]
            try:
                has_pixels = camera.image_path in self._whole or check_photograph(camera.image_path)
                if camera.mask_path is not None:
                    has_pixels = self._counted(camera) and has_pixels
            except (OSError, ValueError) as error:
                self.damage = str(error)
                return
            if not has_pixels:
                blank.append(camera.name)
        if blank:
            warn(
                f"{len(blank)} photographs have no pixel that counts, as they are transparent or masked "
                f"everywhere (first: {blank[0]})"
            )
