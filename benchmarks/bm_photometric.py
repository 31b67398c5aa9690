# SPDX-License-Identifier: Apache-2.0
"""Compares the time of L1 + SSIM, forward and backward, with its byte floor and plain PyTorch convolutions.

python benchmarks/bm_photometric.py [--device cuda] [--height 1064 --width 1600] [--views 1] [--json FILE]
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from harness import copy_bandwidth, make_parser, median_ms, write_json
from torch import Tensor

from blitzgs.ops.photometric import photometric_fwd_bwd, photometric_sums


def plain_loss(x: Tensor, targets: Tensor) -> Tensor:
    """Return 0.8 L1 + 0.2 (1 - SSIM) with separable convolutions of PyTorch."""
    y = targets.permute(0, 3, 1, 2).float() / 255
    x = x.permute(0, 3, 1, 2)
    line = torch.exp(-((torch.arange(11, device=x.device) - 5.0) ** 2) / 4.5)
    line = (line / line.sum()).expand(15, 1, 1, 11)
    stack = torch.cat([x, y, x * x, y * y, x * y], 1)
    blurred = F.conv2d(stack, line, padding=(0, 5), groups=15)
    mx, my, xx, yy, xy = F.conv2d(blurred, line.mT, padding=(5, 0), groups=15).chunk(5, 1)
    top = (2 * mx * my + 0.01**2) * (2 * (xy - mx * my) + 0.03**2)
    bottom = (mx * mx + my * my + 0.01**2) * (xx - mx * mx + yy - my * my + 0.03**2)
    return 0.8 * (x - y).abs().mean() + 0.2 * (1 - (top / bottom).mean())


def main() -> None:
    parser = make_parser(__doc__, repeats=30)
    parser.add_argument("--height", type=int, default=1064)
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--views", type=int, default=1)
    args = parser.parse_args()
    shape = (args.views, args.height, args.width, 3)
    sets = []
    for seed in range(6):
        generator = torch.Generator(args.device).manual_seed(seed)
        x = torch.rand(shape, generator=generator, device=args.device)
        y = torch.randint(0, 256, shape, generator=generator, device=args.device, dtype=torch.uint8)
        weights = torch.full((args.views,), 0.8 / x[0].numel(), device=args.device)
        sets.append((x, y, None, weights, -0.25 * weights))

    values = sets[0][0].numel()
    bandwidth = copy_bandwidth(args.device, 2048 if args.device == "cuda" else 256)
    print(f"{args.views} view(s) of {args.width} x {args.height}, {args.device}, copy {bandwidth:.0f} GB/s")

    results = []

    def report(name: str, milliseconds: float, bytes_per_value: float) -> None:
        floor = bytes_per_value * values / bandwidth / 1e6
        results.append({"work": name, "ms": milliseconds, "floor_ms": floor})
        print(f"{name:36s} {milliseconds:8.3f} ms   byte floor {floor:7.4f} ms")

    def plain(x: Tensor, y: Tensor) -> Tensor:
        return torch.autograd.grad(plain_loss(x, y), x)[0]

    forward = median_ms(photometric_sums, [s[:2] for s in sets], args.repeats)
    report("forward (sums)", forward, 5)
    report("forward + backward (one op)", median_ms(photometric_fwd_bwd, sets, args.repeats), 9)
    tiles = args.views * -(-args.height // 16) * -(-args.width // 16)
    middle = (16, 3 * tiles // 8, 5 * tiles // 8)
    quarter = [(*s, *middle) for s in sets]
    report("the same, the middle quarter", median_ms(photometric_fwd_bwd, quarter, args.repeats), 9 / 4)
    leaves = [(x.clone().requires_grad_(), y) for x, y, *_ in sets]
    report("plain PyTorch, forward + backward", median_ms(plain, leaves, args.repeats), 9)
    if args.json:
        shape_info = {"views": args.views, "height": args.height, "width": args.width}
        write_json(args.json, args.device, **shape_info, results=results)


if __name__ == "__main__":
    main()
