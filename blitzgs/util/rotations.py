# SPDX-License-Identifier: Apache-2.0
"""Rotation matrices and quaternions (w, x, y, z)."""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_matrices(quats: Tensor) -> Tensor:
    """Return the matrices [..., 3, 3] of quaternions [..., 4], rotations if these have length 1."""
    w, x, y, z = quats.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quaternions(rotations: Tensor) -> Tensor:
    """Return (w, x, y, z) [N, 4] of rotations [N, 3, 3], over the largest of the four (Shepperd 1978)."""
    r = rotations
    xx, yy, zz = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    wx, wy, wz = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    # Row i is 4 q_i q; the one with the largest q_i has the least rounding.
    rows = (
        (1 + xx + yy + zz, wx, wy, wz),
        (wx, 1 + xx - yy - zz, xy, xz),
        (wy, xy, 1 - xx + yy - zz, yz),
        (wz, xz, yz, 1 - xx - yy + zz),
    )
    products = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    best = products.diagonal(dim1=1, dim2=2).argmax(dim=1)
    return torch.nn.functional.normalize(products[torch.arange(len(r), device=r.device), best], dim=1)
