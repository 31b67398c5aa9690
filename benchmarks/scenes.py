# SPDX-License-Identifier: Apache-2.0
"""Seeded benchmark inputs, made of torch alone: `aerial(n)` and `garden_like(n)`.

Both return a `BenchmarkScene` whose parameters are activated (what `rasterization` of other packages takes);
`raw()` gives the same Gaussians as the trainer stores them (log scales, logit opacities).
The numbers depend on the seed and on the kind of device, because CPU and CUDA generators differ;
the distribution does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from blitzgs.formats.gaussians import SH_C0
from blitzgs.ops.projection_types import Views


@dataclass(frozen=True)
class BenchmarkScene:
    """N Gaussians and B pinhole cameras; lengths in metres (aerial) or scene units (garden_like)."""

    name: str
    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] w, x, y, z, unit length
    scales: Tensor  # [N, 3] standard deviations
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, 16, 3]
    viewmats: Tensor  # [B, 4, 4] world to camera, x right, y down, z forward
    Ks: Tensor  # [B, 3, 3]
    width: int
    height: int

    @property
    def views(self) -> Views:
        """The cameras as the renderer takes them."""
        return Views(self.viewmats, self.Ks, self.width, self.height)

    def raw(self) -> dict[str, Tensor]:
        """Return the parameters before activation: log scales and logit opacities."""
        return {
            "means": self.means, "quats": self.quats, "scales": self.scales.log(),
            "opacities": torch.logit(self.opacities), "sh": self.sh,
        }  # fmt: skip

    def rows(self, order: Tensor) -> BenchmarkScene:
        """Return the scene with its Gaussians in another order, int64 [N]."""
        names = ("means", "quats", "scales", "opacities", "sh")
        return replace(self, **{name: getattr(self, name)[order] for name in names})

    def first_views(self, count: int) -> BenchmarkScene:
        """Return the scene seen by its first `count` cameras only."""
        return replace(self, viewmats=self.viewmats[:count], Ks=self.Ks[:count])


def aerial(
    n: int,
    device: torch.device | str = "cpu",
    *,
    views: int = 1,
    seed: int = 0,
    width: int = 1600,
    height: int = 1064,
) -> BenchmarkScene:
    """Return N Gaussians on 1 km² of ground and boxes under oblique cameras at 150 m height.

    The surface is a grid of 25 × 25 lots of 40 m: two of three carry a building (a box of random
    footprint, 6 to 45 m high), the rest is open ground. Points are uniform over the surface (ground outside
    the buildings, roofs, walls). With the mean spacing h = sqrt(surface / N), a Gaussian's two tangential
    axes are log-normal around 0.55 h (σ = 0.6 of the logarithm, drawn independently, so that it is
    elongated), the axis along the normal is five times thinner, and its centre is off the surface by 0.15 h;
    the frame is turned at random in the surface and tilted by about 10°. Logit opacities are normal (0.5, 2).

    The cameras look 40° down along +y, 60° wide; further views advance by 20 m along x, like a batch of
    neighbouring images. About 10 % of the Gaussians are in a view.
    """
    generator = torch.Generator(device=device).manual_seed(seed)
    origins, edges_u, edges_v = _lots(generator, device)
    normals = torch.linalg.cross(edges_u, edges_v)
    areas = normals.norm(dim=1)
    normals = normals / areas[:, None]
    total = areas.double().cumsum(0)
    spacing = math.sqrt(float(total[-1]) / max(n, 1))

    target = torch.rand(n, generator=generator, device=device, dtype=torch.float64) * total[-1]
    surface = torch.searchsorted(total, target, right=True).clamp_(max=len(total) - 1)
    place = torch.rand(n, 2, generator=generator, device=device)
    means = origins[surface] + place[:, :1] * edges_u[surface] + place[:, 1:] * edges_v[surface]
    offset = torch.randn(n, 1, generator=generator, device=device)
    means += 0.15 * spacing * offset * normals[surface]

    scales = torch.exp(0.6 * torch.randn(n, 3, generator=generator, device=device)) * (0.55 * spacing)
    scales[:, 2] *= 0.2
    albedo = 0.25 + 0.5 * torch.rand(len(areas), 3, generator=generator, device=device)[surface]
    colors = albedo + 0.08 * torch.randn(n, 1, generator=generator, device=device)
    return BenchmarkScene(
        name=f"aerial {n / 1e6:g}M",
        means=means,
        quats=_surface_aligned(normals[surface], generator),
        scales=scales,
        opacities=torch.sigmoid(0.5 + 2.0 * torch.randn(n, generator=generator, device=device)),
        sh=_spherical_harmonics(colors, generator),
        viewmats=torch.stack(
            [
                look_at((20.0 * (b - (views - 1) / 2), -180.0, 150.0), (20.0 * (b - (views - 1) / 2), 0, 0))
                for b in range(views)
            ]
        ).to(device),
        Ks=_pinhole(width, height, 60.0, views).to(device),
        width=width,
        height=height,
    )


def garden_like(
    n: int = 2_790_000,
    device: torch.device | str = "cpu",
    *,
    views: int = 1,
    seed: int = 0,
    width: int = 1920,
    height: int = 1080,
) -> BenchmarkScene:
    """Return an object-centred cloud of 4 × 4 × 4 units repeated on a 5 × 5 grid, seen from 3 units away.

    It stands in for gsplat's garden test cloud at scene grid 5 (2.79 M Gaussians at 1920 × 1080), which is a
    crop of SfM points of a garden table around the origin, repeated, with random attributes. Here one tile
    holds 30 % of its points on the table (top of radius 0.8, its foot, and a vase on it), 40 % on the ground
    and 30 % in four hedges, each with small noise. Attributes are drawn as in that test: scales uniform
    in [0, 0.02] per axis, uniformly random rotations, opacities uniform in [0, 1]; so there are long
    lists per pixel and many nearly transparent, needle-shaped Gaussians. The cameras orbit the central tile.
    """
    generator = torch.Generator(device=device).manual_seed(seed)
    per_tile = -(-n // 25)
    tile, colors = _garden_tile(per_tile, generator, device)
    steps = torch.arange(-2, 3, device=device) * 4.0
    grid = torch.cartesian_prod(steps, steps)
    means = tile.repeat(25, 1)
    means[:, :2] += grid.repeat_interleave(per_tile, dim=0)
    means, colors = means[:n].clone(), colors.repeat(25, 1)[:n]
    angles = [2 * math.pi * b / max(views, 8) for b in range(views)]
    quats = torch.randn(n, 4, generator=generator, device=device)
    opacities = torch.rand(n, generator=generator, device=device)
    return BenchmarkScene(
        name=f"garden-like {n / 1e6:g}M",
        means=means,
        quats=torch.nn.functional.normalize(quats, dim=1),
        scales=(torch.rand(n, 3, generator=generator, device=device) * 0.02).clamp_(min=1e-6),
        opacities=opacities.clamp_(1e-6, 1 - 1e-6),
        sh=_spherical_harmonics(colors, generator),
        viewmats=torch.stack(
            [look_at((3 * math.sin(a), -3 * math.cos(a), 1.4), (0.0, 0.0, 0.2)) for a in angles]
        ).to(device),
        Ks=_pinhole(width, height, 65.0, views).to(device),
        width=width,
        height=height,
    )


def _lots(generator: torch.Generator, device: torch.device | str) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rectangles of the city, corner and two edges [R, 3]: open ground, roofs and walls."""
    lots, size = 25, 40.0
    corner = (torch.cartesian_prod(torch.arange(lots), torch.arange(lots)) - lots / 2).to(device) * size
    draw = torch.rand(lots * lots, 6, generator=generator, device=device)
    built = draw[:, 0] < 2 / 3
    low = corner + 4.0 + 6.0 * draw[:, 1:3]
    high = corner + size - 4.0 - 6.0 * draw[:, 3:5]
    roof = torch.where(built, 6.0 + 39.0 * draw[:, 5] ** 2, 0.0)
    x = torch.stack([corner[:, 0], low[:, 0], high[:, 0], corner[:, 0] + size])
    y = torch.stack([corner[:, 1], low[:, 1], high[:, 1], corner[:, 1] + size])

    rectangles = []  # corner, edge u, edge v; u × v points outwards

    def flat(x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor, z: Tensor) -> None:
        zero = torch.zeros_like(x0)
        edge_u = torch.stack([x1 - x0, zero, zero], 1)
        edge_v = torch.stack([zero, y1 - y0, zero], 1)
        rectangles.append((torch.stack([x0, y0, z], 1), edge_u, edge_v))

    ground = torch.zeros_like(roof)
    flat(x[0], x[3], y[0], y[1], ground)
    flat(x[0], x[3], y[2], y[3], ground)
    flat(x[0], x[1], y[1], y[2], ground)
    flat(x[2], x[3], y[1], y[2], ground)
    flat(x[1], x[2], y[1], y[2], roof)
    up = torch.stack([ground, ground, roof], 1)[built]
    corners = [(x[1], y[1]), (x[2], y[1]), (x[2], y[2]), (x[1], y[2])]
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        start = torch.stack([x0, y0, ground], 1)[built]
        rectangles.append((start, torch.stack([x1 - x0, y1 - y0, ground], 1)[built], up))
    origins, edges_u, edges_v = (torch.cat(parts) for parts in zip(*rectangles, strict=True))
    return origins, edges_u, edges_v


