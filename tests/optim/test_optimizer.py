# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.optim.LazyAdam` equals `torch.optim.Adam`, which gets zeros for missing gradients."""

import copy
import io
import pickle

import pytest
import torch

from blitzgs.optim import LazyAdam, drift
from blitzgs.optim.drift import Drift
from tests.helpers import BACKENDS, DEVICES, relative_error
from tests.optim.adam_pair import BOUND, LR, AdamPair

SHAPES = {"means": (3,), "quats": (4,), "opacities": (), "sh": (16, 3), "features": (7,)}


class Pair(AdamPair):
    """One `LazyAdam` of all parameters; gradients of a few rows at a time."""

    def __init__(self, backend, rows=60, lr=LR, **options):
        super().__init__(backend, SHAPES, rows)
        self.ours = LazyAdam(self.groups(self.lazy, lr), **options)
        self.torchs = torch.optim.Adam(self.groups(self.dense, lr), **options)

    def step(self, share=0.3, dense=False):
        ids = self.some_rows(share)
        for name, shape in SHAPES.items():
            # From large to so small that eps matters.
            values = self.normal(len(ids), *shape) * 10.0 ** (
                -8 * torch.rand(1, generator=self.generator).item()
            )
            full = torch.zeros_like(self.dense[name]).index_copy_(0, ids, values)
            self.dense[name].grad = full
            sparse = torch.sparse_coo_tensor(ids[None], values, full.shape, is_coalesced=True)
            self.lazy[name].grad = full.clone() if dense else sparse
        self.ours.step()
        self.torchs.step()

    def catch_up(self):
        self.ours.catch_up()


@pytest.mark.parametrize("backend", BACKENDS)
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


@pytest.mark.parametrize("backend", BACKENDS)
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


@pytest.mark.parametrize("device", DEVICES)
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


@pytest.mark.parametrize("backend", BACKENDS)
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


@pytest.mark.parametrize("backend", BACKENDS)
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


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_state_is_that_of_adam(backend):
    """The state is loaded into torch's Adam and back; training continues unchanged."""
    pair = Pair(backend)
    for _ in range(10):
        pair.step(0.2)
    saved = io.BytesIO()
    torch.save(pair.ours.state_dict(), saved)
    saved.seek(0)
    ours, adams = torch.load(saved), pair.torchs.state_dict()
    for index, state in adams["state"].items():
        assert ours["state"][index].keys() == state.keys()
        for key in ("exp_avg", "exp_avg_sq"):
            assert relative_error(ours["state"][index][key], state[key]) < BOUND[pair.dtype]
    pair.require_equal()
    pair.torchs.load_state_dict({**adams, "state": ours["state"]})
    pair.ours = LazyAdam(pair.groups(pair.lazy, LR))
    pair.ours.load_state_dict(adams)
    for _ in range(10):
        pair.step(0.2)
    pair.require_equal()


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
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
    pair.require_equal()


def test_a_closure_computes_the_loss():
    param = torch.ones(4, 3, requires_grad=True)
    optimizer = LazyAdam([param], lr=0.1)

    def closure():
        optimizer.zero_grad()
        loss = param.square().sum()
        loss.backward()
        return loss

    first = optimizer.step(closure).item()
    assert optimizer.step(closure).item() < first == 12.0


