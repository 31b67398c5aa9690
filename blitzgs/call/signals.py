# SPDX-License-Identifier: Apache-2.0
"""Extra signals: values that are composited beside the colours."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

NORMAL_CHANNELS = 3
_MAX_DEGREE = 3


class Signals(NamedTuple):
    """The extra signals of a call.

    Attributes:
        values: of all scenes: [..., N, E], per view [..., C, N, E], or SH coefficients [..., N, K, E].
        sh_degree: degree of the SH that are evaluated; None: the values are composited.
        per_view: whether every view has its own values.
    """

    values: Tensor
    sh_degree: int | None
    per_view: bool

    @property
    def channels(self) -> int:
        """Number of channels E."""
        return self.values.shape[-1]


def checked_signals(values: Tensor, sh_degree: int | None, batch: tuple[int, ...], C: int, N: int) -> Signals:
    """Check the shape of extra signals.

    Args:
        values: `extra_signals` of `blitzgs.rasterization`.
        sh_degree: its `extra_signals_sh_degree`.
        batch: the batch dimensions.
        C: number of views of each scene.
        N: number of Gaussians of each scene.

    Raises:
        ValueError: a shape or the degree does not fit.
    """
    shape, per_view = tuple(values.shape), False
    if sh_degree is None:
        per_view = shape[:-1] == (*batch, C, N)
        wanted, fits = "[..., N, E] or [..., C, N, E]", per_view or shape[:-1] == (*batch, N)
    else:
        if isinstance(sh_degree, bool) or sh_degree not in range(_MAX_DEGREE + 1):
            raise ValueError(f"extra_signals_sh_degree must be None or 0 to {_MAX_DEGREE}, got {sh_degree!r}")
        least = (sh_degree + 1) ** 2
        wanted = f"SH coefficients [N, K, E] or [..., N, K, E] with K of at least {least}"
        if batch and len(shape) == 3 and shape[0] == N:  # all scenes share them, as in gsplat
            values = values.expand(*batch, *shape)
        fits = values.shape[:-2] == (*batch, N) and values.shape[-2] >= least
    if not fits or shape[-1] == 0:
        raise ValueError(
            f"extra_signals must be {wanted}, here with {[*batch]} before N = {N}, C = {C}, got {[*shape]}"
        )
    return Signals(values, sh_degree, per_view)
