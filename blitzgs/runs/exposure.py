# SPDX-License-Identifier: Apache-2.0
"""The exposures of a run's training photographs, as checkpoints hold them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

# Photographs whose gains differ by less than this, as a standard deviation, have the same exposure.
LEAST_SPREAD = 0.02
# File in the folder of a finished run: gain and bias, [2, 3], by the name of the photograph.
FILE = "exposures.json"
# Name of the tensor among those of a checkpoint that are the same on all ranks.
SHARED = "exposures"


def effective(measured: Tensor) -> Tensor:
    """Return gain and bias of each training view as they are used, float64 [T, 2, 3], from the measured ones.

    Their means over the views are 1 and 0. Photographs that agree all have 1 and 0. Does not wait.
    """
    mean = measured.mean(0)
    same = torch.zeros_like(mean)
    same[0] = 1
    differs = measured[:, 0].std(0, correction=0).mean() >= LEAST_SPREAD
    return torch.where(differs, measured - mean + same, same)


def stored(shared: Mapping[str, Tensor]) -> Tensor | None:
    """Return `effective` of a checkpoint's exposures; None if the run has none."""
    found = shared.get(SHARED)
    return None if found is None else effective(found[:, :-1].reshape(-1, 2, 3))
