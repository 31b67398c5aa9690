# SPDX-License-Identifier: Apache-2.0
"""The public renderers, and `contributions`, which measures what Gaussians contribute to views."""

from blitzgs.call.contributors import contributions
from blitzgs.call.rasterize import rasterization
from blitzgs.call.raw import raw_rasterization

__all__ = ["contributions", "rasterization", "raw_rasterization"]
