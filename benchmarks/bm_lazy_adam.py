# SPDX-License-Identifier: Apache-2.0
"""Compares lazy Adam's catch-up and step with byte floors and with torch's fused dense Adam over every row.

python benchmarks/bm_lazy_adam.py [--device cuda] [--rows 4000000] [--fraction 0.1]
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from harness import make_parser, write_json
from timing import copy_bandwidth, median_ms
from torch import Tensor

from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, lazy_adam_catch_up_, lazy_adam_step_

FLOATS = 59  # a row with SH of degree 3
BETA1, BETA2, EPS = 0.9**4, 0.999**4, 1e-15 / 2
STEP = 2000


class State:
    """Parameters and moments whose sizes spread over some orders of magnitude around eps / rounding."""

    def __init__(self, n: int, device: str) -> None:
        shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, 16, 3)]
        self.params = [torch.randn(s, device=device) for s in shapes]
        sizes = [1e-7 * torch.exp(2 * torch.randn(s, device=device)) for s in shapes]
        self.exp_avgs = [torch.randn_like(size) * size for size in sizes]
        self.exp_avg_sqs = [size**2 for size in sizes]
        self.last_step = torch.empty(n, dtype=torch.int32, device=device)
        self.moment_step = torch.empty_like(self.last_step)
        lr_table = torch.full((30_001, 6), 1e-6, device=device)
        self.schedule = AdamSchedule(lr_table, BETA1, BETA2, EPS)

    def state(self) -> AdamState:
        """Return parameters, moments and the steps that they stand at."""
        return AdamState(self.params, self.exp_avgs, self.exp_avg_sqs, self.last_step, self.moment_step)

    def catch_up(self, ids: Tensor) -> None:
        """Bring rows to the step before `STEP`."""
        lazy_adam_catch_up_(self.state(), self.schedule, STEP - 1, ids)

    def step(self, ids: Tensor, grads: list[Tensor]) -> None:
        """Take step `STEP`."""
        lazy_adam_step_(self.state(), self.schedule, STEP, grads, ids)

    def time(self, work: Callable[[], None], gaps: Tensor, repeats: int) -> float:
        """Return the median ms of `work` on rows that are `gaps` steps behind `STEP` - 1."""

        def once() -> float:
            self.last_step.copy_(STEP - 1 - gaps)
            self.moment_step.copy_(self.last_step)
            return median_ms(lambda _: work(), [(gaps,)], repeats=1, warm_up=0)

        once()
        return sorted(once() for _ in range(repeats))[repeats // 2]


def main() -> None:
    parser = make_parser(__doc__, repeats=30)
    parser.add_argument("--rows", type=int, default=4_000_000)
    parser.add_argument("--fraction", type=float, default=0.1)
    args = parser.parse_args()
    device, n = args.device, args.rows
    state = State(n, device)
    bandwidth = copy_bandwidth(device, 2048 if device == "cuda" else 256)
    print(f"{n} rows of {FLOATS} floats, {device}, copy {bandwidth:.0f} GB/s")

    results: list[dict[str, object]] = []

    def report(name: str, milliseconds: float, rows: int, touched: int) -> None:
        gigabytes = rows * FLOATS * 4 * touched / 1e9
        floor, rate = 1e3 * gigabytes / bandwidth, 1e3 * gigabytes / milliseconds
        results.append({"work": name, "rows": rows, "ms": milliseconds, "floor_ms": floor})
        print(f"{name:58s} {milliseconds:8.3f} ms  {rate:6.0f} GB/s  floor {floor:.3f} ms", flush=True)

    none = torch.zeros(n, dtype=torch.int64, device=device)
    some = torch.randint(1, 40, (n,), device=device)
    everyone = torch.arange(n, dtype=torch.int32, device=device)
    scattered = torch.nonzero(torch.rand(n, device=device) < args.fraction).flatten().int()
    chosen = torch.rand(n // 256, device=device) < args.fraction
    runs = everyone[: n // 256 * 256].reshape(-1, 256)[chosen].flatten()
    for name, ids in (
        ("every row", everyone),
        (f"{args.fraction:.0%} of the rows, runs of 256", runs),
        (f"{args.fraction:.0%} of the rows, scattered", scattered),
    ):
        grads = [1e-6 * torch.randn((len(ids), *p.shape[1:]), device=device) for p in state.params]
        for label, work, gaps, touched in (
            # The step reads gradients, and reads and writes parameters and moments.
            ("step, up to date", partial(state.step, ids, grads), none, 7),
            ("step, 1..39 steps behind", partial(state.step, ids, grads), some, 7),
            # Catching up reads parameters and moments, and writes parameters.
            ("catch-up, 1..39 steps behind", partial(state.catch_up, ids), some, 4),
        ):
            report(f"{name}: {label}", state.time(work, gaps, args.repeats), len(ids), touched)

    for p in state.params:
        p.grad = 1e-6 * torch.randn_like(p)
    dense = torch.optim.Adam(state.params, lr=1e-6, betas=(BETA1, BETA2), eps=EPS, fused=True)
    milliseconds = median_ms(lambda _: dense.step(), [(state.params[0],)], args.repeats)
    report("torch fused dense Adam", milliseconds, n, 7)
    if args.json:
        write_json(args.json, device, rows=n, results=results)


if __name__ == "__main__":
    main()
