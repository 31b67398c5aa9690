# SPDX-License-Identifier: Apache-2.0
"""Trainings by other methods, whose models benchmarks/bm_quality.py compares with ours."""
