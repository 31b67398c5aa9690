# SPDX-License-Identifier: Apache-2.0
"""The strategies do what gsplat's do, with `torch.optim.Adam` and with `LazyAdam`."""

import inspect
import math

import pytest
import torch

from blitzgs.compat.gsplat import DefaultStrategy, MCMCStrategy
from tests.call.test_gsplat_parts import Trainer
from tests.call.test_raw_rasterization import NAMES
from tests.helpers import random_scene, relative_error

gsplat = pytest.importorskip("gsplat", reason="needs gsplat, which pip installs without CUDA too")

VIEWS, STEPS = 5, 30
DEFAULT = {"refine_start_iter": 4, "refine_every": 8, "grow_grad2d": 0.005, "prune_opa": 0.3}


@pytest.fixture(autouse=True)
def in_double():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


class Scene:
    """gsplat main's bookkeeping of rows: which row of the beginning each row descends from."""

    def __init__(self, count):
        self.origin = torch.arange(count)

    def on_duplicate(self, sel):
        self.origin = torch.cat([self.origin, self.origin[sel]])

    def on_split(self, sel, rest):
        self.origin = self.origin[torch.cat([rest, sel, sel])]

    def on_remove(self, mask):
        self.origin = self.origin[~mask]

    def on_relocate(self, dead, sources):
        self.origin[dead] = self.origin[sources]

    def on_sample_add(self, sources):
        self.origin = torch.cat([self.origin, self.origin[sources]])


def train(strategy, lazy=False, packed=False, **extra):
    scene = random_scene(n=50, cameras=VIEWS, width=20, height=16, dtype=torch.float64)
    targets = torch.rand(VIEWS, 1, 16, 20, 3, generator=torch.Generator().manual_seed(1))
    mcmc = isinstance(strategy, (MCMCStrategy, gsplat.MCMCStrategy))
    if mcmc:
        begin = strategy.initialize_state
        strategy.initialize_state = lambda scene_scale: begin()
        extra["lr"] = 0.0
    trainer = Trainer(scene, strategy, lazy, packed, moments=False)
    trainer.splats["opacities"].data[::5] = -6  # dead for MCMC
    step_of = strategy.step_post_backward

    def step_post_backward(*args, packed):
        flag = {} if mcmc else {"packed": packed}
        step_of(*args, **flag, **extra)

    strategy.step_post_backward = step_post_backward
    torch.manual_seed(3)
    for step in range(STEPS):
        trainer.step(step, step % VIEWS, targets[step % VIEWS])
    return trainer


def same(first, second):
    for name in NAMES:
        assert relative_error(first.splats[name], second.splats[name]) < 1e-6, name
        for key in ("exp_avg", "exp_avg_sq"):
            if not first.lazy and not second.lazy:
                states = [t.optimizers[name].state[t.splats[name]][key] for t in (first, second)]
                assert relative_error(*states) < 1e-6, (name, key)


