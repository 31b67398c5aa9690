# SPDX-License-Identifier: Apache-2.0
"""The population of Gaussians: first Gaussians, density control, importance, pruning, spawn gate, lineage."""
