# SPDX-License-Identifier: Apache-2.0
"""Finds NaN and infinite input, whose Gaussians or views are not rendered, and warns the caller."""

from __future__ import annotations

import warnings
from functools import lru_cache
from itertools import count

import torch
from torch import Tensor

from blitzgs.rendering.arguments import Gaussians
from blitzgs.rendering.layout import Layout

# On CUDA, the first of this many calls of a size checks the parameters: the check is a pass over all of them,
# and values that are not finite stay so.
EVERY_CUDA_CALLS = 32
COLOURS = ("colors", "sh0", "shN")


@torch.no_grad()
def non_finite(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return, by argument, the indices int64 [M] of Gaussians or views whose values are not finite.

    Indices count through all scenes of a batch. Arguments whose values are all finite have no entry.
    """
    found = {}
    for name, tensors in gaussians.named.items():
        # Of colours per view, a Gaussian's are those of all views.
        rows = [t.movedim(1, 0) for t in tensors] if name == "colors" and gaussians.per_view else tensors
        finite = torch.cat([_finite(t, name, gaussians.raw) for t in rows])
        bad = (~finite).nonzero()[:, 0]
        if len(bad):
            found[name] = bad
    return found


def _finite(values: Tensor, name: str, raw: bool) -> Tensor:
    """Return which rows [N, ...] are finite, after their activation."""
    flat = values.reshape(len(values), -1)
    if raw and name == "opacities":
        return ~flat.isnan().any(dim=1)
    if raw and name == "scales":
        return flat.exp().isfinite().all(dim=1)
    return flat.isfinite().all(dim=1)


def warn_of_non_finite(gaussians: Gaussians, layout: Layout, function: str) -> None:
    """Warn about arguments with values that are not finite; their Gaussians or views are not rendered.

    A few sums tell whether a closer check is needed. SH coefficients, the largest part of a Gaussian, are
    only checked for visible Gaussians.
    """
    first = gaussians.named["means"][0]
    if first.is_cuda and next(_calls(first.device, first.shape[0])) % EVERY_CUDA_CALLS:
        return
    summed = [t for name, given in gaussians.named.items() if name not in COLOURS for t in given]
    with torch.no_grad():
        sums = [t.sum() for t in summed]
        # Splats whose colour is not finite have no opacity, and no other splat is below 1/255.
        hidden = (layout.splats.opacities == 0).any()
        looks_finite = bool(torch.stack(sums).sum().isfinite() & ~hidden)
    if looks_finite:
        return
    names = ", ".join(non_finite(gaussians))
    if names:
        warnings.warn(
            f"blitzgs.{function}: NaN or infinite values in {names}; the Gaussians or views that have them "
            "are not rendered. meta['non_finite'] has their indices.",
            RuntimeWarning,
            stacklevel=4,
        )


@lru_cache(maxsize=64)
def _calls(_device: torch.device, _gaussians: int) -> count[int]:
    """Return the counter of calls with this number of Gaussians."""
    return count()
