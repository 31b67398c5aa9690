# SPDX-License-Identifier: Apache-2.0
"""Loops of other trainers with our parts: INRIA's, and nerfstudio's by a stand-in for its interface."""

import importlib
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from torch import nn

import blitzgs
from blitzgs.compat.gsplat import DefaultStrategy
from blitzgs.compat.inria import DepthGaussianRasterizer as DepthRasterizer
from blitzgs.compat.inria import GaussianRasterizationSettings, GaussianRasterizer, distCUDA2, fused_ssim
from tests.compat.test_inria import camera
from tests.helpers import random_scene, refused

WIDTH, HEIGHT, VIEWS, TANFOV = 40, 32, 6, 0.5


def settings_of(view, degree=0, **more):
    matrix, full, centre = camera(
        2 * math.pi * view / VIEWS, tanfovx=TANFOV, tanfovy=0.4, dtype=torch.float32
    )
    return GaussianRasterizationSettings(
        image_height=HEIGHT, image_width=WIDTH, tanfovx=TANFOV, tanfovy=0.4, bg=torch.zeros(3),
        scale_modifier=1.0, viewmatrix=matrix, projmatrix=full, sh_degree=degree, campos=centre,
        prefiltered=False, debug=False, **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    """Points, their colours, and photographs of blobs that are at some of them."""
    g = torch.Generator().manual_seed(0)
    points, colors = torch.rand(60, 3, generator=g) * 1.6 - 0.8, torch.rand(60, 3, generator=g)
    unit = torch.tensor([[1.0, 0, 0, 0]]).expand(60, 4)
    photographs = [
        GaussianRasterizer(settings_of(view))(
            points, None, torch.full((60, 1), 0.9), colors_precomp=colors, scales=torch.full((60, 3), 0.12),
            rotations=unit,
        )[0]
        for view in range(VIEWS)
    ]  # fmt: skip
    return points, colors, photographs


def loss_of(image, photograph):
    ssim = fused_ssim(image[None], photograph[None])
    return 0.8 * (image - photograph).abs().mean() + 0.2 * (1 - ssim)


class Gaussians:
    """The parameters, activations and densification of the original trainer."""

    def __init__(self, points):
        n = len(points)
        spread = torch.sqrt(distCUDA2(points).clamp_min(1e-7)).log()[:, None].repeat(1, 3)
        start = {
            "xyz": (points.clone(), 2e-3), "f_dc": (torch.zeros(n, 1, 3), 2e-2),
            "f_rest": (torch.zeros(n, 3, 3), 1e-3), "opacity": (torch.zeros(n, 1), 5e-2),
            "scaling": (spread, 1e-2), "rotation": (torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), 1e-2),
        }  # fmt: skip
        self.p = {name: nn.Parameter(value) for name, (value, _) in start.items()}
        groups = [{"params": [self.p[n]], "lr": lr, "name": n} for n, (_, lr) in start.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
        self.clear()

    def clear(self):
        n = len(self.p["xyz"])
        self.accumulated, self.denominator, self.radii = (torch.zeros(n, 1) for _ in range(3))

    def arguments(self):
        p = self.p
        return {
            "means3D": p["xyz"], "opacities": p["opacity"].sigmoid(), "scales": p["scaling"].exp(),
            "rotations": nn.functional.normalize(p["rotation"]),
            "shs": torch.cat([p["f_dc"], p["f_rest"]], dim=1),
        }  # fmt: skip

    def add_statistics(self, screen, radii):
        seen = radii > 0
        self.radii[seen, 0] = torch.max(self.radii[seen, 0], radii[seen].float())
        self.accumulated[seen] += screen.grad[seen, :2].norm(dim=-1, keepdim=True)
        self.denominator[seen] += 1

    def densify(self, threshold):
        mean = (self.accumulated / self.denominator).nan_to_num(0)[:, 0]
        wanted = mean >= threshold
        for group in self.optimizer.param_groups:
            old = group["params"][0]
            state = self.optimizer.state.pop(old)
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = torch.cat([state[key], torch.zeros_like(state[key][wanted])])
            new = nn.Parameter(torch.cat([old.detach(), old.detach()[wanted]]))
            group["params"], self.p[group["name"]], self.optimizer.state[new] = [new], new, state
        self.clear()
        return int(wanted.sum())


def screen_of(gaussians):
    screen = torch.zeros_like(gaussians.p["xyz"], requires_grad=True) + 0
    screen.retain_grad()
    return screen


@pytest.mark.parametrize("newer", [False, True], ids=["2023", "antialiasing"])
def test_the_original_loop(scene, newer):
    points, _, photographs = scene
    gaussians, losses, degree = Gaussians(points), [], 0
    more = {"antialiasing": True} if newer else {}
    for iteration in range(1, 91):
        if iteration == 45:
            degree = 1
        view = iteration % VIEWS
        screen = screen_of(gaussians)
        results = GaussianRasterizer(raster_settings=settings_of(view, degree, **more))(
            means2D=screen, **gaussians.arguments()
        )
        image, radii = results[:2]
        loss = loss_of(image, photographs[view])
        if newer:  # the depth regularisation of the newer trainer
            loss = loss + 0.01 * (results[2] - 0.3).abs().mean()
        loss.backward()
        losses.append(loss.item())
        with torch.no_grad():
            gaussians.add_statistics(screen, radii)
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration == 30:
                grown = gaussians.densify(2e-4)
    assert 0 < grown <= 60 and len(gaussians.p["xyz"]) == 60 + grown
    assert sum(losses[-6:]) < 0.45 * sum(losses[:6])
    assert gaussians.p["f_rest"].abs().max() > 0


def test_a_loop_with_deformations_as_in_deformable_3dgs(scene):
    """A network moves, turns (without normalising) and scales the Gaussians; depth is rendered too."""
    points, _, photographs = scene
    torch.manual_seed(0)
    gaussians, losses = Gaussians(points), []
    network = nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, 10))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for iteration in range(60):
        view = iteration % VIEWS
        time = torch.full((len(points), 1), view / VIEWS)
        moved = network(torch.cat([gaussians.p["xyz"].detach(), time], dim=1)) * 0.1
        moves, turns, growths = moved.split([3, 4, 3], dim=1)
        arguments = gaussians.arguments()
        arguments["means3D"] = arguments["means3D"] + moves
        arguments["rotations"] = arguments["rotations"] + turns
        arguments["scales"] = (arguments["scales"] + growths).clamp_min(1e-3)
        screen, densify = screen_of(gaussians), screen_of(gaussians)
        image, radii, depth = DepthRasterizer(raster_settings=settings_of(view))(
            means2D=screen, means2D_densify=densify, **arguments
        )
        loss = loss_of(image, photographs[view])
        loss.backward()
        losses.append(loss.item())
        assert depth.shape == (1, HEIGHT, WIDTH) and 1 < depth.max() < 4
        gaussians.add_statistics(densify, radii)
        assert (densify.grad >= screen.grad.abs() - 1e-6).all()
        for each in (gaussians.optimizer, optimizer):
            each.step()
            each.zero_grad()
    assert sum(losses[-6:]) < 0.6 * sum(losses[:6])
    assert all(p.abs().max() > 0 for p in network.parameters())