def test_wrong_use_is_refused():
    param = torch.ones(4, 3, requires_grad=True)
    with pytest.raises(ValueError, match=r"betas must satisfy .* got \(0.99, 0.9\)"):
        LazyAdam([param], betas=(0.99, 0.9))
    with pytest.raises(ValueError, match="a parameter must have rows"):
        LazyAdam([torch.nn.Parameter(torch.tensor(1.0))])
    optimizer = LazyAdam([torch.nn.Parameter(torch.ones(3))])
    with pytest.raises(ValueError, match="a parameter must have rows"):
        optimizer.add_param_group({"params": [torch.nn.Parameter(torch.tensor(1.0))]})
    assert len(optimizer.param_groups) == 1
    with pytest.raises(ValueError, match="lr must be 0 or more, got -1"):
        LazyAdam([param], lr=-1)
    with pytest.raises(ValueError, match="weight_decay=0.1 is not supported"):
        LazyAdam([{"params": [param], "weight_decay": 0.1}])
    with pytest.raises(ValueError, match="amsgrad=True is not supported"):
        LazyAdam([param]).load_state_dict(torch.optim.Adam([param], amsgrad=True).state_dict())
    with pytest.raises(
        ValueError, match="the state has no betas, eps; load one of LazyAdam or torch.optim.Adam"
    ):
        LazyAdam([param]).load_state_dict(torch.optim.SGD([param], lr=0.1).state_dict())
    param.grad = torch.ones_like(param)
    for other, names in ((torch.optim.Adamax, "exp_inf"), (torch.optim.NAdam, "mu_product")):
        saved = other([param])
        saved.step()
        with pytest.raises(ValueError, match=f"the state of a parameter has .*{names}.* instead of step"):
            LazyAdam([param]).load_state_dict(saved.state_dict())
    saved, fewer = LazyAdam([param]), LazyAdam([torch.ones(2, 3, requires_grad=True)])
    saved.step()
    with pytest.raises(ValueError, match=r"a parameter is \[2, 3\] and its saved exp_avg \[4, 3\]"):
        fewer.load_state_dict(saved.state_dict())
    assert not fewer.state
    half = torch.ones(4, 3, dtype=torch.float16, requires_grad=True)
    half.grad = torch.ones_like(half)
    with pytest.raises(ValueError, match=r"one of shape \[4, 3\] is torch.float16; convert it"):
        LazyAdam([half]).step()
    optimizer = LazyAdam([{"params": [param], "name": "means"}])
    with pytest.raises(ValueError, match=r"rows for \['means'\] are needed, got \['x'\]"):
        optimizer.append({"x": torch.ones(1, 3)})
    with pytest.raises(ValueError, match="mask must be bool"):
        optimizer.keep(torch.ones(4))
    with pytest.raises(ValueError, match="one parameter and a 'name' of its own"):
        LazyAdam([param]).keep(torch.ones(4, dtype=torch.bool))
    param.grad = torch.ones_like(param)
    optimizer.step()
    optimizer.param_groups[0]["betas"] = (0.5, 0.9)
    with pytest.raises(ValueError, match=r"betas cannot change from \(0.9, 0.999\) to \(0.5, 0.9\)"):
        optimizer.step()
    optimizer.param_groups[0]["betas"] = (0.9, 0.999)
    optimizer.state[param]["exp_avg"] = torch.zeros(5, 3)
    with pytest.raises(ValueError, match="a parameter has 4 rows and its exp_avg 5"):
        optimizer.step()


def test_the_call_of_gsplats_trainer_needs_no_change():
    """Torch's Adam has options that choose an implementation, never the result."""
    param = torch.ones(4, 3, requires_grad=True)
    for options in ({"fused": True}, {"fused": False, "foreach": None}, {"fused": None, "foreach": False}):
        assert LazyAdam([param], eps=1e-15, **options).param_groups[0].keys().isdisjoint(options)
    with pytest.raises(TypeError, match="unexpected keyword argument 'capturable'"):
        LazyAdam([param], capturable=False)


def test_rows_that_do_not_fit_change_nothing():
    """A mask that is too short loses no row, and no parameter becomes longer than the others."""
    means, sh = torch.ones(4, 3, requires_grad=True), torch.ones(4, 16, 3, requires_grad=True)
    optimizer = LazyAdam([{"params": [means], "name": "means"}, {"params": [sh], "name": "sh"}])
    for length in (3, 5):
        with pytest.raises(ValueError, match=rf"mask must be \[4\], .* of means, got \[{length}\]"):
            optimizer.keep(torch.arange(length) < 2)
    with pytest.raises(ValueError, match=r"new rows of sh must be \[M, 16, 3\], got \[2, 9, 3\]"):
        optimizer.append({"means": torch.ones(2, 3), "sh": torch.ones(2, 9, 3)})
    with pytest.raises(TypeError, match=r"new rows of sh must be a torch\.Tensor, got list"):
        optimizer.append({"means": torch.ones(2, 3), "sh": [1.0, 2.0]})
    with pytest.raises(ValueError, match=r"new rows of means must be \[M, 3\], got \[\]"):
        optimizer.append({"means": torch.tensor(1.0), "sh": torch.ones(1, 16, 3)})
    with pytest.raises(ValueError, match=r"the numbers of new rows differ: \[1, 2\]"):
        optimizer.append({"means": torch.ones(2, 3), "sh": torch.ones(1, 16, 3)})
    with pytest.raises(TypeError, match=r"keep: mask must be a torch\.Tensor, got list"):
        optimizer.keep([True] * 4)
    with pytest.raises(ValueError, match="keep: mask is on meta and means on cpu; move one"):
        optimizer.keep(torch.ones(4, dtype=torch.bool, device="meta"))
    assert optimizer.param_groups[0]["params"][0] is means and optimizer.param_groups[1]["params"][0] is sh
    assert all(len(new) == 2 for new in optimizer.keep(torch.arange(4) < 2).values())


