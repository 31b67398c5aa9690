# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from blitzgs.ops.lazy_adam import (
    AdamSchedule,
    AdamState,
    explicit_steps,
    lazy_adam_catch_up_,
    lazy_adam_step_,
)
from tests.helpers import refused

COEFFICIENTS = 4
BETA1, BETA2, EPS = 0.9**2, 0.999**2, 1e-15 / math.sqrt(2)


def shapes(n, k=COEFFICIENTS):
    return [(n, 3), (n, 4), (n, 3), (n,), (n, k, 3)]


def new_state(n, dtype, device="cpu", k=COEFFICIENTS):
    """Random parameters with moments of zero."""
    generator = torch.Generator().manual_seed(0)
    normal = (torch.randn(s, generator=generator, dtype=torch.float64) for s in shapes(n, k))
    params = [values.to(device, dtype) for values in normal]
    moments = ([torch.zeros_like(p) for p in params] for _ in range(2))
    return AdamState(params, *moments, *(torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2)))


def moments_at(state, step):
    """Return both moments with their pending decay up to `step`, float64."""
    gaps = (step - state.moment_step).double()
    return [
        [m.double() * (beta**gaps).view(-1, *[1] * (m.dim() - 1)) for m in moments]
        for beta, moments in ((BETA1, state.exp_avgs), (BETA2, state.exp_avg_sqs))
    ]


def schedule_of(steps, dtype, device="cpu"):
    t = torch.arange(steps + 1) / steps
    base = torch.tensor([1.6e-3, 1e-3, 7e-3, 2e-2, 7.5e-3, 7.5e-3 / 20])
    rates = (base * (0.01**t)[:, None]).float().to(device)
    return AdamSchedule(rates, BETA1, BETA2, EPS, dtype)


class DenseAdam:
    """torch.optim.Adam over every row, SH split in two groups."""

    def __init__(self, params, lr_table, dtype=torch.float64):
        self.dtype = dtype
        means, quats, scales, opacities, sh = (p.cpu().to(dtype, copy=True) for p in params)
        self.tensors = [means, quats, scales, opacities, sh[:, :1].clone(), sh[:, 1:].clone()]
        self.lr_table = lr_table.double().cpu()
        groups = [{"params": [t], "lr": 0.0} for t in self.tensors]
        self.optimizer = torch.optim.Adam(groups, betas=(BETA1, BETA2), eps=EPS, foreach=False)

    def step(self, grads, ids, step):
        grads = [g.cpu().to(self.dtype) for g in grads]
        split = [*grads[:4], grads[4][:, :1], grads[4][:, 1:]]
        for tensor, grad in zip(self.tensors, split, strict=True):
            tensor.grad = torch.zeros_like(tensor)
            tensor.grad[ids.long().cpu()] = grad
        for g, group in enumerate(self.optimizer.param_groups):
            group["lr"] = float(self.lr_table[step, g])
        self.optimizer.step()

    def columns(self, tensors):
        return [*tensors[:4], torch.cat(tensors[4:], 1)]

    def params(self):
        return self.columns(self.tensors)

    def moment(self, name):
        return self.columns([self.optimizer.state[t][name] for t in self.tensors])


def random_step(n, dtype, generator, k=COEFFICIENTS):
    """A few rows are seen often, most rarely; gradients span ten orders of magnitude over the rows."""
    chance = torch.linspace(0.001, 0.6, n) ** 2
    ids = torch.nonzero(torch.rand(n, generator=generator) < chance).flatten().int()
    order = torch.randperm(n, generator=torch.Generator().manual_seed(1))
    size = 10.0 ** torch.linspace(-12, -2, n, dtype=torch.float64)[order]
    grads = []
    for shape in shapes(len(ids), k):
        noise = torch.randn(shape, generator=generator, dtype=torch.float64)
        grads.append((noise * size[ids.long()].reshape(-1, *[1] * (len(shape) - 1))).to(dtype))
    return ids, grads


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_dense_adam_over_thousands_of_steps(dtype):
    steps, n = 2000, 60
    schedule = schedule_of(steps, dtype)
    state = new_state(n, dtype)
    rates = schedule.lr_table
    exact = DenseAdam(state.params, rates)
    rounded = DenseAdam(state.params, rates, dtype) if dtype == torch.float32 else exact
    start = [p.clone() for p in exact.params()]
    generator = torch.Generator().manual_seed(3)
    for step in range(1, steps + 1):
        ids, grads = random_step(n, dtype, generator)
        lazy_adam_step_(state, schedule, step, grads, ids)
        exact.step(grads, ids, step)
        if rounded is not exact:
            rounded.step(grads, ids, step)
        if step == steps // 2:
            lazy_adam_catch_up_(state, schedule, step)
    assert int(state.last_step.min()) < steps  # rows really were left behind
    lazy_adam_catch_up_(state, schedule, steps)
    assert bool((state.last_step == steps).all())

    columns = zip(state.params, exact.params(), rounded.params(), start, strict=True)
    for ours, dense, dense32, before in columns:
        error = (ours.double() - dense).abs().max()
        assert (dense - before).abs().max() > 0.01
        if dtype == torch.float32:  # no further from exact arithmetic than torch's own dense Adam
            assert error <= 1.5 * (dense32.double() - dense).abs().max()
        else:
            assert error < 1e-11
    for ours, name in zip(moments_at(state, steps), ("exp_avg", "exp_avg_sq"), strict=True):
        for mine, dense in zip(ours, exact.moment(name), strict=True):
            tolerance = 1e-4 if dtype == torch.float32 else 1e-11
            largest = float(dense.abs().max())
            torch.testing.assert_close(mine.double(), dense, rtol=tolerance, atol=tolerance * 1e-9 * largest)


