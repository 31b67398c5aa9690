# SPDX-License-Identifier: Apache-2.0
"""Make the pictures of docs/guide/first-model.md, by its own commands.

    python docs/site/tutorial.py FOLDER

FOLDER gets the synthetic city and the run; what it has already is used again. Takes some minutes on a CPU.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

IMAGES = Path(__file__).resolve().parents[1] / "images"
VIEW = "00040_oblique_e.jpg"  # held out
PHOTOGRAPHS = (2, 26, 42, 58)  # in the order of their names
EVALUATE_EVERY = 250  # images
GAP = 6


def blitzgs(*words: str) -> None:
    """Run a command of BlitzGS."""
    subprocess.run([sys.executable, "-m", "blitzgs", *words], check=True)


def read(path: Path) -> NDArray[np.uint8]:
    """Return an image, BGR [H, W, 3]."""
    image = cv2.imread(str(path))
    assert image is not None, f"{path} cannot be read"
    return np.asarray(image, np.uint8)


def beside(images: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return images of one height beside each other, with white gaps."""
    parts = [part for image in images for part in (image, np.full((len(image), GAP, 3), 255, np.uint8))]
    return np.hstack(parts[:-1])


def in_pairs(images: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return two rows of two images, which a phone can show."""
    rows = [beside(images[:2]), beside(images[2:])]
    return np.vstack([rows[0], np.full((GAP, rows[0].shape[1], 3), 255, np.uint8), rows[1]])


def save(name: str, image: NDArray[np.uint8]) -> None:
    """Write a picture of the docs."""
    cv2.imwrite(str(IMAGES / name), image, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main() -> None:
    """Train if needed, and write the pictures."""
    folder = Path(sys.argv[1])
    capture, run = folder / "capture", folder / "runs" / "first"
    blitzgs("synth", str(capture), "--preset", "demo")
    if not (run / "summary.json").exists():
        flag = f"--schedule.evaluate_every={EVALUATE_EVERY}"
        blitzgs("train", "--config", "smoke", "--data", str(capture), "--out", str(run), flag)
    photographs = sorted((capture / "images").iterdir())
    save("tutorial_capture.jpg", in_pairs([read(photographs[number]) for number in PHOTOGRAPHS]))
    panels = [read(found / VIEW) for found in sorted((run / "evaluation").glob("[0-9]*"))]
    width = panels[-1].shape[1] // 3  # render, photograph, error
    stages = [panel[:, :width] for panel in (panels[0], panels[2], panels[-1])]
    save("tutorial_progress.jpg", in_pairs([*stages, panels[-1][:, width : 2 * width]]))
    save("tutorial_evaluation.jpg", panels[-1])


if __name__ == "__main__":
    main()