class ResetsToo(gsplat.DefaultStrategy):
    """gsplat 1.5.3 never resets opacities, for a slip in its condition that its main branch has mended."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        super().step_post_backward(params, optimizers, state, step, info, packed)
        if step % self.reset_every == 0 and step > 0:
            gsplat.strategy.ops.reset_opa(params, optimizers, state, value=2 * self.prune_opa)


OTHERS = {
    "refine_scale2d_stop_iter": 25,
    "grow_scale2d": 0.3,
    "prune_scale2d": 0.8,
    "revised_opacity": True,
    "reset_every": 13,
    "pause_refine_after_reset": 2,
    "prune_scale3d": 0.04,
}


@pytest.mark.parametrize("options", [{"reset_every": 10**6}, OTHERS], ids=["defaults", "others"])
def test_the_default_strategy_is_gsplats(options):
    options = {**DEFAULT, **options}
    theirs = train(ResetsToo(**options, verbose=False))
    assert 20 < len(theirs.splats["means"]) < 400
    for lazy, packed in ((False, False), (False, True), (True, True)):
        scene = Scene(50)
        ours = train(DefaultStrategy(**options), lazy, packed, scene=scene)
        same(ours, theirs)
        assert len(scene.origin) == len(ours.splats["means"])


def test_absolute_gradients_count_in_half_images():
    means2d = torch.zeros(3, 2)
    means2d.absgrad = torch.tensor([[3.0, 0], [0, 4], [1, 1]])
    info = {
        "means2d": means2d, "gaussian_ids": torch.tensor([0, 2, 2]), "radii": torch.ones(3, 2),
        "width": 20, "height": 10, "n_cameras": 2,
    }  # fmt: skip
    strategy = DefaultStrategy(absgrad=True)
    state = strategy.initialize_state()
    strategy.step_post_backward({"means": torch.zeros(4, 3)}, {}, state, 1, info)
    expected = torch.tensor([60.0, 0, 40 + math.hypot(20, 10), 0])
    assert torch.equal(state["grad2d"], expected) and state["count"].tolist() == [1, 0, 2, 0]
    info["means2d"] = torch.zeros(3, 2)
    with pytest.raises(ValueError, match="step_pre_backward"):
        DefaultStrategy().step_post_backward({"means": torch.zeros(4, 3)}, {}, state, 1, info)


def relocation(opacities, scales, ratios, binoms, min_opacity=0.005):
    """Kheradmand et al. 2024, eq. 9, as the paper prints it."""
    shared = 1 - (1 - opacities) ** (1 / ratios)
    sizes = torch.empty_like(scales)
    for row, n in enumerate(ratios.tolist()):
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * shared[row] ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        sizes[row] = scales[row] * opacities[row] / total
    return shared.clamp(min=min_opacity), sizes


def sample(weights, count, replacement=True):
    """The draws of our class from the same random numbers."""
    total = weights.cumsum(0)
    return torch.searchsorted(total, torch.rand(count) * total[-1], right=True)


@pytest.mark.parametrize("lazy", [False, True])
def test_the_mcmc_strategy_is_gsplats(lazy, monkeypatch):
    # gsplat computes relocation on a GPU only.
    monkeypatch.setattr(gsplat.strategy.ops, "compute_relocation", relocation)
    monkeypatch.setattr(gsplat.strategy.ops, "_multinomial_sample", sample)
    monkeypatch.setattr(gsplat.strategy.mcmc, "inject_noise_to_position", lambda **_: None)
    options = {"refine_start_iter": 4, "refine_every": 8, "min_opacity": 0.05, "cap_max": 54}
    theirs, scene = train(gsplat.MCMCStrategy(**options)), Scene(50)
    ours = train(MCMCStrategy(**options), lazy, scene=scene)
    assert len(ours.splats["means"]) == len(scene.origin) == 54  # 50, 52, 54, and then the cap
    assert len(scene.origin.unique()) < 45  # relocation has gone on
    same(ours, theirs)


@pytest.mark.parametrize("opacity,steepness", [(0.004, 100), (0.05, 30), (0.0, 700)])
def test_the_noise_has_the_strength_of_the_paper(opacity, steepness):
    n, lr = 20_000, 1e-3
    params = {
        "means": torch.zeros(n, 3), "quats": torch.tensor([1.0, 2, 0, 0]).repeat(n, 1),
        "scales": torch.tensor([0.5, 0.3, 0.1]).log().repeat(n, 1),
        "opacities": torch.full((n, 1), opacity).logit(),
    }  # fmt: skip
    params = {name: torch.nn.Parameter(value) for name, value in params.items()}
    optimizers = {name: torch.optim.Adam([p]) for name, p in params.items()}
    strategy = MCMCStrategy(noise_injection_stop_iter=2, noise_lr=1e3, noise_opacity_k=steepness)
    strategy.check_sanity(params, optimizers)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {}, lr=lr)
    moved = params["means"].detach().clone()
    turn = torch.tensor([[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]])  # of the quaternion
    covariance = turn @ torch.diag(torch.tensor([0.25, 0.09, 0.01])) @ turn.T
    expected = covariance @ covariance / (1 + math.exp(-steepness * (0.005 - opacity))) ** 2
    assert relative_error(moved.T @ moved / n, expected) < 0.05
    strategy.step_post_backward(params, optimizers, {}, 2, {}, lr=lr)
    assert torch.equal(params["means"], moved)


@pytest.mark.parametrize("ours", [DefaultStrategy, MCMCStrategy])
def test_fields_and_methods_are_gsplats(ours):
    theirs = getattr(gsplat, ours.__name__)
    for name, parameter in inspect.signature(theirs).parameters.items():
        assert inspect.signature(ours).parameters[name].default == parameter.default, name
    for method in ("initialize_state", "check_sanity", "step_pre_backward", "step_post_backward"):
        names = list(inspect.signature(getattr(theirs, method)).parameters)
        if names == ["self", "args", "kwargs"]:
            continue
        assert list(inspect.signature(getattr(ours, method)).parameters)[: len(names)] == names


def test_wrong_parameters_and_optimisers_are_named():
    params = {name: torch.nn.Parameter(torch.zeros(2)) for name in ("means", "quats", "scales", "opacities")}
    optimizers = {name: torch.optim.Adam([p]) for name, p in params.items()}
    with pytest.raises(ValueError, match="params lack opacities"):
        DefaultStrategy().check_sanity({n: p for n, p in params.items() if n != "opacities"}, optimizers)
    with pytest.raises(ValueError, match="names of the trained params"):
        MCMCStrategy().check_sanity(params, {"means": optimizers["means"]})
    optimizers["quats"].add_param_group({"params": [params["scales"]]})
    with pytest.raises(ValueError, match="optimizer of quats"):
        DefaultStrategy().check_sanity(params, optimizers)
    with pytest.raises(ValueError, match="a whole number of steps, got 0.005; .* by name"):
        MCMCStrategy(1_000, 5e5, 500, 25_000, 100, 0.005)  # the order of gsplat 1.5
