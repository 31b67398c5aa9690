# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.optim.LazyAdam` equals `torch.optim.Adam`, which gets zeros for missing gradients."""

import copy
import io
import pickle

import pytest
import torch

from blitzgs.ops.lazy_adam import AdamSchedule, GrowingSchedule
from blitzgs.optim import LazyAdam
from tests.helpers import refused, relative_error

LR = 2.0**-7  # a float32, as LazyAdam rounds learning rates to
BOUND = {torch.float32: 3e-5, torch.float64: 1e-11}
SHAPES = {"means": (3,), "quats": (4,), "opacities": (), "sh": (16, 3), "features": (7,)}


class Pair:
    """Random parameters under dense Adam and under one `LazyAdam` of all, or one for each.

    Attributes:
        lazy: parameters by name, of `LazyAdam`.
        dense: the same parameters, of `torch.optim.Adam`.
    """

    def __init__(self, backend, rows=60, lr=LR, apart=False, **options):
        self.device, self.dtype = backend
        self.generator = torch.Generator().manual_seed(0)
        start = {name: self.normal(rows, *shape) for name, shape in SHAPES.items()}
        self.lazy, self.dense = ({k: v.clone().requires_grad_() for k, v in start.items()} for _ in range(2))
        groups = self.groups(self.lazy, lr)
        self.all = [
            LazyAdam(own, **options) for own in ([[group] for group in groups] if apart else [groups])
        ]
        self.torchs = torch.optim.Adam(self.groups(self.dense, lr), **options)

    @staticmethod
    def groups(params, lr=LR):
        """Return one parameter group for each parameter, with different learning rates."""
        return [
            {"params": [p], "lr": lr * (1 + i), "name": name} for i, (name, p) in enumerate(params.items())
        ]

    def normal(self, *shape):
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64).to(self.device, self.dtype)

    def some_rows(self, share):
        """Draw rows, each with a probability of `share`."""
        rows = len(self.dense["means"])
        return (torch.rand(rows, generator=self.generator) < share).nonzero()[:, 0].to(self.device)

    def require_equal(self):
        self.catch_up()
        for name in self.dense:
            assert relative_error(self.lazy[name], self.dense[name]) < BOUND[self.dtype], name

    @property
    def ours(self):
        """The optimiser of all parameters."""
        (optimizer,) = self.all
        return optimizer

    @ours.setter
    def ours(self, optimizer):
        self.all = [optimizer]

    def step(self, share=0.3, dense=False, without=()):
        ids = self.some_rows(share)
        for name, shape in SHAPES.items():
            if name in without:
                self.lazy[name].grad = self.dense[name].grad = None
                continue
            # From large to so small that eps matters.
            values = self.normal(len(ids), *shape) * 10.0 ** (
                -8 * torch.rand(1, generator=self.generator).item()
            )
            full = torch.zeros_like(self.dense[name]).index_copy_(0, ids, values)
            self.dense[name].grad = full
            sparse = torch.sparse_coo_tensor(ids[None], values, full.shape, is_coalesced=True)
            self.lazy[name].grad = full.clone() if dense else sparse
        for optimizer in self.all:
            optimizer.step()
        self.torchs.step()

    def catch_up(self, **options):
        for optimizer in self.all:
            optimizer.catch_up(**options)

    @torch.no_grad()
    def replace(self, change, names=tuple(SHAPES)):
        """Change parameters and their state as gsplat's strategies do, without a call of the optimiser.

        Args:
            change: called with a tensor and whether it belongs to the state; returns the new tensor.
            names: the parameters.
        """
        for optimizers, params in ([self.torchs], self.dense), (self.all, self.lazy):
            for optimizer in optimizers:
                for group in (group for group in optimizer.param_groups if group["name"] in names):
                    old = group["params"][0]
                    state = optimizer.state.pop(old)
                    moved = {key: change(value, True) for key, value in state.items() if key != "step"}
                    new = change(old.detach(), False).clone().requires_grad_()
                    optimizer.state[new], group["params"] = {**state, **moved}, [new]
                    params[group["name"]] = new


@pytest.mark.parametrize(
    "options", [{}, {"eps": 1e-15}, {"betas": (0.5, 0.9)}, {"betas": (0.0, 0.99)}], ids=str
)
def test_steps_equal_dense_adam(backend, options):
    pair = Pair(backend, **options)
    for _ in range(12):
        pair.step(0.2)
    pair.require_equal()
    for _ in range(12):
        pair.step(0.05)
    pair.require_equal()


def test_rows_may_have_a_thousand_pending_steps(backend):
    pair = Pair(backend, rows=30)
    pair.step(1.0)
    for _ in range(1100):  # more than there are tables for at first
        pair.step(0.02)
    pair.require_equal()


