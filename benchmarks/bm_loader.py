# SPDX-License-Identifier: Apache-2.0
"""Host time of what surrounds a training step: batches, division of tiles, sums of the loss, and schedule.

    python benchmarks/bm_loader.py [--views 2000] [--ranks 2] [--steps 1000] [--json FILE]

The views are those of a city, of 1024 x 684 px; all share one picture, so nothing is decoded. This process is
the first of `--ranks` processes and the others do not exist: it divides tiles as they would, and its sums
wait for no one. Figures are medians of the main thread's processor time in a step, for the first visits of
views, whose tiles have no measured costs yet, and for later ones. The thread that assembles batches is not
measured. To compare with another version of the package, put its folder into PYTHONPATH.
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from harness import make_parser, report
from torch import Tensor

from blitzgs.capture.cameras import Camera
from blitzgs.capture.images import ImageMemory
from blitzgs.capture.lens import Lens
from blitzgs.capture.undistort import rectify
from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.training.batches import BatchLoader
from blitzgs.training.sampler import BatchSampler
from blitzgs.view.views import Space, ViewSet

WIDTH, HEIGHT, BATCH, AHEAD, TILE = 1024, 684, 4, 3, 16
T = TypeVar("T")


class OnePicture:
    """Photographs that are all the same picture, which is in memory."""

    def __init__(self) -> None:
        self._picture = torch.zeros((HEIGHT, WIDTH, 3), dtype=torch.uint8)

    def get(self, index: int) -> Tensor:
        """Return the picture."""
        return self._picture

    def mask(self, index: int) -> None:
        """Return no mask."""

    def prefetch(self, indices: Sequence[int], masks: Sequence[int] = ()) -> None:
        """Do nothing."""

    def memory(self) -> ImageMemory:
        """Return room for all photographs, as a city's host has."""
        return ImageMemory(0, 0, 0, 1 << 34, 0)


class FirstOfMany(Ranks):
    """The first rank of a job whose other ranks do not exist."""

    def all_reduce(self, tensor: Tensor, op: str = "sum") -> Tensor:
        """Return the tensor: the other ranks add nothing."""
        return tensor


class Clock:
    """Adds up the main thread's processor time of named parts of a step."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, work: Callable[[], T]) -> T:
        """Do the work as a part of the present step."""
        begin = time.thread_time()
        found = work()
        self.seconds[name].append(time.thread_time() - begin)
        return found


def measure(views: int, ranks: int, steps: int) -> list[dict[str, Any]]:
    """Return a row for each part of a step."""
    plan = rectify(Lens("PINHOLE", WIDTH, HEIGHT, (800.0, 800.0, WIDTH / 2, HEIGHT / 2)), "crop")
    cameras = [
        Camera(f"{i:05}.jpg", WIDTH, HEIGHT, plan.K, np.eye(4), Path(f"{i:05}.jpg"), None, 1, plan)
        for i in range(views)
    ]
    cpu = torch.device("cpu")
    owners = TileOwners(FirstOfMany(world_size=ranks))
    sampler = BatchSampler([(WIDTH, HEIGHT)] * views, BATCH, seed=0)
    view_set = ViewSet(cameras, Space((0.0, 0.0, 0.0), 1.0, 1.0), cpu)
    loader = BatchLoader(OnePicture(), view_set, list(range(views)), sampler, cpu, AHEAD, owners)
    schedule = Schedule(ScheduleConfig(iterations=BATCH * (steps + 1), batch_size=BATCH))
    tiles = -(-WIDTH // TILE) * -(-HEIGHT // TILE)
    random = np.random.default_rng(0)
    work = [torch.from_numpy(random.integers(0, 900, BATCH * tiles, dtype=np.int32)) for _ in range(8)]
    parts = torch.ones(BATCH, 8, 2, dtype=torch.float64)
    phases = {"first visits, us": Clock(), "later, us": Clock()}
    first, later = phases.values()
    for step in range(steps):
        clock = first if BATCH * (step + 1) <= views else later
        batch = clock("batch, with the division of its tiles", lambda step=step: loader.get(step, steps + 1))
        assert batch.ranges is not None
        clock(
            "costs of tiles and sums of the loss",
            lambda step=step, batch=batch: owners.record(batch.indices, work[step % 8], batch.ranges, parts),
        )
        clock(
            "events of the schedule",
            lambda step=step: schedule.events(BATCH * step, BATCH * (step + 1)),
        )
    loader.close()
    return [
        {"part": name}
        | {
            phase: 1e6 * statistics.median(clock.seconds[name]) if name in clock.seconds else "–"
            for phase, clock in phases.items()
        }
        for name in first.seconds
    ]


def main() -> None:
    """Measure, print a table and optionally write JSON."""
    parser = make_parser(__doc__, device=None)
    parser.add_argument("--views", type=int, default=2000, help="training views (%(default)s)")
    parser.add_argument("--ranks", type=int, default=2, help="processes to divide tiles among (%(default)s)")
    parser.add_argument("--steps", type=int, default=1000, help="steps to measure (%(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    title = f"Host time around a step: {args.views:,} views, {args.ranks} ranks"
    report(title, measure(args.views, args.ranks, args.steps), args.json)


if __name__ == "__main__":
    main()
