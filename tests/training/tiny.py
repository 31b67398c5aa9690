# SPDX-License-Identifier: Apache-2.0
"""A tiny capture that our own kernels rendered from random Gaussians: 8 views of 48 x 32 px; its runs."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from blitzgs.capture.image_files import reduced, reduced_mask
from blitzgs.capture.images import ImageMemory
from blitzgs.capture.lengths import near_plane, nearest_depths
from blitzgs.config.fields import Config
from blitzgs.config.files import load_config
from blitzgs.distributed.group import Ranks
from blitzgs.frame.render import RenderOptions, render_frame
from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, lazy_adam_catch_up_, lazy_adam_step_
from blitzgs.ops.projection_types import Views
from blitzgs.table.table import PARAMETERS, GaussianTable
from blitzgs.training.trainer import Trainer
from tests.helpers import look_at_origin, write_colmap

WIDTH, HEIGHT, COUNT = 48, 32, 400

OVERRIDES = (
    "population.pixels_per_gaussian=0", "schedule.iterations=100", "schedule.densify_from=20",
    "schedule.densify_until=90", "schedule.densify_every=20", "schedule.size_prune_after=50",
    "schedule.sh_every=30", "population.grad_threshold=2e-3", "population.prune_screen_radius=0",
    "log.every=20", "log.tensorboard=false",
)  # fmt: skip


@dataclass
class Camera:
    name: str
    width: int
    height: int
    K: np.ndarray
    world_to_camera: np.ndarray
    image_path: Path = Path("/nowhere")
    mask_path: Path | None = None
    rectification: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(has_invalid=False, is_identity=True)
    )


@dataclass(eq=False)
class Capture:
    cameras: list[Camera]
    points: np.ndarray
    colors: np.ndarray
    train: list[int]
    test: list[int]
    extent: float
    offset: np.ndarray = field(default_factory=lambda: np.array([10.0, 20.0, 30.0]))
    root: Path = Path("/nowhere")
    about: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(frame=None, random_points=False))
    apart: list[int] = field(default_factory=list)
    has_alpha: bool = False

    @property
    def near(self) -> float:
        return near_plane(nearest_depths(self.cameras, self.points)[self.train], self.extent)


class Images:
    def __init__(self, images, masks=None):
        self.images, self.masks = images, masks

    def get(self, index, factor=1):
        if factor == 1:
            return self.images[index]
        mask = self.mask(index)
        mask = None if mask is None else mask.numpy()
        return torch.from_numpy(reduced(self.images[index].numpy(), mask, factor))

    def mask(self, index, factor=1):
        mask = None if self.masks is None else self.masks[index]
        return mask if mask is None or factor == 1 else torch.from_numpy(reduced_mask(mask.numpy(), factor))

    def prefetch(self, indices, masks=(), factor=1):
        pass

    def room(self):
        return 0

    def memory(self):
        return ImageMemory(0, 0, 0, 0, 0)

    def lose(self, *indices, error=FileNotFoundError):
        """Let the reading of these photographs fail, or that of all."""
        read = self.get

        def get(index, factor=1):
            if indices and index not in indices:
                return read(index, factor)
            raise error(f"/photos/{index:02}.png cannot be read")

        self.get = get


def as_flags(*overrides: str) -> list[str]:
    """Return overrides as flags of a command, which takes none twice: of equal fields the last one counts."""
    fields = dict(text.split("=", 1) for text in overrides)
    return [f"--{name}={value}" for name, value in fields.items()]


def tiny_config(*overrides: str) -> Config:
    return load_config(None, [*OVERRIDES, *overrides])


def tiny_cameras(scale: float) -> list[Camera]:
    K = np.array([[40.0, 0.0, 24.5], [0.0, 41.0, 15.0], [0.0, 0.0, 1.0]])
    positions = [
        np.array([3 * np.cos(a), 3 * np.sin(a), 2.5]) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ]
    cameras = [Camera(f"{i:02}.png", WIDTH, HEIGHT, K, look_at_origin(p)) for i, p in enumerate(positions)]
    for camera in cameras:
        camera.world_to_camera[:3, 3] *= scale
    return cameras


def random_gaussians(count: int = COUNT) -> GaussianTable:
    g = torch.Generator().manual_seed(4)
    means = torch.rand(count, 3, generator=g) * torch.tensor([2.4, 2.4, 0.6]) - torch.tensor([1.2, 1.2, 0.3])
    return GaussianTable.create(
        {
            "means": means,
            "quats": torch.randn(count, 4, generator=g),
            "scales": torch.rand(count, 3, generator=g) - 3.0,
            "opacities": torch.rand(count, generator=g) * 4,
            "sh": torch.randn(count, 1, 3, generator=g) * 0.8,
        }
    )


def photographed(
    truth: GaussianTable, cameras: list[Camera], test: int, extent: float
) -> tuple[Capture, Images]:
    """Return a capture of Gaussians: renders from the cameras, and the centres as points.

    `test`: the view that is held out. `extent`: radius of the cameras' positions.
    """
    images = []
    for camera in cameras:
        views = Views(
            torch.from_numpy(camera.world_to_camera).float()[None],
            torch.from_numpy(camera.K).float()[None],
            camera.width,
            camera.height,
        )
        render = render_frame(truth, views, RenderOptions(0, 0.01, 1e6)).renders[0]
        images.append((render.clamp(0, 1) * 255 + 0.5).byte())
    colors = (0.5 + 0.28209479 * truth["sh"][:, 0]).clamp(0, 1).mul(255).byte().numpy()
    train = [i for i in range(len(cameras)) if i != test]
    return Capture(cameras, truth["means"].double().numpy(), colors, train, [test], extent), Images(images)


def tiny_scene(scale: float = 1.0) -> tuple[Capture, Images]:
    """Capture and images; `scale` scales the capture's world, not the images."""
    capture, images = photographed(random_gaussians(), tiny_cameras(1.0), test=3, extent=1.1 * 3.0 * scale)
    capture.cameras, capture.points = tiny_cameras(scale), scale * capture.points
    return capture, images