@pytest.mark.parametrize(
    ("order", "error", "message"),
    [
        ([0, 1], TypeError, r"order must be a torch\.Tensor, got list"),
        (torch.ones(4, dtype=torch.bool), ValueError, r"got torch.bool \[4\]; `keep` takes a mask"),
        (torch.zeros(4), ValueError, r"order must be int64 \[N'\], the old rows, got torch.float32 \[4\]"),
        (torch.arange(4)[None], ValueError, r"got torch.int64 \[1, 4\]"),
        (torch.tensor([0, -1]), ValueError, "order must have rows 0 to 3, as means has 4, got -1"),
        (torch.tensor([0, 4]), ValueError, "order must have rows 0 to 3, as means has 4, got 4"),
        (torch.tensor([2, 0, 3, 2]), ValueError, "each row at most once, got row 2 again"),
        (torch.arange(4, device="meta"), ValueError, "order is on meta and means on cpu; move one"),
    ],
    ids=str,
)
def test_an_order_that_is_none_changes_nothing(order, error, message):
    means = torch.ones(4, 3, requires_grad=True)
    optimizer = LazyAdam([{"params": [means], "name": "means"}])
    with pytest.raises(error, match=f"LazyAdam.permute: .*{message}"):
        optimizer.permute(order)
    assert optimizer.param_groups[0]["params"][0] is means
    assert len(optimizer.permute(torch.arange(0))["means"]) == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_full_tables_restart_and_still_equal_dense_adam(backend, monkeypatch):
    monkeypatch.setattr(drift, "CAPACITY", 40)
    pair = Pair(backend, eps=1e-8)
    for number in range(170):
        pair.step()
        if number == 100:  # in the middle of the tables
            pair.ours.load_state_dict(copy.deepcopy(pair.ours.state_dict()))
    pair.require_equal()
    assert all(len(kept.tables[0]) == 41 and kept.begin > 100 for kept in pair.ours.drifts.values())
    pair.ours.bring_up_to_date()
    for name in SHAPES:
        ours, dense = pair.ours.state[pair.lazy[name]], pair.torchs.state[pair.dense[name]]
        assert int(ours["step"]) == int(dense["step"]) == 170
        for moment in ("exp_avg", "exp_avg_sq"):
            assert relative_error(ours[moment], dense[moment]) < BOUND[pair.dtype], name


def add_step(tables, step, rates):
    """Add a step that moves no rows."""
    tables.step(step, rates, 1e-8, [], [], torch.empty(0, dtype=torch.int64), [])


def test_tables_do_not_grow_over_a_hundred_thousand_steps():
    kept = Drift((0.9, 0.999), torch.float32, torch.device("cpu"), 0)
    sizes = {len(kept.tables[0]), len(kept.lr_tables[0])}
    for step in range(1, 100_001):
        if kept.is_full(step - 1):
            kept.restart(step - 1)
        add_step(kept, step, [1e-3] * 6)
        sizes |= {len(kept.tables[0]), len(kept.lr_tables[0])}
    assert sizes == {drift.CAPACITY + 1} and kept.begin > 90_000


@pytest.mark.parametrize("device", DEVICES)
def test_many_tables_equal_single_ones(device):
    """One launch takes up to 16 tables."""
    rates = torch.rand(18, 6, generator=torch.Generator().manual_seed(0)).tolist()
    options = (0.9, 0.999), torch.float64, torch.device(device), 0
    together, single = Drift(*options, 18), [Drift(*options) for _ in rates]
    for step in range(1, 400):
        add_step(together, step, [rate / step for row in rates for rate in row])
        for one, row in zip(single, rates, strict=True):
            add_step(one, step, [rate / step for rate in row])
    assert together.reach < 399
    for index, one in enumerate(single):
        assert torch.equal(together.tables[index], one.tables[0]) and together.tables[index].any()
        assert torch.equal(together.lr_tables[index], one.lr_tables[0])
    decays = 0.9 / 0.999**0.5 * 0.999 ** (0.5 * torch.arange(4, dtype=torch.float64))
    table, shares = together.tables[17].cpu(), together._shares.cpu()
    lr = together.lr_tables[17].double().cpu()
    expected = sum(decays[:, None] ** (t - 395) * shares[t][:, None] * lr[t] for t in range(396, 400))
    torch.testing.assert_close(table[395, :24].view(4, 6), expected, rtol=1e-12, atol=0)
