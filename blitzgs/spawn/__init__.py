# SPDX-License-Identifier: Apache-2.0
"""The spawn gate: candidates, their lineage, and the model that predicts which of them survive."""
