# SPDX-License-Identifier: Apache-2.0
"""File formats that other programs read and write, each in a file of its own."""
