# SPDX-License-Identifier: Apache-2.0
"""Interfaces of other projects over the parts of BlitzGS, so that their trainers change one import."""
