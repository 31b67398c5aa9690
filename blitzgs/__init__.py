# SPDX-License-Identifier: Apache-2.0
"""BlitzGS: city-scale 3D Gaussian Splatting, trained in minutes on several GPUs."""

__version__ = "0.1.0"
