# SPDX-License-Identifier: Apache-2.0
"""What the calls say about intrinsics that have no effect on a picture: their gradient, skew and scale."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import torch
from torch import Tensor

# Relative to the focal length: below the rounding of float32, and far below a pixel.
_LEAST_SKEW = 1e-6
# Calls between a public function and its caller, for warnings: `blitzgs._torch.not_compiled`.
WRAPPED = {"raw_rasterization": 1}


def check_intrinsics(function: str, Ks: Tensor) -> None:  # noqa: N803
    """Refuse intrinsics on the CPU that the pinhole projection does not have, and warn of a gradient.

    On CUDA the values would have to be waited for, so they are not looked at, as in gsplat.

    Args:
        function: name of the public function.
        Ks: [..., 3, 3].

    Raises:
        ValueError: a matrix on the CPU has a skew, or another last row than 0, 0, 1.
    """
    if torch.compiler.is_compiling():
        return
    if Ks.requires_grad and torch.is_grad_enabled():
        # There is none, as in gsplat.
        _warn_of_gradient(function)
    # Subclasses such as fake tensors have no values; the shapes are checked with the others.
    if Ks.device.type != "cpu" or type(Ks) is not Tensor or Ks.dim() < 3 or Ks.shape[-2:] != (3, 3):
        return
    # In NumPy, which makes no operation of PyTorch out of each comparison.
    rows = Ks.numpy(force=True).reshape(-1, 9)  # with a gradient or a negative bit too
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


@cache
def _warn_of_gradient(function: str) -> None:
    warnings.warn(
        f"blitzgs.{function}: Ks requires a gradient and gets none, as in gsplat; pass Ks.detach()",
        RuntimeWarning,
        stacklevel=4 + WRAPPED.get(function, 0),
    )
