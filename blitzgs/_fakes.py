# SPDX-License-Identifier: Apache-2.0
"""What the ops of a compiled call return, as shapes and dtypes: fake kernels, with which torch traces them.

A fake takes the op's arguments by the names that csrc/registration.cpp gives them. Ops that change tensors
have one as well; others that no public function reaches under `torch.compile` have none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import arguments_of

Arguments = Any  # a namespace of an op's arguments


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


_FAKES: dict[str, Callable[[Arguments], Any]] = {
    "intersect": _intersect,
    "knn_distances": lambda a: a.points.new_empty(a.points.shape[0], a.k),
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
}