def _garden_tile(count: int, generator: torch.Generator, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """Return points [count, 3] of one tile, centred on the table top, and their colours [count, 3]."""
    u = torch.rand(count, 3, generator=generator, device=device)
    kind = torch.rand(count, generator=generator, device=device)
    angle = 2 * math.pi * u[:, 0]
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    zero = torch.zeros_like(angle)

    top = torch.cat([0.8 * u[:, 1:2].sqrt() * circle, zero[:, None]], 1)
    foot = torch.cat([0.25 * circle, -0.75 * u[:, 1:2]], 1)
    bulge = 0.08 + 0.1 * (math.pi * u[:, 1:2]).sin()
    vase = torch.cat([bulge * circle, 0.45 * u[:, 1:2]], 1)
    ground = torch.stack([4 * u[:, 0] - 2, 4 * u[:, 1] - 2, zero - 0.75], 1)
    along, across = 4 * u[:, 1] - 2, 1.6 + 0.35 * u[:, 2]
    side = (u[:, 0] < 0.5).float() * 2 - 1
    turned = (u[:, 0] * 4).frac() < 0.5
    hedge = torch.stack([along, across * side, -0.75 + 1.2 * (u[:, 0] * 8).frac()], 1)
    hedge = torch.where(turned[:, None], hedge[:, [1, 0, 2]], hedge)

    points, colors = hedge, torch.tensor([0.2, 0.4, 0.15], device=device).expand(count, 3)
    for limit, part, color in (
        (0.7, ground, (0.45, 0.43, 0.4)),
        (0.3, top, (0.5, 0.33, 0.22)),
        (0.1, foot, (0.3, 0.2, 0.15)),
        (0.06, vase, (0.6, 0.6, 0.55)),
    ):
        chosen = (kind < limit)[:, None]
        points = torch.where(chosen, part, points)
        colors = torch.where(chosen, torch.tensor(color, device=device), colors)
    points = points + 0.01 * torch.randn(count, 3, generator=generator, device=device)
    return points, colors + 0.1 * torch.randn(count, 1, generator=generator, device=device)


def _surface_aligned(normals: Tensor, generator: torch.Generator) -> Tensor:
    """Return unit quaternions [N, 4] that turn z to the normals, with random spin and about 10° of tilt."""
    count, device = len(normals), normals.device
    # The shortest turn from z to the normal n is (1 + n.z, z × n); no surface has the degenerate n = -z.
    toward = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], 1)
    spin = math.pi * torch.rand(count, generator=generator, device=device)
    zero = torch.zeros_like(spin)
    quats = _quaternion_product(toward, torch.stack([spin.cos(), zero, zero, spin.sin()], 1))
    tilt = 0.09 * torch.randn(count, 2, generator=generator, device=device)
    tilt = torch.cat([torch.ones_like(spin)[:, None], tilt, zero[:, None]], 1)
    return torch.nn.functional.normalize(_quaternion_product(quats, tilt), dim=1)


