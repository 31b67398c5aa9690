# SPDX-License-Identifier: Apache-2.0
"""All tests of this folder need a GPU: a crowded little scene, and the ops run on either device."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectedSplats, ProjectionInputs, ProjectionOptions

ops = torch.ops.blitzgs

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.cuda)


class Scene:
    """N random Gaussians before B cameras that look at them."""

    def __init__(self, n: int = 3000, views: int = 2, width: int = 150, height: int = 100, seed: int = 0):
        g = torch.Generator().manual_seed(seed)
        self.width, self.height, self.degree = width, height, 3
        self.means = torch.rand(n, 3, generator=g) * 4 - 2
        self.quats = torch.randn(n, 4, generator=g)
        self.scales = torch.randn(n, 3, generator=g) * 0.8 - 3.2
        self.opacities = torch.randn(n, generator=g) * 2
        self.sh = torch.randn(n, 16, 3, generator=g) * 0.3
        self.viewmats = torch.stack([_viewmat(0.3 * b, 5.0) for b in range(views)])
        K = torch.tensor([[1.2 * width, 0, 0.47 * width], [0, 1.3 * width, 0.52 * height], [0, 0, 1]])
        self.Ks = K.expand(views, 3, 3).contiguous()

    def parameters(self, device: str, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        names = ("means", "quats", "scales", "opacities", "sh", "viewmats", "Ks")
        return [getattr(self, name).to(device, dtype) for name in names]

    def inputs(
        self,
        device: str,
        dtype: torch.dtype = torch.float32,
        active_ids: Tensor | None = None,
        active_views: Tensor | None = None,
        **changes: Any,
    ) -> ProjectionInputs:
        *gaussians, viewmats, Ks = self.parameters(device, dtype)
        options = ProjectionOptions(self.width, self.height, sh_degree=self.degree, near_plane=0.1)._replace(
            **changes
        )
        active = [tensor for tensor in (active_ids, active_views) if tensor is not None]
        return ProjectionInputs(gaussians, (viewmats, Ks), options, active)

    def project(self, device: str, dtype: torch.dtype = torch.float32, **changes: Any) -> ProjectedSplats:
        return project_splats(self.inputs(device, dtype, **changes))

    def grid(self, tile_size: int = 16, begin: int = 0, end: int = -1) -> list[int]:
        return [len(self.Ks), self.width, self.height, tile_size, begin, end]


def _viewmat(angle: float, distance: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s, 0], [0, 1.0, 0, 0], [-s, 0, c, distance], [0, 0, 0, 1]])


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return |value - expected| / |expected| over all elements; NaN never passes a comparison with it."""
    expected = expected.double().cpu()
    return float((value.double().cpu() - expected).norm() / expected.norm().clamp(min=1e-30))


@pytest.fixture
def scene() -> Scene:
    """Return the default scene."""
    return Scene()
