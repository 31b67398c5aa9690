# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians a view needs."""
