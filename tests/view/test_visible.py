# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.frame import frame as pipeline
from blitzgs.frame.frame import RenderOptions, Views
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import LodGate, SceneGate
from blitzgs.view.visible import VisibleFinder
from tests.helpers import DEVICES
from tests.table.test_blocks import FAR, HEIGHT, NEAR, WIDTH, allowed, make_table, make_views, seen

LIMITS = (NEAR, FAR, 0.3)
OPTIONS = RenderOptions(sh_degree=0, near_plane=NEAR, far_plane=FAR)


@pytest.mark.parametrize("device", DEVICES)
def test_rows_outside_the_views_are_left_out_and_the_image_stays_the_same(device):
    table, views = make_table(device=device), Views(*make_views(device=device), WIDTH, HEIGHT)
    found = VisibleFinder(table).find(*views.as_arguments(), LIMITS)
    ids, bits = found.active.listed()
    assert found.table is table and torch.equal(found.rows_of(ids), ids)
    assert seen(table, views.viewmats, views.Ks) <= allowed((ids, bits))
    assert len(ids) < 0.8 * len(table)
    whole = pipeline.forward(table, views, OPTIONS).renders
    assert whole.any() and torch.equal(pipeline.forward(table, views, OPTIONS, found.active).renders, whole)


@pytest.mark.parametrize("device", DEVICES)
def test_the_gate_leaves_out_the_rows_that_it_leaves_out_of_the_whole_table(device):
    table, views = make_table(device=device), Views(*make_views(device=device), WIDTH, HEIGHT)
    table["level"] = (torch.arange(len(table), device=device) % 6).to(torch.uint8)
    lod = SceneGate(LodGate(20.0, 2.0, 6, 4), 1.0, table, Ranks(device=torch.device(device)))
    gated = lod.active(table, views.viewmats)
    found = VisibleFinder(table, lod).find(*views.as_arguments(), LIMITS).active
    image, expected = (pipeline.forward(table, views, OPTIONS, rows).renders for rows in (found, gated))
    assert torch.equal(image, expected)
    assert not torch.equal(image, pipeline.forward(table, views, OPTIONS).renders)
    assert int(found.considered()) < int(gated.considered()) < len(table)


@pytest.mark.parametrize("device", DEVICES)
def test_a_table_without_rows_is_found_empty(device):
    table = make_table(device=device)
    table.keep(torch.zeros(len(table), dtype=torch.bool, device=device))
    views = Views(*make_views(device=device), WIDTH, HEIGHT)
    found = VisibleFinder(GaussianTable(table.columns)).find(*views.as_arguments(), LIMITS)
    assert len(found.active.listed()[0]) == 0
    assert not pipeline.forward(found.table, views, OPTIONS, found.active).renders.any()
