# SPDX-License-Identifier: Apache-2.0
"""The page: a web server on one port, the capture's cameras in the scene, and the visitors."""

from __future__ import annotations

import contextlib
import io
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import TYPE_CHECKING, Any

from blitzgs.util.errors import optional_package, warn
from blitzgs.view.look import Picture
from blitzgs.viewer.door import Door, is_loopback
from blitzgs.viewer.frustums import Frustums
from blitzgs.viewer.panel import Panel, overlay
from blitzgs.viewer.settings import MOVING_MS
from blitzgs.viewer.visitor import Ask, Visitor
from blitzgs.viewer.world import Exhibit, World

if TYPE_CHECKING:
    import viser

# Seconds that a picture waits to be sent: a photograph to compare with may come from a slow disk.
_SEND_SECONDS = 1.0
# Seconds between two updates of the figures on the page.
_FIGURES_SECONDS = 0.2


def require_viser() -> ModuleType:
    """Import the optional package of the viewer (ImportError: says how to install it)."""
    return optional_package("viser", "view", "the viewer")


class Page:
    """Serves the page at `url`; the caller draws what `next_ask` returns and gives it to `deliver`."""

    def __init__(
        self,
        exhibit: Exhibit,
        host: str = "127.0.0.1",
        port: int = 8080,
        folders: Callable[[Any], None] | None = None,
        memory: Callable[[], str] = lambda: "",
        moving_ms: float = MOVING_MS,
    ) -> None:
        """Start to serve.

        Args:
            host: address to listen on. If others than this machine reach it, a random token is part of `url`.
            port: 0: any free one.
            folders: called for each new visitor with viser's handle, to add folders of the caller's own.
            memory: returns the memory of the model as text.
            moving_ms: milliseconds that a picture may take while the camera moves.

        Raises:
            ImportError: viser is not installed.
            OSError: the address is not this machine's, or the port is in use.
        """
        viser = require_viser()
        self.exhibit, self.folders, self.memory = exhibit, folders, memory
        self.woken = threading.Event()  # set when a picture may be needed
        self.visitors: dict[int, Visitor] = {}  # those who look at present, by viser's numbers
        self.send_seconds = 0.0  # of a processor, that packing pictures has taken so far
        self._moving_ms = moving_ms
        self._turn = 0
        self._sender = ThreadPoolExecutor(1, "viewer sender")
        self._sending = threading.Semaphore(2)
        self.world = World(exhibit.space, exhibit.cameras, exhibit.box, exhibit.up)
        # Its address behind the door is nobody's concern.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(host="127.0.0.1", port=0, label=exhibit.title, verbose=False)
        try:
            token = "" if is_loopback(host) else secrets.token_urlsafe(16)
            self._door = Door(host, port, self._server.get_port(), token)
        except OSError:
            with contextlib.redirect_stdout(io.StringIO()):
                self._server.stop()
            raise
        shown = "localhost" if is_loopback(host) else host
        self.url = f"http://{shown}:{self._door.port}/" + (f"{token}/" if token else "")
        self._set_up()

    def _set_up(self) -> None:
        server, world = self._server, self.world
        server.gui.configure_theme(
            control_width="large", dark_mode=True, show_logo=False, show_share_button=False
        )
        server.gui.set_panel_label(self.exhibit.title)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction(world.up)
        server.scene.world_axes.visible = False
        start = world.start()
        server.initial_camera.position = start.position
        server.initial_camera.look_at = world.middle
        server.initial_camera.up = world.up
        server.initial_camera.fov = start.fov
        self.frustums = Frustums(server, world, self.exhibit, self._stand)
        server.on_client_connect(self._enter)
        server.on_client_disconnect(self._leave)

    def _enter(self, client: viser.ClientHandle) -> None:
        visitor = Visitor(client, self.world, self.exhibit, self.woken.set, self._moving_ms)
        if self.folders is not None:
            self.folders(client)
        Panel(visitor, self.frustums)
        self.visitors[client.client_id] = visitor
        self.woken.set()

    def _leave(self, client: viser.ClientHandle) -> None:
        visitor = self.visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.is_gone = True
        self.woken.set()

    def _stand(self, client_id: int | None, index: int) -> None:
        for visitor in [v for number, v in list(self.visitors.items()) if client_id in (None, number)]:
            visitor.stand_at(index)

    def next_ask(self) -> Ask | None:
        """Return the next picture that a visitor waits for; they take turns. None: there is none."""
        visitors = list(self.visitors.values())
        for shift in range(len(visitors)):
            visitor = visitors[(self._turn + shift) % len(visitors)]
            try:
                ask = visitor.next_ask()
            except Exception as error:  # a browser may send anything
                warn(f"the viewer has dropped a visitor: {error}")
                self.visitors.pop(visitor.client.client_id, None)
                continue
            if ask is not None:
                self._turn += shift + 1
                return ask
        return None

    def deliver(self, ask: Ask, picture: Picture) -> None:
        """Send a picture to its visitor; drops it if two others have not been sent within a second."""
        if not self._sending.acquire(timeout=_SEND_SECONDS):
            return
        try:
            self._sender.submit(self._send, ask, picture)
        except RuntimeError:  # the page is closed
            self._sending.release()

    def _send(self, ask: Ask, picture: Picture) -> None:
        visitor, begin, busy = ask.visitor, time.monotonic(), time.thread_time()
        try:
            shown = visitor.take(ask, picture)
            if shown is None or visitor.client.client_id not in self.visitors:
                return
            visitor.shown = shown
            sharp = ask.scale >= 1.0
            image, quality = shown.shaded.image, 88 if sharp else 70
            visitor.client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
            if sharp or begin >= visitor.figured + _FIGURES_SECONDS:
                visitor.figured = begin
                visitor.figures.content = overlay(visitor, shown, self.memory())
        except Exception as error:
            # A browser that has gone, or one picture less: neither may end the page or a training.
            if visitor.client.client_id in self.visitors:
                warn(f"the viewer could not send a picture: {error}")
        finally:
            self.send_seconds += time.thread_time() - busy
            self._sending.release()

    def close(self) -> None:
        """Stop to serve."""
        self._door.close()
        with contextlib.suppress(Exception), contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()
        self._sender.shutdown(wait=False, cancel_futures=True)
