# SPDX-License-Identifier: Apache-2.0
"""On a large table, GPU and CPU leave out the same rows of views."""

import pytest
import torch

from blitzgs.ops.blocks import ActiveRows, gate_views_
from blitzgs.table.table import GaussianTable
from blitzgs.view.gate import ViewGate
from tests.table.test_blocks import make_views
from tests.view.test_gate import GATE, bits, kept_by_definition, make_scene


def gated(table, viewmats, gate, count):
    """Gate the first `count` rows of lists with a capacity for all rows; return their views."""
    device, capacity = table.device, len(table)
    active = ActiveRows(
        torch.arange(capacity, dtype=torch.int32, device=device),
        torch.full((capacity,), -1, dtype=torch.int32, device=device),
        torch.tensor([count], dtype=torch.int32, device=device),
    )
    gate_views_(active, table["means"], viewmats, gate.rules(table))
    assert (active.views[count:] == -1).all()
    return active.views[:count]


# The launch has as many threads as fit on the GPU; the last sizes make them take turns.
@pytest.mark.parametrize("count", [0, 1, 255, 257, 100_000, 1_000_000])
def test_the_gpu_leaves_out_what_the_cpu_leaves_out(count):
    table = make_scene(1_000_000)
    viewmats, _ = make_views(32)
    gate = ViewGate(GATE.reach(), 0xFFFF0FF1, [view * 2 if view % 3 else -1 for view in range(32)])
    on_gpu = GaussianTable({name: table[name].cuda() for name in table})
    expected = gated(table, viewmats, gate, count)
    found = gated(on_gpu, viewmats.cuda(), gate, count).cpu()
    _, close = kept_by_definition(table, viewmats)
    assert torch.equal(bits(found, 32) | close[:count], bits(expected, 32) | close[:count])
    assert count < 1000 or 0.1 < bits(found, 32).double().mean() < 0.9
