# SPDX-License-Identifier: Apache-2.0
"""Ranks: process group, tile ownership, exchange and exact global selection."""
