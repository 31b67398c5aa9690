# SPDX-License-Identifier: Apache-2.0
"""Ranks: process group, division of tiles, exchange of splats, and exact selection over all ranks."""
