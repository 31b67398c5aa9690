# SPDX-License-Identifier: Apache-2.0
"""`rasterization(distributed=True)`: each rank has some of the Gaussians and some of the views.

As in gsplat (and Grendel-GS, Zhao et al. 2024), every rank projects its Gaussians into the views of all ranks
and sends each splat to the rank that renders its view; gradients are sent back. The collectives use the
process group that the program has started. (The trainer of BlitzGS divides images by tiles instead, with the
transports of `blitzgs.distributed`.)
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from blitzgs.call.arguments import Gaussians
from blitzgs.distributed.group import Ranks
from blitzgs.ops.derivatives import linear_map
from blitzgs.ops.projection_types import ProjectedSplats


def gather_views(gaussians: Gaussians, absgrad: bool, same: Sequence[Any]) -> tuple[Gaussians, Ranks | None]:
    """Return this rank's Gaussians with the views of all ranks, M C, in the order of ranks. Collective.

    `gaussians`: one scene with own views. `same`: values that must be equal on all ranks. Also returns the
    ranks; None if there is one. ValueError: there is what ranks do not exchange; or, on every rank: they
    differ in `same`, in the number of views, or in what needs gradients, and would wait for others forever.
    """
    per_view = gaussians.per_view or (gaussians.signals is not None and gaussians.signals.per_view)
    if len(gaussians.lead) > 1 or per_view or absgrad:
        raise ValueError(
            "distributed=True supports no batch dimensions, colours or extra signals per view, or absgrad, "
            "as gsplat's does not"
        )
    if not dist.is_initialized() or dist.get_world_size() == 1:
        return gaussians, None
    ranks = Ranks(dist.get_rank(), dist.get_world_size())
    scene, recorded = gaussians.scenes[0], torch.is_grad_enabled()
    extra = None if gaussians.signals is None else gaussians.signals.values
    learned = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, extra)
    need_poses = recorded and scene.viewmats.requires_grad
    need = need_poses or (recorded and any(t is not None and t.requires_grad for t in learned))
    channels = [None if t is None else t.shape[-1] for t in (scene.colors, extra)]
    own = (gaussians.views, *same, *channels, need, need_poses)
    _require_same(own, ranks, scene.viewmats.device)
    viewmats = _all_poses(scene.viewmats, ranks)
    Ks = torch.cat(ranks.all_gather(scene.Ks.detach().contiguous()))
    scene = scene._replace(viewmats=viewmats, Ks=Ks)
    return gaussians._replace(scenes=(scene,), lead=(len(viewmats),)), ranks


def _require_same(given: tuple[Any, ...], ranks: Ranks, device: torch.device) -> None:
    """Compare a hash of the values over the ranks; exchange all values only if the hashes differ."""
    own = torch.tensor([zlib.crc32(repr(given).encode())], device=device)
    if len(set(torch.cat(ranks.all_gather(own)).tolist())) == 1:
        return
    everyone = ranks.all_gather_object(given)
    raise ValueError(
        "distributed=True: all ranks have to give the same number of views, width, height, tile size, render "
        f"mode, channels, and need of gradients of Gaussians and of poses; they gave {everyone}"
    )


def send_splats(
    splats: ProjectedSplats, channels: Tensor, ranks: Ranks, views: int
) -> tuple[ProjectedSplats, Tensor]:
    """Send each splat to the rank that renders its view. Collective, as is its backward pass.

    `splats`: of this rank's Gaussians in all ranks' views, of which each has `views`, with their channels [P,
    D]. Returns those of this rank's views, ordered by (rank, Gaussian, view), with only the columns that tile
    lists and images need.
    """
    images = splats.camera_ids.long()
    destinations = images // views
    order = torch.argsort(destinations, stable=True)
    sent = torch.bincount(destinations, minlength=ranks.world_size)
    sizes = sent.tolist(), ranks.exchange_counts(sent).tolist()
    widths = (2, 3, 1, 1, channels.shape[1])
    columns = (splats.means2d, splats.conics, splats.opacities[:, None], splats.depths[:, None], channels)
    table = torch.cat(columns, dim=1).index_select(0, order)
    arrived = _sent(table, *sizes, ranks)
    means2d, conics, opacities, depths, own_channels = (
        column.contiguous() for column in arrived.split(widths, dim=1)
    )
    own_views = ranks.all_to_all((images % views).index_select(0, order), *sizes).int()
    own = {"means2d": means2d, "conics": conics, "opacities": opacities[:, 0], "depths": depths[:, 0]}
    return splats._replace(camera_ids=own_views, **own), own_channels


def _sent(table: Tensor, sent: list[int], received: list[int], ranks: Ranks) -> Tensor:
    """Send rows to other ranks; the backward pass sends their gradients back."""

    def returned(_needed: Any, v: Sequence[Tensor | None]) -> list[Tensor]:
        # Every rank sends, also one whose rows have no gradient.
        rows = table.new_zeros(sum(received), table.shape[1]) if v[0] is None else v[0]
        return [ranks.all_to_all(rows, received, sent)]

    (arrived,) = linear_map(lambda rows: (ranks.all_to_all(rows, sent, received),), returned, [table])
    return arrived


def _all_poses(viewmats: Tensor, ranks: Ranks) -> Tensor:
    """Gather the poses of all ranks; the gradient of a pose is the sum over all ranks."""

    def summed(_needed: Any, v: Sequence[Tensor | None]) -> list[Tensor]:
        total = v[0].contiguous().clone() if v[0] is not None else viewmats.new_zeros(shape)
        return [ranks.all_reduce(total)[ranks.rank * len(viewmats) :][: len(viewmats)]]

    def gather(poses: Tensor) -> tuple[Tensor, ...]:
        return (torch.cat(ranks.all_gather(poses.contiguous())),)

    shape = (ranks.world_size * len(viewmats), 4, 4)
    (gathered,) = linear_map(gather, summed, [viewmats])
    return gathered
