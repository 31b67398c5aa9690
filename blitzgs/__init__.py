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
    from blitzgs.call.gaussians import knn, position_noise, quat_scale_to_covar_preci, relocate
    from blitzgs.call.losses import l1_ssim
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

# Loaded on first use: `blitzgs --help` and the synthetic city need no kernels.
_MODULES = {
    "blitzgs.call": ("contributions", "rasterization", "raw_rasterization"),
    "blitzgs.call.contributors": (
        "rasterize_contributing_gaussian_ids",
        "rasterize_num_contributing_gaussians",
        "rasterize_top_contributing_gaussian_ids",
    ),
    "blitzgs.call.gaussians": ("knn", "position_noise", "quat_scale_to_covar_preci", "relocate"),
    "blitzgs.call.losses": ("l1_ssim",),
    "blitzgs.ops.harmonics": ("spherical_harmonics",),
    "blitzgs.runs.folder": ("open_run",),
    "blitzgs.table.blocks": ("morton_order",),
}


if not TYPE_CHECKING:  # to a type checker, it would have every name

    def __getattr__(name: str) -> Any:
        if name == "optim":
            return import_module("blitzgs.optim")
        for module, names in _MODULES.items():
            if name in names:
                return getattr(import_module(module), name)
        raise AttributeError(f"module 'blitzgs' has no attribute {name!r}")
