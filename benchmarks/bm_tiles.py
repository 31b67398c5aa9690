# SPDX-License-Identifier: Apache-2.0
"""Measures what views of a tileset load, and how far they are from the whole model, along a flight.

    blitzgs export RUN --tiles CITY
    python benchmarks/bm_tiles.py CITY [--errors 4 16 64] [--frames 12] [--device cuda] [--json FILE]

The flight comes from above towards the middle of the scene, by the same ratio of distances from frame to
frame. For each frame and error in pixels, the tiles are chosen as the page chooses them (without a budget),
read from the GLB files, rendered, and compared with the picture of the model, which is in the leaves. A view
loads more than it shows: the tiles above those that it shows.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bm_formats import read
from harness import make_parser, report
from torch import Tensor

from blitzgs import rasterization
from blitzgs.table.table import PARAMETERS
from blitzgs.view.draw import intrinsics
from blitzgs.viewer.world import looking

# The flight begins and ends at these multiples of the distance of the page's first view.
FARTHEST, NEAREST = 4.0, 0.05


@dataclass
class Tile:
    """A tile of the tree; rows of its Gaussians among those of all tiles."""

    centre: np.ndarray
    half: np.ndarray
    error: float
    children: list[Tile]
    rows: slice
    bytes: int


class City:
    """All tiles of a tileset, on a device."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        """Read all files."""
        tileset = json.loads((folder / "tileset.json").read_text())
        self.view, self.degree = tileset["extras"]["view"], tileset["extras"]["degree"]
        self._folder, self._parts, self._count = folder, [], 0
        self.leaves: list[slice] = []  # rows of the model
        self.root = self._tile(tileset["root"])
        columns = (torch.cat([getattr(part, name) for part in self._parts]).to(device) for name in PARAMETERS)
        self.means, self.quats, scales, opacities, self.sh = columns
        self.scales, self.opacities = scales.exp(), opacities.sigmoid()
        self._parts.clear()

    def __len__(self) -> int:
        return self._count

    def _tile(self, node: dict[str, Any]) -> Tile:
        box = np.array(node["boundingVolume"]["box"])
        start, path = self._count, self._folder / node["content"]["uri"]
        self._parts.append(read(path))
        self._count += len(self._parts[-1])
        rows, size = slice(start, self._count), path.stat().st_size
        children = [self._tile(child) for child in node.get("children", [])]
        if not children:
            self.leaves.append(rows)
        return Tile(box[:3], np.diag(box[3:].reshape(3, 3)), node["geometricError"], children, rows, size)

    def chosen(
        self, pose: np.ndarray, K: np.ndarray, size: tuple[int, int], pixels: float
    ) -> tuple[list[Tile], list[Tile]]:
        """Return the tiles that a view loads, as `tiles.js` chooses them; it shows those not refined."""
        axes, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
        (fx, _, cx), (_, fy, cy) = K[:2]
        right, down, ahead = axes
        across = fx * right + cx * ahead, -fx * right + (size[0] - cx) * ahead
        sides = np.stack([ahead, *across, fy * down + cy * ahead, -fy * down + (size[1] - cy) * ahead])
        loaded, shown, waiting = [], [], [self.root]
        while waiting:
            tile = waiting.pop()
            if not (sides @ (tile.centre - centre) + np.abs(sides) @ tile.half > 0).all():
                continue
            loaded.append(tile)
            away = np.linalg.norm(np.maximum(0, np.abs(centre - tile.centre) - tile.half))
            if tile.children and tile.error * fy / max(float(away), self.view["near"]) > pixels:
                waiting += tile.children
            else:
                shown.append(tile)
        return loaded, shown

    def render(self, rows: Tensor, pose: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> Tensor:
        """Render some of the Gaussians; float32 [H, W, 3] in [0, 1]."""
        view, device = self.view, self.means.device
        images, _, _ = rasterization(
            self.means[rows], self.quats[rows], self.scales[rows], self.opacities[rows], self.sh[rows],
            torch.from_numpy(pose).float()[None].to(device), torch.from_numpy(K).float()[None].to(device),
            *size, near_plane=view["near"], far_plane=view["far"], eps2d=view["blur"], sh_degree=self.degree,
            backgrounds=torch.tensor([view["background"]], dtype=torch.float32, device=device),
            rasterize_mode="antialiased" if view["antialiased"] else "classic",
        )  # fmt: skip
        return images[0].clamp(0, 1)


@torch.no_grad()
def measure(folder: Path, device: str, frames: int, width: int, errors: tuple[float, ...]) -> dict[str, Any]:
    """Fly through a tileset.

    Returns numbers of Gaussians of the model and of all tiles, their bytes, and for each error and frame:
    distance, tiles and Gaussians of the picture, those that it needs loaded, their bytes, those of the flight
    so far, and PSNR in dB.
    """
    city = City(folder, torch.device(device))
    view, size = city.view, (width, width * 9 // 16)
    eye, target, up = (np.array(view[name]) for name in ("eye", "target", "up"))
    K = intrinsics(*size, view["fov"])
    everything = torch.arange(len(city), device=city.means.device)
    model = torch.cat([everything[rows] for rows in city.leaves])
    loaded: dict[float, dict[int, int]] = {error: {} for error in errors}
    rows = []
    for factor in np.geomspace(FARTHEST, NEAREST, frames):
        stance = looking(target + factor * (eye - target), target, up, view["fov"])
        pose = np.eye(4)
        pose[:3, :3] = stance.rotation.T
        pose[:3, 3] = -stance.rotation.T @ stance.position
        full = city.render(model, pose, K, size)
        for error in errors:
            needed, tiles = city.chosen(pose, K, size, error)
            loaded[error] |= {tile.rows.start: tile.bytes for tile in needed}
            some = torch.cat([everything[tile.rows] for tile in tiles]) if tiles else everything[:0]
            difference = float((city.render(some, pose, K, size) - full).double().square().mean())
            rows.append(
                {
                    "pixel_error": error,
                    "distance": float(factor * np.linalg.norm(eye - target)),
                    "tiles": len(tiles),
                    "gaussians": len(some),
                    "loaded_gaussians": sum(tile.rows.stop - tile.rows.start for tile in needed),
                    "bytes": sum(tile.bytes for tile in needed),
                    "loaded_bytes": sum(loaded[error].values()),
                    "psnr": -10 * math.log10(difference) if difference > 0 else None,  # None: equal
                }
            )
    total = sum(file.stat().st_size for file in (folder / "tiles").iterdir())
    numbers = {"gaussians": len(model), "of_tiles": len(city)}
    return {**numbers, "bytes": total, "width": size[0], "height": size[1], "frames": rows}


def main(arguments: list[str] | None = None) -> None:
    parser = make_parser(__doc__)
    parser.add_argument("tiles", type=Path, help="folder of the tileset")
    parser.add_argument("--errors", type=float, nargs="+", default=[4.0, 16.0, 64.0], help="in pixels")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--width", type=int, default=1920, help="of the frames in pixels")
    options = parser.parse_args(arguments)
    found = measure(options.tiles, options.device, options.frames, options.width, tuple(options.errors))
    title = f"Tiles of {options.tiles.name}: {found['gaussians']:,} Gaussians, {found['bytes'] / 1e6:.1f} MB"
    report(title, found["frames"], options.json, options.device)


if __name__ == "__main__":
    main()
