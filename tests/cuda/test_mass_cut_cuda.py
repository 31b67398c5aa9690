# SPDX-License-Identifier: Apache-2.0
"""The search for thresholds among very many items gives the same result on CUDA and the CPU."""

import pytest
import torch

from blitzgs.ops.mass_cut import STEPS, MassCut

SHARE = 99, 100


@pytest.mark.parametrize("n_segments", [4, 32])
def test_cuda_equals_cpu_on_many_items(n_segments):
    g = torch.Generator().manual_seed(2)
    n = 300_000
    owners = torch.arange(n, dtype=torch.int32).repeat_interleave(3)
    segments = torch.randint(0, n_segments, (3 * n,), generator=g, dtype=torch.int32)
    weights = (torch.randn(3 * n, generator=g) * 3 + 22).exp().long()
    weights[::5] = 1 << 30
    ids = torch.randperm(n, generator=g)
    found = []
    for device in ("cpu", "cuda"):
        cut = MassCut.begin(*(t.to(device) for t in (weights, segments, owners, ids)), n_segments)
        cut.take_steps(SHARE, 0, STEPS)
        found.append(cut.chosen.cpu())
    assert torch.equal(*found) and 0.1 < found[0].double().mean() < 0.99
