# SPDX-License-Identifier: Apache-2.0
"""The ops of BlitzGS: their public functions and autograd formulas.

An op that gets a tensor of a wrong shape, dtype or device, or a number out of its range, raises a
RuntimeError that names the op, the argument and its value. Docstrings name errors for other reasons.
"""
