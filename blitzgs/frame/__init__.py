# SPDX-License-Identifier: Apache-2.0
"""The frame: project, exchange, list and composite, for one process or several."""
