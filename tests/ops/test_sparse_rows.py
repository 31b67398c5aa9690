# SPDX-License-Identifier: Apache-2.0
"""Rows of a sparse gradient are used as they are if they are distinct, and summed otherwise."""

import pytest
import torch

from blitzgs.ops.sparse_rows import KeptMarks, distinct_rows, sparse_rows
from tests.helpers import DEVICES


class Rows(torch.autograd.Function):
    """Some rows of a table; the gradient is sparse."""

    @staticmethod
    def forward(ctx, table, ids):
        ctx.shape, ctx.ids = table.shape, ids
        return table[ids]

    @staticmethod
    def backward(ctx, v_rows):
        return sparse_rows(ctx.ids, v_rows, ctx.shape), None


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_a_gradient_that_autograd_hands_on_is_not_sorted(device, dtype):
    table, marks = torch.randn(9, 3, device=device, requires_grad=True), KeptMarks()
    marks.of(table)
    ids = torch.tensor([1, 4, 7], dtype=dtype, device=device)
    (Rows.apply(table, ids) * torch.arange(3.0, device=device)).sum().backward()
    rows, values = distinct_rows(table.grad)
    assert values.data_ptr() == table.grad._values().data_ptr()  # sorting would copy them
    assert torch.equal(rows[0], ids.long())
    assert torch.equal(values, torch.arange(3.0, device=device).expand(3, 3))


@pytest.mark.parametrize("device", DEVICES)
def test_sums_of_gradients_are_summed(device):
    table = torch.zeros(9, 3, device=device, requires_grad=True)
    for ids in ([1, 4, 7], [4, 8]):
        Rows.apply(table, torch.tensor(ids, device=device)).sum().backward()
    rows, values = distinct_rows(table.grad)
    assert rows[0].tolist() == [1, 4, 7, 8]
    assert values[:, 0].tolist() == [1, 2, 1, 1]


def test_foreign_sparse_tensors_are_coalesced():
    kept = sparse_rows(torch.tensor([0, 1]), torch.ones(2, 1), torch.Size([3, 1]))
    doubled = torch.sparse_coo_tensor(torch.tensor([[2, 2]]), torch.ones(2, 1), (3, 1))
    rows, values = distinct_rows(doubled)
    assert rows[0].tolist() == [2] and values.tolist() == [[2]]
    assert distinct_rows(kept)[0].tolist() == [[0, 1]]
