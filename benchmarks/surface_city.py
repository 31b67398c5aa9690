# SPDX-License-Identifier: Apache-2.0
"""Writes a model of the size of a synthetic city without training it: Gaussians on the surfaces it shows.

    python benchmarks/surface_city.py FILE.ply [--preset city] [--millions 12] [--processes 2]

Every view of the preset's flight gives as many random pixels: a Gaussian lies flat where the pixel's ray
meets the city, has the colour of the photograph there, and is as large as its share of the city's area. The
SH coefficients that depend on the direction are noise, so that files have the bytes of a trained model.
`bm_tiles.py` measures flights over its tiles.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np
import torch
from harness import make_parser

from blitzgs.formats.gaussians import SH_C0
from blitzgs.formats.ply import write_ply
from blitzgs_synth.flight import View, plan_flight
from blitzgs_synth.photographs import each
from blitzgs_synth.plan import PRESETS, Doubles, Plan
from blitzgs_synth.render import SAMPLES, City

OPACITY = 2.2  # logit
THICKNESS = 0.08  # of the size


def surface(city: City, views: list[View], count: int, number: int) -> Doubles:
    """Return position, normal and colour, [M, 9], at `count` random pixels of a view that see the city."""
    view, random = views[number], np.random.default_rng([7, number])
    pixels = np.floor(random.random((count, 2)) * [view.width, view.height]).astype(np.float32)
    colors = city.shade(view, (pixels[None] + SAMPLES[:, None]).reshape(-1, 2)).T
    hits = city.hit(view, pixels + 0.5)
    positions = view.centre + view.directions(pixels + 0.5) * hits.distance[:, None]
    a, b, c = city.mesh.triangles[hits.triangle].astype(np.float64).swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = (hits.triangle >= 0) & (np.abs(positions[:, :2]).max(1) < 0.75 * city.plan.options.extent)
    return np.concatenate([positions, normals, colors], 1)[seen]


def turns_to(normals: Doubles) -> Doubles:
    """Return quaternions (w, x, y, z) [M, 4] that turn the z axis to unit normals [M, 3]."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(z)], 1)
    quats[z < -0.9999] = [0, 1, 0, 0]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__, device=None, writes_json=False)
    parser.add_argument("file", type=Path)
    parser.add_argument("--preset", choices=PRESETS, default="city")
    parser.add_argument("--millions", type=float, default=12, help="about so many Gaussians (%(default)s)")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="(%(default)s)")
    args = parser.parse_args(arguments)
    options = PRESETS[args.preset]
    city, views = City(Plan(options)), plan_flight(options)
    count = -(-int(args.millions * 1e6) // len(views))
    found = np.concatenate(list(each(partial(surface, city, views, count), len(views), args.processes)))
    positions, normals, colors = (torch.from_numpy(part) for part in np.split(found, 3, axis=1))
    generator = torch.Generator().manual_seed(2)
    size = 0.8 * np.sqrt((1.5 * options.extent) ** 2 / len(found))
    scales = np.log(size) + 0.4 * torch.randn(len(found), 3, generator=generator)
    scales[:, 2] = np.log(THICKNESS * size)
    sh = torch.randn(len(found), 16, 3, generator=generator).mul_(0.02)
    sh[:, 0] = (colors - 0.5) / SH_C0
    write_ply(
        args.file, means=positions.float(), quats=torch.from_numpy(turns_to(normals.numpy())).float(),
        scales=scales, opacities=torch.full((len(found),), OPACITY), sh=sh,
    )  # fmt: skip
    print(f"{args.file}: {len(found):,} Gaussians")


if __name__ == "__main__":
    main()
