# SPDX-License-Identifier: Apache-2.0
"""gsplat's strategies with our renderer and optimiser, and ours that do what gsplat's do."""

import inspect
import math

import pytest
import torch

import blitzgs
from blitzgs.compat.gsplat import DefaultStrategy, MCMCStrategy
from blitzgs.optim import LazyAdam
from tests.call.test_raw_rasterization import NAMES, activated, raw, raw_parameters
from tests.helpers import random_scene, rasterize_scene, refused, relative_error
from tests.population.test_relocation import by_the_double_sum

gsplat = pytest.importorskip("gsplat", reason="needs gsplat, which pip installs without CUDA too")

RATES = dict(zip(NAMES, (2.0**-9, 2.0**-10, 2.0**-8, 2.0**-6, 2.0**-8, 2.0**-10), strict=True))


class Trainer:
    """The loop of gsplat's simple_trainer: its strategy, an optimiser for each parameter."""

    def __init__(self, scene, strategy, lazy, packed, moments):
        self.scene, self.strategy = scene, strategy
        self.lazy, self.packed, self.moments = lazy, packed, moments
        self.splats = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(p.detach()) for name, p in raw_parameters(scene).items()}
        )
        self.optimizers = {
            name: (LazyAdam if lazy else torch.optim.Adam)(
                [{"params": p, "lr": RATES[name], "name": name}], eps=1e-15
            )
            for name, p in self.splats.items()
        }
        strategy.check_sanity(self.splats, self.optimizers)
        self.state = strategy.initialize_state(scene_scale=10.0)
        self.state["count"] = torch.zeros(len(scene.means), dtype=torch.float32)  # it adds float32 to it

    def render(self, view):
        one = self.scene.view(view)
        p = {name: self.splats[name] for name in NAMES}
        if self.lazy:
            return raw(p, one, optimizers=self.optimizers)
        return activated(p, one, packed=self.packed)

    def step(self, step, view, target):
        image, _, info = self.render(view)
        self.strategy.step_pre_backward(self.splats, self.optimizers, self.state, step, info)
        blitzgs.l1_ssim(image, target).backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            if self.lazy:
                optimizer.catch_up(moments=self.moments)
        packed = self.lazy or self.packed
        self.strategy.step_post_backward(self.splats, self.optimizers, self.state, step, info, packed=packed)


@pytest.mark.parametrize("function", [blitzgs.rasterization, blitzgs.raw_rasterization])
def test_the_renderers_take_the_defaults_of_all_gsplats_arguments(function):
    scene = random_scene(n=20)
    parameters = inspect.signature(gsplat.rasterization).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
    if function is blitzgs.rasterization:
        expected, actual = (
            rasterize_scene(scene, **options) for options in ({}, {**defaults, "sh_degree": 3})
        )
    else:
        expected, actual = (raw(raw_parameters(scene), scene, **options) for options in ({}, defaults))
    assert torch.equal(actual[0], expected[0])


def test_meta_agrees_with_the_projection_in_torch():
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    scene = random_scene(n=60, cameras=3)
    _, _, meta = rasterize_scene(scene, packed=False, rasterize_mode="antialiased")
    quats = torch.nn.functional.normalize(scene.quats, dim=1)
    covars, _ = _quat_scale_to_covar_preci(quats, scene.scales, True, False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        scene.means, covars, scene.viewmats, scene.Ks, scene.width, scene.height, calc_compensations=True
    )
    seen = (meta["radii"] > 0).all(dim=-1)
    assert seen.any() and not (seen & ~(radii > 0).all(dim=-1)).any()
    for ours, theirs in (("means2d", means2d), ("depths", depths), ("conics", conics)):
        assert relative_error(meta[ours][seen], theirs[seen]) < 1e-3, ours
    assert relative_error(meta["opacities"][seen], (scene.opacities * compensations)[seen]) < 1e-3
    assert math.isclose(seen.float().mean(), (radii > 0).all(dim=-1).float().mean(), abs_tol=0.3)


VIEWS, STEPS = 5, 30
DEFAULT = {"refine_start_iter": 4, "refine_every": 8, "grow_grad2d": 0.005, "prune_opa": 0.3}


@pytest.fixture
def in_double():
    """The strategies make tensors of the default dtype."""
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


def train(strategy, lazy=False, packed=False, moments=False, **extra):
    scene = random_scene(n=50, cameras=VIEWS, width=20, height=16, dtype=torch.float64)
    targets = torch.rand(VIEWS, 1, 16, 20, 3, generator=torch.Generator().manual_seed(1))
    mcmc = isinstance(strategy, (MCMCStrategy, gsplat.MCMCStrategy))
    if mcmc:
        begin = strategy.initialize_state
        strategy.initialize_state = lambda scene_scale: begin()
        extra["lr"] = 0.0
    trainer = Trainer(scene, strategy, lazy, packed, moments)
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
    "refine_scale2d_stop_iter": 25, "grow_scale2d": 0.3, "prune_scale2d": 0.8, "revised_opacity": True,
    "reset_every": 13, "pause_refine_after_reset": 2, "prune_scale3d": 0.04,
}  # fmt: skip


@pytest.mark.usefixtures("in_double")
def test_gsplats_own_strategy_does_the_same_whatever_renders_and_steps():
    kinds = ((False, False, False), (False, True, False), (True, True, False), (True, True, True))
    options = {**DEFAULT, "reset_every": 20, "verbose": False}
    dense, *others = (train(gsplat.DefaultStrategy(**options), *kind) for kind in kinds)
    assert 60 < len(dense.splats["means"]) < 400
    for trainer in others:
        same(trainer, dense)


@pytest.mark.usefixtures("in_double")
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
    for own, message in (
        (strategy, "has no absgrad; render with absgrad=True"),
        (DefaultStrategy(), "has no grad; call step_pre_backward"),
    ):
        refused(ValueError, message, own.step_post_backward, {"means": torch.zeros(4, 3)}, {}, state, 1, info)


def relocation(opacities, scales, ratios, binoms, min_opacity=0.005):
    """Kheradmand et al. 2024, eq. 9, as the paper prints it."""
    rows = [by_the_double_sum(o, n, 0.0) for o, n in zip(opacities.tolist(), ratios.tolist(), strict=True)]
    shared, factors = torch.tensor(rows).T
    return shared.clamp(min=min_opacity), scales * factors[:, None]


def sample(weights, count, replacement=True):
    """The draws of our class from the same random numbers."""
    total = weights.cumsum(0)
    return torch.searchsorted(total, torch.rand(count) * total[-1], right=True)


@pytest.mark.usefixtures("in_double")
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
    refused(ValueError, "optimizer of quats", DefaultStrategy().check_sanity, params, optimizers)
    with pytest.raises(ValueError, match="a whole number of steps, got 0.005; .* by name"):
        MCMCStrategy(1_000, 5e5, 500, 25_000, 100, 0.005)  # the order of gsplat 1.5