def test_a_loop_with_anchors_as_in_scaffold_gs(scene):
    """Visible anchors, found by `visible_filter`, make Gaussians with colours of a network."""
    points, _, photographs = scene
    torch.manual_seed(0)
    n, k = len(points), 2
    features = nn.Parameter(0.1 * torch.randn(n, 8))
    offsets, scaling = nn.Parameter(0.01 * torch.randn(n, k, 3)), nn.Parameter(torch.full((n, 3), -2.0))
    color, opacity = nn.Linear(11, 3 * k), nn.Linear(11, k)
    trained = [features, offsets, scaling, *color.parameters(), *opacity.parameters()]
    optimizer, losses = torch.optim.Adam(trained, lr=1e-2), []
    unit = torch.tensor([[1.0, 0, 0, 0]])
    for iteration in range(90):
        view = iteration % VIEWS
        settings = settings_of(view, degree=1)
        rasterizer = GaussianRasterizer(raster_settings=settings)
        visible = rasterizer.visible_filter(
            means3D=points, scales=scaling.exp(), rotations=unit.expand(n, 4), cov3D_precomp=None
        ) > 0  # fmt: skip
        anchors = points[visible]
        seen_from = nn.functional.normalize(anchors - settings.campos, dim=1)
        code = torch.cat([features[visible], seen_from], dim=1)
        neural = opacity(code).tanh().view(-1, 1)
        mask = neural[:, 0] > 0
        xyz = (anchors[:, None] + offsets[visible]).view(-1, 3)[mask]
        screen = torch.zeros_like(xyz, requires_grad=True) + 0
        screen.retain_grad()
        image, radii = rasterizer(
            means3D=xyz, means2D=screen, shs=None, colors_precomp=color(code).sigmoid().view(-1, 3)[mask],
            opacities=neural[mask], scales=scaling.exp()[visible].repeat_interleave(k, 0)[mask],
            rotations=unit.expand(len(xyz), 4), cov3D_precomp=None,
        )  # fmt: skip
        loss = loss_of(image, photographs[view]) + 0.01 * scaling.exp().prod(dim=1).mean()
        loss.backward()
        losses.append(loss.item())
        assert not screen.grad[radii == 0].any() and screen.grad.abs().max() > 0
        optimizer.step()
        optimizer.zero_grad()
    assert sum(losses[-6:]) < 0.7 * sum(losses[:6])


