# SPDX-License-Identifier: Apache-2.0
"""The ops of BlitzGS: their public functions and autograd formulas."""
