# SPDX-License-Identifier: Apache-2.0
"""Long runs stay exact: disturbed at random moments, and beside dense Adam in very many steps.

Disturbed runs lose at most the checkpoint interval and end as if undisturbed. BLITZGS_TRIALS sets how often
each disturbance is tried, 20 by default.

In the other test, torch's Adam runs beside the trainer, in float64. Adam gets the gradients of every step,
with zeros for the rows that no view of the step sees, and moves all rows. The trainer does not touch most
rows for a hundred steps and more between their views. Memory does not grow.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.runs import trained_model
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.view.views import Space, ViewSet
from tests.distributed.rank_harness import CONTEXT
from tests.training.tiny import (
    OVERRIDES,
    Camera,
    Capture,
    Images,
    as_flags,
    make_trainer,
    steps_of,
    write_tiny_capture,
)

TRIALS = int(os.environ.get("BLITZGS_TRIALS", "20"))
INTERVAL = 0.5
# Time for a step, for a save and for the scheduling of a busy machine.
SLACK = 1.0
SETTINGS = (
    *OVERRIDES, "schedule.iterations=3000", "population.max_gaussians=700",
    "log.tensorboard=true", "data.cache_bytes=0", f"log.checkpoint_seconds={INTERVAL}",
)  # fmt: skip


def _train(arguments):
    os.setsid()
    torch.set_num_threads(1)
    from blitzgs.cli import main
    from blitzgs.training.events import save

    save.RETRY_SECONDS = 0.2
    raise SystemExit(main(arguments))


def start(data, out, *flags):
    settings = as_flags("config=defaults", *SETTINGS)
    process = CONTEXT.Process(
        target=_train, args=(["train", "--data", str(data), "--out", str(out), *settings, *flags],)
    )
    process.start()
    return process


def wait_for_first_checkpoint(process, out):
    while not list((out / "checkpoints").glob("checkpoint_*")):
        assert process.exitcode is None, f"ended early with {process.exitcode}"
        time.sleep(0.01)


def age_of_newest(out):
    """Seconds since the newest checkpoint was complete."""
    ages = []
    for path in (out / "checkpoints").glob("checkpoint_*/manifest.json"):
        with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
            ages.append(time.time() - path.stat().st_mtime)
    return min(ages)


def finish(data, out):
    process = start(data, out, "--resume")
    process.join(240)
    assert process.exitcode == 0
    return trained_model.restore(out, Ranks()).table


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a capture, the table of an undisturbed run, and its seconds after the first checkpoint."""
    data, out = tmp_path_factory.mktemp("capture"), tmp_path_factory.mktemp("whole") / "run"
    write_tiny_capture(data)
    process = start(data, out)
    wait_for_first_checkpoint(process, out)
    begin = time.monotonic()
    process.join(240)
    assert process.exitcode == 0
    return data, trained_model.restore(out, Ranks()).table, time.monotonic() - begin


def kill(process, data, out):
    os.kill(process.pid, signal.SIGKILL)
    lost = age_of_newest(out)
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert lost <= INTERVAL + SLACK
    return lost


def hang_up(process, data, out):
    os.kill(process.pid, signal.SIGHUP)
    process.join(60)
    assert process.exitcode == 0
    return 0.0


def fill_disk(process, data, out):
    """For two seconds, no file may get longer than 16 bytes, so every write fails."""
    soft, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (16, hard))
    process.join(2.0)
    if process.exitcode is None:
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (soft, hard))
        process.join(240)
    assert process.exitcode == 0
    return 0.0


def take_photographs_away(process, data, out):
    aside = data / "images aside"
    (data / "images").rename(aside)
    try:
        process.join(60)
        # If the last batches were loaded before, the evaluation is the first to read a lost photograph.
        assert process.exitcode == 1
    finally:
        aside.rename(data / "images")
    return 0.0


def start_again(process, data, out):
    for flags in ((), ("--resume",)):
        second = start(data, out, *flags)
        second.join(120)
        assert second.exitcode == 1 or process.exitcode == 0
    process.join(240)
    assert process.exitcode == 0
    return 0.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("disturb", [kill, hang_up, fill_disk, take_photographs_away, start_again])
