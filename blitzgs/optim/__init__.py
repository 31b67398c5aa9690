# SPDX-License-Identifier: Apache-2.0
"""Optimisers of `torch.optim`'s kind for Gaussians."""

from blitzgs.optim.lazy_adam import LazyAdam

__all__ = ["LazyAdam"]