def one_update(n=7, dtype=torch.float64):
    """A state after one step of every row, and its schedule of 4000 steps."""
    schedule = schedule_of(4000, dtype)
    state = new_state(n, dtype)
    generator = torch.Generator().manual_seed(4)
    ids = torch.arange(n, dtype=torch.int32)
    grads = [torch.randn(s, generator=generator, dtype=torch.float64).to(dtype) for s in shapes(n)]
    lazy_adam_step_(state, schedule, 1, grads, ids)
    return state, schedule


def test_eps_is_exact_where_it_matters():
    """Gradients at and below eps take the explicit path and agree with dense Adam there too."""
    schedule = schedule_of(400, torch.float64)
    state = new_state(40, torch.float64)
    dense = DenseAdam(state.params, schedule.lr_table)
    ids = torch.arange(40, dtype=torch.int32)
    size = 10.0 ** torch.linspace(-18, -6, 40, dtype=torch.float64)
    grads = [size.reshape(-1, *[1] * (len(s) - 1)).expand(s).clone() for s in shapes(40)]
    lazy_adam_step_(state, schedule, 1, grads, ids)
    dense.step(grads, ids, 1)
    none = torch.zeros(0, dtype=torch.int32)
    for step in range(2, 401):
        dense.step([torch.zeros((0, *s[1:]), dtype=torch.float64) for s in shapes(40)], none, step)
    lazy_adam_catch_up_(state, schedule, 400)
    torch.testing.assert_close(state.params, dense.params(), rtol=0, atol=1e-9)


def scattered_state(n, dtype, step, device="cpu"):
    """Rows at `step` with second moments of 1e-40 to 1 and arbitrary first moments, some of them zero."""
    state = new_state(n, dtype, device)
    generator = torch.Generator().manual_seed(11)
    for m, v in zip(*state[1:3], strict=True):
        root = 10.0 ** (20 * torch.rand(v.shape, generator=generator, dtype=torch.float64) - 20)
        share = torch.randn(v.shape, generator=generator, dtype=torch.float64)
        share[torch.rand(v.shape, generator=generator) < 0.1] = 0
        v.copy_(root**2)
        m.copy_(v.double().sqrt() * share.to(device))
    state.last_step.fill_(step)
    state.moment_step.fill_(step)
    return state


def drift_one_by_one(state, lr_table, begin, end):
    """Return what dense Adam subtracts from the parameters over steps without a gradient, float64."""
    rates = lr_table.double().cpu()
    drifts = []
    for c, (m, v) in enumerate(zip(*([y.double().cpu() for y in x] for x in state[1:3]), strict=True)):
        root, drift = v.sqrt(), torch.zeros_like(m)
        for t in range(begin + 1, end + 1):
            j = t - begin
            rate = rates[t, c].expand(m.shape).clone()
            if c == 4:
                rate[:, 1:] = rates[t, 5]
            first = m * BETA1**j / (1 - BETA1**t)
            drift += rate * first / (root * BETA2 ** (j / 2) / math.sqrt(1 - BETA2**t) + EPS)
        drifts.append(drift)
    return drifts


