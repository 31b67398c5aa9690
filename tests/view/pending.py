# SPDX-License-Identifier: Apache-2.0
"""Optimiser steps of some rows of a table, for tests of active sets while steps are pending."""

import torch
from torch import Tensor

from blitzgs.model import PARAMETERS, GaussianTable
from blitzgs.ops.lazy_adam import (
    AdamSchedule,
    AdamState,
    lazy_adam_catch_up_,
    lazy_adam_step_,
    schedule_table,
)

_BETAS, _EPS = (0.9, 0.999), 1e-15


def _state(table: GaussianTable) -> AdamState:
    groups = table.parameters, table.exp_avgs, table.exp_avg_sqs
    return AdamState(*groups, table["last_step"], table["moment_step"])


def schedule_of(rates: Tensor) -> Tensor:
    """Return the table of the schedule with these learning rates, [S + 1, 6], for a `BlockIndex`."""
    return schedule_table(rates, *_BETAS)


def caught_up(table: GaussianTable, rates: Tensor, step: int) -> GaussianTable:
    """Return a copy of a table with no pending steps up to `step`."""
    copy = GaussianTable({name: table[name].clone() for name in table})
    lazy_adam_catch_up_(_state(copy), AdamSchedule(rates, *_BETAS, _EPS), step)
    return copy


def step_some(
    table: GaussianTable, ids: Tensor, rates: Tensor, step: int, generator: torch.Generator
) -> Tensor:
    """Take a step with random gradients of about half of the rows `ids`; return these rows, int32 [U]."""
    stepped = ids[torch.rand(len(ids), generator=generator).to(ids.device) < 0.5]
    grads = [
        torch.randn((len(stepped), *table[name].shape[1:]), generator=generator).to(ids.device)
        for name in PARAMETERS
    ]
    lazy_adam_step_(_state(table), AdamSchedule(rates, *_BETAS, _EPS), step, grads, stepped)
    return stepped
