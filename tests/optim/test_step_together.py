# SPDX-License-Identifier: Apache-2.0
"""`step_together` and a `LazyAdam` of all parameters equal `torch.optim.Adam`, in few calls of the op."""

import copy
import pickle
import weakref

import pytest
import torch

from blitzgs.ops.sparse_rows import sparse_rows
from blitzgs.optim import LazyAdam, drift, step_together
from tests.helpers import BACKENDS, relative_error
from tests.optim.adam_pair import BOUND, AdamPair

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}


class Pair(AdamPair):
    """One `LazyAdam` for each parameter, or one for all."""

    def __init__(self, backend, in_one=False, rows=50):
        super().__init__(backend, SHAPES, rows)
        groups = self.groups(self.lazy)
        self.ours = [LazyAdam(groups, eps=1e-15)]
        if not in_one:
            self.ours = [LazyAdam([group], eps=1e-15) for group in groups]
        self.torchs = torch.optim.Adam(self.groups(self.dense), eps=1e-15)

    def step(self, share=0.3, without=()):
        ids = self.some_rows(share)
        for name, shape in SHAPES.items():
            if name in without:
                self.lazy[name].grad = self.dense[name].grad = None
                continue
            values = self.normal(len(ids), *shape)
            self.dense[name].grad = torch.zeros_like(self.dense[name]).index_copy_(0, ids, values)
            self.lazy[name].grad = sparse_rows(ids, values, self.lazy[name].shape)
        step_together(self.ours, set_to_none=True)
        groups = [group for optimizer in self.ours for group in optimizer.param_groups]
        assert all(param.grad is None for group in groups for param in group["params"])
        self.torchs.step()

    def catch_up(self):
        for optimizer in self.ours:
            optimizer.catch_up()

    @property
    def joined(self):
        joints = {id(optimizer.joint) for optimizer in self.ours}
        return len(joints) == 1 and self.ours[0].joint is not None

    @torch.no_grad()
    def change_rows(self, change, ours=True):
        """Change the rows of parameters and state as gsplat's strategies do, without a call of the optimiser.

        Args:
            change: called with a tensor and whether it belongs to the state; returns the new tensor.
            ours: False: only those of dense Adam.
        """
        for optimizers, params in [([self.torchs], self.dense)] + [(self.ours, self.lazy)] * ours:
            for optimizer in optimizers:
                for group in optimizer.param_groups:
                    old = group["params"][0]
                    state = optimizer.state.pop(old)
                    moved = {key: change(value, True) for key, value in state.items() if key != "step"}
                    new = change(old.detach(), False).clone().requires_grad_()
                    optimizer.state[new], group["params"] = {**state, **moved}, [new]
                    params[group["name"]] = new


@pytest.fixture
def calls(monkeypatch):
    """The number of parameters in each call of the op that takes steps."""
    found = []
    taken = drift.Drift.step

    def step(tables, number, rates, eps, states, gradients, *others):
        found.append(sum(column.numel() > 0 for column in gradients))
        taken(tables, number, rates, eps, states, gradients, *others)

    monkeypatch.setattr(drift.Drift, "step", step)
    return found


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("in_one", [True, False])
def test_one_call_takes_the_step_of_all(backend, in_one, calls):
    pair = Pair(backend, in_one)
    for _ in range(12):
        pair.step(0.2)
    pair.require_equal()
    for _ in range(12):
        pair.step(0.2)
    pair.require_equal()
    assert pair.joined and calls == [6] * 24


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("without", [(), ("quats",)], ids=["jointly", "alone"])
def test_a_graph_that_saved_the_parameters_is_refused_after_a_step(backend, without):
    pair = Pair(backend)
    losses = {name: param.square().sum() for name, param in pair.lazy.items() if name not in without}
    pair.step(without=without)
    assert pair.joined == (not without)
    for loss in losses.values():
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            loss.backward()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("with_moments", [True, False])
def test_rows_change_as_strategies_change_them(backend, with_moments, calls):
    pair = Pair(backend)
    for number in range(24):
        pair.step()
        if number in (5, 11):
            before = pair.ours[0].joint
            for optimizer in pair.ours:
                if with_moments:
                    optimizer.bring_up_to_date()
                elif number == 5:
                    optimizer.catch_up()
            states = [state.keys() for optimizer in pair.ours for state in optimizer.state.values()]
            assert all((keys == {"step", "exp_avg", "exp_avg_sq"}) == with_moments for keys in states)
        if number == 5:  # duplicate; gsplat appends float zeros to every entry of the state
            pair.change_rows(
                lambda t, of_state: torch.cat(
                    [t, torch.zeros(9, *t.shape[1:]).to(t.device) if of_state else t[:9]]
                )
            )
        if number == 11:  # prune
            pair.change_rows(lambda t, _: t[5:])
        if number == 17:
            order = torch.randperm(len(pair.lazy["means"]), generator=pair.generator).to(pair.device)
            for optimizer in pair.ours:
                pair.lazy.update(optimizer.permute(order))
            pair.change_rows(lambda t, _, order=order: t[order], ours=False)
        if number in (6, 12, 18):  # the tables of missed steps go on where nothing was behind
            assert pair.joined and (pair.ours[0].joint is before) == (with_moments or number == 18)
            before = pair.ours[0].joint
    assert pair.joined and calls == [6] * 24
    pair.require_equal()


