# SPDX-License-Identifier: Apache-2.0
"""Checks the arguments of `blitzgs.optim.LazyAdam`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

MOMENTS = ("exp_avg", "exp_avg_sq")

Groups = Mapping[str, dict[str, Any]]  # parameter groups of one parameter each, by name


def check_group(group: dict[str, Any]) -> None:
    """Check the parameters and options of a group (ValueError: one is wrong or not supported)."""
    if any(isinstance(param, Tensor) and param.dim() == 0 for param in group["params"]):
        raise ValueError("LazyAdam: a parameter must have rows, [N, ...], got a single number; use Adam")
    beta1, beta2 = group["betas"]
    if not (beta1 >= 0 and 0 < beta2 < 1 and beta1 * beta1 < beta2):
        raise ValueError(f"LazyAdam: betas must satisfy 0 <= beta1 < sqrt(beta2) < 1, got {group['betas']}")
    for name in ("lr", "lr_rest", "eps"):
        if group[name] is not None and not group[name] >= 0:
            raise ValueError(f"LazyAdam: {name} must be 0 or more, got {group[name]}")
    for name in ("weight_decay", "amsgrad", "maximize", "capturable", "differentiable"):
        if group.get(name):
            raise ValueError(f"LazyAdam: {name}={group[name]} is not supported; leave it out")


def check_param(param: Tensor) -> None:
    """Check that a parameter has a form that the op takes (ValueError: it has not)."""
    if param.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"LazyAdam: parameters must be float32 or float64, one of shape {list(param.shape)} is "
            f"{param.dtype}; convert it"
        )
    if not param.is_contiguous():
        raise ValueError(f"LazyAdam: a parameter of shape {list(param.shape)} is not contiguous; clone it")


def check_rows(param: Tensor, state: Mapping[str, Any]) -> None:
    """Check that a parameter's state has as many rows as the parameter (ValueError: it has not)."""
    for name, value in state.items():
        if name != "step" and value.shape[0] != param.shape[0]:
            raise ValueError(
                f"LazyAdam: a parameter has {len(param)} rows and its {name} {len(value)}; change both "
                "together (append, keep, permute), or call catch_up(moments=True) before"
            )


def check_listed(rows: Tensor, count: Tensor | None, param: Tensor) -> None:
    """Check the rows that `catch_up` takes, on the CPU (on CUDA, the host would wait for them)."""
    check_tensor("catch_up: rows", rows)
    if rows.is_cpu:
        listed = rows if count is None else rows[: int(count)]
        low, high = map(int, torch.aminmax(listed)) if len(listed) > 0 else (0, -1)
        if low < 0 or high >= len(param):
            wrong = low if low < 0 else high
            raise ValueError(f"LazyAdam.catch_up: rows must be 0 to {len(param) - 1}, got {wrong}")


def check_saved(saved: Mapping[str, Any], params: Sequence[Tensor]) -> None:
    """Check the state that `load_state_dict` takes, of all parameters; torch checks their number."""
    for group in saved["param_groups"]:
        if missing := {"lr", "betas", "eps"} - group.keys():
            raise ValueError(
                f"LazyAdam: the state has no {', '.join(sorted(missing))}; load one of LazyAdam or "
                "torch.optim.Adam"
            )
        check_group({"lr_rest": None, **group})
    indices = [index for group in saved["param_groups"] for index in group["params"]]
    for index, param in zip(indices, params, strict=False):
        state = saved["state"].get(index)
        if not state:
            continue
        if state.keys() != {"step", *MOMENTS}:
            raise ValueError(
                f"LazyAdam: the state of a parameter has {', '.join(sorted(state))} instead of step, "
                f"{', '.join(MOMENTS)}; load one of LazyAdam or torch.optim.Adam"
            )
        for name in MOMENTS:
            if state[name].shape != param.shape:
                raise ValueError(
                    f"LazyAdam: a parameter is {list(param.shape)} and its saved {name} "
                    f"{list(state[name].shape)}; load the parameters that were saved with it first"
                )


def groups_by_name(groups: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the groups by name (ValueError: a group has no name of its own, or several parameters)."""
    named = {group.get("name"): group for group in groups if len(group["params"]) == 1}
    if None in named or len(named) != len(groups):
        raise ValueError("LazyAdam: to change rows, each group needs one parameter and a 'name' of its own")
    return named  # type: ignore[return-value]


def check_new_rows(rows: Mapping[str, Tensor], named: Groups) -> int:
    """Check the rows that `append` takes; return their number."""
    if rows.keys() != named.keys():
        raise ValueError(f"LazyAdam.append: rows for {sorted(named)} are needed, got {sorted(rows)}")
    for name, group in named.items():
        new, old = rows[name], group["params"][0]
        check_tensor(f"append: new rows of {name}", new)
        if new.dim() == 0 or new.shape[1:] != old.shape[1:]:
            wanted = ", ".join(("M", *map(str, old.shape[1:])))
            raise ValueError(f"LazyAdam.append: new rows of {name} must be [{wanted}], got {list(new.shape)}")
    counts = {len(new) for new in rows.values()}
    if len(counts) != 1:
        raise ValueError(f"LazyAdam.append: the numbers of new rows differ: {sorted(counts)}")
    return counts.pop()


def check_mask(mask: Tensor, named: Groups) -> None:
    """Check the mask that `keep` takes."""
    check_tensor("keep: mask", mask)
    if mask.dtype != torch.bool:
        raise ValueError(f"LazyAdam.keep: mask must be bool, got {mask.dtype}")
    for name, group in named.items():
        param = group["params"][0]
        if mask.shape != param.shape[:1]:
            raise ValueError(
                f"LazyAdam.keep: mask must be [{len(param)}], a value for each row of {name}, got "
                f"{list(mask.shape)}"
            )
        _check_device("keep: mask", mask, name, param)


def check_order(order: Tensor, named: Groups) -> None:
    """Check the order that `permute` takes."""
    check_tensor("permute: order", order)
    if order.dtype != torch.int64 or order.dim() != 1:
        raise ValueError(
            f"LazyAdam.permute: order must be int64 [N'], the old rows, got {order.dtype} "
            f"{list(order.shape)}; `keep` takes a mask"
        )
    for name, group in named.items():
        _check_device("permute: order", order, name, group["params"][0])
    name, count = min(
        ((name, len(group["params"][0])) for name, group in named.items()), key=lambda pair: pair[1]
    )
    absent = order[(order < 0) | (order >= count)]
    if len(absent) > 0:
        raise ValueError(
            f"LazyAdam.permute: order must have rows 0 to {count - 1}, as {name} has {count}, got "
            f"{int(absent[0])}"
        )
    twice = (order.bincount() > 1).nonzero()[:, 0]
    if len(twice) > 0:
        raise ValueError(
            f"LazyAdam.permute: order must have each row at most once, got row {int(twice[0])} again; "
            "`append` adds copies"
        )


def check_tensor(argument: str, value: object) -> None:
    """Check that an argument of a method is a tensor (TypeError: it is not)."""
    if not isinstance(value, Tensor):
        raise TypeError(f"LazyAdam.{argument} must be a torch.Tensor, got {type(value).__name__}")


def _check_device(argument: str, value: Tensor, name: str, param: Tensor) -> None:
    if value.device != param.device:
        raise ValueError(f"LazyAdam.{argument} is on {value.device} and {name} on {param.device}; move one")
