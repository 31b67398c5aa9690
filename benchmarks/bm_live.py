# SPDX-License-Identifier: Apache-2.0
"""Measures what the live page costs a training: without it, with nobody looking, with a client that orbits.

    python benchmarks/bm_live.py --data CAPTURE [--config smoke] [--repeats 3] [--device cpu]
                                 [--json FILE] [section.field=value ...]

Every repeat trains the three kinds one after another, so that a machine with other work treats them alike.
"images_per_second" is the median; "serving" is the share of the training's time between two steps that
pictures took, and "sending" that of one processor that packing them took.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from harness import make_parser, report

from blitzgs.config.files import load_config, recipe_path
from blitzgs.distributed.group import Ranks, resolve_device
from blitzgs.training.inputs import open_capture
from blitzgs.training.trainer import Trainer
from blitzgs.training.watching import Watching

KINDS = ("no viewer", "nobody looks", "a client orbits")


def train(kind: str, options) -> dict[str, float]:  # noqa: ANN001
    """Train once; return the figures."""
    config = load_config(
        recipe_path(options.config),
        [f"data.path={options.data}", "log.tensorboard=false", *options.fields],
    )
    device, _ = resolve_device(options.device, 0, 1, False)
    ranks = Ranks(device=device)
    capture, images = open_capture(config, ranks)
    client = None
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, capture, images, Path(folder) / "run", ranks)
        serving = [0.0]
        live = None
        if kind != KINDS[0]:
            from blitzgs.cli.train import live_page

            live = live_page(trainer.state, 0, "127.0.0.1")
            trainer.watch(live)
            _time_serving(serving)
        if live is not None and kind == KINDS[2]:
            client = _client(live)
        # The evaluation at the end is not part of the speed.
        trainer.finish = lambda agreement: {}  # type: ignore[method-assign]
        trainer.train()
        seconds = trainer.state.progress.seconds
        found = {
            "images_per_second": trainer.state.images_seen / seconds,
            "serving": serving[0] / seconds,
            "sending": 0.0 if live is None else live.page.send_seconds / seconds,
            "pictures_per_second": 0.0 if live is None else live.drawn / seconds,
        }
        if client is not None:
            client.kill()
            client.wait()
    images.close()
    return found


def _time_serving(total: list[float]) -> None:
    """Add up the time of `Watching.serve`."""
    original = getattr(Watching.serve, "original", Watching.serve)

    def serve(self, stops):  # noqa: ANN001, ANN202
        begin = time.perf_counter()
        original(self, stops)
        total[0] += time.perf_counter() - begin

    serve.original = original  # type: ignore[attr-defined]
    Watching.serve = serve  # type: ignore[method-assign]


def _client(live) -> subprocess.Popen[str]:  # noqa: ANN001
    import viser

    world = live.page.world
    start = world.start()
    options = {
        "url": live.page.url, "version": viser.__version__, "warm_up": 1.0, "seconds": 3600.0,
        "middle": world.middle.tolist(), "radius": 3.0, "height": float(start.position[2]),
        "size": [1920, 1080], "moves": True,
    }  # fmt: skip
    program = Path(__file__).with_name("view_client.py")
    return subprocess.Popen(
        [sys.executable, str(program), json.dumps(options)], stdout=subprocess.DEVNULL, text=True
    )


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__, repeats=3)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--config", default="smoke")
    parser.add_argument("fields", nargs="*", help="fields of the configuration, section.field=value")
    options = parser.parse_args(arguments)
    runs: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    for _ in range(options.repeats):
        for kind in KINDS:
            runs[kind].append(train(kind, options))
    rows = [
        {"kind": kind} | {name: statistics.median(run[name] for run in found) for name in found[0]}
        for kind, found in runs.items()
    ]
    base = rows[0]["images_per_second"]
    for row in rows:
        row["relative"] = row["images_per_second"] / base
    report("Cost of the live page", rows, options.json, options.device)


if __name__ == "__main__":
    main()
