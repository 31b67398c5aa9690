# SPDX-License-Identifier: Apache-2.0
"""Drives a headless Chromium through the DevTools protocol, without a driver of its own."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

try:
    import websocket
except ImportError:  # websocket-client, of the extra test
    websocket = None

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


class Browser:
    """One page of a headless Chromium, with WebGL on the CPU; without Chromium, the test is skipped."""

    def __init__(self, url: str, width: int = 1280, height: int = 720):
        program = next((path for name in NAMES if (path := shutil.which(name))), None)
        if program is None or websocket is None:
            pytest.skip(
                "Chromium or websocket-client is missing: install them (Debian: apt-get install chromium)"
            )
        self.folder = tempfile.mkdtemp(prefix="browser_")
        self.process = subprocess.Popen(
            [
                program, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle",
                "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0",
                "--remote-allow-origins=*", "--hide-scrollbars", "--no-first-run", "--mute-audio",
                f"--user-data-dir={self.folder}", f"--window-size={width},{height}", "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        port_file = Path(self.folder) / "DevToolsActivePort"
        wait_for(lambda: port_file.exists() and port_file.read_text().strip(), 30, "Chromium starts")
        port = int(port_file.read_text().split()[0])
        pages = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10))
        address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
        self.socket = websocket.create_connection(address, timeout=60)
        self.number, self.messages = 0, []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.call("Page.navigate", url=url)

    def call(self, method: str, **params):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message.get("result", {})
            self.messages.append(message)

    def go(self, url: str):
        """Open another page, and wait until its program is ready."""
        self.call("Page.navigate", url=url)
        wait_for(lambda: self.evaluate("location.href") == url, 30, "the page is open")
        wait_for(lambda: self.evaluate("typeof blitzgs !== 'undefined'"), 30, "its program runs")
        self.evaluate("blitzgs.ready")

    def errors(self) -> list[str]:
        """Return the page's exceptions and error messages so far."""
        found = []
        self.evaluate("0")  # collects what has arrived
        for message in self.messages:
            method, params = message.get("method"), message.get("params", {})
            if method == "Runtime.exceptionThrown":
                found.append(str(params["exceptionDetails"]))
            elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
                found.append(" ".join(str(part.get("value")) for part in params["args"]))
            elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
                found.append(f"{params['entry']['text']} {params['entry'].get('url', '')}")
        return found

    def evaluate(self, expression: str):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def screenshot(self, path: Path | str | None = None) -> np.ndarray:
        """Return the page, uint8 RGB [H, W, 3]; write it if a path is given."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            Path(path).write_bytes(data)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def mouse(self, kind: str, x: float, y: float, button: str = "left", buttons: int = 1, clicks: int = 1):
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=clicks
        )

    def click(self, x: float, y: float):
        self.mouse("mouseMoved", x, y, "none", 0, 0)
        time.sleep(0.2)
        self.mouse("mousePressed", x, y)
        time.sleep(0.05)
        self.mouse("mouseReleased", x, y, buttons=0)

    def drag(self, start, end, steps: int = 8, pause: float = 0.03):
        self.mouse("mouseMoved", *start, "none", 0, 0)
        self.mouse("mousePressed", *start)
        for step in range(1, steps + 1):
            x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            self.mouse("mouseMoved", x, y)
            time.sleep(pause)
        self.mouse("mouseReleased", *end, buttons=0)

    def place_of(self, text: str):
        """Return the middle of the innermost visible element with a text, (x, y); None: there is none."""
        found = self.evaluate(
            f"""(() => {{
              const all = [...document.querySelectorAll('button,label,div,span,p,input,a')];
              const found = all.filter(e => e.textContent.trim() === {json.dumps(text)} && e.offsetParent);
              if (!found.length) return null;
              const e = found[found.length - 1];
              e.scrollIntoView({{block: 'center'}});
              const box = e.getBoundingClientRect();
              return [box.x + box.width / 2, box.y + box.height / 2];
            }})()"""
        )
        return None if found is None else tuple(found)

    def press(self, text: str, timeout: float = 60):
        """Click on the element with a text."""
        wait_for(lambda: self.place_of(text), timeout, f"{text!r} is on the page")

        def rests():
            before = self.place_of(text)
            time.sleep(0.4)  # folders open slowly
            return before is not None and self.place_of(text) == before

        wait_for(rests, timeout, f"{text!r} rests")
        self.click(*self.place_of(text))

    def press_until(self, text: str, shown: str):
        """Click on the element with a text until another text shows: a page in motion may lose a click."""

        def shows():
            if not self.place_of(shown):
                self.press(text)
            with contextlib.suppress(AssertionError):
                return wait_for(lambda: self.place_of(shown), 10, shown)

        wait_for(shows, 60, f"{shown!r} shows after {text!r}")

    def figures(self) -> str:
        """Return the figures over the picture; empty before the first."""
        return self.evaluate("document.getElementById('blitzgs-figures')?.innerText ?? ''")

    def close(self):
        with contextlib.suppress(Exception):
            self.call("Browser.close")
        self.socket.close()
        try:
            self.process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def wait_for(condition, seconds: float, what: str):
    """Wait until a condition holds, and return its value."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.1)
    raise AssertionError(f"not within {seconds} s: {what}")
