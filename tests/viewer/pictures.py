# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of docs/guide/view.md.

    python -m tests.viewer.pictures RUN [--data CAPTURE]

RUN is the run of `make demo`; the live page trains its capture anew in a temporary folder for a while.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from blitzgs.cli.view import photographs
from blitzgs.distributed.group import Ranks
from blitzgs.report.report import look_of, write_report
from blitzgs.runs.folder import open_run
from blitzgs.viewer.studio import Studio, open_model
from blitzgs.viewer.web import web_file
from blitzgs.viewer.world import looking
from tests.browser import Browser, wait_for
from tests.viewer.test_page import settled

IMAGES = Path(__file__).parents[2] / "docs" / "images"
WIDTH = 1200


def save(browser: Browser, name: str) -> None:
    """Write the page as a JPEG file, without notes such as that on the missing graphics card."""
    browser.evaluate("document.querySelectorAll('[class*=Notification-root]').forEach(e => e.remove())")
    time.sleep(0.3)
    image = browser.screenshot()[..., ::-1]
    image = cv2.resize(image, (WIDTH, WIDTH * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / name), image, [cv2.IMWRITE_JPEG_QUALITY, 82])


def at_rest(run: Path, data: Path | None) -> None:
    studio = Studio(open_model(run, Ranks(), photographs(run, data)), port=0)
    with Browser(studio.page.url, 1600, 900) as browser:
        wait_for(browser.figures, 120, "a picture")
        visitor = settled(studio)
        world, start = studio.page.world, studio.page.world.start()
        visitor.go(
            looking(world.middle + 1.15 * (start.position - world.middle), world.middle, world.up, 0.9), 5
        )
        settled(studio)
        save(browser, "view_page.jpg")
        visitor.stand_at(studio.page.exhibit.test[len(studio.page.exhibit.test) // 2])
        visitor.change(comparison="wipe", wipe=0.5)
        settled(studio)
        save(browser, "view_compare.jpg")
    studio.close()


def report(run: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = write_report(run, look_of(run), Path(folder) / "report.html")
        with Browser(f"file://{file}", 1200, 1240) as browser:
            wait_for(
                lambda: browser.evaluate("document.querySelectorAll('.chart').length > 3"), 60, "the page"
            )
            browser.evaluate("document.querySelector('header p').remove()")  # the path of the run
            time.sleep(1)
            save(browser, "report.jpg")


def sent(run: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.html"
        file.write_text(web_file(open_model(run, Ranks()), 50_000_000).text)
        with Browser(file.as_uri(), 1280, 720) as browser:
            wait_for(lambda: browser.evaluate("window.blitzgs?.scene.count"), 60, "the page's program")
            browser.evaluate("blitzgs.ready")
            browser.drag((700, 300), (560, 290))
            time.sleep(3)
            save(browser, "scene_page.jpg")


def live(data: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "blitzgs", "train", "--config", "smoke", "--data", str(data)]
        training = subprocess.Popen(
            [*command, "--out", f"{folder}/city", "--viewer=0"],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        url = next(line.split()[-1] for line in training.stdout if "viewer: open" in line)
        with Browser(url, 1600, 900) as browser:
            wait_for(browser.figures, 120, "a picture")
            next(line for line in training.stdout if line.strip().startswith("400/"))
            time.sleep(8)
            save(browser, "view_live.jpg")
        os.kill(training.pid, signal.SIGTERM)
        training.communicate(timeout=120)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path)
    args = parser.parse_args()
    report(args.run)
    at_rest(args.run, args.data)
    sent(args.run)
    live(args.data or Path(open_run(args.run).config().data.path))


if __name__ == "__main__":
    main()
