# SPDX-License-Identifier: Apache-2.0
"""The public renderer: gsplat's call over the ops of BlitzGS, and one from parameters as they are learned."""

from blitzgs.rendering.call import rasterization
from blitzgs.rendering.raw import raw_rasterization

__all__ = ["rasterization", "raw_rasterization"]
