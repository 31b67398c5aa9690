# SPDX-License-Identifier: Apache-2.0
"""Random projected splats, and their images by definition."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from blitzgs.reference import composite


@dataclass
class Splats:
    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    camera_ids: Tensor

    def to(self, dtype):
        floats = (self.means2d, self.conics, self.opacities, self.colors, self.depths)
        return Splats(*(t.to(dtype) for t in floats), self.camera_ids)

    def geometry(self):
        """Return the arguments of `intersect`."""
        return self.means2d, self.conics, self.opacities, self.depths, self.camera_ids

    def values(self):
        """Return the arguments that `rasterize` differentiates."""
        return self.means2d, self.conics, self.opacities, self.colors


def random_splats(
    count,
    width,
    height,
    *,
    channels=3,
    cameras=1,
    smallest=0.4,
    largest=10.0,
    dtype=torch.float32,
    seed=0,
    opacity=(0.0, 1.0),
):
    """Splats with axes log-uniform in [smallest, largest] pixels, also around the image."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    means = (uniform(count, 2) * 1.4 - 0.2) * torch.tensor([width, height], dtype=torch.float64)
    axes = smallest * torch.exp(uniform(count, 2) * math.log(largest / smallest))
    angle = uniform(count) * 2 * math.pi
    cos, sin = angle.cos(), angle.sin()
    inverse = axes**-2
    conics = torch.stack(
        [
            cos**2 * inverse[:, 0] + sin**2 * inverse[:, 1],
            cos * sin * (inverse[:, 0] - inverse[:, 1]),
            sin**2 * inverse[:, 0] + cos**2 * inverse[:, 1],
        ],
        -1,
    )
    opacities = opacity[0] + (opacity[1] - opacity[0]) * uniform(count)
    colors, depths = uniform(count, channels), uniform(count) + 0.5
    camera_ids = torch.randint(0, cameras, (count,), generator=generator).int()
    return Splats(means, conics, opacities, colors, depths, camera_ids).to(dtype)


def pixel_alphas(means2d, conics, opacities, width, height):
    """Alpha of every splat at every pixel before any cut, [P, H, W]."""
    ys = torch.arange(height, dtype=means2d.dtype)[:, None] + 0.5
    xs = torch.arange(width, dtype=means2d.dtype)[None, :] + 0.5
    dx, dy = xs - means2d[:, 0, None, None], ys - means2d[:, 1, None, None]
    a, b, c = (conics[:, i, None, None] for i in range(3))
    power = -0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)
    return (opacities[:, None, None] * torch.exp(power)).clamp(max=0.99)


def by_definition(splats, width, height, n_cameras=1, backgrounds=None):
    """Return renders [B, H, W, D], alphas [B, H, W] and the pixels at a cut, bool [B, H, W]."""
    renders, alphas, cuts = [], [], []
    for camera in range(n_cameras):
        here = (splats.camera_ids == camera).nonzero()[:, 0]
        here = here[splats.depths[here].argsort(stable=True)]
        columns = (column[here] for column in (*splats.values(), splats.depths))
        image = composite(*columns, width, height, tolerance=1e-5)
        behind = 0 if backgrounds is None else image.transmittances[..., None] * backgrounds[camera]
        renders.append(image.values + behind)
        alphas.append(1 - image.transmittances)
        cuts.append(image.cut)
    return torch.stack(renders), torch.stack(alphas), torch.stack(cuts)


def with_capacity(column, capacity):
    """Return a column of `capacity` splats that begins with these; the others would change any result."""
    garbage = float("nan") if column.is_floating_point() else torch.iinfo(column.dtype).max - 3
    padded = column.new_full((capacity, *column.shape[1:]), garbage)
    padded[: len(column)] = column
    return padded


def kept_by(outputs: tuple) -> list[Tensor]:
    """Return what the backward pass of the rasterisation takes of the outputs of the forward pass."""
    _, transmittances, last_ids, _, packed_splats, tile_order = outputs[:6]
    return [transmittances, last_ids, packed_splats, tile_order]
