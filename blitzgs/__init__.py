# SPDX-License-Identifier: Apache-2.0
"""BlitzGS: city-scale 3D Gaussian Splatting, trained in minutes on several GPUs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from blitzgs import optim
    from blitzgs.call import contributions, rasterization, raw_rasterization
    from blitzgs.call.contributors import (
        rasterize_contributing_gaussian_ids,
        rasterize_num_contributing_gaussians,
        rasterize_top_contributing_gaussian_ids,
    )
    from blitzgs.call.gaussians import knn, l1_ssim, position_noise, quat_scale_to_covar_preci, relocate
    from blitzgs.ops.harmonics import spherical_harmonics
    from blitzgs.runs.folder import open_run
    from blitzgs.table.blocks import morton_order

__version__ = "0.2.0"
__all__ = [
    "contributions",
    "knn",
    "l1_ssim",
    "morton_order",
    "open_run",
    "optim",
    "position_noise",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterize_contributing_gaussian_ids",
    "rasterize_num_contributing_gaussians",
    "rasterize_top_contributing_gaussian_ids",
    "raw_rasterization",
    "relocate",
    "spherical_harmonics",
]

_MODULES = {
    "contributions": "blitzgs.call",
    "knn": "blitzgs.call.gaussians",
    "l1_ssim": "blitzgs.call.gaussians",
    "morton_order": "blitzgs.table.blocks",
    "open_run": "blitzgs.runs.folder",
    "position_noise": "blitzgs.call.gaussians",
    "quat_scale_to_covar_preci": "blitzgs.call.gaussians",
    "rasterization": "blitzgs.call",
    "rasterize_contributing_gaussian_ids": "blitzgs.call.contributors",
    "rasterize_num_contributing_gaussians": "blitzgs.call.contributors",
    "rasterize_top_contributing_gaussian_ids": "blitzgs.call.contributors",
    "raw_rasterization": "blitzgs.call",
    "relocate": "blitzgs.call.gaussians",
    "spherical_harmonics": "blitzgs.ops.harmonics",
}


def __getattr__(name: str) -> Any:
    # Loaded on first use: `blitzgs --help` and the synthetic city need no kernels.
    if name == "optim":
        return import_module("blitzgs.optim")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'blitzgs' has no attribute {name!r}")
