# SPDX-License-Identifier: Apache-2.0
"""Projects of photogrammetry programs as captures, one file for each program."""
