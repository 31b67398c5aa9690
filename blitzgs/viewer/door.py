# SPDX-License-Identifier: Apache-2.0
"""The one port of the page: lets in who may, and passes their bytes on to the web server behind it.

Without a token, only pages and programs that name this machine as localhost get in; a web site that the
browser shows at the same time does not. With a token, the page's address begins with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import os
import socket
import threading
from concurrent.futures import Future
from urllib.parse import urlsplit

_MAX_HEAD = 32_768
_HEAD_SECONDS = 15.0
_CHUNK = 1 << 18


def unheard(host: str, port: int, error: OSError | OverflowError) -> OSError:
    """Return the message of a viewer that cannot listen at its address, or at a number that is no port."""
    if isinstance(error, OverflowError):
        why = "ports are 0 to 65535"
    elif isinstance(error, socket.gaierror):
        why = "no such host"
    else:
        why = os.strerror(error.errno or 0)  # the error's own text may repeat the address
    return OSError(f"the viewer cannot listen on {host}:{port} ({why}): choose another port (0: any) or host")


class Door:
    """Listens on an address, on its `port`, and forwards to a port of 127.0.0.1."""

    def __init__(self, host: str, port: int, behind: int, token: str) -> None:
        """Listen (OSError: the address is not this machine's, or the port is in use).

        `port`: 0: any free one. `behind`: port of 127.0.0.1 to forward to. `token`: beginning of the
        address's path; empty: none is needed.
        """
        self._behind, self._token = behind, token
        self._started: Future[int] = Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve(host, port)), daemon=True, name="viewer door"
        )
        self._thread.start()
        try:
            self.port = self._started.result()
        except (OSError, OverflowError) as error:
            raise unheard(host, port, error) from error

    def close(self) -> None:
        """Stop listening and end all connections."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._ends.set)
        self._thread.join(timeout=2)

    async def _serve(self, host: str, port: int) -> None:
        """Listen until `close`; `asyncio.run` then ends all visits."""
        self._loop, self._ends = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await asyncio.start_server(self._visit, host, port)
        except Exception as error:
            self._started.set_exception(error)
            return
        self._started.set_result(server.sockets[0].getsockname()[1])
        await self._ends.wait()
        server.close()

    async def _visit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            # ValueError: the host or the origin is no address; EOFError: the visitor has gone.
            with contextlib.suppress(
                OSError, ValueError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError
            ):
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_SECONDS)
                answer, passed = self._judged(head[:_MAX_HEAD].decode("latin-1"))
                if passed is None:
                    writer.write(answer)
                    await writer.drain()
                else:
                    await self._pass_on(passed, reader, writer)
        finally:
            with contextlib.suppress(OSError, RuntimeError):
                writer.close()

    def _judged(self, head: str) -> tuple[bytes, bytes | None]:
        """Return an answer, or the request to pass on."""
        first, *lines = head.split("\r\n")
        headers = {
            name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)
        }
        method, _, rest = first.partition(" ")
        path, _, version = rest.rpartition(" ")
        if method not in ("GET", "HEAD"):
            return _answer("405 Method Not Allowed", "only GET"), None
        upgrades = headers.get("upgrade", "").lower() == "websocket"
        host = headers.get("host", "")
        if self._token:
            begin, _, query = path.partition("?")
            given, _, inner = begin.lstrip("/").partition("/")
            if not hmac.compare_digest(given.encode(), self._token.encode()):
                return _answer("403 Forbidden", "this address needs the token that blitzgs printed"), None
            if begin == f"/{self._token}" and not upgrades:  # relative addresses need the slash
                return _answer(
                    "302 Found", "", f"Location: /{self._token}/{'?' + query if query else ''}\r\n"
                ), None
            path = f"/{inner}" + (f"?{query}" if query else "")
        elif not _is_local(host):
            return _answer("403 Forbidden", "open http://localhost or http://127.0.0.1 instead"), None
        origin = headers.get("origin")
        if upgrades and origin is not None and urlsplit(origin).netloc != host:
            return _answer("403 Forbidden", "another site's page may not use this viewer"), None
        if not upgrades:  # one request a connection, so that each is judged
            lines = [line for line in lines if not line.lower().startswith("connection:")]
            lines.insert(0, "Connection: close")
        return b"", "\r\n".join([f"{method} {path} {version}", *lines]).encode("latin-1")

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        upgrades = b"\r\nupgrade: websocket" in head.lower()
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._behind)
        try:
            inner_writer.write(head)
            ways = [_copy(inner_reader, writer)]
            if upgrades:
                ways.append(_copy(reader, inner_writer))
            tasks = [asyncio.ensure_future(way) for way in ways]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            inner_writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while chunk := await reader.read(_CHUNK):
        writer.write(chunk)
        await writer.drain()


def is_loopback(host: str) -> bool:
    """Tell whether an address to listen on is reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _is_local(host: str) -> bool:
    """Tell whether a header "Host: NAME:PORT" names this machine by an address that no name server gives."""
    name = urlsplit(f"//{host}").hostname or ""
    return is_loopback(name) or name.endswith(".localhost")


def _answer(status: str, text: str, extra: str = "") -> bytes:
    body = (text + "\n").encode()
    return (
        f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(body)}\r\n"
        f"{extra}Connection: close\r\n\r\n"
    ).encode() + body
