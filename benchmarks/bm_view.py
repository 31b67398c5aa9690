# SPDX-License-Identifier: Apache-2.0
"""Measures the viewer: pictures a second that are drawn, and that a client on the same host receives.

    python benchmarks/bm_view.py [--gaussians 12000000] [--model RUN|FILE.ply] [--size 1920x1080]
                                 [--seconds 10] [--device cuda] [--json FILE]

A client without a browser orbits around the middle and counts the pictures that arrive, after two seconds of
warming up. "drawn alone" is the renderer of the viewer without server and client.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from harness import make_parser, report
from scenes import aerial

from blitzgs.config.fields import Config
from blitzgs.distributed.group import Ranks, extend_memory_in_place
from blitzgs.frame.ownership import TileOwners
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.view.draw import Drawer, intrinsics
from blitzgs.view.look import Look
from blitzgs.view.views import Space, render_options
from blitzgs.view.visible import Subject
from blitzgs.viewer.studio import Opened, Studio, box_of, open_model
from blitzgs.viewer.world import SCALE, Exhibit, World, looking

WARM_UP = 2.0


def synthetic(count: int, device: str) -> Opened:
    """Return the synthetic aerial scene as a model to show; trained units of 1 km."""
    scene, unit = aerial(count, device), 1024.0
    columns = scene.rows(morton_order(scene.means)).raw()
    columns["means"] /= unit
    columns["scales"] -= float(np.log(unit))
    table = GaussianTable.of_parameters(columns)
    space = Space((0.0, 0.0, 0.0), unit, 1.0)
    options = render_options(Config(), space, 3)
    exhibit = Exhibit(
        title="benchmark", space=space, sh_degree=3, background=options.background,
        levels=False, lod=False, smooth=False, box=box_of(table["means"]),
    )  # fmt: skip
    return Opened(exhibit, Subject(table, options, space, None), Ranks(device=torch.device(device)))


def orbit(opened: Opened) -> tuple[list[float], float, float]:
    """Return middle, radius and height of the client's circle, page units."""
    box = SCALE * opened.exhibit.box
    extent = float(np.linalg.norm(box[1] - box[0])) / 2
    return box.mean(axis=0).tolist(), 0.5 * extent, 0.35 * extent


def drawn_alone(opened: Opened, size: tuple[int, int], seconds: float) -> dict[str, float]:
    """Draw the client's orbit without a server."""
    drawer, world = (
        Drawer(opened.subject, TileOwners(opened.ranks)),
        World(opened.exhibit.space, [], opened.exhibit.box),
    )
    middle, radius, height = orbit(opened)
    times, begin = [], time.monotonic()
    while (now := time.monotonic()) < begin + WARM_UP + seconds:
        angle = 0.3 * (now - begin)
        place = np.array(middle) + [radius * np.sin(angle), -radius * np.cos(angle), height]
        stance = looking(place, np.array(middle), np.array([0, 0, 1.0]), np.radians(50))
        look = Look(world.viewmat(stance), intrinsics(*size, stance.fov), *size)
        picture = drawer.draw(look)
        assert picture is not None
        if now > begin + WARM_UP:
            times.append(time.monotonic() - now)
    return {
        "drawn_alone_fps": len(times) / sum(times),
        "draw_ms": 1000 * float(np.median(times)),
        "draw_ms_p99": 1000 * float(np.quantile(times, 0.99)),
        "in_view": picture.gaussians,
    }


def served(opened: Opened, size: tuple[int, int], seconds: float) -> dict[str, float]:
    """Serve the page to a client in a process of its own."""
    import viser

    studio = Studio(opened, port=0)
    try:
        middle, radius, height = orbit(opened)
        options = {
            "url": studio.page.url, "version": viser.__version__, "warm_up": WARM_UP, "seconds": seconds,
            "middle": middle, "radius": radius, "height": height, "size": list(size),
        }  # fmt: skip
        program = Path(__file__).with_name("view_client.py")
        client = subprocess.Popen(
            [sys.executable, str(program), json.dumps(options)], stdout=subprocess.PIPE, text=True
        )
        end = time.monotonic() + 30
        while not studio.page.visitors and time.monotonic() < end and client.poll() is None:
            time.sleep(0.01)
        for visitor in list(studio.page.visitors.values()):
            visitor.change(most_side=max(size))
        time.sleep(WARM_UP)
        before, begin = studio.drawn, time.monotonic()
        time.sleep(max(0.1, seconds - 0.5))
        drawn = (studio.drawn - before) / (time.monotonic() - begin)
        found = next((visitor.shown for visitor in studio.page.visitors.values()), None)
        output, _ = client.communicate(timeout=seconds + 60)
    finally:
        studio.close()
    side = 0 if found is None else found.ask.look.width
    return {"drawn_fps": drawn, **json.loads(output.splitlines()[-1]), "width": side}


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--gaussians", type=int, default=12_000_000)
    parser.add_argument("--model", type=Path, help="a run or a PLY file instead of the synthetic scene")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args(arguments)
    extend_memory_in_place()  # as `blitzgs view`
    width, height = (int(text) for text in options.size.split("x"))
    ranks = Ranks(device=torch.device(options.device))
    opened = (
        synthetic(options.gaussians, options.device)
        if options.model is None
        else open_model(options.model, ranks)
    )
    on_gpu = ranks.device.type == "cuda"
    row: dict[str, float | str] = {
        "Gaussians": len(opened.table), "size": options.size, "model_mb": opened.bytes / 1e6
    }  # fmt: skip
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(ranks.device)
        held = torch.cuda.memory_allocated(ranks.device)
    row |= drawn_alone(opened, (width, height), options.seconds)
    row |= served(opened, (width, height), options.seconds)
    if on_gpu:
        row["mb_above_model"] = (torch.cuda.max_memory_reserved(ranks.device) - held) / 1e6
        row["mb_of_that_in_use"] = (torch.cuda.max_memory_allocated(ranks.device) - held) / 1e6
    report("The viewer", [row], options.json, options.device)


if __name__ == "__main__":
    main()