def test_a_disturbed_run_ends_like_any_other(scene, tmp_path, disturb):
    data, expected, seconds = scene
    choice, worst = random.Random(disturb.__name__), 0.0
    for trial in range(TRIALS):
        own = shutil.copytree(data, tmp_path / f"data{trial}")
        out = tmp_path / f"run{trial}"
        while True:
            process = start(own, out)
            wait_for_first_checkpoint(process, out)
            time.sleep(choice.uniform(0, 0.7 * seconds))
            if process.exitcode is None:
                break
            # The run ended first: the machine was busier when the undisturbed run was timed.
            assert process.exitcode == 0
            seconds *= 0.7
            shutil.rmtree(out)
        worst = max(worst, disturb(process, own, out))
        found = finish(own, out)
        for name in expected:
            assert torch.equal(found[name], expected[name]), (trial, name)
        times = [record["t"] for record in steps_of(out)]
        assert times == sorted(set(times)) and times[-1] == 3000
        shutil.rmtree(out)
        shutil.rmtree(own)
    print(f"{disturb.__name__}: {TRIALS} trials, at most {worst:.2f} s lost")


WIDTH, HEIGHT = 32, 24
ACROSS, SPACING = 16, 2.0  # number of cameras in a row and in a column, and the distance between neighbours
COUNT = 2400
# The largest allowed error of a parameter after T steps. Each step rounds it to float32, by at most 2^-24 of
# its size, and the errors make a random walk: 2^-24 sqrt(T) times the size. The largest of 50,000 normal
# numbers is 4.4 times their deviation; the rest of the factor is for the rounding of gradients and moments.
WALK, LARGEST = 2.0**-24, 8
# Largest growth of the memory of host and GPU, in bytes, from a fifth of the run to its end.
MAX_GROWTH = 8_000_000, 1_000_000


def carpet(count, seed):
    """Return Gaussians below all cameras, with random rotations and three different axes each."""
    g = torch.Generator().manual_seed(seed)
    size = torch.tensor([ACROSS * SPACING, ACROSS * SPACING, 0.5])
    return {
        "means": (torch.rand(count, 3, generator=g) - 0.5) * size,
        "quats": torch.randn(count, 4, generator=g),
        "scales": torch.rand(count, 3, generator=g) * 1.5 - 2.5,
        "opacities": torch.rand(count, generator=g) * 3,
        "sh": torch.randn(count, 16, 3, generator=g) * torch.tensor([0.8] + [0.1] * 15)[:, None],
    }


def carpet_capture(device):
    """Return a grid of cameras that look down, each on a hundredth of the Gaussians."""
    K, cameras = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), []
    for i in range(ACROSS**2):
        pose = np.eye(4)
        at = (np.array(divmod(i, ACROSS)) + 0.5 - ACROSS / 2) * SPACING
        pose[:3, 3] = [-at[0], -at[1], 3.0]
        cameras.append(Camera(f"{i:04}.png", WIDTH, HEIGHT, K, pose))
    parameters = carpet(COUNT, 1)
    truth = GaussianTable.create({name: column.to(device) for name, column in parameters.items()})
    views = ViewSet(cameras, Space((0.0, 0.0, 0.0), 1.0, 1.0), truth.device)
    images = [(picture(truth, views, i).clamp(0, 1) * 255 + 0.5).byte().cpu() for i in range(len(cameras))]
    colors = np.full((COUNT, 3), 128, np.uint8)
    train = list(range(len(cameras) - 1))
    points = parameters["means"].double().numpy()
    capture = Capture(cameras, points, colors, train, [len(train)], 10.0, np.zeros(3))
    return capture, Images(images)


def picture(table, views, index):
    return render_frame(table, views.pick([index]), RenderOptions(3, 0.01, 1e6)).renders[0]


def flat(columns):
    """Columns of a table side by side, [N, 59] in float64."""
    return torch.cat([c.flatten(1) if c.dim() > 1 else c[:, None] for c in columns], 1).double()


class DenseAdam:
    """torch's Adam over all rows of a table, with the gradients of the trainer's steps."""

    def __init__(self, table, optimiser):
        self.params = flat(table.parameters)
        self.widths = [p[0].numel() for p in table.parameters]
        # Learning rates differ between columns, so Adam moves `move` from zero with a rate of one.
        self.move = torch.zeros_like(self.params, requires_grad=True)
        self.move.grad = torch.zeros_like(self.params)
        # With one image per step, the trainer uses Adam's constants without scaling.
        self.adam = torch.optim.Adam([self.move], 1.0, (0.9, 0.999), 1e-15, fused=True)
        groups = torch.tensor([3, 4, 3, 1, 3, 45], device=table.device)  # the colours have two rates
        self.rates = optimiser.lr_table.double().repeat_interleave(groups, 1)

    def step(self, table, frame, gradients, scale_reg, step):
        """Take a step with the gradients that the trainer's optimiser gets next."""
        splats, options = frame.projected, frame.options.projection(frame.views)
        *v, _ = torch.ops.blitzgs.project_bwd(
            list(table.parameters), frame.views.viewmats, frame.views.Ks, scale_reg, None,
            splats.camera_ids, splats.visible_ids, splats.splat_offsets, None, *options,
            list(gradients.parts), None, False,
        )  # fmt: skip
        self.move.grad.zero_().index_copy_(0, splats.visible_ids.long(), flat(v))
        self.adam.step()
        self.params.addcmul_(self.move.data, self.rates[step])
        self.move.data.zero_()

    def columns(self):
        return self.params.split(self.widths, 1)


