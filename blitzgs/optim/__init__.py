# SPDX-License-Identifier: Apache-2.0
"""Optimisers for Gaussians with the interface of `torch.optim`."""

from blitzgs.optim.lazy_adam import LazyAdam

__all__ = ["LazyAdam"]