def test_learning_rates_follow_a_scheduler():
    pair = Pair(("cpu", torch.float64))
    decays = [torch.optim.lr_scheduler.ExponentialLR(o, 0.5) for o in (pair.ours, pair.torchs)]
    for _ in range(12):
        pair.step(0.1)
        for decay in decays:
            decay.step()
    pair.require_equal()


def test_the_first_values_of_a_row_may_have_a_rate_of_their_own(device):
    generator = torch.Generator().manual_seed(1)
    start = torch.randn(20, 16, 3, generator=generator).to(device)
    sh, dc, rest = (t.clone().requires_grad_() for t in (start, start[:, :1], start[:, 1:]))
    whole = LazyAdam([{"params": [sh], "lr": 1e-2, "lr_rest": 1e-3}])
    split = torch.optim.Adam([{"params": [dc], "lr": 1e-2}, {"params": [rest], "lr": 1e-3}])
    for _ in range(10):
        gradient = torch.randn(20, 16, 3, generator=generator).to(device)
        gradient[torch.rand(20, generator=generator) < 0.7] = 0
        sh.grad = gradient.to_sparse(1)
        dc.grad, rest.grad = gradient[:, :1].clone(), gradient[:, 1:].clone()
        whole.step()
        split.step()
    whole.catch_up()
    assert relative_error(sh, torch.cat([dc, rest], 1)) < 3e-5


def test_dense_gradients_and_missing_ones(backend):
    pair = Pair(backend)
    for number in range(9):
        pair.step(0.3, dense=number % 3 == 0)
        if number == 4:  # a step that one parameter has no part in
            for params in (pair.lazy, pair.dense):
                for name, param in params.items():
                    param.grad = None if name == "quats" else torch.ones_like(param)
            pair.ours.step()
            pair.torchs.step()
    pair.require_equal()


def test_rows_are_added_kept_and_reordered(backend):
    pair = Pair(backend)

    def renew_dense(of_row):
        for group in pair.torchs.param_groups:
            (old,) = group["params"]
            state = pair.torchs.state.pop(old)
            new = torch.nn.Parameter(of_row(group["name"], old.detach()))
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = of_row(None, state[key])
            pair.torchs.state[new] = state
            group["params"], pair.dense[group["name"]] = [new], new

    for _ in range(8):
        pair.step(0.2)
    new = {name: pair.normal(9, *shape) for name, shape in SHAPES.items()}
    pair.lazy = pair.ours.append(new)
    renew_dense(lambda name, old: torch.cat([old, new[name] if name else old.new_zeros(9, *old.shape[1:])]))
    for _ in range(8):
        pair.step(0.2)
    mask = torch.rand(69, generator=pair.generator).to(pair.device) < 0.6
    pair.lazy = pair.ours.keep(mask)
    renew_dense(lambda _, old: old[mask])
    for _ in range(8):
        pair.step(0.2)
    order = torch.randperm(int(mask.sum()), generator=pair.generator).to(pair.device)
    pair.lazy = pair.ours.permute(order)
    renew_dense(lambda _, old: old[order])
    pair.step(0.2)
    pair.require_equal()


@pytest.mark.parametrize("moments", [True, False])
@pytest.mark.parametrize("apart", [True, False])
def test_strategies_replace_parameters_and_state(backend, moments, apart):
    pair = Pair(backend, apart=apart)
    for number in range(30):
        pair.step()
        if number % 6 == 5:
            pair.catch_up(moments=moments)
            keys = [state.keys() for optimizer in pair.all for state in optimizer.state.values()]
            assert all((own == {"step", "exp_avg", "exp_avg_sq"}) == moments for own in keys)
        if number == 5:  # duplicate; gsplat appends float zeros to every entry of the state
            pair.replace(
                lambda t, of_state: torch.cat(
                    [t, torch.zeros(9, *t.shape[1:]).to(t.device) if of_state else t[:9]]
                )
            )
        if number == 11:  # prune
            pair.replace(lambda t, _: t[5:])
        if number == 17:  # reset opacities
            pair.replace(lambda t, of_state: t * 0 if of_state else t.clamp(max=-1.0), ["opacities"])
        if number == 23:
            order = torch.randperm(64, generator=pair.generator).to(pair.device)
            pair.replace(lambda t, _, order=order: t[order])
    pair.require_equal()


def test_a_state_that_begins_anew_begins_anew():
    """As if a strategy put another history in the place of a parameter's own."""
    pair = Pair(("cpu", torch.float64))
    for number in range(12):
        pair.step(without=["quats"] if number % 2 else ())
        if number == 5:
            pair.catch_up()
            for optimizer, params in ((pair.ours, pair.lazy), (pair.torchs, pair.dense)):
                optimizer.state[params["means"]] = {}
                optimizer.state[params["sh"]]["step"].zero_()
    pair.require_equal()


