# SPDX-License-Identifier: Apache-2.0
"""BlitzGS: city-scale 3D Gaussian Splatting, trained in minutes on several GPUs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from blitzgs import optim
    from blitzgs.call import contributions, rasterization, raw_rasterization
    from blitzgs.call.losses import l1_ssim
    from blitzgs.runs.folder import open_run
    from blitzgs.table.blocks import morton_order

__version__ = "0.1.0"
__all__ = [
    "contributions",
    "l1_ssim",
    "morton_order",
    "open_run",
    "optim",
    "rasterization",
    "raw_rasterization",
]

_MODULES = {
    "contributions": "blitzgs.call",
    "l1_ssim": "blitzgs.call.losses",
    "morton_order": "blitzgs.table.blocks",
    "open_run": "blitzgs.runs.folder",
    "rasterization": "blitzgs.call",
    "raw_rasterization": "blitzgs.call",
}


def __getattr__(name: str) -> Any:
    # Loaded on first use: `blitzgs --help` and the synthetic city need no kernels.
    if name == "optim":
        return import_module("blitzgs.optim")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'blitzgs' has no attribute {name!r}")
