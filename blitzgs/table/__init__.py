# SPDX-License-Identifier: Apache-2.0
"""The table of Gaussians: its columns, blocks of rows with bounds, and the pool of blocks on a device."""