@pytest.mark.parametrize("changed", [{"betas": (0.5, 0.9)}, {"eps": 0.1}], ids=str)
def test_betas_and_eps_may_change(changed):
    pair = Pair(("cpu", torch.float64))
    for number in range(12):
        if number == 6:
            for optimizer in (pair.ours, pair.torchs):
                optimizer.param_groups[0].update(changed)
        pair.step()
    pair.require_equal()


@pytest.mark.parametrize("change", [LazyAdam.catch_up, LazyAdam.state_dict])
def test_a_backward_pass_fails_once_its_parameters_caught_up(backend, change):
    pair = Pair(backend)
    pair.step()
    pair.catch_up()
    loss = pair.lazy["means"].square().sum()
    change(pair.ours)  # all rows are current, none moves
    loss.backward()
    pair.step()
    loss = pair.lazy["means"].square().sum()
    change(pair.ours)
    refused(RuntimeError, "modified by an inplace operation", loss.backward)


@pytest.mark.parametrize("index", [0, 2, 4])
def test_a_removed_group_leaves_the_others_as_they_were(index):
    pair = Pair(("cpu", torch.float64))
    for _ in range(6):
        pair.step()
    removed = pair.ours.param_groups.pop(index)["name"]
    kept = pair.lazy.pop(removed).detach().clone()
    pair.dense.pop(removed)
    del pair.torchs.param_groups[index]
    pair.lazy[removed] = pair.dense[removed] = kept
    for _ in range(6):
        pair.step()
    pair.require_equal()


def test_a_graph_that_saved_the_parameters_is_refused_after_a_step(backend):
    pair = Pair(backend)
    losses = [param.square().sum() for param in pair.lazy.values()]
    pair.step()
    for loss in losses:
        refused(RuntimeError, "modified by an inplace operation", loss.backward)


@pytest.mark.parametrize("adam_first", [True, False])
@pytest.mark.parametrize(
    "options",
    [{}, {"eps": 1e-4}, {"betas": (0.5, 0.9)}, {"foreach": True}, {"fused": True}, {"amsgrad": False}],
    ids=str,
)
def test_adam_goes_on_from_our_state_and_we_from_adams(backend, adam_first, options):
    """The optimisers take turns of the same parameters, each from the state that the last one saved."""
    pair = Pair((backend[0], torch.float32))
    device = pair.device
    exact = {name: param.detach().double().cpu().requires_grad_() for name, param in pair.dense.items()}
    result = {key: value for key, value in options.items() if key not in ("foreach", "fused")}
    reference = torch.optim.Adam(pair.groups(exact), **result)
    params, saved = pair.dense, None
    for turn in range(4):
        is_adam = (turn % 2 == 0) == adam_first
        current = (torch.optim.Adam if is_adam else LazyAdam)(pair.groups(params), **options)
        if saved is not None:
            current.load_state_dict(torch.load(io.BytesIO(saved)))
        for _ in range(6):
            ids = pair.some_rows(0.3)
            for name, shape in SHAPES.items():
                values = pair.normal(len(ids), *shape)
                full = torch.zeros_like(params[name]).index_copy_(0, ids, values)
                exact[name].grad = full.double().cpu()
                params[name].grad = full if is_adam else full.to_sparse(1)
            reference.step()
            current.step()
        written = io.BytesIO()
        torch.save(current.state_dict(), written)
        saved = written.getvalue()
        for name, param in params.items():
            ours, dense = current.state[param], reference.state[exact[name]]
            assert ours.keys() == dense.keys() and int(ours["step"]) == int(dense["step"])
            pairs = [(param, exact[name])] + [(ours[key], dense[key]) for key in ("exp_avg", "exp_avg_sq")]
            assert all(relative_error(a.double(), b.to(device)) < 3e-5 for a, b in pairs), (turn, name)
            assert current.param_groups[0]["lr"] == reference.param_groups[0]["lr"]


def with_counters(optimizer, kind):
    for state in optimizer.state.values():
        state["step"] = kind(state["step"])
    return optimizer


@pytest.mark.parametrize(
    "copy_of",
    [
        copy.deepcopy,
        lambda x: pickle.loads(pickle.dumps(x)),
        lambda x: with_counters(x, int),
        lambda x: with_counters(x, torch.Tensor.double),
    ],
)
def test_a_copy_continues(copy_of):
    pair = Pair(("cpu", torch.float64))
    for _ in range(5):
        pair.step(0.3)
    pair.ours = copy_of(pair.ours)
    pair.lazy = {group["name"]: group["params"][0] for group in pair.ours.param_groups}
    for _ in range(5):
        pair.step(0.3)
    pair.require_equal()


