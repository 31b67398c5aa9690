# SPDX-License-Identifier: Apache-2.0
"""Sums: over trees and views, of density control, and what a step reports."""

import math

import pytest
import torch

from blitzgs.ops.importance import DIVISIONS, ViewSums, view_sums_
from blitzgs.ops.photometric import report_
from blitzgs.ops.population import density_stats_, tree_sums
from tests.helpers import refused, sum_parts

DEPTH, FEATURES, TREES = 5, 3, 9


def forest(seed=0):
    """Ragged trees: a list of nodes (threshold, feature, unknown goes left, left, right, leaf)."""
    g = torch.Generator().manual_seed(seed)
    nodes, roots = [], []

    def grow(depth):
        at = len(nodes)
        nodes.append(None)
        leaf = int(torch.randint(-(1 << 40), 1 << 40, (), generator=g))
        if depth == DEPTH or torch.rand((), generator=g) < 0.2:
            nodes[at] = (0.0, 0, False, -1, -1, leaf)
            return at
        threshold, feature = float(torch.rand((), generator=g)), int(torch.randint(3, (), generator=g))
        unknown = bool(torch.rand((), generator=g) < 0.5)
        nodes[at] = (threshold, feature, unknown, grow(depth + 1), grow(depth + 1), leaf)
        return at

    for _ in range(TREES):
        roots.append(grow(0))
    return nodes, roots


def tensors(nodes, roots):
    bits = torch.tensor([node[0] for node in nodes]).view(torch.int32)
    rest = torch.tensor([[2 * node[1] + node[2], node[3], node[4]] for node in nodes], dtype=torch.int32)
    leaves = torch.tensor([node[5] for node in nodes])
    return torch.tensor(roots, dtype=torch.int32), torch.cat((bits[:, None], rest), 1), leaves, DEPTH


@pytest.mark.parametrize("count", [0, 1, 700])
def test_tree_sums_equal_a_walk_down_each_tree(device, count):
    nodes, roots = forest()
    features = torch.rand(count, FEATURES, generator=torch.Generator().manual_seed(1))
    features[::3, 1] = math.nan
    features[1::5, 0] = math.inf
    if count > 1:
        features[0, 0] = nodes[roots[0]][0]  # equal to a threshold: right
    expected = []
    for row in features.tolist():
        total = 0
        for at in roots:
            while nodes[at][3] >= 0:
                threshold, feature, unknown, left, right, _ = nodes[at]
                threshold = float(torch.tensor(threshold))
                goes_left = unknown if math.isnan(row[feature]) else row[feature] < threshold
                at = left if goes_left else right
            total += nodes[at][5]
        expected.append(total)
    moved = [t.to(device) if isinstance(t, torch.Tensor) else t for t in tensors(nodes, roots)]
    assert tree_sums(features.to(device), *moved).tolist() == expected


def test_tree_sums_errors_name_the_value():
    roots, nodes, leaves, depth = tensors(*forest())
    with pytest.raises(RuntimeError, match=r"nodes must have shape \[\*, 4\], got"):
        tree_sums(torch.rand(2, 3), roots, nodes[:, :3], leaves, depth)
    with pytest.raises(RuntimeError, match="features must be Float, got Double"):
        tree_sums(torch.rand(2, 3).double(), roots, nodes, leaves, depth)
    refused(RuntimeError, "at most 32 .*, got 33", tree_sums, torch.rand(2, 33), roots, nodes, leaves, depth)


def test_tree_sums_opcheck():
    torch.library.opcheck(torch.ops.blitzgs.tree_sums, (torch.rand(20, 3), *tensors(*forest())))


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


@pytest.mark.parametrize("rule", DIVISIONS)
def test_view_sums_equal_dense_sums(device, rule):
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


def test_view_sums_errors_name_the_value():
    refused(RuntimeError, "cull has 64 columns, got 64", add, empty("cpu"), "cpu", columns=[*COLUMNS[1:], 64])
    refused(RuntimeError, "1 to 32 views at once, got 33", add, empty("cpu"), "cpu", columns=list(range(33)))
    short = empty("cpu")._replace(seen=torch.zeros(3, dtype=torch.int32))
    refused(RuntimeError, r"seen must have shape \[300\], got \[3\]", add, short, "cpu")


def test_view_sums_opcheck():
    splats, _, *rest = batch()
    arguments = (list(empty("cpu")), list(splats), *rest, COLUMNS, 2, EPS, UNIT)
    torch.library.opcheck(torch.ops.blitzgs.view_sums_, arguments)


WIDTH, HEIGHT, B = 640, 480, 3


def rows(n=50, dtype=torch.float32, device="cpu"):
    """Some Gaussians of n in one to three views, with anisotropic covariances."""
    generator = torch.Generator().manual_seed(0)
    visible = torch.arange(1, n, 3, dtype=torch.int32)
    counts = torch.randint(1, B + 1, (len(visible),), generator=generator)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)]).int()
    factor = torch.randn(int(offsets[-1]), 2, 2, generator=generator, dtype=torch.float64) * 5
    covariance = factor @ factor.mT + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    gradients = torch.randn(len(conics), 2, generator=generator, dtype=torch.float64)
    phi = torch.rand(n, generator=generator, dtype=torch.float64)
    to = lambda t: t.to(device, dtype)  # noqa: E731
    return visible.to(device), offsets.to(device), to(gradients), to(conics), to(phi), covariance


def state(n=50, dtype=torch.float32, device="cpu"):
    zeros = torch.zeros(n, dtype=dtype, device=device)
    return zeros, torch.zeros(n, dtype=torch.int32, device=device), zeros.clone()


