# SPDX-License-Identifier: Apache-2.0
"""Optimiser steps of some rows of a table, for tests of active sets while steps are pending."""

import torch
from torch import Tensor

from blitzgs.ops.lazy_adam import AdamSchedule, AdamState, lazy_adam_catch_up_, lazy_adam_step_
from blitzgs.table.table import PARAMETERS, GaussianTable


def _state(table: GaussianTable) -> AdamState:
    groups = table.parameters, table.exp_avgs, table.exp_avg_sqs
    return AdamState(*groups, table["last_step"], table["moment_step"])


def schedule_of(rates: Tensor) -> AdamSchedule:
    """Return the schedule with these learning rates, [S + 1, 6]."""
    return AdamSchedule(rates, 0.9, 0.999, 1e-15)


def caught_up(table: GaussianTable, schedule: AdamSchedule, step: int) -> GaussianTable:
    """Return a copy of a table with no pending steps up to `step`."""
    copy = GaussianTable({name: table[name].clone() for name in table})
    lazy_adam_catch_up_(_state(copy), schedule, step)
    return copy


def step_some(
    table: GaussianTable, ids: Tensor, schedule: AdamSchedule, step: int, generator: torch.Generator
) -> Tensor:
    """Take a step with random gradients of about half of the rows `ids`; return these rows, int32 [U]."""
    stepped = ids[torch.rand(len(ids), generator=generator).to(ids.device) < 0.5]
    grads = [
        torch.randn((len(stepped), *table[name].shape[1:]), generator=generator).to(ids.device)
        for name in PARAMETERS
    ]
    lazy_adam_step_(_state(table), schedule, step, grads, stepped)
    return stepped