@pytest.mark.parametrize("changed", ["rows of one", "dtype", "no state", "step"])
def test_parameters_that_no_longer_fit_are_stepped_by_themselves(changed, calls):
    pair = Pair(("cpu", torch.float64))
    for _ in range(5):
        pair.step()
    pair.ours[0].bring_up_to_date()
    optimizer, group = pair.ours[0], pair.ours[0].param_groups[0]
    old = group["params"][0]
    state = optimizer.state.pop(old)
    values = old.detach()[: -1 if changed == "rows of one" else None]
    new = values.to(torch.float32 if changed == "dtype" else old.dtype).clone().requires_grad_()
    moments = {key: state[key][: len(new)].to(new.dtype) for key in ("exp_avg", "exp_avg_sq")}
    number = state["step"].clone() if changed == "step" else state["step"]
    group["params"] = [new]
    if changed != "no state":
        optimizer.state[new] = {"step": number, **moments}
    joint = optimizer.joint
    assert joint is not None and not joint.follow()
    assert all(own.joint is None for own in pair.ours)
    for own in pair.ours[1:]:
        for param in own.param_groups[0]["params"]:
            values = torch.ones(2, *param.shape[1:]).to(param)
            param.grad = sparse_rows(torch.tensor([1, 4]), values, param.shape)
        own.step()
    assert set(calls[5:]) == {1}
    assert {float(own.state[own.param_groups[0]["params"][0]]["step"]) for own in pair.ours[1:]} == {6.0}


def test_parameters_that_are_up_to_date_are_not_kept_alive():
    pair = Pair(("cpu", torch.float64))
    pair.step()
    for optimizer in pair.ours:
        optimizer.bring_up_to_date()
    moment = weakref.ref(next(iter(pair.ours[2].state.values()))["exp_avg"])
    param = weakref.ref(pair.lazy["means"])
    pair.change_rows(lambda t, _: t[1:].clone())
    assert moment() is None and param() is None
    pair.step()
    pair.require_equal()


def test_saved_states_do_not_share_the_number_of_steps():
    pair = Pair(("cpu", torch.float64))
    pair.step()
    saved = [optimizer.state_dict()["state"][0]["step"] for optimizer in pair.ours]
    pair.step()
    assert pair.joined and [float(step) for step in saved] == [1.0] * 6
    assert len({step.data_ptr() for step in saved}) == 6


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("with_moments", [True, False])
def test_a_reset_of_one_parameter_keeps_the_others(backend, with_moments):
    pair = Pair(backend)
    for number in range(12):
        pair.step()
        if number == 5:  # gsplat's reset_opa
            for optimizer in pair.ours:
                optimizer.bring_up_to_date() if with_moments else optimizer.catch_up()
            for optimizer, params in ((pair.ours[3], pair.lazy), (pair.torchs, pair.dense)):
                old = params["opacities"]
                group = next(g for g in optimizer.param_groups if g["params"][0] is old)
                state = optimizer.state.pop(old)
                new = old.detach().clamp(max=-1.0).requires_grad_()
                zeros = {key: torch.zeros_like(value) for key, value in state.items() if key != "step"}
                optimizer.state[new], group["params"] = {**state, **zeros}, [new]
                params["opacities"] = new
    assert pair.joined
    pair.require_equal()


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_cannot_be_joined_is_stepped_by_itself(backend, calls):
    pair = Pair(backend)
    for number in range(15):
        if number == 5:
            pair.step(without=("shN", "quats"))
            assert not pair.joined
        elif number in (6, 10):
            pair.step(without=("opacities",))
            pair.step(share=0.0)
        else:
            pair.step()
    assert not pair.joined and 1 in calls  # opacities have taken fewer steps than the others
    pair.require_equal()


