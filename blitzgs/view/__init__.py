# SPDX-License-Identifier: Apache-2.0
"""The view level, which Gaussians a view needs, and pictures of a model for those who look at it."""
