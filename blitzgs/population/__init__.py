# SPDX-License-Identifier: Apache-2.0
"""How the population of Gaussians grows and shrinks."""
