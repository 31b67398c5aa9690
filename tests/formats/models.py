"""Models of random Gaussians."""

import torch

from blitzgs.formats.gaussians import Gaussians


def some_gaussians(count, degree, seed=0, levels=False):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=3 * normal(count, 3),
        quats=normal(count, 4),
        scales=normal(count, 3) * 0.7 - 3,
        opacities=2 * normal(count),
        sh=0.2 * normal(count, (degree + 1) ** 2, 3),
        levels=torch.randint(0, 4, (count,), generator=generator).float() if levels else None,
    )
