# SPDX-License-Identifier: Apache-2.0
"""The training loop with its schedule, loss and events."""
