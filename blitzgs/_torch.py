# SPDX-License-Identifier: Apache-2.0
"""What BlitzGS uses of torch beyond its public interface, each behind one function.

Every use must work with each version of torch that pyproject.toml admits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks
from torch.utils import _pytree as pytree

_F = TypeVar("_F", bound=Callable[..., Any])

# A context in which autograd records nothing, as in `torch.no_grad`, in less of the host's time.
below_autograd = torch._C._AutoDispatchBelowAutograd
# Tells whether the caller is inside a transform of `torch.func`.
func_transforms_are_active = torch._C._are_functorch_transforms_active
# Returns the hooks on saved tensors, which checkpointing uses, or None; the argument is True.
hooks_on_saved_tensors = torch._C._autograd._top_saved_tensors_default_hooks
# Return the indices and the values of a sparse tensor whether it is coalesced or not.
raw_indices, raw_values = Tensor._indices, Tensor._values


def current_stream_numbers(device_index: int) -> tuple[int, int, int]:
    """Return (id, device index, device type) of the current stream of a CUDA device; -1: the current one."""
    numbers: tuple[int, int, int] = torch._C._cuda_getCurrentStream(device_index)
    return numbers


def arguments_of(op: Any) -> dict[str, Any]:
    """Return the arguments of an overload of an op, in their order, with their defaults; None: no default."""
    return {argument.name: argument.default_value for argument in op._schema.arguments}


def refusing_derivatives(
    message: str, tensors: Sequence[Tensor], inputs: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Return tensors that depend on `inputs` in autograd's graph, where a backward pass raises an error."""
    refuse = torch._C._functions.DelayedError(message.encode(), len(tensors) + len(inputs))
    return tuple(refuse(*tensors, *inputs)[: len(tensors)])


def not_compiled(function: _F) -> _F:
    """Return a function that runs as it is where `torch.compile` meets it, between two graphs.

    `torch.compiler.disable` does the same, but imports torch's compiler, which takes seconds.
    """
    message = f"blitzgs.{function.__name__} runs between two graphs, so fullgraph=True is not possible"

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if torch.compiler.is_compiling():
            torch._dynamo.graph_break(msg=message)
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return call  # type: ignore[return-value]


def register_mapping(kind: type, copy: Callable[[dict[str, Any]], Any]) -> None:
    """Let `tree_map` visit the values of a mapping; `copy` makes the results of a dict of them."""
    pytree.register_pytree_node(
        kind,
        lambda values: (list(values.values()), list(values)),
        lambda values, keys: copy(dict(zip(keys, values, strict=True))),
    )


def quick_step(step: _F) -> _F:
    """Return the method `step` of an optimiser as torch wraps it: with step hooks, and a range for profilers.

    Where there are neither, it is called without torch's wrapper, which takes 5 us of the host's time.
    """
    wrapped = torch.optim.Optimizer.profile_hook_step(step)

    @functools.wraps(step)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        if (
            torch.autograd.profiler._is_profiler_enabled
            or self._optimizer_step_pre_hooks
            or self._optimizer_step_post_hooks
            or _global_optimizer_pre_hooks
            or _global_optimizer_post_hooks
        ):
            return wrapped(self, *args, **kwargs)
        return step(self, *args, **kwargs)

    call.hooked = True  # type: ignore[attr-defined]  # torch wraps each step without this mark
    return call  # type: ignore[return-value]


def mark_coalesced(table: Tensor) -> None:
    """Note on a sparse tensor that its indices ascend and are distinct."""
    table._coalesced_(True)