def test_catching_up_some_rows_of_some_parameters():
    pair = Pair(("cpu", torch.float64))
    pair.step(1.0)
    for _ in range(5):
        pair.step(0.0)
    before = {name: param.detach().clone() for name, param in pair.lazy.items()}
    rows = torch.tensor([3, 7], dtype=torch.int32)
    pair.ours.catch_up([pair.lazy["means"]], rows)
    moved = (pair.lazy["means"] != before["means"]).any(dim=1).nonzero()[:, 0]
    assert moved.tolist() == [3, 7]
    assert relative_error(pair.lazy["means"][rows], pair.dense["means"][rows]) < 1e-11
    pair.ours.catch_up(pair.lazy["means"])  # one parameter, not in a list
    assert relative_error(pair.lazy["means"], pair.dense["means"]) < 1e-11
    assert torch.equal(pair.lazy["sh"], before["sh"])
    pair.ours.catch_up(pair.lazy["sh"], count=torch.tensor([2], dtype=torch.int32))
    assert (pair.lazy["sh"] != before["sh"]).any(dim=(1, 2)).nonzero()[:, 0].tolist() == [0, 1]
    pair.require_equal()


def test_the_old_name_of_catching_up():
    pair = Pair(("cpu", torch.float64))
    pair.step()
    with pytest.warns(FutureWarning, match=r"is now catch_up\(moments=True\)"):
        pair.ours.bring_up_to_date()
    assert all(state.keys() == {"step", "exp_avg", "exp_avg_sq"} for state in pair.ours.state.values())


def test_full_tables_restart_and_still_equal_dense_adam(backend, monkeypatch):
    monkeypatch.setattr(GrowingSchedule, "LENGTH", 40)
    pair = Pair(backend, eps=1e-8)
    for number in range(170):
        pair.step()
        if number == 100:  # in the middle of the tables
            pair.ours.load_state_dict(copy.deepcopy(pair.ours.state_dict()))
    pair.require_equal()
    for group in pair.ours.param_groups:
        (schedule,) = group["schedules"].values()
        assert len(schedule.tables[0]) == len(schedule.tables[1]) == 41 and schedule.begin > 100
    pair.catch_up(moments=True)
    for name in SHAPES:
        ours, dense = pair.ours.state[pair.lazy[name]], pair.torchs.state[pair.dense[name]]
        assert int(ours["step"]) == int(dense["step"]) == 170
        for moment in ("exp_avg", "exp_avg_sq"):
            assert relative_error(ours[moment], dense[moment]) < BOUND[pair.dtype], name


def test_a_growing_schedule_has_the_sums_of_one_known_in_advance(device):
    rates = torch.rand(400, 6, generator=torch.Generator().manual_seed(0)).to(device)
    dtype = torch.float64 if device == "cpu" else torch.float32
    known = AdamSchedule(rates, 0.9, 0.999, 1e-8, dtype=dtype)
    growing = GrowingSchedule((0.9, 0.999), 1e-8, dtype, torch.device(device), 0)
    param = torch.zeros(1, 4, dtype=dtype, device=device)
    steps = [torch.zeros(1, dtype=torch.int32, device=device) for _ in range(2)]
    state = [param, param.clone(), param.clone(), *steps]
    for step in range(1, 400):
        growing.step_(state, torch.tensor(0.0), param.clone(), None, tuple(rates[step, 4:].tolist()))
    assert growing.explicit_steps < 399
    ours, expected = (s.tables[0][:400, :24].view(400, 4, 6)[:, :, 4:] for s in (growing, known))
    assert torch.equal(growing.tables[1][1:400, 4:], rates[1:, 4:])
    # From steps long ago, rows no longer move in float64.
    torch.testing.assert_close(ours, expected, rtol=1e-12 if device == "cpu" else 1e-5, atol=0)


def sparse_gradient(rows: list[int]) -> torch.Tensor:
    return torch.sparse_coo_tensor([rows], torch.ones(len(rows), 3), (8, 3), is_coalesced=True)


def test_only_a_single_gradient_keeps_its_mark_and_all_equal_dense_adam():
    """Two backward passes before a step give rows twice; a step must add them, whatever came before."""
    lazy, dense = (torch.nn.Parameter(torch.zeros(8, 3)) for _ in range(2))
    ours, torchs = LazyAdam([lazy], lr=0.1), torch.optim.Adam([dense], lr=0.1)
    marked = []
    for passes in ([[1, 4]], [[0, 4]], [[1, 4], [2, 4]], [[7]], [[], [3, 5]]):
        lazy.grad, dense.grad = None, torch.zeros(8, 3)
        for rows in passes:
            dense.grad += sparse_gradient(rows).to_dense()
            torch.autograd.backward(lazy, sparse_gradient(rows))
        if lazy.grad.is_coalesced():
            marked.append(lazy.grad._indices()[0].tolist())
        ours.step()
        torchs.step()
    assert [7] in marked and all(rows == sorted(set(rows)) for rows in marked)
    ours.catch_up()
    torch.testing.assert_close(lazy, dense)
