# SPDX-License-Identifier: Apache-2.0
"""The CPU rasteriser against plain PyTorch, on the same splats and the same image.

    python benchmarks/bm_rasterize.py [--threads 2] [--json out.json]

The PyTorch implementation is written to be fast: it takes the same tile lists, evaluates whole batches of
tiles of similar list length at once, and gets its gradients from autograd. A blend is a (splat, pixel) pair
with alpha >= 1/255 that is composited.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from harness import make_parser, report
from scenes import BenchmarkScene, aerial, garden_like
from timing import median_ms
from torch import Tensor

from blitzgs.ops.intersect import intersect, tile_counts
from blitzgs.ops.project import project
from blitzgs.ops.rasterize import rasterize

Renderer = Callable[[list[Tensor]], Tensor]

TILE = 16
WIDTH, HEIGHT = 395, 297
PAIRS_PER_BATCH = 1 << 21  # (entry, pixel) pairs that one batch of tiles evaluates


def torch_tiles(values: list[Tensor], isects: Tensor, tiles: Tensor, offsets: Tensor, tiles_x: int) -> Tensor:
    """Composite some tiles: [tiles, pixels, D + 1], colour and final transmittance."""
    means2d, conics, opacities, colors = values
    lengths = offsets[tiles + 1] - offsets[tiles]
    places = torch.arange(int(lengths.max()))
    present = places < lengths[:, None]
    index = isects[(offsets[tiles][:, None] + places).clamp(max=len(isects) - 1)].long()  # [tiles, entries]
    pixel = torch.arange(TILE * TILE)
    centres = torch.stack([pixel % TILE, pixel // TILE], -1) + 0.5
    corner = torch.stack([tiles % tiles_x, tiles // tiles_x], -1) * TILE
    d = (corner[:, None] + centres)[:, None] - means2d[index][:, :, None]  # [tiles, entries, pixels, 2]
    a, b, c = conics[index][..., None, :].unbind(-1)
    dx, dy = d.unbind(-1)
    alphas = opacities[index][..., None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alphas = alphas.clamp(max=0.99)
    alphas = torch.where((alphas >= 1 / 255) & present[..., None], alphas, 0.0)
    # The product only falls, so comparing it with the minimum finds where each pixel ends.
    ends = torch.cumprod(1 - alphas, 1)
    alphas = torch.where(ends >= 1e-4, alphas, 0.0)
    before = torch.cumprod(torch.cat([torch.ones_like(alphas[:, :1]), 1 - alphas], 1), 1)
    color = torch.einsum("tep,ted->tpd", alphas * before[:, :-1], colors[index])
    return torch.cat([color, before[:, -1, :, None]], -1)


def torch_rasterize(values: list[Tensor], isects: Tensor, offsets: Tensor) -> Tensor:
    """Render one view with plain PyTorch: [H, W, D + 1]."""
    tiles_x, tiles_y = tile_counts(WIDTH, HEIGHT, TILE)
    lengths = offsets.diff()
    order = torch.argsort(lengths, descending=True)
    images, done = [], 0
    while done < len(order):
        longest = max(int(lengths[order[done]]), 1)
        batch = order[done : done + max(PAIRS_PER_BATCH // (longest * TILE * TILE), 1)]
        if int(lengths[batch[0]]) == 0:
            empty = values[3].new_zeros(len(batch), TILE * TILE, values[3].shape[1] + 1)
            empty[..., -1] = 1
            images.append(empty)
        else:
            images.append(torch_tiles(values, isects, batch, offsets, tiles_x))
        done += len(batch)
    pixels = torch.cat(images)[torch.argsort(order)]
    image = pixels.view(tiles_y, tiles_x, TILE, TILE, -1).permute(0, 2, 1, 3, 4)
    return image.reshape(tiles_y * TILE, tiles_x * TILE, -1)[:HEIGHT, :WIDTH]


def count_blends(values: list[Tensor], isects: Tensor, offsets: Tensor, last_ids: Tensor) -> int:
    """Count the composited (splat, pixel) pairs."""
    tiles_x, tiles_y = tile_counts(WIDTH, HEIGHT, TILE)
    total = 0
    for tile in range(tiles_x * tiles_y):
        entries = isects[offsets[tile] : offsets[tile + 1]].long()
        y, x = tile // tiles_x * TILE, tile % tiles_x * TILE
        last = last_ids[0, y : y + TILE, x : x + TILE]
        height, width = last.shape
        dx = torch.arange(width) + x + 0.5 - values[0][entries, 0, None, None]
        dy = (torch.arange(height) + y + 0.5)[:, None] - values[0][entries, 1, None, None]
        a, b, c = values[1][entries].T[:, :, None, None]
        power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
        alphas = values[2][entries][:, None, None] * torch.exp(power)
        drawn = (alphas >= 1 / 255) & (torch.arange(len(entries))[:, None, None] < last)
        total += int(drawn.sum())
    return total


def run(scene: BenchmarkScene, repeats: int) -> list[dict[str, object]]:
    """Time one scene with both implementations."""
    view = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, scene.viewmats, scene.Ks,
        WIDTH, HEIGHT, tile_size=TILE, sh_degree=3, raw=False,
    )  # fmt: skip
    values = [t.detach() for t in (view.means2d, view.conics, view.opacities, view.colors)]
    isects, offsets = intersect(
        *values[:3], view.depths, view.camera_ids, n_cameras=1, width=WIDTH, height=HEIGHT
    )
    leaves = [t.clone().requires_grad_() for t in values]
    options = {"n_cameras": 1, "width": WIDTH, "height": HEIGHT}
    v_image = torch.randn(HEIGHT, WIDTH, 3)
    last_ids = torch.ops.blitzgs.rasterize_fwd(
        *values, None, isects, offsets, [1, WIDTH, HEIGHT, TILE, 0, -1]
    )[2]
    blends = count_blends(values, isects, offsets, last_ids)

    def ours(inputs: list[Tensor]) -> Tensor:
        return rasterize(*inputs, isects, offsets, **options)[0][0]

    def plain(inputs: list[Tensor]) -> Tensor:
        return torch_rasterize(inputs, isects, offsets)[..., :3]

    results = []
    for name, render in (("blitzgs", ours), ("plain PyTorch", plain)):

        def gradients(render: Renderer) -> None:
            torch.autograd.grad((render(leaves) * v_image).sum(), leaves)

        def image(render: Renderer) -> None:
            with torch.no_grad():
                render(values)

        runs = {"repeats": repeats if name == "blitzgs" else min(repeats, 3), "warm_up": 1}
        forward, both = median_ms(image, [(render,)], **runs), median_ms(gradients, [(render,)], **runs)
        results.append(
            {
                "scene": scene.name,
                "splats in view": len(values[0]),
                "rasteriser": name,
                "forward ms": forward,
                "forward + backward ms": both,
                "renders/s": 1e3 / forward,
                "gradients/s": 1e3 / both,
                "M blends/s forward": blends / forward / 1e3,
            }
        )
    difference = float((ours(values) - plain(values)).abs().max())
    for result in results:
        result["largest image difference"] = difference
    return results


def main() -> None:
    """Print the comparison for an aerial and a garden-like scene."""
    parser = make_parser(__doc__, device=None, repeats=7)
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="CPU threads")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    scenes = [aerial(200_000, width=WIDTH, height=HEIGHT), garden_like(400_000, width=WIDTH, height=HEIGHT)]
    rows = [row for scene in scenes for row in run(scene, arguments.repeats)]
    report(f"Rasterisation on the CPU, {WIDTH} x {HEIGHT}", rows, arguments.json)


if __name__ == "__main__":
    main()
