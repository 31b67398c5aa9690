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
    """Return the inner products [R] of columns [3, R]."""
    product: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
