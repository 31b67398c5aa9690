# SPDX-License-Identifier: Apache-2.0
"""Cameras, captures and images: what a model is trained on."""
