# SPDX-License-Identifier: Apache-2.0
"""The plug-in against a stand-in for the documented interface of nerfstudio, which is not installed."""

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

import blitzgs
from blitzgs.compat.gsplat import DefaultStrategy
from tests.helpers import random_scene

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
    with pytest.raises(AssertionError, match="gsplat is called"):
        original.get_outputs(model, arguments)


def test_the_entry_point_names_the_method():
    text = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text()
    section = text.split('[project.entry-points."nerfstudio.method_configs"]\n')[1]
    assert section.startswith('blitzgs = "blitzgs.compat.nerfstudio:method"\n')
