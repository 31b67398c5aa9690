# SPDX-License-Identifier: Apache-2.0
"""The image by definition: plain float64 PyTorch, one short function for each formula.

Tests compare every kernel of every backend with `render`. It visits each Gaussian at each pixel (no tiles, no
radius, no culling but the depth range), so it is for small inputs. Autograd differentiates it.
"""

from blitzgs.reference.projection import Splats, project_splats
from blitzgs.reference.render import Composite, ReferenceImage, composite, render

__all__ = ["Composite", "ReferenceImage", "Splats", "composite", "project_splats", "render"]
