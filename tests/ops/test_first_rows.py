# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.projection_types import first_rows
from tests.helpers import DEVICES


@pytest.mark.parametrize("device", DEVICES)
def test_first_rows_share_their_memory(device):
    columns = [torch.randn(9, 3, device=device), torch.arange(12, device=device)[3:]]
    for found, column, count in zip(first_rows(columns, [4, 20]), columns, [4, 20], strict=True):
        assert torch.equal(found, column[:count]) and found.data_ptr() == column.data_ptr()
        assert found._base is None


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match="first_rows: 1 columns need a length each, got 2"):
        first_rows([torch.zeros(4, 3)], [1, 2])
