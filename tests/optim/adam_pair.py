# SPDX-License-Identifier: Apache-2.0
"""The same parameters under dense Adam and under `LazyAdam`, for tests that compare both."""

from collections.abc import Mapping

import torch
from torch import Tensor

from tests.helpers import relative_error

LR = 2.0**-7  # a float32, as LazyAdam rounds learning rates to
BOUND = {torch.float32: 3e-5, torch.float64: 1e-11}


class AdamPair:
    """Two copies of random parameters; a subclass makes the optimisers and takes their steps.

    Attributes:
        lazy: parameters by name, of `LazyAdam`.
        dense: the same parameters, of `torch.optim.Adam`.
    """

    def __init__(self, backend: tuple[str, torch.dtype], shapes: Mapping[str, tuple[int, ...]], rows: int):
        self.device, self.dtype = backend
        self.generator = torch.Generator().manual_seed(0)
        start = {name: self.normal(rows, *shape) for name, shape in shapes.items()}
        self.lazy, self.dense = ({k: v.clone().requires_grad_() for k, v in start.items()} for _ in range(2))

    @staticmethod
    def groups(params: Mapping[str, Tensor], lr: float = LR) -> list[dict]:
        """Return one parameter group for each parameter, with different learning rates."""
        return [
            {"params": [p], "lr": lr * (1 + i), "name": name} for i, (name, p) in enumerate(params.items())
        ]

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64).to(self.device, self.dtype)

    def some_rows(self, share: float) -> Tensor:
        """Draw rows, each with a probability of `share`."""
        rows = len(self.dense["means"])
        return (torch.rand(rows, generator=self.generator) < share).nonzero()[:, 0].to(self.device)

    def catch_up(self) -> None:
        """Apply all pending steps."""
        raise NotImplementedError

    def require_equal(self) -> None:
        self.catch_up()
        for name in self.dense:
            assert relative_error(self.lazy[name], self.dense[name]) < BOUND[self.dtype], name
