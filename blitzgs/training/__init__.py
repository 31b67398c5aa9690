# SPDX-License-Identifier: Apache-2.0
"""The training loop and what it needs: schedule, loss, checkpoints, logging, configuration."""
