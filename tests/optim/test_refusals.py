# SPDX-License-Identifier: Apache-2.0
"""What `LazyAdam` refuses, by name, and without changing anything; closures, hooks and profilers."""

import pytest
import torch

from blitzgs.optim import LazyAdam
from tests.helpers import refused


@pytest.mark.parametrize(
    "option",
    [
        {"weight_decay": 0.1},
        {"amsgrad": True},
        {"maximize": True},
        {"capturable": True},
        {"differentiable": True},
    ],
    ids=str,
)
def test_what_only_adam_has_is_refused_by_name(option):
    param = torch.ones(4, 3, requires_grad=True)
    ((name, value),) = option.items()
    message = f"{name}={value} is not supported; leave it out"
    refused(ValueError, message, LazyAdam, [param], **option)
    refused(ValueError, message, LazyAdam, [{"params": [param], **option}])
    optimizer = LazyAdam([param])
    refused(ValueError, message, optimizer.load_state_dict, torch.optim.Adam([param], **option).state_dict())
    assert optimizer.param_groups[0]["lr"] == 1e-3 and not optimizer.param_groups[0][name]


def test_wrong_use_is_refused():
    param = torch.ones(4, 3, requires_grad=True)
    refused(ValueError, r"betas must satisfy .* got \(0.99, 0.9\)", LazyAdam, [param], betas=(0.99, 0.9))
    refused(ValueError, "a parameter must have rows", LazyAdam, [torch.nn.Parameter(torch.tensor(1.0))])
    optimizer = LazyAdam([torch.nn.Parameter(torch.ones(3))])
    with pytest.raises(ValueError, match="a parameter must have rows"):
        optimizer.add_param_group({"params": [torch.nn.Parameter(torch.tensor(1.0))]})
    assert len(optimizer.param_groups) == 1
    refused(ValueError, "lr must be 0 or more, got -1", LazyAdam, [param], lr=-1)
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
    refused(ValueError, r"is \[2, 3\] .* saved exp_avg \[4, 3\]", fewer.load_state_dict, saved.state_dict())
    assert not fewer.state
    half = torch.ones(4, 3, dtype=torch.float16, requires_grad=True)
    half.grad = torch.ones_like(half)
    refused(ValueError, r"one of shape \[4, 3\] is torch.float16; convert it", LazyAdam([half]).step)
    optimizer = LazyAdam([{"params": [param], "name": "means"}])
    refused(ValueError, r"rows for .'means'. .* got \['x'\]", optimizer.append, {"x": torch.ones(1, 3)})
    refused(ValueError, "mask must be bool", optimizer.keep, torch.ones(4))
    refused(ValueError, "one .* a 'name' of its own", LazyAdam([param]).keep, torch.ones(4, dtype=torch.bool))
    param.grad = torch.ones_like(param)
    optimizer.step()
    with pytest.raises(ValueError, match="moments=True takes all rows"):
        optimizer.catch_up(rows=torch.tensor([1], dtype=torch.int32), moments=True)
    param.grad = torch.ones_like(param).to_sparse(2)
    refused(ValueError, r"must have whole rows \(one sparse dimension\), got 2", optimizer.step)
    param.grad = torch.ones_like(param)
    optimizer.state[param]["exp_avg"] = torch.zeros(5, 3)
    refused(ValueError, "a parameter has 4 rows and its exp_avg 5", optimizer.step)


def test_what_cannot_catch_up_is_refused():
    """A name would leave all rows behind, and a row that is not there would end the process."""
    param = torch.ones(4, 3, requires_grad=True)
    optimizer = LazyAdam([{"params": [param], "name": "means"}])
    for row in (1, 2):
        param.grad = torch.sparse_coo_tensor([[row]], torch.ones(1, 3), (4, 3), check_invariants=True)
        optimizer.step()
    for params in ("means", {"means": param}):
        refused(TypeError, r"catch_up: params must be a torch\.Tensor, got str", optimizer.catch_up, params)
    refused(TypeError, r"catch_up: rows must be a torch\.Tensor, got list", optimizer.catch_up, rows=[1])
    for row in (-1, 4):
        rows = torch.tensor([0, row], dtype=torch.int32)
        refused(ValueError, f"catch_up: rows must be 0 to 3, got {row}", optimizer.catch_up, rows=rows)
    optimizer.catch_up(rows=rows, count=torch.tensor([1], dtype=torch.int32))


@pytest.mark.cuda
def test_memory_of_another_device_is_refused():
    """Kernels that read it would end all work of the process on the GPU."""
    param = torch.nn.Parameter(torch.ones(4, 3, device="cuda"))
    optimizer = LazyAdam([param])
    for _ in range(2):
        param.grad = torch.ones_like(param).to_sparse(1)
        optimizer.step()
    with pytest.raises(RuntimeError, match="ids must be on the device of the parameter"):
        optimizer.catch_up(rows=torch.tensor([1], dtype=torch.int32))
    optimizer.state[param]["exp_avg"] = torch.zeros(4, 3)
    refused(RuntimeError, "a parameter or moment must be on the device of the parameter", optimizer.step)


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
    refused(TypeError, r"keep: mask must be a torch\.Tensor, got list", optimizer.keep, [True] * 4)
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
    refused(error, f"LazyAdam.permute: .*{message}", optimizer.permute, order)
    assert optimizer.param_groups[0]["params"][0] is means
    assert len(optimizer.permute(torch.arange(0))["means"]) == 0


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


def test_step_hooks_and_profilers_see_each_step():
    param, seen = torch.nn.Parameter(torch.ones(4, 3)), []
    optimizer = LazyAdam([param])
    before = optimizer.register_step_pre_hook(lambda *_: seen.append("before"))
    after = optimizer.register_step_post_hook(lambda *_: seen.append("after"))
    param.grad = torch.ones_like(param)
    optimizer.step()
    before.remove()
    after.remove()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        optimizer.step()
    assert seen == ["before", "after"] and int(optimizer.state[param]["step"]) == 2
    assert "Optimizer.step#LazyAdam.step" in {event.name for event in profile.events()}
