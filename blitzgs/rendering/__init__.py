# SPDX-License-Identifier: Apache-2.0
"""The public renderer: `rasterization` with gsplat's arguments, and `raw_rasterization` of raw parameters."""

from blitzgs.rendering.call import rasterization
from blitzgs.rendering.raw import raw_rasterization

__all__ = ["rasterization", "raw_rasterization"]
