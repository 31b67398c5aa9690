# SPDX-License-Identifier: Apache-2.0
import numpy as np
import torch

from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.frame.ownership import TileOwners
from blitzgs.optim.table_adam import TableAdam
from blitzgs.training.batch import Batch
from blitzgs.training.loss import photometric
from blitzgs.training.step import Stepper
from tests.training.tiny import look_at_origin, random_gaussians, tiny_config


def test_a_step_marks_its_stages_and_lowers_the_loss():
    config, table = tiny_config(), random_gaussians(300)
    optimiser = TableAdam(config.optimiser, Schedule(config.schedule), 1.0, "cpu")
    stepper = Stepper(table, optimiser, TileOwners(Ranks()), config.loss, 1.0)
    viewmat = torch.from_numpy(look_at_origin(np.array([3.0, 0.0, 1.5]))).float()[None]
    K = torch.tensor([[[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]])
    views, options = Views(viewmat, K, 80, 60), RenderOptions(0, 0.05, 100.0)
    targets = torch.full((1, 60, 80, 3), 90, dtype=torch.uint8)
    batch = Batch([0], views, targets, None, torch.full((1,), 3.0 * 60 * 80), None)
    losses = []
    for step in range(1, 30):
        stages = []
        frame, terms, sums = stepper.forward(step, options, batch, stages.append)
        assert stages == ["other", "optimiser", "project", "exchange", "sort", "raster", "loss", "other"]
        stages.clear()
        stepper.backward(step, frame, terms, stages.append)
        assert stages == ["raster back", "exchange back", "optimiser", "other"]
        losses.append(photometric(sums.read(), batch.samples, config.loss).item())
    assert losses[-1] < losses[0] - 0.01
