# SPDX-License-Identifier: Apache-2.0
"""The configuration: its fields, their ranges, YAML files and flags, and the recipes."""
