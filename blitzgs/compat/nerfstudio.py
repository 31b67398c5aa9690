# SPDX-License-Identifier: Apache-2.0
"""The method `blitzgs` of nerfstudio: splatfacto with this project's renderer and strategies.

nerfstudio finds `method` by the entry point `nerfstudio.method_configs` and imports this module.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, fields
from types import FunctionType
from typing import Any

from nerfstudio.configs.method_configs import method_configs
from nerfstudio.models import splatfacto
from nerfstudio.plugins.types import MethodSpecification

from blitzgs.call import rasterization
from blitzgs.compat.gsplat import DefaultStrategy, MCMCStrategy

_OURS = {"rasterization": rasterization, "DefaultStrategy": DefaultStrategy, "MCMCStrategy": MCMCStrategy}


def _with_our_names(function: Any) -> FunctionType:
    """Return a function of splatfacto that finds our names; the method `splatfacto` keeps gsplat's."""
    names = {**function.__globals__, **_OURS}
    found = FunctionType(
        function.__code__, names, function.__name__, function.__defaults__, function.__closure__
    )
    found.__kwdefaults__ = function.__kwdefaults__
    return found


class BlitzGSModel(splatfacto.SplatfactoModel):  # type: ignore[misc]
    """Splatfacto's model; what it calls of gsplat is of BlitzGS."""

    populate_modules = _with_our_names(splatfacto.SplatfactoModel.populate_modules)
    get_outputs = _with_our_names(splatfacto.SplatfactoModel.get_outputs)
    step_post_backward = _with_our_names(splatfacto.SplatfactoModel.step_post_backward)


@dataclass
class BlitzGSModelConfig(splatfacto.SplatfactoModelConfig):  # type: ignore[misc]
    """Splatfacto's options."""

    _target: type = field(default_factory=lambda: BlitzGSModel)


def _specification() -> MethodSpecification:
    config = deepcopy(method_configs["splatfacto"])
    config.method_name = "blitzgs"
    given = config.pipeline.model
    options = {f.name: getattr(given, f.name) for f in fields(given) if f.name != "_target" and f.init}
    config.pipeline.model = BlitzGSModelConfig(**options)
    return MethodSpecification(config, description="Splatfacto with the renderer and strategies of BlitzGS.")


method = _specification()
