# SPDX-License-Identifier: Apache-2.0
"""Dense Adam for parameters of which each step gives a gradient to few rows; its cost follows these rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from blitzgs._torch import quick_step
from blitzgs.ops.derivatives import KeptMarks, distinct_rows
from blitzgs.ops.lazy_adam import GrowingSchedule
from blitzgs.optim.lazy_adam_checks import (
    MOMENTS,
    check_group,
    check_listed,
    check_mask,
    check_new_rows,
    check_order,
    check_param,
    check_rows,
    check_saved,
    check_tensor,
    groups_by_name,
)
from blitzgs.util.errors import warn

# Entries of a parameter's state: the step up to which each row's values, and its moments, are current,
# counted from `GrowingSchedule.begin`. A state without them, as `torch.optim.Adam` has it, is up to date.
_STEPS = ("last_step", "moment_step")
# Entry of a group: the schedule of each parameter, by its index, because strategies replace parameters.
_SCHEDULES = "schedules"

Place = tuple[dict[str, Any], int, Tensor]  # a group, the index of a parameter in it, the parameter


class LazyAdam(torch.optim.Optimizer):
    """`torch.optim.Adam` for tables of rows, whose cost follows the rows that have a gradient.

    Use it in a training loop of your own, whose learning rates may follow any scheduler; the trainer, which
    has a `GaussianTable` and knows its schedule in advance, uses `blitzgs.optim.table_adam.TableAdam`.

    Rows that are missing in a sparse gradient (`rasterization(..., sparse_grad=True)`) have the gradient
    zero. `step` does not touch them, so they fall behind. `catch_up` applies the steps that they missed, in
    closed form whatever their number, and gives them the values of `torch.optim.Adam` to rounding
    (csrc/adam/lazy_adam.h). Call it before the parameters are read: before a view is rendered and before
    evaluation. Call `catch_up(moments=True)` before code that knows only `torch.optim.Adam` replaces
    parameters and their state. With a dense gradient, `step` is a step of plain Adam.

    Parameters are [N, ...], contiguous, float32, or float64 on the CPU. Learning rates are rounded to
    float32. A parameter of SH coefficients may give its first coefficient (three values a row) another
    learning rate than the rest: see `lr_rest`.

    For example:

        optimizer = LazyAdam([
            {"params": [means], "lr": 1.6e-4, "name": "means"},
            {"params": [sh], "lr": 2.5e-3, "lr_rest": 1.25e-4, "name": "sh"},
        ], eps=1e-15)
        optimizer.catch_up()
        rasterization(means, ..., sparse_grad=True)[0].sum().backward()
        optimizer.step()
        new = optimizer.keep(mask)  # {"means": Parameter, "sh": Parameter}
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        amsgrad: bool = False,
        *,
        foreach: bool | None = None,
        maximize: bool = False,
        capturable: bool = False,
        differentiable: bool = False,
        fused: bool | None = None,
        decoupled_weight_decay: bool = False,
    ) -> None:
        """Take parameters, or groups of them, as any optimiser of torch.

        Args:
            params: parameters, or dicts of them with options of their own: those below, `lr_rest` (the
                learning rate of all but the first three values of a row; None: as `lr`) and `name`.
            lr: learning rate; a scheduler may change it from step to step.
            betas: decay rates of the moments, 0 <= beta1 < sqrt(beta2) < 1.
            eps: added to the root of the second moment.
            foreach, fused: accepted and not needed: they select how `torch.optim.Adam` computes, never the
                result. A step is always a fused kernel.
            decoupled_weight_decay: accepted, without effect as there is no weight decay.
            weight_decay, amsgrad, maximize, capturable, differentiable: only the default.

        Raises:
            ValueError: an option is outside its range, or not supported.
        """
        defaults = {
            "lr": lr, "lr_rest": None, "betas": betas, "eps": eps, "weight_decay": weight_decay,
            "amsgrad": amsgrad, "foreach": foreach, "maximize": maximize, "capturable": capturable,
            "differentiable": differentiable, "fused": fused,
            "decoupled_weight_decay": decoupled_weight_decay,
        }  # fmt: skip
        self._marks = KeptMarks()
        super().__init__(params, defaults)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._marks = KeptMarks()
        for group in self.param_groups:
            group.setdefault(_SCHEDULES, {})
            for name, value in self.defaults.items():
                group.setdefault(name, value)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add parameters with options of their own, see `__init__`."""
        super().add_param_group(param_group)
        self.param_groups[-1][_SCHEDULES] = {}
        try:
            check_group(self.param_groups[-1])
        except ValueError:
            del self.param_groups[-1]
            raise

    @quick_step
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
        for group, index, param in self._places():
            if (gradient := param.grad) is not None:
                self._step_alone(group, index, param, gradient)
        return loss

    def _step_alone(self, group: dict[str, Any], index: int, param: Tensor, gradient: Tensor) -> None:
        rows = None
        if gradient.is_sparse:
            if gradient.sparse_dim() != 1:
                raise ValueError(
                    "LazyAdam: a sparse gradient must have whole rows (one sparse dimension), got "
                    f"{gradient.sparse_dim()} of them"
                )
            self._marks.of(param)
            rows, gradient = distinct_rows(gradient)
        state, schedule = self._tables_of(group, index, param)
        rate, rest = group["lr"], group["lr_rest"]
        rates = (float(rate), float(rate if rest is None else rest))
        _move(schedule.step_, param, state, state["step"], gradient, rows, rates)
        # A backward pass that has saved the parameter must fail, as it does after a step of torch's Adam.
        torch.autograd.graph.increment_version(param)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove the gradients, or set them to zero; see `torch.optim.Optimizer.zero_grad`."""
        if not set_to_none:
            return super().zero_grad(False)
        for _, _, param in self._places():
            param.grad = None

    def catch_up(
        self,
        params: Tensor | Iterable[Tensor] | None = None,
        rows: Tensor | None = None,
        count: Tensor | None = None,
        *,
        moments: bool = False,
    ) -> None:
        """Apply the steps that rows missed, so that the parameters can be read.

        The cost is one reading of the rows' step numbers, and work for the rows that are behind and still
        move.

        Args:
            params: the parameters to update, one or several; None: all.
            rows: int32 [A], the rows to update, each once; None: all.
            count: int32 [1] on the device of the rows, how many of them are rows, the first ones; the host
                does not wait for it. None, or on CUDA a number above A: all of them.
            moments: whether the moments of all rows catch up too, which costs a pass over them; the state is
                then that of `torch.optim.Adam`. Without it, the state has two more columns, `last_step` and
                `moment_step`, which must stay beside the moments if rows change.

        Raises:
            TypeError: `params` or `rows` are no tensors.
            ValueError: `moments` of some rows only, or, on the CPU, a row that a parameter does not have.
        """
        if moments and rows is not None:
            raise ValueError("LazyAdam.catch_up: moments=True takes all rows; leave `rows` out")
        if isinstance(params, Tensor):
            params = [params]
        given = list(params or ())
        for param in given:
            if not isinstance(param, Tensor):  # as a name
                check_tensor("catch_up: params", param)
        chosen = None if params is None else set(map(id, given))
        for group, index, param in self._places():
            if (chosen is not None and id(param) not in chosen) or _STEPS[0] not in self.state.get(param, ()):
                continue
            state, schedule = self._tables_of(group, index, param)
            behind = schedule.current < schedule.last
            if moments:
                _settle(param, state, schedule)
            elif behind:
                if rows is not None:
                    check_listed(rows, count, param)
                _move(schedule.catch_up_, param, state, rows, count)
            # As after a step, a backward pass of an image made before must fail. Some rows may catch up
            # between the views of a step: the image of another view was made of its own, which are current.
            if behind and rows is None:
                torch.autograd.graph.increment_version(param)

    def bring_up_to_date(self) -> None:
        """Deprecated name of `catch_up(moments=True)`."""
        warn("LazyAdam.bring_up_to_date() is now catch_up(moments=True)", FutureWarning)
        self.catch_up(moments=True)

    def state_dict(self) -> dict[str, Any]:
        """Bring all rows up to date and return the state of `torch.optim.Adam`, which can load it.

        Torch's class goes on with `lr` for all values of a row; `lr_rest` is kept for this class.
        """
        self.catch_up(moments=True)
        packed = super().state_dict()
        for group in packed["param_groups"]:
            del group[_SCHEDULES]
        return packed

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state of this class or of `torch.optim.Adam`.

        The parameters must have the values that they had when the state was saved.

        Raises:
            ValueError: the state does not fit, or is of another optimiser, or of an Adam with options that
                this class does not support.
        """
        check_saved(state_dict, [param for _, _, param in self._places()])
        super().load_state_dict(state_dict)
        for _, _, param in self._places():
            state = self.state.get(param)
            if state:
                state["step"] = _counter(state["step"])

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
        named = groups_by_name(self.param_groups)
        return self._renew(named, lambda _, old: old[rows], lambda old: old[rows])

    @torch.no_grad()
    def _renew(
        self,
        named: Mapping[str, dict[str, Any]],
        of_param: Callable[[str, Tensor], Tensor],
        of_state: Callable[[Tensor], Tensor],
    ) -> dict[str, Parameter]:
        """Replace every parameter and its moments by what the functions make of them."""
        self.catch_up(moments=True)
        renewed = {}
        for name, group in named.items():
            old = group["params"][0]
            new = Parameter(of_param(name, old.detach()), requires_grad=old.requires_grad)
            if state := self.state.pop(old, None):
                self.state[new] = {**state, **{key: of_state(state[key]) for key in MOMENTS}}
            group["params"] = [new]
            renewed[name] = new
        return renewed

    def _places(self) -> Iterator[Place]:
        """Iterate over all parameters."""
        for group in self.param_groups:
            for index, param in enumerate(group["params"]):
                yield group, index, param

    def _tables_of(
        self, group: dict[str, Any], index: int, param: Tensor
    ) -> tuple[dict[str, Any], GrowingSchedule]:
        """Return the state of a parameter and its schedule; make or correct them where needed."""
        state: dict[str, Any] = self.state[param]
        if not state:
            state["step"] = _counter(0)
            state.update({name: torch.zeros_like(param) for name in MOMENTS})
        for name in _STEPS:
            # gsplat's strategies append float zeros. The value is right for rows whose moments are zero.
            if name in state and state[name].dtype != torch.int32:
                state[name] = state[name].int()
        taken = state["step"]
        # Code that moves an optimiser's state to a device moves this too; others keep a plain number.
        if not (isinstance(taken, Tensor) and taken.is_cpu and taken.dtype == torch.float32):
            state["step"] = taken = _counter(taken)
        step, rules = int(taken), (tuple(group["betas"]), group["eps"])
        schedule: GrowingSchedule | None = group[_SCHEDULES].get(index)
        # The steps that rows missed had the betas and the eps of their time.
        if schedule is not None and (
            schedule.last != step or (schedule.betas, schedule.eps) != rules or schedule.is_full()
        ):
            if _STEPS[0] in state:
                _settle(param, state, schedule)
            schedule = None
        if schedule is None:
            check_param(param)
            schedule = GrowingSchedule(*rules, param.dtype, param.device, step)
            group[_SCHEDULES][index] = schedule
        if _STEPS[0] not in state:
            place = torch.full((len(param),), schedule.row, dtype=torch.int32, device=param.device)
            state.update({name: place.clone() for name in _STEPS})
        return state, schedule


def _counter(steps: Any) -> Tensor:
    """Return a number of steps in a new tensor, as the op counts it and `torch.optim.Adam` keeps it."""
    return torch.tensor(float(steps), dtype=torch.float32, device="cpu")


def _move(move: Callable[..., None], param: Tensor, state: Mapping[str, Any], *arguments: Any) -> None:
    """Call a method of a schedule; say what is wrong with the parameter if it is refused."""
    try:
        move(
            [param, state["exp_avg"], state["exp_avg_sq"], state["last_step"], state["moment_step"]],
            *arguments,
        )
    except RuntimeError:
        check_param(param)
        check_rows(param, state)
        raise


@torch.no_grad()
def _settle(param: Tensor, state: dict[str, Any], schedule: GrowingSchedule) -> None:
    """Bring all rows and their moments up to date, and leave the state of `torch.optim.Adam`."""
    _move(schedule.catch_up_, param, state)
    behind = (schedule.row - state["moment_step"]).double()
    for name, beta in zip(MOMENTS, schedule.betas, strict=True):
        state[name] *= (beta**behind).to(param.dtype).view(-1, *(1,) * (param.dim() - 1))
    for name in _STEPS:
        del state[name]
