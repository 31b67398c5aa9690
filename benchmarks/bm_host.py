# SPDX-License-Identifier: Apache-2.0
"""Host time of one `blitzgs.rasterization`, forward and backward, on a scene so small that only it counts.

    python benchmarks/bm_host.py [--device cpu] [--repeats 500] [--json FILE]

50 Gaussians with SH of degree 1 in an image of 32 x 32 px; gradients for every parameter; autograd in one
thread. On the CPU each figure includes the kernels. On CUDA each step ends with a
synchronisation, so a figure is the longer of host and device. Each figure is a median over repeats. To
compare with another version of the package, put its folder into PYTHONPATH.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from harness import make_parser, report
from scenes import aerial

from blitzgs import rasterization

GAUSSIANS, WIDTH, HEIGHT = 50, 32, 32
CALLS: dict[str, dict[str, Any]] = {
    "dense": {},
    "sparse": {"sparse_grad": True},
    "not packed": {"packed": False},
    "2 views": {"views": 2},
    "values": {"sh_degree": None},
    "sparse, meta": {"sparse_grad": True, "read_meta": True},
}


def measure(
    device: str, repeats: int, views: int = 1, read_meta: bool = False, **options: Any
) -> list[float]:
    """Return the median microseconds of the forward and of the backward pass.

    Args:
        device: where to render.
        repeats: number of timed calls.
        views: number of views.
        read_meta: whether to read all entries of `meta`, as part of the forward pass.
        options: further arguments of `rasterization`.
    """
    scene = aerial(GAUSSIANS, device, views=views, width=WIDTH, height=HEIGHT)
    options = {"sh_degree": 1, **options}
    colors = scene.sh if options["sh_degree"] is not None else scene.sh[:, 0]
    given = (scene.means, scene.quats, scene.scales, scene.opacities, colors)
    parameters = [t.detach().clone().requires_grad_() for t in given]
    v_renders = torch.ones(views, HEIGHT, WIDTH, 3, device=device)
    synchronize = torch.cuda.synchronize if scene.means.is_cuda else lambda: None
    samples = []
    for _ in range(repeats // 10 + repeats):
        begin = time.perf_counter()
        renders, _, meta = rasterization(*parameters, scene.viewmats, scene.Ks, WIDTH, HEIGHT, **options)
        if read_meta:
            list(meta.values())
        synchronize()
        middle = time.perf_counter()
        torch.autograd.grad(renders, parameters, v_renders)
        synchronize()
        samples.append((middle - begin, time.perf_counter() - middle))
    return [1e6 * statistics.median(times) for times in zip(*samples[repeats // 10 :], strict=True)]


def main() -> None:
    """Measure all calls; print a table and optionally write JSON."""
    args = make_parser(__doc__, repeats=500).parse_args()
    rows = []
    with torch.autograd.set_multithreading_enabled(False):
        for name, options in CALLS.items():
            forward, backward = measure(args.device, args.repeats, **options)
            rows.append({"call": name, "forward us": forward, "backward us": backward,
                         "total us": forward + backward})  # fmt: skip
    report("Host time of a call", rows, args.json, args.device)


if __name__ == "__main__":
    main()
