# SPDX-License-Identifier: Apache-2.0
"""INRIA's rasteriser written from its published formulas in float64 torch, without any part of BlitzGS."""

import math

import torch

Y0, Y1 = 0.28209479177387814, 0.4886025119029199


def camera(angle=0.3, distance=3.0, tanfovx=0.5, tanfovy=0.4, shift=(0.0, 0.0), dtype=torch.float64):
    """Return the matrices of a trainer for row vectors: view, full projection, and the centre."""
    centre = torch.tensor([math.sin(angle), -0.4, -math.cos(angle)], dtype=torch.float64) * distance
    forward = -centre / centre.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1, 0], dtype=torch.float64), forward)
    right /= right.norm()
    world_to_view = torch.eye(4, dtype=torch.float64)
    world_to_view[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    world_to_view[:3, 3] = -world_to_view[:3, :3] @ centre
    near, far = 0.01, 100.0
    clip = torch.zeros(4, 4, dtype=torch.float64)
    clip[0, 0], clip[1, 1] = 1 / tanfovx, 1 / tanfovy
    clip[0, 2], clip[1, 2] = shift
    clip[2, 2], clip[2, 3], clip[3, 2] = far / (far - near), -far * near / (far - near), 1
    view = world_to_view.T
    return view.to(dtype), (view @ clip.T).to(dtype), centre.to(dtype)


def covariances(scales, rotations, modifier):
    """The 3D covariances; the quaternions are not normalised."""
    r, x, y, z = rotations.unbind(1)
    matrix = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y),
            2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x),
            2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y),
        ],
        dim=1,
    ).view(-1, 3, 3)  # fmt: skip
    scaled = matrix @ torch.diag_embed(modifier * scales)
    return scaled @ scaled.transpose(1, 2)


def colours(sh, degree, directions):
    """SH of degree 0 or 1, clamped."""
    value = Y0 * sh[:, 0]
    if degree > 0:
        x, y, z = directions[:, :, None].unbind(1)
        value = value - Y1 * y * sh[:, 1] + Y1 * z * sh[:, 2] - Y1 * x * sh[:, 3]
    return (value + 0.5).clamp(min=0)


def render(s, means, opacities, offsets, sh=None, colors=None, covariance=None, tile_cut=False):
    """Return image [C, H, W], inverse depth and depth [H, W], radii [N], and the marks of cut pixels [H, W].

    `offsets` [N, 2], zeros, are added to the projected means in clip space.
    """
    height, width = s.image_height, s.image_width
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], dim=1)
    t = homogeneous @ s.viewmatrix
    clip = homogeneous @ s.projmatrix
    screen = clip[:, :2] / clip[:, 3:] + offsets
    size = means.new_tensor([width, height])
    pixels = ((screen + 1) * size - 1) / 2  # the centre of pixel (i, j) is (i, j) here
    focal = size / (2 * means.new_tensor([s.tanfovx, s.tanfovy]))
    z = t[:, 2]
    slopes = torch.stack(
        [
            (t[:, 0] / z).clamp(-1.3 * s.tanfovx, 1.3 * s.tanfovx),
            (t[:, 1] / z).clamp(-1.3 * s.tanfovy, 1.3 * s.tanfovy),
        ]
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [focal[0] / z, zero, -focal[0] * slopes[0] / z, zero, focal[1] / z, -focal[1] * slopes[1] / z], dim=1
    ).view(-1, 2, 3)
    onto = jacobian @ s.viewmatrix[:3, :3].T
    flat = onto @ covariance @ onto.transpose(1, 2)
    sharp = torch.linalg.det(flat)
    flat = flat + 0.3 * torch.eye(2, dtype=flat.dtype)
    determinant = torch.linalg.det(flat)
    conic = torch.linalg.inv(flat)
    middle = 0.5 * (flat[:, 0, 0] + flat[:, 1, 1])
    radius = (3 * (middle + (middle**2 - determinant).clamp(min=0.1).sqrt()).sqrt()).ceil().detach()
    opacities = opacities.view(-1)
    if s.antialiasing:
        opacities = opacities * (sharp / determinant).clamp(min=0.000025).sqrt()
    if colors is None:
        directions = torch.nn.functional.normalize(means - s.campos, dim=1)
        colors = colours(sh, s.sh_degree, directions)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = means.new_zeros(colors.shape[1], height, width)
    inverse, depth, left = (means.new_zeros(height, width) for _ in range(3))
    left = left + 1
    done, marks = torch.zeros(height, width, dtype=bool), torch.zeros(height, width, dtype=bool)
    for i in torch.argsort(z.detach(), stable=True).tolist():
        if z[i] <= 0.2:
            continue
        dx, dy = pixels[i, 0] - columns, pixels[i, 1] - rows
        power = -0.5 * (conic[i, 0, 0] * dx**2 + conic[i, 1, 1] * dy**2) - conic[i, 0, 1] * dx * dy
        alpha = (opacities[i] * power.exp()).clamp(max=0.99)
        drawn = (alpha >= 1 / 255) & ~done
        if tile_cut:
            lowest = [int(((p - radius[i]) / 16).clamp(min=0)) for p in pixels[i]]
            highest = [int((p + radius[i] + 15) / 16) for p in pixels[i]]
            drawn &= (columns // 16 >= lowest[0]) & (columns // 16 < highest[0])
            drawn &= (rows // 16 >= lowest[1]) & (rows // 16 < highest[1])
        after = left * (1 - alpha)
        marks |= ((alpha * 255 - 1).abs() < 1e-6) | (drawn & ((after / 1e-4 - 1).abs() < 1e-6))
        done = done | (drawn & (after < 1e-4))
        drawn &= ~done
        weight = torch.where(drawn, alpha * left, 0)
        image = image + weight * colors[i][:, None, None]
        inverse, depth = inverse + weight / z[i], depth + weight * z[i]
        left = torch.where(drawn, after, left)
    return image + left * s.bg[:, None, None], inverse, depth, radius.int(), marks