SPLATFACTO = '''
from dataclasses import dataclass, field

class DefaultStrategy:
    """gsplat's"""

class MCMCStrategy:
    """gsplat's"""

def rasterization(*args, **kwargs):
    raise AssertionError("gsplat is called")

class SplatfactoModel:
    def __init__(self, config):
        self.config = config
        self.populate_modules()

    def populate_modules(self):
        self.strategy = DefaultStrategy(verbose=self.config.verbose)

    def get_outputs(self, camera):
        render, _, self.info = rasterization(**camera, packed=False)
        return render

    def step_post_backward(self, step):
        return isinstance(self.strategy, DefaultStrategy)

@dataclass
class SplatfactoModelConfig:
    _target: type = field(default_factory=lambda: SplatfactoModel)
    verbose: bool = False
'''


@pytest.fixture
def plugin(monkeypatch):
    parts = ("configs", "configs.method_configs", "models", "models.splatfacto", "plugins", "plugins.types")
    names = ("", *(f".{part}" for part in parts))
    modules = {f"nerfstudio{name}": ModuleType(f"nerfstudio{name}") for name in names}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
        if "." in name:
            parent, _, last = name.rpartition(".")
            setattr(modules[parent], last, module)
    splatfacto = modules["nerfstudio.models.splatfacto"]
    exec(compile(SPLATFACTO, "splatfacto.py", "exec"), splatfacto.__dict__)

    @dataclass
    class MethodSpecification:
        config: object
        description: str

    modules["nerfstudio.plugins.types"].MethodSpecification = MethodSpecification
    config = SimpleNamespace(
        method_name="splatfacto",
        pipeline=SimpleNamespace(model=splatfacto.SplatfactoModelConfig(verbose=True)),
    )
    modules["nerfstudio.configs.method_configs"].method_configs = {"splatfacto": config}
    monkeypatch.delitem(sys.modules, "blitzgs.compat.nerfstudio", raising=False)
    found = importlib.import_module("blitzgs.compat.nerfstudio")
    yield found, config
    sys.modules.pop("blitzgs.compat.nerfstudio", None)


def test_the_method_renders_with_blitzgs_and_leaves_splatfacto_alone(plugin):
    found, theirs = plugin
    config = found.method.config
    assert config.method_name == "blitzgs" and theirs.method_name == "splatfacto"
    assert config.pipeline.model.verbose and found.method.description
    model = config.pipeline.model._target(config.pipeline.model)
    assert isinstance(model.strategy, DefaultStrategy) and model.strategy.verbose
    assert model.step_post_backward(1)
    scene = random_scene(n=10, cameras=1)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
    arguments = dict(zip(names, scene.arguments(), strict=True)) | {"sh_degree": 3}
    expected, _, _ = blitzgs.rasterization(**arguments)
    assert torch.equal(model.get_outputs(arguments), expected)
    original = theirs.pipeline.model._target
    refused(AssertionError, "gsplat is called", original.get_outputs, model, arguments)


def test_the_entry_point_names_the_method():
    text = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text()
    section = text.split('[project.entry-points."nerfstudio.method_configs"]\n')[1]
    assert section.startswith('blitzgs = "blitzgs.compat.nerfstudio:method"\n')
