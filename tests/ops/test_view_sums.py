# SPDX-License-Identifier: Apache-2.0
"""The sums of an importance sweep equal dense sums."""

import pytest
import torch

from blitzgs.ops.importance import DIVISIONS, ViewSums, view_sums_
from tests.helpers import DEVICES

N, VIEWS, WORDS = 300, 7, 2
COLUMNS = [0, 3, 31, 32, 40, 61, 63]
EPS, UNIT = 1e-6, 2.0**-20


def batch(seed=0):
    """Splats of some Gaussians in some views, ordered by (Gaussian, view)."""
    g = torch.Generator().manual_seed(seed)
    seen = torch.rand(N, VIEWS, generator=g) < 0.4
    gaussians, cameras = seen.nonzero().unbind(1)
    visible, lengths = gaussians.unique_consecutive(return_counts=True)
    offsets = torch.cat((torch.zeros(1, dtype=torch.int64), lengths.cumsum(0)))
    count = len(gaussians)
    radii = torch.randint(0, 3, (count, 2), generator=g, dtype=torch.int32)
    pixels = torch.randint(0, 5000, (count,), generator=g, dtype=torch.int32)
    weights = torch.randint(0, 1 << 44, (count,), generator=g)
    counts = torch.rand(count, generator=g) < 0.5
    return (visible.int(), offsets.int(), cameras.int(), radii), gaussians, weights, pixels, counts


def empty(device):
    zeros = torch.zeros(N, dtype=torch.int32, device=device)
    cull = torch.full((N, WORDS), -1, dtype=torch.int32, device=device)
    return ViewSums(zeros.long(), zeros.clone(), zeros, cull)


def add(sums, device, rule="density", columns=COLUMNS, seed=0):
    splats, _, weights, pixels, counts = batch(seed)
    moved = [t.to(device) for t in (weights, pixels, counts)]
    view_sums_(sums, tuple(t.to(device) for t in splats), *moved, columns, rule=rule, eps=EPS, unit=UNIT)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("rule", DIVISIONS)
def test_equals_dense_sums(device, rule):
    sums = empty(device)
    for seed in (0, 1):
        add(sums, device, rule, seed=seed)
    score, seen, counted = (torch.zeros(N, dtype=torch.int64) for _ in range(3))
    cull = torch.ones(N, 32 * WORDS, dtype=torch.bool)
    for seed in (0, 1):
        (_, _, cameras, radii), gaussians, weights, pixels, counts = batch(seed)
        area = pixels.double() + EPS
        divisor = {"weight": 1.0, "root": area.sqrt(), "density": area}[rule]
        terms = weights.double() / 2**32 / divisor
        score.index_add_(0, gaussians, (terms / UNIT).round().long())
        seen.index_add_(0, gaussians, (radii > 0).any(1).long())
        counted.index_add_(0, gaussians, counts.long())
        cull[gaussians[counts], torch.tensor(COLUMNS)[cameras.long()][counts]] = False
    assert torch.equal(sums.score.cpu(), score) and score.max() > 0
    assert torch.equal(sums.seen.cpu().long(), seen) and torch.equal(sums.counted.cpu().long(), counted)
    bits = sums.cull.cpu()[:, :, None] >> torch.arange(32) & 1
    assert torch.equal(bits.view(N, -1).bool(), cull)


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match="cull has 64 columns, got 64"):
        add(empty("cpu"), "cpu", columns=[*COLUMNS[1:], 64])
    with pytest.raises(RuntimeError, match="1 to 32 views at once, got 33"):
        add(empty("cpu"), "cpu", columns=list(range(33)))
    short = empty("cpu")._replace(seen=torch.zeros(3, dtype=torch.int32))
    with pytest.raises(RuntimeError, match=r"seen must have shape \[300\], got \[3\]"):
        add(short, "cpu")


def test_opcheck():
    splats, _, *rest = batch()
    arguments = (list(empty("cpu")), list(splats), *rest, COLUMNS, 2, EPS, UNIT)
    torch.library.opcheck(torch.ops.blitzgs.view_sums_, arguments)