def write_tiny_capture(folder: Path) -> None:
    """Write the capture as a COLMAP model with PNG images."""
    capture, images = tiny_scene()
    (folder / "images").mkdir(parents=True)
    for camera, image in zip(capture.cameras, images.images, strict=True):
        cv2.imwrite(str(folder / "images" / camera.name), image.numpy()[..., ::-1])
    K = capture.cameras[0].K
    names, poses = zip(*((camera.name, camera.world_to_camera) for camera in capture.cameras), strict=True)
    camera = (WIDTH, HEIGHT, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    write_colmap(folder / "sparse/0", camera, list(names), np.stack(poses), capture.points, capture.colors)


def make_trainer(
    folder: Path,
    *overrides: str,
    scene: tuple[Capture, Images] | None = None,
    ranks: Ranks | None = None,
    resume: bool = False,
) -> Trainer:
    """Return a trainer of the tiny capture, or of another one."""
    return Trainer(tiny_config(*overrides), *(scene or tiny_scene()), folder, ranks or Ranks(), resume)


def train(folder: Path, *overrides: str, **how: Any) -> tuple[Trainer, dict[str, Any] | None]:
    """Train to the end; return the trainer and its summary, None if it was stopped."""
    trainer = make_trainer(folder, *overrides, **how)
    return trainer, trainer.train()


def lose_view(capture: Capture, images: Images, view: int) -> None:
    """Take a training view from a capture, as if its photograph were missing from the start."""
    del capture.cameras[view], images.images[view]
    for part in (capture.train, capture.test):
        part[:] = [index - (index > view) for index in part if index != view]


def at_step(monkeypatch, number: int, action: Callable[[Trainer], object]) -> None:
    """Call `action(trainer)` after step `number`."""
    step = Trainer.step

    def changed(self, taken):
        step(self, taken)
        if taken == number:
            action(self)

    monkeypatch.setattr(Trainer, "step", changed)


def stop_at(monkeypatch, number: int) -> None:
    """Ask the process to stop after step `number`."""
    at_step(monkeypatch, number, lambda trainer: os.kill(os.getpid(), signal.SIGTERM))


def trained_in_parts(train: Callable, folder: Path, number: int, *overrides: str) -> Trainer:
    """Stop the training after step `number`, go on, and return the second trainer."""
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, number)
        assert train(folder, *overrides)[1] is None
    return train(folder, *overrides, resume=True)[0]


def read_log(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a run's log."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def steps_of(folder: Path) -> list[dict[str, Any]]:
    """Return the records of steps in a run's log."""
    return [record for record in read_log(folder) if "loss" in record]


def events_of(folder: Path, event: str) -> list[dict[str, Any]]:
    """Return the records of one kind of event in a run's log."""
    return [record for record in read_log(folder) if record.get("event") == event]


def sorted_rows(table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the columns of a table, on the CPU, with the rows in the order of their ids."""
    order = table["id"].argsort()
    return {name: table[name][order].cpu() for name in table}


def assert_same_table(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> None:
    """Check that two tables hold the same bits."""
    assert len(a) == len(b) and sorted(a) == sorted(b)
    for name in a:
        assert torch.equal(a[name], b[name]), name


def _state(table: GaussianTable) -> AdamState:
    groups = table.parameters, table.exp_avgs, table.exp_avg_sqs
    return AdamState(*groups, table["last_step"], table["moment_step"])


def schedule_of(rates: Tensor) -> AdamSchedule:
    """Return the schedule with these learning rates, [S + 1, 6]."""
    return AdamSchedule(rates, 0.9, 0.999, 1e-15)


def caught_up(table: GaussianTable, schedule: AdamSchedule, step: int) -> GaussianTable:
    """Return a copy of a table with no pending steps up to `step`."""
    copy = GaussianTable({name: table[name].clone() for name in table})
    lazy_adam_catch_up_(_state(copy), schedule, step)
    return copy


def step_some(
    table: GaussianTable, ids: Tensor, schedule: AdamSchedule, step: int, generator: torch.Generator
) -> Tensor:
    """Take a step with random gradients of about half of the rows `ids`; return these rows, int32 [U]."""
    stepped = ids[torch.rand(len(ids), generator=generator).to(ids.device) < 0.5]
    grads = [
        torch.randn((len(stepped), *table[name].shape[1:]), generator=generator).to(ids.device)
        for name in PARAMETERS
    ]
    lazy_adam_step_(_state(table), schedule, step, grads, stepped)
    return stepped
