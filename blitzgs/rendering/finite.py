# SPDX-License-Identifier: Apache-2.0
"""NaN and infinite input: its Gaussians or views are not rendered, and the caller is told."""

from __future__ import annotations

import warnings
from functools import lru_cache
from itertools import count

import torch
from torch import Tensor

from blitzgs.rendering.arguments import Gaussians
from blitzgs.rendering.layout import Layout

# On CUDA the parameters are looked through in the first of so many calls of a size: it takes a pass over all
# of them, and what is not finite stays so.
EVERY_CUDA_CALLS = 32
COLOURS = ("colors", "sh0", "shN")


@torch.no_grad()
def non_finite(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return what is not finite, by argument: indices int64 [M] of Gaussians, or of views.

    Indices count through the scenes of a batch. An argument that is finite has no entry.
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
    """Warn, naming the arguments, where something is not finite and so is not rendered.

    A few sums tell whether to look closer. SH, which are most of a Gaussian, are looked at in visible rows
    alone.
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
    """Return what counts the calls with so many Gaussians."""
    return count()
