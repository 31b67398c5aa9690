# SPDX-License-Identifier: Apache-2.0
"""Sums over trees equal a walk in Python."""

import math

import pytest
import torch

from blitzgs.ops.tree_sums import tree_sums
from tests.helpers import DEVICES

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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 700])
def test_sums_equal_a_walk_down_each_tree(device, count):
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


def test_errors_name_the_value():
    roots, nodes, leaves, depth = tensors(*forest())
    with pytest.raises(RuntimeError, match=r"nodes must have shape \[\*, 4\], got"):
        tree_sums(torch.rand(2, 3), roots, nodes[:, :3], leaves, depth)
    with pytest.raises(RuntimeError, match="features must be Float, got Double"):
        tree_sums(torch.rand(2, 3).double(), roots, nodes, leaves, depth)
    with pytest.raises(RuntimeError, match="at most 32 features, got 33"):
        tree_sums(torch.rand(2, 33), roots, nodes, leaves, depth)


def test_opcheck():
    torch.library.opcheck(torch.ops.blitzgs.tree_sums, (torch.rand(20, 3), *tensors(*forest())))
