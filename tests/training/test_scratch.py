# SPDX-License-Identifier: Apache-2.0
"""The memory of a training step follows the number of visible Gaussians, not the size of the table."""

import numpy as np
import pytest
import torch

from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.frame.ownership import TileOwners
from blitzgs.optim.table_adam import TableAdam
from blitzgs.table.blocks import morton_order
from blitzgs.table.table import GaussianTable
from blitzgs.training.batch import Batch
from blitzgs.training.step import Stepper
from blitzgs.view.gate import ViewGate
from tests.helpers import DEVICES
from tests.training.tiny import look_at_origin, random_gaussians, tiny_config

SEEN = 20_000
WIDTH, HEIGHT = 80, 60


def table_of(unseen: int, device: str) -> GaussianTable:
    """`SEEN` Gaussians before the camera, and others far behind it."""
    rows = random_gaussians(SEEN + unseen)
    rows["scales"].sub_(1.5)
    rows["means"][SEEN:] += torch.tensor([1e4, 0.0, 0.0])
    rows["means"][SEEN:] *= 1 + torch.rand(unseen, 1, generator=torch.Generator().manual_seed(1))
    table = GaussianTable({name: rows[name].to(device) for name in rows})
    table.permute(morton_order(table["means"]))
    return table


def peak_bytes(run, device: str) -> int:
    """Return the largest number of bytes requested at one time while `run()` runs, beyond those before it."""
    if device == "cuda":
        # Requested bytes, and not allocated ones (`max_memory_allocated`): for more than 1 MiB, torch uses a
        # free block whole if less than 1 MiB of it would remain, and the free blocks depend on the table.
        torch.cuda.synchronize()
        before = torch.cuda.memory_stats()["requested_bytes.all.current"]
        torch.cuda.reset_peak_memory_stats()
        run()
        return torch.cuda.memory_stats()["requested_bytes.all.peak"] - before
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as all:
        run()
    events = [e for e in all.profiler.kineto_results.events() if e.name() == "[memory]"]
    assert len(events) > 20
    sums = np.cumsum([e.nbytes() for e in sorted(events, key=lambda e: e.start_ns())])
    return max(0, int(sums.max()))


def scratch_of_a_step(unseen: int, device: str) -> int:
    config, table = tiny_config(), table_of(unseen, device)
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), 1.0, device)
    stepper = Stepper(table, optimiser, TileOwners(Ranks(device=torch.device(device))), config.loss, 1.0)
    viewmat = torch.from_numpy(look_at_origin(np.array([3.0, 0.0, 1.5]))).float()[None].to(device)
    K = torch.tensor([[[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]], device=device)
    targets = torch.full((1, HEIGHT, WIDTH, 3), 90, dtype=torch.uint8, device=device)
    samples = torch.full((1,), 3.0 * HEIGHT * WIDTH, device=device)
    batch = Batch([0], Views(viewmat, K, WIDTH, HEIGHT), targets, None, samples, None)
    options, gate = RenderOptions(0, 0.05, 100.0), ViewGate([1e3], 1)

    def step(number: int) -> None:
        frame, terms, sums = stepper.forward(number, options, batch, view_filter=gate)
        stepper.backward(number, frame, terms, keep_means2d=True)
        sums.read()

    for number in range(1, 6):  # capacities are estimated, and every row is behind
        step(number)
    return peak_bytes(lambda: step(6), device)


@pytest.mark.parametrize("device", DEVICES)
def test_scratch_of_a_step_does_not_grow_with_what_is_not_seen(device):
    few, many = scratch_of_a_step(40_000, device), scratch_of_a_step(16 * 40_000, device)
    assert few > 8 * SEEN  # the step saw Gaussians, and its memory was measured
    assert many <= 1.01 * few, f"{(many - few) / (15 * 40_000):.3f} bytes for each row that no view sees"
