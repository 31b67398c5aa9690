# SPDX-License-Identifier: Apache-2.0
"""What each op returns, as shapes and dtypes: the fake kernels with which torch traces calls of ops.

A fake takes the op's arguments by the names that csrc/registration.cpp gives them. `tile_costs` and
`divide_tiles` have none: they compute with numbers that the host has read, so torch never traces them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import arguments_of

Arguments = Any  # a namespace of an op's arguments
_BLOCK_ROWS, _WORD_BITS = 256, 32


def register() -> None:
    """Register all fake kernels; the library must be loaded."""
    for name, fake in (_FAKES | dict.fromkeys(_IN_PLACE, lambda _: None)).items():
        torch.library.register_fake(f"blitzgs::{name}", _by_names(name, fake))
    layout = torch.ops.blitzgs.splat_gradient_layout()
    torch.library.register_fake("blitzgs::splat_gradient_layout", lambda: list(layout))


def _by_names(name: str, fake: Callable[[Arguments], Any]) -> Callable[..., Any]:
    """Return a fake kernel as torch takes it."""
    defaults = arguments_of(getattr(torch.ops.blitzgs, name).default)

    def call(*args: Any, **kwargs: Any) -> Any:
        return fake(SimpleNamespace(**defaults | dict(zip(defaults, args, strict=False)) | kwargs))

    return call


# Ops that return nothing.
_IN_PLACE = (
    "copy_to_host_", "density_stats_", "gate_views_", "lazy_adam_catch_up_", "lazy_adam_step_",
    "limit_scales_", "mass_cut_", "position_noise_", "project_bwd_step_", "put_rows_", "share_rows_",
    "swap_blocks_", "take_rows_", "update_block_bounds_", "view_sums_",
)  # fmt: skip


def _unknown() -> Any:
    """Return a size that depends on values."""
    return torch.library.get_ctx().new_dynamic_size()


def _ints(like: Tensor, *shape: Any) -> Tensor:
    return like.new_empty(shape, dtype=torch.int32)


def _longs(like: Tensor, *shape: Any) -> Tensor:
    return like.new_empty(shape, dtype=torch.int64)


def _contiguous(like: Tensor) -> Tensor:
    return torch.empty_like(like, memory_format=torch.contiguous_format)


def _columns(like: Tensor, rows: Any, shapes: Iterable[Sequence[int]]) -> list[Tensor]:
    return [like.new_empty(rows, *shape) for shape in shapes]


def _cull_blocks(a: Arguments) -> tuple[Tensor, ...]:
    blocks = _unknown() if a.capacity_blocks is None else min(a.capacity_blocks, len(a.bounds))
    return tuple(_ints(a.bounds, n) for n in (blocks * _BLOCK_ROWS, blocks * _BLOCK_ROWS, 1, 1))


def _project_fwd(a: Arguments) -> tuple[Tensor, ...]:
    means, U, P = a.gaussians[0], _unknown(), _unknown()
    return (
        *(_ints(means, n) for n in (P, P, U, U + 1)),
        *_columns(means, P, ((2,), (3,), (), ())),
        means.new_empty(P if len(a.gaussians) > 4 else 0, 3),
        _ints(means, P, 2),
        _ints(means, P),
        _longs(means, P if a.rank_tiles else 0),
        _longs(means, 0 if a.ids is None else P),
        _longs(means, 4 + a.viewmats.shape[0] + len(a.rank_tiles)),
    )


def _project_bwd(a: Arguments) -> tuple[Tensor, ...]:
    means, coefficients = a.gaussians[0], a.gaussians[4].shape[1] if len(a.gaussians) > 4 else 0
    rows = (means if a.dense else a.visible_ids).shape[0]
    v_viewmats = means.new_empty(a.viewmats.shape[0] if a.need_viewmats else 0, 4, 4)
    return (*_columns(means, rows, ((3,), (4,), (3,), (), (coefficients, 3))), v_viewmats)


def _unscented_fwd(a: Arguments) -> tuple[Tensor, ...]:
    means, P = a.gaussians[0], len(a.gaussian_ids)
    colors = means.new_empty(P if len(a.gaussians) > 4 else 0, 3)
    return (*_columns(means, P, ((2,), (3,), (), ())), colors, _ints(means, P, 2), _ints(means, P))


def _unscented_bwd(a: Arguments) -> tuple[Tensor, ...]:
    means, coefficients = a.gaussians[0], a.gaussians[4].shape[1] if len(a.gaussians) > 4 else 0
    return tuple(_columns(means, len(means), ((3,), (4,), (3,), (), (coefficients, 3))))


def _intersect(a: Arguments) -> tuple[Tensor, Tensor]:
    tiles = a.n_cameras * -(-a.width // a.tile_size) * -(-a.height // a.tile_size)
    return _ints(a.means2d, a.n_isects if a.n_isects >= 0 else _unknown()), _longs(a.means2d, tiles + 1)


def _rasterize_fwd(a: Arguments) -> tuple[Tensor, ...]:
    image = (a.n_cameras, a.height, a.width)
    return (
        a.means2d.new_empty(*image, a.colors.shape[1]),
        a.means2d.new_empty(image),
        _ints(a.means2d, *image),
        _ints(a.means2d, a.tile_offsets.shape[0] - 1),
        # The layout of packed splats, and the order of the tiles, differ between backends.
        a.means2d.new_empty(a.means2d.shape[0], _unknown(), dtype=torch.uint8),
        _ints(a.means2d, _unknown(), 16),
        a.means2d.new_empty(_unknown() if a.backward_follows else 0, 12),
    )


def _rasterize_bwd(a: Arguments) -> tuple[Tensor, ...]:
    means2d, _, _, colors = a.splats
    n = means2d.shape[0] if a.gradients is None else 0
    v_means2d_abs = means2d.new_empty(n if a.absgrad else 0, 2)
    return (*_columns(means2d, n, ((2,), (3,), (), (colors.shape[1],))), v_means2d_abs)


def _render(a: Arguments) -> list[Tensor]:
    splats, count, visible = (a.means2d, a.conics, a.splat_opacities), len(a.camera_ids), len(a.visible_ids)
    rows = []
    if a.gaussians:
        found = [table.new_empty(visible, *table.shape[1:]) for table in a.gaussians]
        if a.sh:
            found.append(a.sh[0].new_empty(visible, sum(part.shape[1] for part in a.sh), 3))
        colors = a.means2d.new_empty(count if a.sh else 0, 3)
        rows = [colors, torch.empty_like(a.visible_ids), _longs(a.visible_ids, visible), *found]
    channels = a.means2d.new_empty(count, 3 + a.with_depth) if a.channels is None else a.channels
    grid, ops = (a.viewmats.shape[0], a.width, a.height, a.tile_size, 0, -1), torch.ops.blitzgs
    lists = ops.intersect(*splats, a.depths, a.camera_ids, None, *grid, a.n_isects, None, True)
    outputs = ops.rasterize_fwd(*splats, channels, None, *lists, *grid, True, a.backward_follows)
    return [*lists, *outputs, torch.empty_like(outputs[1]), *rows]


def _contributions(a: Arguments) -> tuple[Tensor, ...]:
    n = a.means2d.shape[0]
    return _longs(a.means2d, n), _ints(a.means2d, n), _longs(a.means2d, n if a.squares else 0)


def _pixel_splats(a: Arguments) -> tuple[Tensor, ...]:
    like, n = a.means2d, a.n_rows
    numbers = (like.new_empty(n), _ints(like, n), _ints(like, n))
    return (*numbers, _ints(like, n, a.strongest), like.new_empty(n, a.strongest))


def _photometric_fwd_bwd(a: Arguments) -> tuple[Tensor, ...]:
    views = a.renders.shape[0]
    weights = (a.renders.new_empty(0 if a.visible is None else views) for _ in range(2))
    return (
        a.renders.new_empty(views, _unknown(), 2, dtype=torch.float64), _contiguous(a.renders), *weights
    )  # fmt: skip


def _scatter_splats(a: Arguments) -> tuple[Tensor, Tensor]:
    words = sum(column.shape[1] for column in a.columns) * sum(a.group_sizes)
    return _ints(a.masks, words), _longs(a.masks, -(-a.masks.shape[0] // 32), len(a.group_sizes))


_FAKES: dict[str, Callable[[Arguments], Any]] = {
    "arrange_splats": lambda a: [t.new_empty(*a.shape, *t.shape[1:]) for t in a.columns],
    "bracket_keys": lambda a: _longs(a.gone, len(a.gone) + len(a.blocks)),
    "contributions": _contributions,
    "cull_blocks": _cull_blocks,
    "draw_weights": lambda a: _longs(a.opacities, len(a.opacities)),
    "find_non_finite": lambda a: _ints(a.columns[0]),
    "first_rows": lambda a: [t.new_empty(n, *t.shape[1:]) for t, n in zip(a.columns, a.lengths, strict=True)],
    "gather_splats": lambda a: [_ints(a.packed, sum(a.group_sizes), width) for width in a.widths],
    "hash_key": lambda a: torch.empty_like(a.hashes),
    "intersect": _intersect,
    "key_histogram": lambda a: _longs(a.keys, 1 << a.width),
    "keys_up_to": lambda a: torch.empty_like(a.keys, dtype=torch.bool),
    "knn_distances": lambda a: a.points.new_empty(a.points.shape[0], a.k),
    "l1_ssim_fwd_bwd": lambda a: (a.renders.new_empty(()), _contiguous(a.renders)),
    # Six rules of four numbers, two steps and a number, to a multiple of four numbers.
    "lazy_adam_final_rules": lambda a: a.table.new_empty(
        max(0, len(a.table) - a.explicit_steps), 28 * a.like.dtype.itemsize, dtype=torch.uint8
    ),
    "morton_keys": lambda a: _longs(a.points, a.points.shape[0]),
    "overlap": lambda a: torch.empty_like(a.opacities),
    "photometric_bwd": lambda a: _contiguous(a.renders),
    "photometric_fwd": lambda a: tuple(a.renders.new_empty(a.renders.shape[0]) for _ in range(2)),
    "photometric_fwd_bwd": _photometric_fwd_bwd,
    "pixel_splats": _pixel_splats,
    "project_bwd": _project_bwd,
    "project_fwd": _project_fwd,
    "rasterize_bwd": _rasterize_bwd,
    "rasterize_fwd": _rasterize_fwd,
    "render": _render,
    "residual_draws": lambda a: (
        torch.empty_like(a.weights),
        torch.empty_like(a.weights, dtype=torch.float32),
    ),
    "rows_of_sectors": lambda a: a.sectors.new_empty(a.n, a.sectors.shape[1] // _WORD_BITS),
    "sampling_keys": lambda a: torch.empty_like(a.weights),
    "scatter_splats": _scatter_splats,
    "sectors_of_rows": lambda a: a.rows.new_empty(
        -(-a.rows.shape[0] // _BLOCK_ROWS), _WORD_BITS * a.rows.shape[1], _BLOCK_ROWS // _WORD_BITS
    ),
    "seen_blocks": lambda a: _ints(a.bounds, len(a.bounds)),
    "spawn_features": lambda a: a.columns[0].new_empty(a.rows.shape[0], 10),
    "splats_of_arranged": lambda a: [
        t.new_empty(len(a.places[0]), *t.shape[len(a.shape) :]) for t in a.arranged
    ],
    "sum_splats": lambda a: [a.values[0].new_empty(a.splats, width) for width in a.widths],
    "unscented_bwd": _unscented_bwd,
    "unscented_fwd": _unscented_fwd,
    "unscented_visible": lambda a: a.viewmats.new_empty(
        len(a.gaussians[0]), len(a.viewmats), dtype=torch.bool
    ),
    "tree_sums": lambda a: _longs(a.features, a.features.shape[0]),
}