@pytest.mark.parametrize("begin", [1, 30, 150, 400, 2000])
@pytest.mark.parametrize("gap", [1, 2, 40, 700])
def test_float32_drift_of_any_second_moment(begin, gap, device):
    """Final rules (late) and explicit steps (early) are exact to rounding for every ratio to eps."""
    schedule = schedule_of(4000, torch.float32, device)
    state = scattered_state(200, torch.float32, begin, device)
    for p in state.params:
        p.zero_()  # so that the parameter is the drift, unrounded
    lazy_adam_catch_up_(state, schedule, begin + gap)
    for ours, exact in zip(
        state.params, drift_one_by_one(state, schedule.lr_table, begin, begin + gap), strict=True
    ):
        normal, got = exact.abs() > 1e-30, -ours.double().cpu()
        assert normal.double().mean() > 0.8
        torch.testing.assert_close(got[normal], exact[normal], rtol=4e-6, atol=0)
        assert (got[~normal].abs() < 1e-29).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_catching_up_in_parts_is_catching_up_at_once(dtype):
    """Moments do not change during a catch-up; long after their last step, rows no longer move."""
    schedule = schedule_of(4000, dtype)
    begin, tolerance = 900, 3e-6 if dtype == torch.float32 else 1e-12
    once, parts = (scattered_state(50, dtype, begin) for _ in range(2))
    moments = [m.clone() for m in (*once.exp_avgs, *once.exp_avg_sqs)]
    for p in (*once.params, *parts.params):
        p.zero_()
    for step in (901, 902, 917, 940, 1300, 3000):
        lazy_adam_catch_up_(parts, schedule, step)
    lazy_adam_catch_up_(once, schedule, 3000)
    torch.testing.assert_close(once.params, parts.params, rtol=tolerance, atol=1e-37)
    for before, after in zip(moments, (*parts.exp_avgs, *parts.exp_avg_sqs), strict=True):
        assert torch.equal(before, after)
    assert bool((parts.moment_step == begin).all()) and bool((parts.last_step == 3000).all())


