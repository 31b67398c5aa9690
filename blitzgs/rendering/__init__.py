# SPDX-License-Identifier: Apache-2.0
"""The public renderers, and `contributions`, which measures what Gaussians contribute to views."""

from blitzgs.rendering.call import rasterization
from blitzgs.rendering.importance import contributions
from blitzgs.rendering.raw import raw_rasterization

__all__ = ["contributions", "rasterization", "raw_rasterization"]
