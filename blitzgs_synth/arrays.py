# SPDX-License-Identifier: Apache-2.0
"""Names for the array types of this package."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# float32 on the way of every sample: numpy's stubs cannot follow the precision through arithmetic.
Floats = NDArray[Any]
Doubles = NDArray[np.float64]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


def dot(a: Floats, b: Floats) -> Floats:
    """Return the inner products [R] of columns [3, R], or of one vector [3] with each column."""
    product: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


def transformed(matrix: Floats, columns: Floats) -> Floats:
    """Return the products of a matrix [3, 3] with each column of [3, R], as rows [R, 3].

    NumPy's `@` would use BLAS, which starts a thread for each core. In every process of a generation these
    threads wait for each other in loops, and all processes together are then less than half as fast.
    """
    rows = np.empty((columns.shape[1], 3), np.result_type(matrix, columns))
    for i in range(3):
        rows[:, i] = dot(matrix[i], columns)
    return rows