def _quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    w0, x0, y0, z0 = a.unbind(1)
    w1, x1, y1, z1 = b.unbind(1)
    return torch.stack(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
            w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        ],
        1,
    )


def _spherical_harmonics(colors: Tensor, generator: torch.Generator) -> Tensor:
    """Return degree-3 coefficients [N, 16, 3] with mean colour `colors` and bands of 0.06, 0.04 and 0.03."""
    sh = torch.randn(len(colors), 16, 3, generator=generator, device=colors.device)
    bands = torch.tensor([0.0] + 3 * [0.06] + 5 * [0.04] + 7 * [0.03], device=colors.device)
    sh *= bands[:, None]
    sh[:, 0] = (colors - 0.5) / SH_C0
    return sh


def look_at(position: tuple[float, float, float], target: tuple[float, float, float]) -> Tensor:
    """Return the world-to-camera matrix [4, 4] of an upright camera (world z is up)."""
    centre = torch.tensor(position, dtype=torch.float64)
    forward = torch.nn.functional.normalize(torch.tensor(target, dtype=torch.float64) - centre, dim=0)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = torch.nn.functional.normalize(right, dim=0)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre
    return viewmat.float()


def _pinhole(width: int, height: int, horizontal_fov_degrees: float, views: int) -> Tensor:
    focal = 0.5 * width / math.tan(math.radians(horizontal_fov_degrees) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return K.expand(views, 3, 3).clone()
