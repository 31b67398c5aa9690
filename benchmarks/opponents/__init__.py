# SPDX-License-Identifier: Apache-2.0
"""Trainings of others, to compare the quality of models with (benchmarks/bm_quality.py)."""
