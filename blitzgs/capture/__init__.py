# SPDX-License-Identifier: Apache-2.0
"""The input of training: cameras, captures and images."""
