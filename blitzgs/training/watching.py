# SPDX-License-Identifier: Apache-2.0
"""Serves those who watch a training: draws pictures between two steps, pauses and saves on request."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import Any

from blitzgs.frame.ownership import TileOwners
from blitzgs.training.events import save
from blitzgs.training.state import TrainingState
from blitzgs.util.errors import warn
from blitzgs.view.draw import Drawer, DrawingError
from blitzgs.view.look import Watcher, Wish

# Seconds between two questions to the watcher while the training is paused and nothing is to be drawn.
_PAUSE_SECONDS = 0.03


class Watching:
    """Stands between a training and its watcher; every rank has one, and rank 0's knows the watcher."""

    def __init__(self, state: TrainingState, watcher: Watcher | None) -> None:
        """Prepare; `watcher` is None on ranks other than 0."""
        self._state, self._watcher = state, watcher

    def wants(self) -> bool:
        """Tell whether this rank's watcher has a wish."""
        return self._watcher is not None and bool(self._asked("wants"))

    def told(self, t: int, values: Mapping[str, Any]) -> None:
        """Pass a record of the log on."""
        self._asked("told", t, values)

    def serve(self, stops: Callable[[], bool]) -> None:
        """Fulfil what the watcher wants between two steps, until `stops`; every rank calls this together."""
        wish = self._next()
        if wish.pause:
            with self._state.paused_clock(), self._state.stage("paused"):
                while wish.pause and not stops():
                    self._fulfil(wish)
                    if wish.look is None:
                        time.sleep(_PAUSE_SECONDS)
                    wish = self._next()
        if not wish.pause:
            with self._state.stage("viewer"):
                self._fulfil(wish)

    def close(self) -> None:
        """Tell the watcher that the training has ended."""
        self._asked("close")
        self._watcher = None

    def _next(self) -> Wish:
        return self._state.ranks.broadcast_object(self._asked("wish") or Wish())

    def _fulfil(self, wish: Wish) -> None:
        if wish.save:
            save.save_checkpoint(self._state)
            if wish.pause:  # no step comes after which it would be finished
                save.finish_checkpoint(self._state)
        if wish.look is None:
            return
        begin, state = time.perf_counter(), self._state
        try:
            state.stepper.write_back()  # a pool takes the rows that the view sees
            picture = Drawer(state.subject(), TileOwners(state.ranks)).draw(wish.look)
        except Exception as error:
            if state.ranks.world_size > 1 and not isinstance(error, DrawingError):
                raise  # the other ranks are in the middle of the picture
            self._asked("failed", str(error))
            return
        if picture is not None:
            self._asked("show", picture, time.perf_counter() - begin)

    def _asked(self, method: str, *arguments: Any) -> Any:
        """Call a method of the watcher; None without one, or if it fails. After an error it is gone."""
        if self._watcher is None:
            return None
        try:
            return getattr(self._watcher, method)(*arguments)
        except Exception as error:
            watcher, self._watcher = self._watcher, None
            warn(f"the viewer failed ({type(error).__name__}: {error}); training goes on without it")
            with contextlib.suppress(Exception):
                watcher.close()
            return None
