# SPDX-License-Identifier: Apache-2.0
"""A step of several optimisers at once, for gsplat's strategies, which need one for each parameter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from blitzgs.optim.joint import step_jointly
from blitzgs.optim.lazy_adam import LazyAdam


def step_together(optimizers: Iterable[LazyAdam] | Mapping[str, LazyAdam], set_to_none: bool = False) -> None:
    """Take a step of several optimisers, in few calls if their parameters are those of gsplat's trainer.

    The result is that of `step` of each. gsplat's strategies need an optimiser for each parameter, but the
    parameters have the same rows. If their gradients are those of one call of
    `raw_rasterization(..., optimizers=...)`, means, quats, scales, opacities and sh0 take one call and shN
    another. Otherwise each optimiser takes its step by itself. A single `LazyAdam` with a group for each
    parameter does the same in its own `step`. Step hooks of the optimisers are not called.

    Args:
        optimizers: the optimisers, as a mapping or a sequence; one that occurs several times takes one step.
        set_to_none: whether to remove the gradients afterwards, as `zero_grad(set_to_none=True)` does.

    Raises:
        TypeError: an optimiser is not a `LazyAdam`, or there is only one, not in a sequence.
        ValueError: as `LazyAdam.step`.
    """
    if isinstance(optimizers, LazyAdam):
        raise TypeError(
            "step_together takes a mapping or a sequence of optimisers; call `step` of a single one"
        )
    chosen = list(dict.fromkeys(optimizers.values() if isinstance(optimizers, Mapping) else optimizers))
    for optimizer in chosen:
        if not isinstance(optimizer, LazyAdam):
            raise TypeError(
                f"step_together: every optimiser must be a LazyAdam, got {type(optimizer).__name__}; call "
                "the step of the others separately"
            )
    if not step_jointly(chosen):
        for optimizer in chosen:
            optimizer.step()
    for optimizer in chosen:
        optimizer._opt_called = True  # torch's schedulers warn if they do not see a step
        if set_to_none:
            optimizer.handed.clear()
            for group in optimizer.param_groups:
                for param in group["params"]:
                    param.grad = None
