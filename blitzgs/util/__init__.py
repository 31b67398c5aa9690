# SPDX-License-Identifier: Apache-2.0
"""Output folders, charts and progress."""
