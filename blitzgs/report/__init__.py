# SPDX-License-Identifier: Apache-2.0
"""Pages to read after a training: the report of a run, and runs side by side."""