@pytest.mark.parametrize("with_phi", [False, True])
def test_density_stats_match_the_definition(device, with_phi):
    visible, offsets, gradients, conics, phi, covariance = rows(device=device)
    sums, counts, radii = state(device=device)
    for _ in range(2):
        density_stats_(
            sums, counts, radii, visible, offsets, gradients, conics, WIDTH, HEIGHT, B,
            phi if with_phi else None,
        )  # fmt: skip
    expected_sum, expected_count, expected_radius = torch.zeros(50), torch.zeros(50), torch.zeros(50)
    largest = torch.linalg.eigvalsh(covariance)[:, 1]
    for u, g in enumerate(visible.tolist()):
        for r in range(int(offsets[u]), int(offsets[u + 1])):
            norm = (gradients[r].cpu() * torch.tensor([WIDTH / 2, HEIGHT / 2])).norm()
            expected_sum[g] += 2 * B * norm * (phi[g].cpu() if with_phi else 1)
            expected_count[g] += 2
            expected_radius[g] = max(expected_radius[g], float((3 * largest[r].sqrt()).ceil()))
    torch.testing.assert_close(sums.cpu(), expected_sum)
    assert counts.tolist() == expected_count.tolist()
    off = (radii.cpu() - expected_radius)[visible.long().cpu()].abs()
    assert off.max() <= 1 and (off == 0).float().mean() > 0.9  # a radius on an integer may round either way


def test_radii_keep_their_maximum_and_empty_steps_change_nothing(device):
    visible, offsets, gradients, conics, _, _ = rows(device=device)
    sums, counts, radii = state(device=device)
    radii += 1e6
    density_stats_(sums, counts, radii, visible, offsets, gradients, conics, WIDTH, HEIGHT, 1.0)
    assert (radii == 1e6).all()
    before = sums.clone()
    density_stats_(
        sums, counts, radii, visible[:0], offsets[:1], gradients[:0], conics[:0], WIDTH, HEIGHT, 1.0
    )
    assert torch.equal(sums, before)


def test_gradients_are_read_where_they_are(device):
    """The gradients may be the first columns of a table."""
    visible, offsets, gradients, conics, _, _ = rows(device=device)

    def sums(v_means2d):
        columns = state(device=device)
        density_stats_(*columns, visible, offsets, v_means2d, conics, WIDTH, HEIGHT, 1.0)
        return columns[0]

    expected = sums(gradients)
    assert torch.equal(sums(torch.cat((gradients, gradients.exp()), 1)[:, :2]), expected)
    refused(RuntimeError, r"v_means2d must have shape \[\d+, 2\]", sums, gradients[1:].contiguous())


def test_density_stats_errors_name_the_value():
    visible, offsets, gradients, conics, _, _ = rows()
    sums, counts, radii = state()
    with pytest.raises(RuntimeError, match="grad_count must be Int, got Float"):
        density_stats_(sums, sums.clone(), radii, visible, offsets, gradients, conics, WIDTH, HEIGHT, 1.0)
    with pytest.raises(RuntimeError, match=r"splat_offsets must have shape \[18\]"):
        density_stats_(sums, counts, radii, visible, offsets[1:], gradients, conics, WIDTH, HEIGHT, 1.0)


def test_density_stats_opcheck(device):
    visible, offsets, gradients, conics, phi, _ = rows(device=device)
    torch.library.opcheck(
        torch.ops.blitzgs.density_stats_,
        (*state(device=device), visible, offsets, gradients, conics, phi, WIDTH, HEIGHT, 2.0),
    )


@pytest.mark.parametrize("n_parts", [0, 1, 3000])
def test_each_target_of_a_report_gets_this_ranks_share(device, n_parts):
    g = torch.Generator().manual_seed(1)
    parts = torch.rand(3, n_parts, 2, generator=g, dtype=torch.float64).to(device)
    work = torch.randint(0, 1000, (777,), generator=g, dtype=torch.int32).to(device)
    targets = [torch.full((2 * 3 * 4 + 777,), -1.0, device=device) for _ in range(4)]
    report_(parts, work, (100, 500), 2, 4, targets)
    expected = torch.full_like(targets[0], -1.0)
    expected[12:18] = parts.sum(1).T.flatten().float()
    expected[24 + 100 : 24 + 500] = work[100:500].float()
    for target in targets:
        torch.testing.assert_close(target, expected, rtol=1e-6, atol=0)
    assert torch.equal(torch.cat(sum_parts(parts)), targets[0][12:18])


def test_a_report_of_tiles_alone_and_of_nothing(device):
    work = torch.arange(5, dtype=torch.int32, device=device)
    target = torch.zeros(5, device=device)
    report_(None, work, (1, 3), 0, 1, [target])
    assert target.tolist() == [0, 1, 2, 0, 0]
    report_(None, None, (0, 0), 0, 1, [target[:0]])


def test_report_op_errors_name_the_value():
    work, target = torch.zeros(5, dtype=torch.int32), torch.zeros(5)
    refused(RuntimeError, r"range of the 5 tiles, got \[3, 6\)", report_, None, work, (3, 6), 0, 1, [target])
    with pytest.raises(RuntimeError, match=r"a target must have shape \[9\], got \[5\]"):
        report_(torch.zeros(1, 2, 2, dtype=torch.float64), work, (0, 5), 1, 2, [target])
    refused(RuntimeError, r"rank must be in \[0, 2\), got 2", report_, None, work, (0, 5), 2, 2, [target])
    with pytest.raises(RuntimeError, match="parts must be Double, got Float"):
        report_(torch.zeros(1, 2, 2), None, (0, 0), 0, 1, [target])
