# SPDX-License-Identifier: Apache-2.0
"""BlitzGS: city-scale 3D Gaussian Splatting, trained in minutes on several GPUs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

# Idle OpenMP threads sleep instead of spinning. On a machine with other work, spinning makes every parallel
# section wait for the scheduler: small training steps became twenty times slower. Torch reads this when it is
# loaded, so it has no effect on a program that imported torch before.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

if TYPE_CHECKING:
    from blitzgs.ops.importance import contributions
    from blitzgs.rendering import rasterization
    from blitzgs.training.run_folder import open_run

__version__ = "0.1.0"
__all__ = ["contributions", "open_run", "rasterization"]


def __getattr__(name: str) -> Any:
    # Loaded on first use: `blitzgs --help` and the synthetic city need no kernels.
    if name == "rasterization":
        from blitzgs.rendering import rasterization

        return rasterization
    if name == "open_run":
        from blitzgs.training.run_folder import open_run

        return open_run
    if name == "contributions":
        from blitzgs.ops.importance import contributions

        return contributions
    raise AttributeError(f"module 'blitzgs' has no attribute {name!r}")