def memory(device):
    """Bytes in use: of this process on the host, and of tensors on the GPU."""
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return resident, torch.cuda.memory_allocated() if device == "cuda" else 0


def start_trainer(folder, device, steps):
    options = (
        f"schedule.iterations={steps}", f"schedule.position_decay={steps}", "schedule.densify_from=0",
        "schedule.densify_until=0", f"log.every={steps // 10}", "log.checkpoint_seconds=0",
    )  # fmt: skip
    ranks = Ranks(device=torch.device(device))
    trainer = make_trainer(folder, *options, scene=carpet_capture(device), ranks=ranks)
    table, unit = trainer.state.table, trainer.state.space.unit
    # The octree's Gaussians are round, so gradients of quaternions would be rounding errors, which Adam
    # magnifies.
    for name, values in carpet(len(table), 2).items():
        values = values / unit if name == "means" else values
        table[name].copy_(values - np.log(unit) if name == "scales" else values)
    trainer.state.stepper.reindex()
    return trainer


@pytest.mark.parametrize(
    ("device", "steps"),
    [("cpu", 1000), pytest.param("cuda", 100_000, marks=[pytest.mark.slow, pytest.mark.cuda])],
)
@torch.no_grad()
def test_a_long_run_stays_with_dense_adam_and_needs_no_more_memory(tmp_path, device, steps):
    trainer = start_trainer(tmp_path, device, steps)
    state = trainer.state
    table, optimiser = state.table, state.optimiser
    dense, start, lazy_step = DenseAdam(table, optimiser), flat(table.parameters), optimiser.step

    def both(table, frame, gradients, scale_reg, opacity_reg, step, *others):
        assert opacity_reg is None  # `DenseAdam` has no such term
        dense.step(table, frame, gradients, scale_reg, step)
        lazy_step(table, frame, gradients, scale_reg, opacity_reg, step, *others)

    optimiser.step = both
    for step in range(1, steps + 1):
        trainer.step(step)
        if step == steps // 5:
            before = memory(device)
    after = memory(device)
    trainer.close()
    growth = [b - a for a, b in zip(before, after, strict=True)]
    print(f"{device}, {steps:,} steps: bytes more on host and GPU since a fifth of them: {growth}")

    behind = steps - table["moment_step"]
    assert int(behind.max()) > 100 and float((behind < 1000).float().mean()) > 0.9
    state.catch_up()
    moved = (dense.params - start).split(dense.widths, 1)
    walk = WALK * steps**0.5
    for name, ours, expected, way in zip(PARAMETERS, table.parameters, dense.columns(), moved, strict=True):
        error, size = flat([ours]) - expected, expected.abs().max()
        rms, largest = error.square().mean().sqrt() / size, error.abs().max() / size
        print(f"{name}: error {rms / walk:.3f} rms, {largest / walk:.3f} at most, in units of the walk")
        assert rms <= walk and largest <= LARGEST * walk, name
        assert way.square().mean().sqrt() > 100 * rms * size, name
    other = GaussianTable({name: column.clone() for name, column in table.columns.items()})
    for column, values in zip(other.parameters, dense.columns(), strict=True):
        column.copy_(values.view(column.shape))
    shown = [
        torch.stack([picture(gaussians, state.views, index) for index in range(0, ACROSS**2, 16)])
        for gaussians in (table, other)
    ]
    difference = (shown[0] - shown[1]).abs()
    # A Gaussian whose alpha is close to the cut-off of 1/255 at a pixel may be in one picture alone.
    assert difference.max() < 1 / 255 and (difference > 1e-3).float().mean() < 1e-3
    assert all(grown <= most for grown, most in zip(growth, MAX_GROWTH, strict=True))
