# SPDX-License-Identifier: Apache-2.0
"""Measures density events (relocation and growth) of a large table, and what they do to steps.

    python benchmarks/bm_events.py [--millions 1 4 12] [--device cuda] [--json FILE]
    torchrun --nproc-per-node=4 benchmarks/bm_events.py [--millions 12]

The table is the `aerial` scene of `scenes.py`, dealt round-robin to the ranks, each row some steps behind.
Before every event, one percent of the Gaussians become transparent; an event replaces them, and the table
grows by 5 % in each of the first five and not in as many after them. Times are medians and means, in ms by
the host's clock with the device idle before and after, of the slowest rank. "event" is an event as in a
training. With one rank, steps of four views are measured before the events, after them, and once the table is
sorted again.
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from bm_step import LOSS, STEP, make_optimiser, make_table, put_behind, random_photographs, take_step
from harness import make_parser, seconds_of, write_json
from scenes import BenchmarkScene, aerial

from blitzgs.config.fields import Config
from blitzgs.config.schedule import Event, Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.runs.log import RunLog
from blitzgs.runs.trained_model import Progress
from blitzgs.table.blocks import morton_order, sort_rows
from blitzgs.table.table import GaussianTable
from blitzgs.training.events import densify
from blitzgs.training.state import TrainingState
from blitzgs.training.step import Stepper

VIEWS = 4  # of a step
EVENTS = 5  # timed events of each kind
DEAD = 0.01  # share that dies before an event


def rows_of(scene: BenchmarkScene, ranks: Ranks) -> torch.Tensor:
    """Return the rows of this rank's share of a scene."""
    mine = torch.arange(ranks.rank, len(scene.means), ranks.world_size, device=scene.means.device)
    return mine[morton_order(scene.means[mine])]


def make_state(scene: BenchmarkScene, table: GaussianTable, ranks: Ranks) -> TrainingState:
    """Return a state that has what density events need."""
    config = replace(
        Config(),
        schedule=replace(Config().schedule, batch_size=len(scene.viewmats)),
        population=replace(
            Config().population, strategy="relocation", min_opacity=0.005, prune_screen_radius=0.0,
            prune_world_scale=0.0, pixels_per_gaussian=0.0, gaussians_per_point=0.0,
        ),
    )  # fmt: skip
    schedule = Schedule(config.schedule)
    optimiser = make_optimiser(schedule, ranks.device)
    owners = TileOwners(ranks)
    capture = SimpleNamespace(cameras=[], train=[], points=[])
    progress = Progress(step=STEP, sh_degree=3, level_count=1, peak_gaussians=0, seconds=0.0)
    return TrainingState(
        config=config,
        capture=cast(Any, capture),
        images=cast(Any, None),
        folder=Path(),
        ranks=ranks,
        schedule=schedule,
        space=cast(Any, SimpleNamespace(extent=float(scene.means[:, :2].abs().max()))),
        table=table,
        progress=progress,
        views=cast(Any, None),
        sampler=cast(Any, None),
        optimiser=optimiser,
        stepper=Stepper(table, optimiser, owners, LOSS, 1.0),
        owners=owners,
        run_id="",
        origin="",
        save_clock=cast(Any, None),
        veto=None,
        lineage=None,
        log=RunLog(None, 1, 0, tensorboard=False),
    )


class Events:
    """Runs events on the table of a state, and steps between them."""

    def __init__(self, state: TrainingState, scene: BenchmarkScene) -> None:
        self.state, self._time = state, 0
        self._batch = random_photographs(scene.views) if state.ranks.world_size == 1 else None
        self.sorts = 0
        densify.sort_rows = self._sort

    def _sort(self, table: GaussianTable) -> None:
        self.sorts += 1
        sort_rows(table)

    def prepare_event(self) -> None:
        """Put every row some steps behind, and make some transparent."""
        table = self.state.table
        self._time += 1
        generator = torch.Generator(table.device).manual_seed(self._time * 1000 + self.state.ranks.rank)
        chosen = torch.rand(len(table), generator=generator, device=table.device) < DEAD
        table["opacities"].masked_fill_(chosen, -9.0)
        put_behind(self.state.stepper, STEP + 1)

    def event(self) -> None:
        """Run an event."""
        densify.run_density_event(self.state, Event(self._time, 0, "densify"))

    def step_ms(self, repeats: int = 12) -> float | None:
        """Return the median ms of a step; None with several ranks."""
        if self._batch is None:
            return None
        stepper, seconds = self.state.stepper, []
        take = partial(take_step, stepper, STEP + 1, self._batch)
        for _ in range(repeats):
            put_behind(stepper, STEP + 1)
            seconds.append(seconds_of(self.state.ranks.device, take))
        return 1e3 * statistics.median(seconds[2:])


def slowest(ranks: Ranks, values: dict[str, float]) -> dict[str, float]:
    """Return the largest of all ranks' values, by name."""
    everywhere = ranks.all_gather_object(values)
    return {name: max(other.get(name, 0.0) for other in everywhere) for name in values}


def measure(millions: float, ranks: Ranks) -> dict[str, Any]:
    """Measure the events of one size, as a whole."""
    if ranks.device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    scene = aerial(int(millions * 1e6), str(ranks.device), views=VIEWS)
    table = make_table(scene, rows_of(scene, ranks))
    state = make_state(scene, table, ranks)
    events = Events(state, scene)
    result: dict[str, Any] = {"millions": millions, "ranks": ranks.world_size}
    table_gb = sum(table.row_bytes.values()) * len(table) / 1e9
    events.prepare_event()
    events.event()  # warms up, and sorts if this version sorts rarely
    result["step sorted"] = events.step_ms()
    measured: dict[str, list[float]] = defaultdict(list)
    for growth in (0.05, 0.0):
        state.config = replace(state.config, population=replace(state.config.population, growth=growth))
        for _ in range(EVENTS):
            events.prepare_event()
            ranks.barrier()
            measured[f"event, growth {growth:g}"].append(seconds_of(ranks.device, events.event))
        result[f"step after growth {growth:g}"] = events.step_ms()
    result["rows"] = state.population()
    result["sorts"] = events.sorts
    sort_rows(table)
    densify.sort_rows = sort_rows  # keeps no table
    state.stepper.reindex()
    result["step sorted again"] = events.step_ms()
    times = {name: 1e3 * statistics.median(seconds) for name, seconds in measured.items()}
    times |= {f"mean {name}": 1e3 * statistics.mean(seconds) for name, seconds in measured.items()}
    result |= slowest(ranks, times)
    result["each event"] = [round(1e3 * s, 2) for seconds in measured.values() for s in seconds]
    if ranks.device.type == "cuda":
        result["table_gb"], result["peak_gb"] = table_gb, torch.cuda.max_memory_allocated() / 1e9
    return result


@torch.no_grad()
def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--millions", type=float, nargs="+", default=[1, 4, 12], help="Gaussians (%(default)s)"
    )
    args = parser.parse_args()
    ranks = Ranks.from_environment(args.device)
    results = [measure(millions, ranks) for millions in args.millions]
    if ranks.rank == 0:
        for result in results:
            shown = ", ".join(
                f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in result.items()
            )
            print(shown, flush=True)
        write_json(args.json, args.device, results=results)
    ranks.close()


if __name__ == "__main__":
    main()