def test_a_step_after_catching_up_equals_a_step_alone():
    schedule = schedule_of(1000, torch.float64)
    a, b = (scattered_state(40, torch.float64, 500) for _ in range(2))
    ids = torch.arange(40, dtype=torch.int32)
    grads = [
        torch.randn(s, generator=torch.Generator().manual_seed(2), dtype=torch.float64) for s in shapes(40)
    ]
    lazy_adam_catch_up_(a, schedule, 533, ids)
    for state in (a, b):
        lazy_adam_step_(state, schedule, 541, grads, ids)
        assert bool((state.last_step == 541).all()) and bool((state.moment_step == 541).all())
    for x, y in zip((*a.exp_avgs, *a.exp_avg_sqs), (*b.exp_avgs, *b.exp_avg_sqs), strict=True):
        assert torch.equal(x, y)
    torch.testing.assert_close(a.params, b.params, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("gap", [-1, 0, 1, 5000])
def test_final_rules_replace_many_pending_steps(gap, dtype):
    """Gaps around the first one for which the table is used, and much larger ones."""
    schedule = schedule_of(9000, dtype)
    reach = explicit_steps(BETA1, BETA2, dtype)
    for begin in (1, 40, 900, 2000):
        state, alone = (scattered_state(40, dtype, begin) for _ in range(2))
        end = begin + reach + gap
        lazy_adam_catch_up_(state, schedule, end)
        torch.ops.blitzgs.lazy_adam_catch_up_(
            alone.tensors, schedule.tables[:2], *schedule.constants(end), None
        )
        torch.testing.assert_close(state.params, alone.params, rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("steps", [1, 60, 100_000])
def test_a_schedule_makes_its_tables_once(steps, dtype):
    schedule = schedule_of(steps, dtype)
    reach = explicit_steps(BETA1, BETA2, dtype)
    assert [len(table) for table in schedule.tables] == [steps + 1, steps + 1, max(0, steps + 1 - reach)]
    assert schedule.tables[0] is schedule.table and schedule.tables[1] is schedule.lr_table
    assert schedule.tables[2].shape[1] == 28 * dtype.itemsize
    assert schedule.constants(7) == (7, reach, BETA1, BETA2, EPS)


def test_a_schedule_of_another_dtype_is_refused():
    state, _ = one_update(dtype=torch.float64)
    schedule = schedule_of(4000, torch.float32)
    refused(RuntimeError, "rules must have shape", lazy_adam_catch_up_, state, schedule, 5)


@pytest.mark.cuda
def test_catching_up_needs_no_more_memory_late_in_a_schedule():
    schedule = schedule_of(100_000, torch.float32, "cuda")
    peaks = []
    for step in (300, 30_000, 100_000):
        state = scattered_state(64, torch.float32, 200, "cuda")
        lazy_adam_catch_up_(state, schedule, 201)
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        lazy_adam_catch_up_(state, schedule, step)
        peaks.append(torch.cuda.max_memory_allocated() - before)
    assert peaks[0] == peaks[1] == peaks[2]


def test_order_of_the_list_does_not_matter():
    a, schedule = one_update(50, torch.float32)
    b, _ = one_update(50, torch.float32)
    ids = torch.arange(0, 50, 2, dtype=torch.int32)
    order = torch.randperm(25, generator=torch.Generator().manual_seed(5))
    grads = [torch.randn(s, generator=torch.Generator().manual_seed(6)) for s in shapes(25)]
    lazy_adam_step_(a, schedule, 90, grads, ids)
    lazy_adam_step_(b, schedule, 90, [g[order] for g in grads], ids[order])
    for x, y in zip(
        [*a.params, *a.exp_avgs, *a.exp_avg_sqs], [*b.params, *b.exp_avgs, *b.exp_avg_sqs], strict=True
    ):
        assert torch.equal(x, y)


def test_empty_list_and_zero_gradient():
    state, schedule = one_update()
    before = [p.clone() for p in state.params]
    nothing = [torch.zeros(s, dtype=torch.float64) for s in shapes(0)]
    lazy_adam_step_(state, schedule, 2, nothing, torch.zeros(0, dtype=torch.int32))
    lazy_adam_catch_up_(state, schedule, 1)
    torch.testing.assert_close(state.params, before, rtol=0, atol=0)
    fresh = new_state(3, torch.float32)
    still = [p.clone() for p in fresh.params]
    schedule = schedule_of(4000, torch.float32)
    lazy_adam_step_(fresh, schedule, 10, [torch.zeros(s) for s in shapes(3)], None)
    torch.testing.assert_close(fresh.params, still, rtol=0, atol=0)


def test_errors_name_the_value():
    state, schedule = one_update()
    refused(ValueError, r"beta1=0.9, beta2=0.5", AdamSchedule, schedule.lr_table, 0.9, 0.5, EPS)
    with pytest.raises(
        RuntimeError, match="step 9999 is outside the learning-rate table, which ends at step 4000"
    ):
        lazy_adam_catch_up_(state, schedule, 9999)
    bad = [torch.zeros(s, dtype=torch.float64) for s in shapes(2)]
    with pytest.raises(
        RuntimeError, match=r"the gradient of means must have 1 rows of 3 values, got \[2, 3\]"
    ):
        lazy_adam_step_(state, schedule, 2, bad, torch.zeros(1, dtype=torch.int32))


def test_opcheck():
    state, schedule = one_update(5, torch.float32)
    tables, reach = schedule.tables, schedule.explicit_steps
    grads = [torch.randn(s) for s in shapes(2)]
    ids = torch.tensor([1, 3], dtype=torch.int32)
    columns = state.tensors
    torch.library.opcheck(
        torch.ops.blitzgs.lazy_adam_step_, (columns, tables, *schedule.constants(2), grads, ids)
    )
    torch.library.opcheck(
        torch.ops.blitzgs.lazy_adam_catch_up_, (columns, tables, *schedule.constants(9), ids)
    )
    torch.library.opcheck(torch.ops.blitzgs.lazy_adam_final_rules, (tables[0], state.params[0], reach, EPS))
    bad = [*tables[:2], tables[2][1:]]
    with pytest.raises(RuntimeError, match=r"final_rules must have shape"):
        torch.ops.blitzgs.lazy_adam_catch_up_(columns, bad, *schedule.constants(9), ids)


@pytest.mark.cuda
@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_cuda_equals_cpu(k):
    schedules = {device: schedule_of(300, torch.float32, device) for device in ("cpu", "cuda")}
    states = {device: new_state(1000, torch.float32, device, k) for device in schedules}
    generator = torch.Generator().manual_seed(8)
    for step in range(1, 301):
        ids, grads = random_step(1000, torch.float32, generator, k)
        for device, state in states.items():
            lazy_adam_step_(state, schedules[device], step, [g.to(device) for g in grads], ids.to(device))
    for device, state in states.items():
        lazy_adam_catch_up_(state, schedules[device], 300)
    for name in ("params", "exp_avgs", "exp_avg_sqs"):
        for a, b in zip(getattr(states["cpu"], name), getattr(states["cuda"], name), strict=True):
            torch.testing.assert_close(a, b.cpu(), rtol=1e-5, atol=1e-6 * float(a.abs().max()))
    assert torch.equal(states["cpu"].moment_step, states["cuda"].moment_step.cpu())


@pytest.mark.cuda
@pytest.mark.parametrize("column", [1, 4])
def test_cuda_refuses_what_begins_within_16_bytes(column):
    state = new_state(8, torch.float32, "cuda", k=16)
    moment = state.exp_avgs[column]
    state.exp_avgs[column] = moment.new_zeros(moment.numel() + 1)[1:].view(moment.shape)
    with pytest.raises(RuntimeError, match="must be 16-byte aligned on CUDA"):
        lazy_adam_catch_up_(state, schedule_of(10, torch.float32, "cuda"), 5)
