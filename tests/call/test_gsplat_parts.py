# SPDX-License-Identifier: Apache-2.0
"""Parts of gsplat that need no GPU work with our renderer: its strategies, and its projection in torch."""

import inspect
import math

import pytest
import torch

import blitzgs
from blitzgs.optim import LazyAdam
from tests.call.test_raw_rasterization import NAMES, activated, raw, raw_parameters
from tests.helpers import random_scene, rasterize_scene, relative_error

gsplat = pytest.importorskip("gsplat", reason="needs gsplat, which pip installs without CUDA too")

RATES = dict(zip(NAMES, (2.0**-9, 2.0**-10, 2.0**-8, 2.0**-6, 2.0**-8, 2.0**-10), strict=True))


class Trainer:
    """The loop of gsplat's simple_trainer: its strategy, an optimiser for each parameter."""

    def __init__(self, scene, strategy, lazy, packed, moments):
        self.scene, self.strategy, self.lazy, self.packed, self.moments = (
            scene,
            strategy,
            lazy,
            packed,
            moments,
        )
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
        one = random_scene(n=1, cameras=1, width=self.scene.width, height=self.scene.height)
        one.viewmats, one.Ks = self.scene.viewmats[view, None], self.scene.Ks[view, None]
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


@pytest.fixture
def in_double():
    """The strategies make tensors of the default dtype."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("in_double")
def test_the_default_strategy_does_the_same_whatever_renders_and_steps():
    scene = random_scene(n=50, cameras=5, width=20, height=16, dtype=torch.float64)
    targets = torch.rand(5, 1, 16, 20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    trainers = []
    for kind in ((False, False, False), (False, True, False), (True, True, False), (True, True, True)):
        strategy = gsplat.DefaultStrategy(
            refine_start_iter=4,
            refine_every=8,
            reset_every=20,
            grow_grad2d=0.005,
            prune_opa=0.3,
            verbose=False,
        )
        trainer = Trainer(scene, strategy, *kind)
        torch.manual_seed(3)  # of the strategy's splits
        for step in range(30):
            trainer.step(step, step % 5, targets[step % 5])
        trainers.append(trainer)
    dense, *others = trainers
    assert 60 < len(dense.splats["means"]) < 400
    for trainer in others:
        for name in NAMES:
            assert relative_error(trainer.splats[name], dense.splats[name]) < 1e-6, name


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
