# SPDX-License-Identifier: Apache-2.0
"""Time of a lazy Adam step against its byte floor and against torch's fused dense Adam over every row.

python benchmarks/bm_lazy_adam.py [--device cuda] [--rows 4000000] [--fraction 0.1]
"""

from __future__ import annotations

import argparse

import torch
from timing import copy_bandwidth, median_ms
from torch import Tensor

from blitzgs.ops.lazy_adam import lazy_adam_step_

FLOATS = 59  # a row with SH of degree 3
BETA1, BETA2, EPS = 0.9**4, 0.999**4, 1e-15 / 2
STEP = 2000


def make_state(n: int, device: str) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 16, 3)]
    params = [torch.randn(s, device=device) for s in shapes]
    exp_avgs = [1e-6 * torch.randn(s, device=device) for s in shapes]
    return params, exp_avgs, [m * m for m in exp_avgs]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--rows", type=int, default=4_000_000)
    parser.add_argument("--fraction", type=float, default=0.1)
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    device, n = args.device, args.rows
    params, exp_avgs, exp_avg_sqs = make_state(n, device)
    lr_table = torch.full((30_001, 6), 1e-6, device=device)
    last_step = torch.empty(n, dtype=torch.int32, device=device)
    bandwidth = copy_bandwidth(device, 2048 if device == "cuda" else 256)
    print(f"{n} rows of {FLOATS} floats, {device}, copy {bandwidth:.0f} GB/s")

    def report(name: str, milliseconds: float, rows: int) -> None:
        gigabytes = rows * FLOATS * 4 * 7 / 1e9  # gradient read; parameter and moments read and written
        floor = 1e3 * gigabytes / bandwidth
        rate = 1e3 * gigabytes / milliseconds
        print(f"{name:48s} {milliseconds:8.3f} ms  {rate:6.0f} GB/s  floor {floor:.3f} ms")

    def step_time(ids: Tensor, gaps: Tensor, sparse: bool) -> float:
        grads = [1e-6 * torch.randn((len(ids), *p.shape[1:]), device=device) for p in params]
        behind = (STEP - 1 - gaps).int()

        def once(rows: Tensor) -> None:
            lazy_adam_step_(
                params,
                exp_avgs,
                exp_avg_sqs,
                grads,
                rows,
                last_step,
                lr_table,
                STEP,
                BETA1,
                BETA2,
                EPS,
                sparse,
            )

        def prepare_and_time() -> float:
            last_step.copy_(behind)
            return median_ms(once, [(ids,)], repeats=1, warm_up=0)

        prepare_and_time()
        return sorted(prepare_and_time() for _ in range(args.repeats))[args.repeats // 2]

    none = torch.zeros(n, dtype=torch.int64, device=device)
    some = torch.randint(0, 40, (n,), device=device)
    everyone = torch.arange(n, dtype=torch.int32, device=device)
    scattered = torch.nonzero(torch.rand(n, device=device) < args.fraction).flatten().int()
    chosen = torch.rand(n // 256, device=device) < args.fraction
    runs = everyone[: n // 256 * 256].reshape(-1, 256)[chosen].flatten()
    for name, ids in (
        ("every row", everyone),
        (f"{args.fraction:.0%} of the rows, runs of 256", runs),
        (f"{args.fraction:.0%} of the rows, scattered", scattered),
    ):
        report(f"{name}, up to date", step_time(ids, none, False), len(ids))
        report(f"{name}, 0..39 steps behind", step_time(ids, some, False), len(ids))
        report(f"{name}, sparse variant", step_time(ids, none, True), len(ids))

    for p in params:
        p.grad = 1e-6 * torch.randn_like(p)
    dense = torch.optim.Adam(params, lr=1e-6, betas=(BETA1, BETA2), eps=EPS, fused=True)
    report("torch fused dense Adam", median_ms(lambda _: dense.step(), [(params[0],)], args.repeats), n)


if __name__ == "__main__":
    main()
