# SPDX-License-Identifier: Apache-2.0
"""Random projected splats, and a dense compositor in plain torch: the definition of the image."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


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


def dense_composite(splats, width, height, n_cameras=1, backgrounds=None):
    """Composite every splat over every pixel: renders [B, H, W, D] and alphas [B, H, W]."""
    order = torch.argsort(splats.depths, stable=True)
    renders, remainders = [], []
    for camera in range(n_cameras):
        here = order[splats.camera_ids[order] == camera]
        alphas = pixel_alphas(*(t[here] for t in splats.values()[:3]), width, height)
        alphas = torch.where(_drawn(alphas.detach()), alphas, 0.0)
        ends = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), 0)
        color = torch.einsum("phw,phw,pd->hwd", alphas, ends[:-1], splats.colors[here])
        if backgrounds is not None:
            color = color + ends[-1][..., None] * backgrounds[camera]
        renders.append(color)
        remainders.append(ends[-1])
    return torch.stack(renders), 1 - torch.stack(remainders)


def _drawn(alphas):
    """Return which splats, front to back, each pixel composites: bool [P, H, W]."""
    drawn = torch.zeros_like(alphas, dtype=torch.bool)
    rest, running = torch.ones_like(alphas[0]), torch.ones_like(alphas[0], dtype=torch.bool)
    for i, alpha in enumerate(alphas):
        touched = running & (alpha >= 1 / 255)
        after = rest * (1 - alpha)
        drawn[i] = touched & (after >= 1e-4)
        running &= drawn[i] | ~touched
        rest = torch.where(drawn[i], after, rest)
    return drawn


def near_a_cut(splats, width, height, margin=1e-5):
    """Return the pixels [B, H, W] with an alpha so near to 1/255 that rounding may decide."""
    alphas = pixel_alphas(*(t.double() for t in splats.values()[:3]), width, height)
    close = ((alphas * 255 - 1).abs() < margin).any(0)
    return close[None]


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
