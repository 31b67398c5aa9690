# SPDX-License-Identifier: Apache-2.0
"""Measures images per second of the image store: cold, from compressed memory, and from the decoded cache.

python benchmarks/bm_images.py --data DIR [--downscale 2] [--threads 4] [--rounds 3]
Without --data: 24 JPEG photographs of noise, 2000 x 1500, are made for it.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from harness import make_parser, write_json

from blitzgs.capture.capture import Capture, load_capture
from blitzgs.capture.colmap import ColmapCamera, ColmapImages, ColmapModel, write_model
from blitzgs.capture.images import ImageStore


def make_capture(root: Path, count: int = 24, width: int = 2000, height: int = 1500) -> None:
    random = np.random.default_rng(0)
    names = [f"{i:03d}.jpg" for i in range(count)]
    (root / "images").mkdir()
    for name in names:
        noise = random.integers(0, 256, (height // 4, width // 4, 3), dtype=np.uint8)
        cv2.imwrite(
            str(root / "images" / name), cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
        )
    camera = ColmapCamera(1, "OPENCV", width, height, np.array([1600, 1600, 1000, 750, -0.1, 0.02, 0, 0.0]))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    ones = np.ones(count, dtype=np.uint32)
    translations = random.normal(size=(count, 3))
    offsets = np.zeros(count + 1, dtype=np.uint64)
    images = ColmapImages(np.cumsum(ones, dtype=np.uint32), ones, quats, translations, names, offsets)
    write_model(root / "sparse" / "0", ColmapModel([camera], images))


def throughput(store: ImageStore, ahead: int, rounds: int) -> float:
    """Return images per second in a shuffled order; `ahead`: images decoded ahead of their use."""
    count = len(store.capture.cameras)
    order = np.concatenate([np.random.default_rng(r).permutation(count) for r in range(rounds)]).tolist()
    begin = time.perf_counter()
    for position, index in enumerate(order):
        store.prefetch(order[position : position + ahead])
        store.get(index)
    return len(order) / (time.perf_counter() - begin)


def report(capture: Capture, threads: int, rounds: int) -> dict[str, float]:
    """Print and return images per second by source, and the size of the compressed images."""
    camera = capture.cameras[0]
    raw = 3 * camera.width * camera.height
    source = camera.rectification.lens
    print(
        f"{len(capture.cameras)} images, {source.width} x {source.height} -> {camera.width} x {camera.height}"
    )
    few = ImageStore(capture, threads=threads, decoded_bytes=8 * threads * raw)
    results = {"cold, files to pixels": throughput(few, 2 * threads, 1)}
    results["from compressed memory"] = throughput(few, 2 * threads, rounds)
    part = few.compressed.bytes / len(capture.cameras) / raw
    ample = ImageStore(capture, threads=threads, decoded_bytes=2 * raw * len(capture.cameras))
    throughput(ample, 2 * threads, 1)
    results["from the decoded cache"] = throughput(ample, 2 * threads, rounds)
    for name, rate in results.items():
        print(f"{name:28s} {rate:8.1f} images/s")
    print(f"{'compressed':28s} {part:8.2f} of the raw pixels")
    return results | {"compressed share of the raw pixels": part}


def main() -> None:
    parser = make_parser(__doc__, device=None)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--downscale", type=float, default=2)
    parser.add_argument("--threads", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if args.data is None:
            make_capture(Path(folder))
        begin = time.perf_counter()
        capture = load_capture(args.data or folder, downscale=args.downscale)
        print(f"load_capture                 {1e3 * (time.perf_counter() - begin):8.1f} ms")
        results = report(capture, args.threads, args.rounds)
    if args.json:
        write_json(args.json, "cpu", results=results)


if __name__ == "__main__":
    main()
