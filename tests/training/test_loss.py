# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest
import torch

from blitzgs.config.fields import LossConfig
from blitzgs.distributed.group import Ranks
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.population.initialisation import INITIAL_OPACITY
from blitzgs.table.table import GaussianTable
from blitzgs.training.batch import Batch
from blitzgs.training.loss import loss_terms, opacity_term, scale_term, weighted
from blitzgs.training.trainer import Trainer
from tests.helpers import DEVICES, parameter_gradients
from tests.training.tiny import look_at_origin, random_gaussians, tiny_config, tiny_scene

EXTENT, CONFIG = 1.7, LossConfig(opacity=0.3, scale=0.5, scale_reference=2.0)


@pytest.mark.parametrize("device", DEVICES)
def test_regularisers_are_means_over_the_visible_gaussians_of_a_view(device):
    plain = random_gaussians(300)
    table = GaussianTable({name: plain[name].to(device) for name in plain})
    poses = [look_at_origin(np.array([2.0 * np.cos(a), 2.0 * np.sin(a), 0.5])) for a in (0.0, 1.0, 3.0)]
    viewmats = torch.from_numpy(np.stack(poses)).float().to(device)
    K = torch.tensor([[90.0, 0, 40], [0, 90.0, 30], [0, 0, 1]], device=device).repeat(3, 1, 1)
    views = Views(viewmats, K, 80, 60)
    frame = pipeline.forward(table, views, RenderOptions(0, 0.05, 100.0))
    targets = torch.zeros((3, 60, 80, 3), dtype=torch.uint8, device=device)
    samples = torch.full((3,), 3.0 * 60 * 80, device=device)
    terms = loss_terms(frame, Batch([0, 1, 2], views, targets, None, samples, None), CONFIG, EXTENT)

    scales, opacities = (table[name].double().requires_grad_() for name in ("scales", "opacities"))
    views_of, ids_of = frame.projected.camera_ids, frame.projected.gaussian_ids.long()
    expected = []
    for view in range(3):
        seen = ids_of[views_of == view]
        assert 50 < len(seen) < 300  # so that the views' means differ
        axes = scales[seen].exp() / EXTENT
        expected.append(torch.stack([axes.amin(1).mean() / 2, opacities[seen].sigmoid().mean()]))
    found = scale_term(frame, table, 2 * EXTENT), opacity_term(frame, table)
    torch.testing.assert_close(torch.stack(found, 1).double(), torch.stack(expected), rtol=1e-5, atol=0)

    weights = torch.tensor([0.5, 0.3], dtype=torch.float64, device=device)
    (torch.stack(expected) @ weights).mean().backward()
    no_images = torch.zeros_like(frame.renders)
    regularisers = terms.scale_reg, terms.opacity_reg
    _, _, v_scales, v_opacities, _ = parameter_gradients(table, frame, no_images, *regularisers)
    visible = frame.projected.visible_ids.long()
    for got, want in ((v_scales, scales.grad[visible]), (v_opacities, opacities.grad[visible])):
        torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=1e-6 * float(want.abs().max()))


def test_the_logged_loss_has_all_terms(tmp_path):
    """In the first step all Gaussians are round and have the same opacity, so the terms are known."""
    first, fixed = {}, ("log.every=1", "schedule.iterations=8", "loss.scale=0")
    for override in ("loss.opacity=0", "loss.opacity=2", "loss.scale=5"):
        Trainer(tiny_config(*fixed, override), *tiny_scene(), tmp_path / override, Ranks()).train()
        lines = (tmp_path / override / "log.jsonl").read_text().splitlines()
        first[override] = next(record for record in map(json.loads, lines) if "loss" in record)
    plain = first["loss.opacity=0"]
    axis = first["loss.scale=5"]["l_scale"]
    for override, term in (("loss.opacity=2", 2 * INITIAL_OPACITY), ("loss.scale=5", 5 * axis)):
        assert first[override]["loss"] - plain["loss"] == pytest.approx(term, rel=1e-4)


@pytest.mark.parametrize(
    ("views", "opacity"), [(1, 0.05), (22, 0.05), (50, 0.022), (110, 0.01), (5_000, 0.005)]
)
def test_the_opacity_term_follows_the_number_of_views_within_what_was_measured(views, opacity):
    found = weighted(LossConfig(opacity_total=1.1, scale=0.7), views)
    assert found.opacity == pytest.approx(opacity) and found.opacity_total == 0 and found.scale == 0.7
    assert weighted(found, views + 1) == found  # a resumed run keeps its weight
    assert weighted(CONFIG, views) == CONFIG
