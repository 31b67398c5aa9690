# SPDX-License-Identifier: Apache-2.0
"""Structure from motion with COLMAP: finds out where photographs were taken from, and writes a capture."""