def test_rates_follow_a_scheduler():
    pair = Pair(("cpu", torch.float64))
    decays = [torch.optim.lr_scheduler.ExponentialLR(pair.ours[index], 0.5) for index in (0, 5)]
    for _ in range(12):
        pair.step(0.2)
        for decay in decays:
            decay.step()
        for index in (0, 5):
            pair.torchs.param_groups[index]["lr"] *= 0.5
    assert pair.joined
    pair.require_equal()


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_and_saved_states_continue(copy_of):
    pair = Pair(("cpu", torch.float64))
    for _ in range(5):
        pair.step()
    pair.ours = [copy_of(optimizer) for optimizer in pair.ours]
    pair.lazy = {o.param_groups[0]["name"]: o.param_groups[0]["params"][0] for o in pair.ours}
    for _ in range(5):
        pair.step()
    assert pair.joined
    pair.require_equal()
    for optimizer in pair.ours:
        optimizer.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    for _ in range(5):
        pair.step()
    assert pair.joined
    pair.require_equal()


def test_catching_up_some_rows():
    pair = Pair(("cpu", torch.float64))
    pair.step(1.0)
    for _ in range(5):
        pair.step(0.0)
    before = {name: param.detach().clone() for name, param in pair.lazy.items()}
    rows = torch.tensor([3, 7], dtype=torch.int32)
    pair.ours[5].catch_up(rows=rows)
    moved = (pair.lazy["shN"].detach() != before["shN"]).flatten(1).any(dim=1)
    assert moved.nonzero()[:, 0].tolist() == [3, 7]
    assert torch.equal(pair.lazy["means"].detach(), before["means"])
    pair.ours[0].catch_up()
    assert not torch.equal(pair.lazy["opacities"].detach(), before["opacities"])
    pair.require_equal()


@pytest.mark.parametrize("backend", BACKENDS)
def test_full_tables_restart(backend, monkeypatch):
    monkeypatch.setattr(drift, "CAPACITY", 20)
    pair = Pair(backend)
    for _ in range(75):
        pair.step()
    assert pair.joined
    pair.require_equal()


def test_other_optimisers_are_refused():
    pair = Pair(("cpu", torch.float64))
    with pytest.raises(TypeError, match="every optimiser must be a LazyAdam, got Adam"):
        step_together([*pair.ours, pair.torchs])
    with pytest.raises(TypeError, match="takes a mapping or a sequence of optimisers; call `step`"):
        step_together(pair.ours[0])


@pytest.mark.parametrize("in_one", [True, False])
@pytest.mark.parametrize("joined", [True, False])
def test_a_removed_group_leaves_the_others_as_they_were(in_one, joined):
    pair = Pair(("cpu", torch.float64), in_one)
    for _ in range(6):
        pair.step(without=() if joined else ("shN",))
    assert pair.joined == joined
    index = list(SHAPES).index("scales")
    optimizer, group = (pair.ours[0], index) if in_one else (pair.ours[index], 0)
    del optimizer.param_groups[group]
    removed = pair.lazy["scales"].detach().clone()
    for _ in range(6):
        pair.step()
    for optimizer in pair.ours:
        optimizer.catch_up()
    assert torch.equal(pair.lazy["scales"].detach(), removed) and not pair.joined
    for name in SHAPES.keys() - {"scales"}:
        assert relative_error(pair.lazy[name], pair.dense[name]) < BOUND[pair.dtype], name
