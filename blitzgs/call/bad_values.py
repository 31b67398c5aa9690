# SPDX-License-Identifier: Apache-2.0
"""What calls say about values that have no effect on an image.

Gaussians and views that are NaN or infinite are not rendered; intrinsics with a skew are refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import count

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs._library import below_autograd
from blitzgs.call.arguments import Gaussians
from blitzgs.call.layout import Layout
from blitzgs.ops.host import HostCopy, to_host
from blitzgs.util.errors import warn

# Relative to the focal length: below the rounding of float32, and far below a pixel; as in the projection.
_LEAST_SKEW = 1e-6


def check_intrinsics(Ks: Sequence[Tensor]) -> None:
    """Refuse intrinsics [C, 3, 3] of scenes with a skew, or another last row than 0, 0, 1 (ValueError).

    The projection renders nothing with them, so calls look only where a view shows nothing: the host waits.
    """
    _check_rows(np.concatenate([to_host(matrices.detach()).numpy().reshape(-1, 9) for matrices in Ks]))


def _check_rows(rows: npt.NDArray[np.floating]) -> None:
    # Comparisons with NaN are false: what is not finite is warned of elsewhere.
    with np.errstate(invalid="ignore"):
        wrong = (abs(rows[:, [1, 3]]) > _LEAST_SKEW * abs(rows[:, :1])).any(axis=1)
        wrong |= (abs(rows[:, 6:] - (0, 0, 1)) > _LEAST_SKEW).any(axis=1)
    if wrong.any():
        index = int(wrong.argmax())
        raise ValueError(
            f"Ks[{index}] must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got "
            f"{rows[index].reshape(3, 3).tolist()}: a skew has no effect (undistort the image first), and Ks "
            "must be divided by Ks[..., 2, 2]"
        )


class CamerasOnHost:
    """Copies cameras to the host while the device works; for calls that do not learn what each view sees."""

    def __init__(self, gaussians: Gaussians) -> None:
        named = gaussians.named
        matrices = [t.detach().reshape(-1) for name in ("Ks", "viewmats") for t in named[name]]
        self._n_intrinsics = sum(t.numel() for t in named["Ks"])
        self._copy = HostCopy(torch.cat(matrices).double().view(torch.int64))

    def are_finite(self) -> bool:
        """Tell whether all cameras are finite; waits for the copy (ValueError: see `check_intrinsics`)."""
        values = self._copy.read().view(torch.float64).numpy()
        _check_rows(values[: self._n_intrinsics].reshape(-1, 9))
        return bool(np.isfinite(values).all())


# On CUDA, the first of this many calls of a size checks all arguments, in a pass over all Gaussians. Cameras
# differ from call to call, so every call looks for bad ones.
EVERY_CUDA_CALLS = 32
COLOURS = ("colors", "sh0", "shN")
SIGNALS = "extra_signals"


@torch.no_grad()
def non_finite(gaussians: Gaussians) -> dict[str, Tensor]:
    """Return, by argument, the indices int64 [M] of Gaussians or views whose values are not finite.

    Indices count through all scenes of a batch. Arguments whose values are all finite have no entry: one sum
    over each tells whether its rows have to be looked at, which needs no memory of their size.
    """
    activated = {
        name: [_activated(t, name, gaussians.raw) for t in tensors]
        for name, tensors in _evaluated(gaussians).items()
    }
    totals = [torch.stack([t.sum() for t in tensors]).sum() for tensors in activated.values()]
    found = {}
    for (name, tensors), finite in zip(
        activated.items(), torch.stack(totals).isfinite().tolist(), strict=True
    ):
        if finite:
            continue
        # Of colours per view, a Gaussian's are those of all views.
        signals = gaussians.signals is not None and gaussians.signals.per_view
        per_view = {"colors": gaussians.per_view, SIGNALS: signals}
        rows = [t.movedim(1, 0) for t in tensors] if per_view.get(name) else tensors
        bad = torch.cat([_rows_not_finite(t) for t in rows]).nonzero()[:, 0]
        if len(bad):
            found[name] = bad
    return found


def _evaluated(gaussians: Gaussians) -> Mapping[str, Sequence[Tensor]]:
    """Return the arguments without the SH above the degree, which the image does not depend on."""
    named: dict[str, Sequence[Tensor]] = dict(gaussians.named)
    if gaussians.sh_degree is not None:
        left = (gaussians.sh_degree + 1) ** 2
        for name in COLOURS:  # in the order of the coefficients
            if name in named:
                count = min(left, named[name][0].shape[-2])
                named[name] = [part.narrow(-2, 0, count) for part in named[name]]
                left -= count
    if gaussians.signals is not None and gaussians.signals.sh_degree is not None:
        used = (gaussians.signals.sh_degree + 1) ** 2
        named[SIGNALS] = [part.narrow(-2, 0, used) for part in named[SIGNALS]]
    return named


def _activated(values: Tensor, name: str, raw: bool) -> Tensor:
    """Return the values that have to be finite: those after the activation, if there is one."""
    if raw and name == "opacities":
        return values.sigmoid()
    return values.exp() if raw and name == "scales" else values


def _rows_not_finite(values: Tensor) -> Tensor:
    """Return which rows of [N, ...] have a value that is not finite, bool [N]."""
    flat = values.reshape(len(values), -1)
    bad = ~flat.sum(dim=1).isfinite()
    rows = bad.nonzero()[:, 0]
    bad[rows] = ~flat[rows].isfinite().all(dim=1)  # the sum of finite values may overflow
    return bad


def watch_for_non_finite(
    gaussians: Gaussians, layout: Layout, nan_marks: Sequence[Tensor], suspects_cameras: bool
) -> None:
    """Warn about arguments of a renderer with values that are not finite, after a cheap check for any.

    On CUDA most calls check the cameras alone, see `EVERY_CUDA_CALLS`. SH coefficients, the largest part of a
    Gaussian, are only checked for visible Gaussians. `nan_marks`: for each Gaussian, NaN if its colours (if
    they are values) or its extra signals are not finite.
    """
    named = gaussians.named
    first = named["means"][0]
    if first.is_cuda and next(_calls(first.device, first.shape[0])) % EVERY_CUDA_CALLS:
        if not suspects_cameras:
            return
        columns, opacities = [*named["viewmats"], *named["Ks"]], []
    else:
        columns = [t for name, given in named.items() if name not in (*COLOURS, SIGNALS) for t in given]
        columns += nan_marks
        # Splats whose SH are not finite have no opacity, and no other splat is below 1/255.
        opacities = [layout.splats.opacities]
    # One pass over the columns tells whether a closer check is needed.
    with below_autograd():
        if not torch.ops.blitzgs.find_non_finite(columns, opacities).item():
            return
    if names := ", ".join(non_finite(gaussians)):
        _warn(gaussians, names, "are not rendered. meta['non_finite'] has their indices.")


def warn_of_non_finite(gaussians: Gaussians) -> None:
    """Check all arguments, warn of values that are not finite, and name the first Gaussians or views."""
    found = {name: indices[:5].tolist() for name, indices in non_finite(gaussians).items()}
    if found:
        shown = "; ".join(f"{name}, first at {', '.join(map(str, at))}" for name, at in found.items())
        _warn(gaussians, shown, "contribute nothing")


def _warn(gaussians: Gaussians, where: str, ending: str) -> None:
    warn(
        f"blitzgs.{gaussians.function}: NaN or infinite values in {where}; the Gaussians or views that have "
        f"them {ending}",
        RuntimeWarning,
    )


@lru_cache(maxsize=64)
def _calls(_device: torch.device, _gaussians: int) -> count[int]:
    """Return the counter of calls with this number of Gaussians."""
    return count()
