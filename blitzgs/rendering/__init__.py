# SPDX-License-Identifier: Apache-2.0
"""The public renderer: gsplat's call over the ops of BlitzGS."""

from blitzgs.rendering.call import rasterization

__all__ = ["rasterization"]
