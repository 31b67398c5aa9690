# SPDX-License-Identifier: Apache-2.0
"""What the calls say about intrinsics that have no effect on a picture: their gradient, skew and scale."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from blitzgs.call.arguments import Gaussians
from blitzgs.ops.host import HostCopy, to_host

# Relative to the focal length: below the rounding of float32, and far below a pixel; as in the projection.
_LEAST_SKEW = 1e-6
# Calls between a public function and its caller, for warnings: `blitzgs._torch.not_compiled`.
WRAPPED = {"raw_rasterization": 1}


def warn_of_gradient(function: str) -> None:
    """Warn, once, that intrinsics which require a gradient get none, as in gsplat.

    Args:
        function: name of the public function.
    """
    if not torch.compiler.is_compiling() and torch.is_grad_enabled():
        _warn_of_gradient(function)


@cache
def _warn_of_gradient(function: str) -> None:
    warnings.warn(
        f"blitzgs.{function}: Ks requires a gradient and gets none, as in gsplat; pass Ks.detach()",
        RuntimeWarning,
        stacklevel=4 + WRAPPED.get(function, 0),
    )


def check_intrinsics(Ks: Sequence[Tensor]) -> None:  # noqa: N803
    """Refuse intrinsics that the pinhole projection does not have; waits for the device.

    The projection renders nothing with them, so that calls look only where a view shows nothing.

    Args:
        Ks: [C, 3, 3] of each scene.

    Raises:
        ValueError: a matrix has a skew, or another last row than 0, 0, 1.
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
        """Start to copy the cameras of a call."""
        named = gaussians.named
        matrices = [t.detach().reshape(-1) for name in ("Ks", "viewmats") for t in named[name]]
        self._n_intrinsics = sum(t.numel() for t in named["Ks"])
        self._copy = HostCopy(torch.cat(matrices).double().view(torch.int64))

    def are_finite(self) -> bool:
        """Tell whether all cameras are finite; waits for the copy.

        Raises:
            ValueError: see `check_intrinsics`.
        """
        values = self._copy.read().view(torch.float64).numpy()
        _check_rows(values[: self._n_intrinsics].reshape(-1, 9))
        return bool(np.isfinite(values).all())
