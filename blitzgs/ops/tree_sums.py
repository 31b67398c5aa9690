# SPDX-License-Identifier: Apache-2.0
"""Evaluates gradient-boosted trees with integer sums."""

from __future__ import annotations

import torch
from torch import Tensor

import blitzgs._library  # noqa: F401  (registers the ops)


@torch.no_grad()
def tree_sums(features: Tensor, roots: Tensor, nodes: Tensor, leaves: Tensor, depth: int) -> Tensor:
    """Return, for each row of features, the sum of the leaf values that it reaches in all trees.

    Args:
        features: float32 [M, F], F <= 32; NaN: unknown.
        roots: int32 [T], the first node of each tree.
        nodes: int32 [n, 4]: the bits of the float32 threshold below which a row goes left; twice the number
            of the feature that is compared, plus 1 where NaN goes left; the left child, -1 for a leaf; and
            the right one. Children and features must be in range: the kernel does not check them.
        leaves: int64 [n]; read at leaves.
        depth: largest number of comparisons on a path from a root to a leaf.

    Returns:
        int64 [M], the same bits on every device.

    Raises:
        RuntimeError: wrong shapes or dtypes.
    """
    return torch.ops.blitzgs.tree_sums(features, roots, nodes, leaves, depth)
