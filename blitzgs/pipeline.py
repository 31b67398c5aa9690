# SPDX-License-Identifier: Apache-2.0
"""The hot path of training and rendering: views in, images and compact gradients out, without autograd.

`forward` goes from the active Gaussians through projection, tile intersection and compositing to a `Frame`;
`backward` returns along the same route from image gradients to the gradients of the visible Gaussians alone.
Nothing
here is as long as the table: cost follows what the views see.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from blitzgs.model import GaussianTable
from blitzgs.ops.project import Rows

MAX_VIEWS = 32


@dataclass(frozen=True)
class Views:
    """B pinhole views of one image size, rendered together.

    Attributes:
        viewmats: world to camera, float32 [B, 4, 4].
        Ks: intrinsics in pixels, float32 [B, 3, 3].
        width: pixels.
        height: pixels.
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]


@dataclass(frozen=True)
class RenderOptions:
    """How Gaussians become an image; lengths in the unit of the table.

    Attributes:
        sh_degree: spherical-harmonics degree that is evaluated.
        near_plane: what is nearer is not seen.
        far_plane: what is farther is not seen.
        eps2d: screen-space blur, pixels squared.
        antialiased: compensate that blur in the opacities.
        background: RGB behind everything.
        tile_size: pixels.
        deterministic: gradients repeat bit for bit on CUDA too (they always do on the CPU).
    """

    sh_degree: int
    near_plane: float
    far_plane: float
    eps2d: float = 0.3
    antialiased: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tile_size: int = 16
    deterministic: bool = False


class Active(NamedTuple):
    """The Gaussians worth projecting: ascending rows int32 [A], their views as bits int32 [A]; None: all."""

    ids: Tensor | None = None
    views: Tensor | None = None


class Frame(NamedTuple):
    """What `forward` rendered and what `backward` needs of it.

    Attributes:
        views: the views.
        options: the options.
        rows: the projected Gaussians, P rows.
        backgrounds: [B, 3]; None: black.
        isect_rows: int32 [I], rows by tile, front to back.
        tile_offsets: int64 [B * T + 1].
        renders: [B, H, W, 3].
        transmittances: [B, H, W], share of the background that shows.
        last_ids: int32 [B, H, W], for the backward pass.
        tile_work: int32 [B * T], list entries each tile went through.
        aux: the backend's own.
    """

    views: Views
    options: RenderOptions
    rows: Rows
    backgrounds: Tensor | None
    isect_rows: Tensor
    tile_offsets: Tensor
    renders: Tensor
    transmittances: Tensor
    last_ids: Tensor
    tile_work: Tensor
    aux: Tensor


class Gradients(NamedTuple):
    """Gradients of the U visible Gaussians, and those of the P rows' 2D means.

    Attributes:
        parameters: of means [U, 3], quats [U, 4], scales [U, 3], opacities [U], sh [U, K, 3].
        means2d: [P, 2], per pixel.
    """

    parameters: tuple[Tensor, ...]
    means2d: Tensor


def forward(
    table: GaussianTable, views: Views, options: RenderOptions, active: Active | None = None
) -> Frame:
    """Render views of a table whose active rows are up to date.

    Args:
        table: the Gaussians.
        views: at most `MAX_VIEWS` views.
        options: how to render.
        active: rows and views to consider; None: all.

    Returns:
        The frame; its images do not depend on the order of the table's rows, nor on inactive rows.
    """
    active = active or Active()
    count = len(views)
    rows = Rows(
        *torch.ops.blitzgs.project_fwd(
            *table.parameters, views.viewmats, views.Ks, active.ids, active.views, views.width, views.height,
            options.tile_size, options.sh_degree, options.near_plane, options.far_plane, options.eps2d, 0.0,
            options.antialiased, True,
        )
    )  # fmt: skip
    ids = table["id"][rows.gaussian_ids]
    isect_rows, tile_offsets = torch.ops.blitzgs.intersect(
        rows.means2d, rows.conics, rows.opacities, rows.depths, rows.camera_ids, ids, count, views.width,
        views.height, options.tile_size, 0, -1, int(rows.counts[2]),
    )  # fmt: skip
    backgrounds = None
    if any(options.background):
        backgrounds = torch.tensor(options.background, device=table.device).repeat(count, 1)
    composited = torch.ops.blitzgs.rasterize_fwd(
        rows.means2d, rows.conics, rows.opacities, rows.colors, backgrounds, isect_rows, tile_offsets, count,
        views.width, views.height, options.tile_size, 0, -1,
    )  # fmt: skip
    return Frame(views, options, rows, backgrounds, isect_rows, tile_offsets, *composited)


def backward(
    table: GaussianTable, frame: Frame, v_renders: Tensor, scale_reg: Tensor | None = None
) -> Gradients:
    """Carry image gradients back to the parameters.

    Args:
        table: the table that was rendered, unchanged since.
        frame: from `forward`.
        v_renders: gradient of the loss by the images, [B, H, W, 3].
        scale_reg: weight per view, [B], of the smallest axis of each Gaussian visible in it; None: no such
            term.
    """
    views, options, rows = frame.views, frame.options, frame.rows
    v_means2d, v_conics, v_opacities, v_colors, _ = torch.ops.blitzgs.rasterize_bwd(
        rows.means2d, rows.conics, rows.opacities, rows.colors, frame.backgrounds, frame.isect_rows,
        frame.tile_offsets, frame.renders, frame.transmittances, frame.last_ids, frame.aux, v_renders, None,
        len(views), views.width, views.height, options.tile_size, 0, -1, False, options.deterministic,
    )  # fmt: skip
    *parameters, _ = torch.ops.blitzgs.project_bwd(
        *table.parameters, views.viewmats, views.Ks, rows.camera_ids, rows.visible_ids, rows.row_offsets,
        views.width, views.height, options.sh_degree, options.eps2d, options.antialiased, True, v_means2d,
        v_conics, None, v_opacities, v_colors, scale_reg, False,
    )  # fmt: skip
    return Gradients(tuple(parameters), v_means2d)
