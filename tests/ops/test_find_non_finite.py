# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

import blitzgs.call.finite  # noqa: F401  (registers the fake kernel)
from tests.helpers import BACKENDS

find_non_finite = torch.ops.blitzgs.find_non_finite


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_each_value_of_each_column_is_looked_at(backend, value):
    device, dtype = backend
    # 20 columns take two launches; a value of 1e38 squares to infinity, but is finite.
    columns = [torch.full((n, 3), 1e38, dtype=dtype, device=device) for n in (0, 1, 7, 300_000, *[5] * 16)]
    opacities = torch.full((9,), 1e-45, device=device, dtype=dtype)
    assert not find_non_finite(columns, [opacities])
    for column in columns[1:]:
        column[-1, 2] = value
        assert find_non_finite(columns, [opacities]) and not find_non_finite([columns[0]], [])
        column[-1, 2] = 0.0
    assert not find_non_finite(columns, [opacities])
    opacities[8] = -0.0
    assert find_non_finite(columns, [opacities]) and find_non_finite(columns, [opacities[8:]])


def test_columns_need_not_be_contiguous():
    column = torch.ones(4, 6).T
    column[5, 3] = torch.nan
    assert find_non_finite([column], []) and not find_non_finite([column[:5]], [])


def test_errors_name_the_value():
    with pytest.raises(RuntimeError, match="find_non_finite: a column must be Float, got Double"):
        find_non_finite([torch.ones(2)], [torch.ones(2, dtype=torch.float64)])
    with pytest.raises(RuntimeError, match="find_non_finite: there must be columns"):
        torch.ops.blitzgs.find_non_finite([], [torch.ones(2)])
