# SPDX-License-Identifier: Apache-2.0
"""Dense Adam for parameters of which each step gives a gradient to few rows; its cost follows these rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from blitzgs.ops.sparse_rows import distinct_rows
from blitzgs.optim.drift import Drift
from blitzgs.optim.handed import Handed, move_to_grad
from blitzgs.optim.joint import Joint, step_jointly
from blitzgs.optim.lazy_adam_checks import (
    check_group,
    check_mask,
    check_new_rows,
    check_order,
    check_saved,
    groups_by_name,
)
from blitzgs.optim.table import MOMENTS, STEPS, Table, rates_of, steps_of


class LazyAdam(torch.optim.Optimizer):
    """`torch.optim.Adam` for tables of rows, whose cost follows the rows that have a gradient.

    Use it in a training loop of your own, whose learning rates may follow any scheduler; the trainer, which
    has a `GaussianTable` and knows its schedule in advance, uses `blitzgs.optim.table_adam.TableAdam`.

    Rows that are missing in a sparse gradient (`rasterization(..., sparse_grad=True)`) have the gradient
    zero. `step` does not touch them, so they fall behind. `catch_up` applies the steps that they missed, in
    closed form whatever their number, and gives them the values of `torch.optim.Adam` to rounding
    (csrc/adam/lazy_adam.h). Call it before the parameters are read: before a view is rendered and before
    evaluation. Call `bring_up_to_date` before a strategy replaces parameters and their state. With a dense
    gradient, `step` is a step of plain Adam.

    Parameters are [N, ...], contiguous, float32, or float64 on the CPU. Learning rates are rounded to
    float32. A parameter of SH coefficients may give its first coefficient (three values a row) another
    learning rate than the rest: see `lr_rest`.

    Example::

        optimizer = LazyAdam([
            {"params": [means], "lr": 1.6e-4, "name": "means"},
            {"params": [sh], "lr": 2.5e-3, "lr_rest": 1.25e-4, "name": "sh"},
        ], eps=1e-15)
        optimizer.catch_up()
        rasterization(means, ..., sparse_grad=True)[0].sum().backward()
        optimizer.step()
        new = optimizer.keep(mask)  # {"means": Parameter, "sh": Parameter}

    Attributes:
        drifts: tables of the steps that rows missed, by the indices of a parameter's group and of the
            parameter in it, because strategies replace the parameters and their state. Parameters of
            `joint` have none.
        joint: the parameters that are stepped together, also those of other optimisers (`step_together`).
        handed: gradients that are not in `.grad`, but count as if they were: those that backward passes of
            `raw_rasterization(..., direct_grad=True)` handed over since the last `zero_grad`.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        *,
        foreach: bool | None = None,
        fused: bool | None = None,
    ) -> None:
        """Take parameters, or groups of them, as any optimiser of torch.

        Args:
            params: parameters, or dicts of them with options of their own: those below, `lr_rest` (the
                learning rate of all but the first three values of a row; None: as `lr`) and `name`.
            lr: learning rate; a scheduler may change it from step to step.
            betas: decay rates of the moments, 0 <= beta1 < sqrt(beta2) < 1; fixed once a step was taken.
            eps: added to the root of the second moment.
            foreach: accepted and not needed: it selects how `torch.optim.Adam` computes, never the result.
            fused: accepted and not needed, as `foreach`: a step is always a fused kernel.

        Raises:
            ValueError: an option is outside its range.
        """
        self.drifts: dict[tuple[int, int], Drift] = {}
        self.joint: Joint | None = None
        self.handed: list[Handed] = []
        self._drift_groups: list[dict[str, Any]] = []
        super().__init__(params, {"lr": lr, "lr_rest": None, "betas": betas, "eps": eps})

    def __getstate__(self) -> dict[str, Any]:
        self.leave_joint()  # its other members do not belong to a copy
        self._follow_groups()
        own = {"drifts": self.drifts, "joint": None, "handed": [], "_drift_groups": self._drift_groups}
        return {**super().__getstate__(), **own}

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add parameters with options of their own, see `__init__`."""
        super().add_param_group(param_group)
        try:
            check_group(self.param_groups[-1])
        except ValueError:
            del self.param_groups[-1]
            raise

    def param_ids(self) -> set[int]:
        """Return the `id` of every parameter."""
        return {id(param) for group in self.param_groups for param in group["params"]}

    def receive(self, rows: Tensor, gradients: Mapping[Tensor, Tensor]) -> None:
        """Take gradients that count as if they were added to `.grad`; see `Handed` for the arguments."""
        self.handed.append(Handed(rows, gradients))

    def move_handed(self) -> None:
        """Add the gradients that were handed over to `.grad`."""
        if self.handed:
            move_to_grad(self.handed, [param for _, _, param in self._placed()])

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove all gradients, also those that were handed over; see `torch.optim.Optimizer.zero_grad`."""
        if set_to_none:
            self.handed.clear()
        self.move_handed()
        super().zero_grad(set_to_none)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take a step for the rows that have a gradient, which first catch up with the step before.

        Args:
            closure: computes the loss again and returns it.

        Returns:
            What the closure returned.

        Raises:
            ValueError: a parameter, its gradient or its state has a form that the class does not support.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if not step_jointly([self]):
            self._step_alone()
        return loss

    def _step_alone(self) -> None:
        """Take a step for each parameter by itself."""
        self.leave_joint()
        self.move_handed()
        for place, group, param in self._placed():
            if param.grad is None:
                continue
            state, table = self._table_of(place, group, param)
            drift = table.drift
            if drift.is_full(int(state["step"])):
                table.restart(int(state["step"]))
                drift.restart(int(state["step"]))
            if param.grad.is_sparse:
                if param.grad.sparse_dim() != 1:
                    raise ValueError(
                        "LazyAdam: a sparse gradient must have whole rows (one sparse dimension), got "
                        f"{param.grad.sparse_dim()} of them"
                    )
                indices, values = distinct_rows(param.grad)
            else:
                indices, values = torch.arange(len(param), device=param.device), param.grad
            if param.numel() == 0:
                indices = indices[:0]
            rates = (0.0,) * 4 + rates_of(group)
            gradients = table.columns([values])
            state["step"] += 1
            drift.step(int(state["step"]), rates, table.eps, table.tensors, gradients, indices, [False])

    @torch.no_grad()
    def catch_up(
        self,
        params: Iterable[Tensor] | None = None,
        rows: Tensor | None = None,
        count: Tensor | None = None,
    ) -> None:
        """Apply the steps that rows missed, so that the parameters can be read.

        The cost is one reading of the rows' step numbers, and work for the rows that are behind and still
        move.

        Args:
            params: the parameters to update, one or several; None: all.
            rows: int32 [A], the rows to update, each once; None: all.
            count: int32 [1] on the device of the rows, how many of them are rows, the first ones; the host
                does not wait for it. None, or on CUDA a number above A: all of them.
        """
        if isinstance(params, Tensor):
            params = [params]
        chosen = None if params is None else {id(param) for param in params}
        wanted = [entry for entry in self._behind() if chosen is None or id(entry[2]) in chosen]
        if not wanted:
            return
        if self.joint is not None and self.joint.follow():
            self.joint.catch_up([param for _, _, param in wanted], rows, count)
            return
        for place, group, param in wanted:
            state, table = self._table_of(place, group, param)
            table.catch_up(int(state["step"]), rows, count)

    @torch.no_grad()
    def bring_up_to_date(self) -> None:
        """Bring all rows and their moments up to date; afterwards the state is that of `torch.optim.Adam`.

        Call it before a density strategy that knows `torch.optim.Adam` replaces parameters and state. It also
        brings up to date the optimisers that are stepped together with this one.
        """
        behind = self._behind()
        if not behind:
            return
        if self.joint is not None and self.joint.follow():
            self.joint.bring_up_to_date()
            return
        for place, group, param in behind:
            state, table = self._table_of(place, group, param)
            table.bring_up_to_date(int(state["step"]))
            for name in STEPS:
                del state[name]

    def _behind(self) -> list[tuple[tuple[int, int], dict[str, Any], Tensor]]:
        """Return the entries of `_placed` whose parameters may have rows or moments that are behind."""
        return [entry for entry in self._placed() if STEPS[0] in self.state.get(entry[2], ())]

    def leave_joint(self) -> None:
        """Step each parameter by itself again, see `step_together`."""
        if self.joint is not None:
            self.joint.dissolve()

    def state_dict(self) -> dict[str, Any]:
        """Bring all rows up to date and return the state of `torch.optim.Adam`: step, exp_avg, exp_avg_sq."""
        self.bring_up_to_date()
        packed = super().state_dict()
        # Optimisers that are stepped together share the number of steps.
        packed["state"] = {
            index: {**state, "step": state["step"].clone()} if state else state
            for index, state in packed["state"].items()
        }
        return packed

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state of this class or of `torch.optim.Adam`.

        The parameters must have the values that they had when the state was saved.

        Raises:
            ValueError: the state does not fit, or is of another optimiser, or of an Adam with weight decay,
                AMSGrad or maximize.
        """
        check_saved(state_dict, [param for _, _, param in self._placed()])
        self.leave_joint()
        super().load_state_dict(state_dict)
        self.drifts.clear()
        for _, group, param in self._placed():
            group.setdefault("lr_rest", None)
            state = self.state.get(param)
            if state:
                state["step"] = torch.tensor(float(state["step"]), dtype=torch.float32, device="cpu")

    def append(self, rows: Mapping[str, Tensor]) -> dict[str, Parameter]:
        """Add rows at the end of every parameter; their moments are zero.

        Args:
            rows: [M, ...] for the `name` of every group; converted to the dtype and device of the parameter.

        Returns:
            The new parameters by name. They replace the old ones in this optimiser.

        Raises:
            TypeError: rows are not a tensor.
            ValueError: names or shapes do not fit.
        """
        named = groups_by_name(self.param_groups)
        count = check_new_rows(rows, named)
        return self._renew(
            named,
            lambda name, old: torch.cat([old, rows[name].to(old)]),
            lambda old: torch.cat([old, old.new_zeros(count, *old.shape[1:])]),
        )

    def keep(self, mask: Tensor) -> dict[str, Parameter]:
        """Keep the rows where `mask`, bool [N], is true; return the new parameters as `append` does.

        Raises:
            TypeError: the mask is not a tensor.
            ValueError: the mask has another dtype or device, or not one entry for each row.
        """
        check_mask(mask, groups_by_name(self.param_groups))
        return self._select(mask.nonzero()[:, 0])

    def permute(self, order: Tensor) -> dict[str, Parameter]:
        """Make row i the old row `order[i]`; return the new parameters as `append` does.

        Args:
            order: int64 [N'], each row at most once; rows that are missing are dropped.

        Raises:
            TypeError: the order is not a tensor.
            ValueError: the order has another shape, dtype or device, or has a row twice or one that does not
                exist.
        """
        check_order(order, groups_by_name(self.param_groups))
        return self._select(order)

    def _select(self, rows: Tensor) -> dict[str, Parameter]:
        """Make the parameters of some of their rows, int64 [N']."""
        return self._renew(
            groups_by_name(self.param_groups),
            lambda _, old: old.index_select(0, rows),
            lambda old: old.index_select(0, rows),
        )

    @torch.no_grad()
    def _renew(
        self,
        named: dict[str, dict[str, Any]],
        of_param: Callable[[str, Tensor], Tensor],
        of_state: Callable[[Tensor], Tensor],
    ) -> dict[str, Parameter]:
        """Replace every parameter and its moments by what the functions make of them."""
        self.bring_up_to_date()
        renewed = {}
        for name, group in named.items():
            old = group["params"][0]
            new = Parameter(of_param(name, old.detach()), requires_grad=old.requires_grad)
            state = self.state.pop(old, None)
            if state:
                for key in MOMENTS:
                    state[key] = of_state(state[key])
                self.state[new] = state
            group["params"] = [new]
            renewed[name] = new
        self.handed.clear()
        return renewed

    def index_of(self, group: dict[str, Any]) -> int | None:
        """Return the present index of a group; None: it was removed."""
        self._follow_groups()
        return next((index for index, own in enumerate(self.param_groups) if own is group), None)

    def _follow_groups(self) -> None:
        """Move `drifts` to the present indices of their groups, because groups may have been removed."""
        known, now = self._drift_groups, self.param_groups
        if len(known) == len(now) and all(a is b for a, b in zip(known, now, strict=True)):
            return
        places = {id(group): index for index, group in enumerate(now)}
        self.drifts = {
            (places[id(known[g])], p): drift
            for (g, p), drift in self.drifts.items()
            if id(known[g]) in places
        }
        self._drift_groups = list(now)

    def _placed(self) -> Iterator[tuple[tuple[int, int], dict[str, Any], Tensor]]:
        """Iterate over all parameters with their indices (group, parameter) and their groups."""
        self._follow_groups()
        for g, group in enumerate(self.param_groups):
            for p, param in enumerate(group["params"]):
                yield (g, p), group, param

    def _table_of(
        self, place: tuple[int, int], group: dict[str, Any], param: Tensor
    ) -> tuple[dict[str, Any], Table]:
        """Return the state of a parameter, and the parameter as a table by itself."""
        state = self.state_of(param)
        betas = tuple(group["betas"])
        drift = self.drifts.get(place)
        if drift is None:
            drift = self.drifts[place] = Drift(betas, param.dtype, param.device, int(state["step"]))
        if drift.betas != betas:
            raise ValueError(f"LazyAdam: betas cannot change from {drift.betas} to {betas} after a step")
        if STEPS[0] not in state:
            state.update({name: steps_of(param, int(state["step"]) - drift.begin) for name in STEPS})
        return state, Table([param], [state], drift, 0, group["eps"])

    def state_of(self, param: Tensor) -> dict[str, Any]:
        """Return the state of a parameter; make it on first use, and correct a strategy's dtypes."""
        state: dict[str, Any] = self.state[param]
        if param.dtype not in (torch.float32, torch.float64):
            raise ValueError(
                f"LazyAdam: parameters must be float32 or float64, one of shape {list(param.shape)} is "
                f"{param.dtype}; convert it"
            )
        if not param.is_contiguous():
            raise ValueError(
                f"LazyAdam: a parameter of shape {list(param.shape)} is not contiguous; clone it"
            )
        if not state:
            state["step"] = torch.tensor(0.0, dtype=torch.float32, device="cpu")
            state.update({name: torch.zeros_like(param) for name in MOMENTS})
        columns = [name for name in STEPS if name in state]
        for name in columns:
            # gsplat's strategies append float zeros. The value is right for rows whose moments are zero.
            if state[name].dtype != torch.int32:
                state[name] = state[name].int()
        for name in (*MOMENTS, *columns):
            if state[name].shape[0] != param.shape[0]:
                raise ValueError(
                    f"LazyAdam: a parameter has {len(param)} rows and its {name} {len(state[name])}; change "
                    "both together (append, keep, permute)"
                )
        return state
