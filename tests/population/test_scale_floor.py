# SPDX-License-Identifier: Apache-2.0
"""Floors of scales equal those of one Gaussian and view at a time, and whole runs keep to them."""

import math

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame.frame import Views
from blitzgs.population.scale_floor import FLOOR, raise_scales, scale_floors
from blitzgs.table.table import GaussianTable
from blitzgs.training.events import densify
from blitzgs.training.trainer import Trainer
from tests.training.tiny import random_gaussians, tiny_cameras, tiny_config, tiny_scene

NEAR, PIXELS = 0.5, 0.4


def views_of(cameras) -> list[Views]:
    """Return each camera as a group of one view, and the first two as a group of two."""

    def group(some):
        poses = torch.from_numpy(np.stack([camera.world_to_camera for camera in some])).float()
        Ks = torch.from_numpy(np.stack([camera.K for camera in some])).float()
        return Views(poses, Ks, some[0].width, some[0].height)

    return [group(cameras[:2]), *(group([camera]) for camera in cameras[2:])]


def one_at_a_time(mean, cameras) -> float:
    finest = math.inf
    for camera in cameras:
        pose, K = camera.world_to_camera.astype(np.float32).astype(float), camera.K.astype(np.float32)
        x, y, z = pose[:3, :3] @ mean + pose[:3, 3]
        if z <= NEAR:
            continue
        u, v = (K[0, 0] * x / z + K[0, 2]) / camera.width, (K[1, 1] * y / z + K[1, 2]) / camera.height
        if -0.15 < u < 1.15 and -0.15 < v < 1.15:
            finest = min(finest, z / max(K[0, 0], K[1, 1]))
    return math.log(PIXELS * finest) if finest < math.inf else -80.0


def test_the_finest_view_that_samples_a_gaussian_sets_its_floor():
    means = random_gaussians()["means"] * 6
    cameras = tiny_cameras(1.0)[:4]
    cameras[3].K = cameras[3].K * np.array([[4, 1, 1], [1, 3, 1], [1, 1, 1]])
    found = scale_floors(means, views_of(cameras), NEAR, PIXELS)
    expected = torch.tensor([one_at_a_time(mean, cameras) for mean in means.double().numpy()])
    assert 5 < int((expected == -80).sum()) < 350 and expected.unique().numel() > 40
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected.double(), rtol=1e-6, atol=1e-6)


def test_scales_of_the_given_rows_rise_to_the_floor():
    table = random_gaussians()
    table[FLOOR] = torch.linspace(-3.5, -2.0, len(table))
    before, ids = table["scales"].clone(), torch.arange(0, len(table), 3, dtype=torch.int32)
    raise_scales(table, ids)
    expected = before.clone()
    expected[::3] = torch.maximum(before, table[FLOOR][:, None])[::3]
    assert torch.equal(table["scales"], expected) and not torch.equal(before, expected)


@pytest.mark.parametrize("batch_size", [1, 2])
def test_no_scale_falls_below_the_floor_in_a_run(tmp_path, batch_size):
    """This holds for Gaussians that the last step saw; others may have pending steps that shrink them."""
    options = ("model.scale_floor=0.447", f"schedule.batch_size={batch_size}", "optimiser.sparse=true")
    trainer = Trainer(tiny_config(*options), *tiny_scene(), tmp_path, Ranks())
    seen = {}
    backward = trainer.state.stepper.backward

    def spied(step, frame, *rest, **options):
        seen["ids"] = frame.projected.visible_ids.long()
        return backward(step, frame, *rest, **options)

    trainer.state.stepper.backward = spied
    summary = trainer.train()
    table = trainer.state.table
    floors = table[FLOOR]
    assert (floors > -80).any() and summary["psnr"] > 15
    assert (table["scales"][seen["ids"]] >= floors[seen["ids"], None]).all()
    assert (table["scales"] == floors[:, None]).any(dim=1).sum() > 3
    # Children have the floor of their parents until floors are computed again.
    born = table["birth"] > 20
    assert born.any() and (floors[born] > -80).any()
    assert GaussianTable(table.columns)[FLOOR] is floors


def test_the_first_density_event_of_a_compressed_schedule_finds_the_floors(tmp_path):
    # Events are less than an image apart, so the time of an event in images does not tell its number.
    options = ("schedule.scale=0.3", "schedule.densify_from=5", "schedule.densify_every=3", "log.pictures=0")
    config = tiny_config(*options, "model.scale_floor=0.447", "population.max_gaussians=400")
    trainer = Trainer(config, *tiny_scene(), tmp_path, Ranks())
    densify.run(trainer.state, trainer.state.schedule.events(0, 2)[0])
    assert (trainer.state.table[FLOOR] > -80).any()
    trainer.close()
