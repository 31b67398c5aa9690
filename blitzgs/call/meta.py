# SPDX-License-Identifier: Apache-2.0
"""Makes the `meta` of `blitzgs.rasterization`, with gsplat's keys."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from blitzgs._torch import register_mapping
from blitzgs.call.arguments import Gaussians
from blitzgs.call.finite import non_finite
from blitzgs.call.layout import Layout
from blitzgs.call.lists import Lists
from blitzgs.ops.projection_types import ProjectedSplats


class Later:
    """A value that `LazyDict` computes when it is first read."""

    __slots__ = ("compute",)

    def __init__(self, compute: Callable[[], Any]) -> None:
        self.compute = compute


class LazyDict(dict[str, Any]):
    """A dict whose `Later` values are replaced by what they compute when they are first read.

    In every other way it is a dict: readers never see a `Later`, copies and pickles are plain dicts, and any
    value may be replaced or deleted.
    """

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if isinstance(value, Later):
            value = self[key] = value.compute()
        return value

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys; defined so that `dict(self)` and `**self` read values by `__getitem__`."""
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of a key, or `default`."""
        return self[key] if key in self else default  # noqa: SIM401

    def setdefault(self, key: str, default: Any = None) -> Any:
        """Return the value of a key, which is `default` from now on where there was none."""
        return self[key] if key in self else super().setdefault(key, default)

    def pop(self, key: str, *default: Any) -> Any:
        """Remove a key and return its value, or `default`."""
        self.get(key)
        return super().pop(key, *default)

    def popitem(self) -> tuple[str, Any]:
        """Remove the last key and return it and its value."""
        return self._settled().popitem()

    def values(self) -> Any:
        """Return a view of the values."""
        return self._settled().values()

    def items(self) -> Any:
        """Return a view of the keys and values."""
        return self._settled().items()

    def copy(self) -> dict[str, Any]:
        """Return a plain dict of the same values."""
        return dict(self)

    def __eq__(self, other: object) -> bool:
        return dict(self) == other

    def __ne__(self, other: object) -> bool:
        return dict(self) != other

    def __or__(self, other: Any) -> Any:
        return dict(self) | other

    def __ror__(self, other: Any) -> Any:
        return other | dict(self)

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)

    def _settled(self) -> Any:
        """Compute all remaining values; return the same dict, which then is a plain one for readers."""
        for key in self:
            self[key]
        return super()


class LateMapping(Mapping[str, Any]):
    """A mapping whose keys and values are computed when it is first looked into; copies are plain dicts."""

    def __init__(self, compute: Callable[[], Mapping[str, Any]]) -> None:
        self._compute = compute
        self._contents: Mapping[str, Any] | None = None

    def _whole(self) -> Mapping[str, Any]:
        if self._contents is None:
            self._contents = self._compute()
        return self._contents

    def __getitem__(self, key: str) -> Any:
        return self._whole()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole())

    def __len__(self) -> int:
        return len(self._whole())

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


# Register the classes, so that tree_map visits their values: unregistered, they would be leaves.
for _class in (LazyDict, LateMapping):
    register_mapping(_class, dict)


def make_meta(
    gaussians: Gaussians,
    layout: Layout,
    arranged: dict[str, Tensor],
    lists: Lists,
    lead: tuple[int, ...],
    arrived: ProjectedSplats | None,
) -> dict[str, Any]:
    """Return `meta`; entries that the image did not need are computed when they are first read.

    Under `torch.compile` it is a plain dict, and the compiler removes entries that the caller does not read.

    Args:
        gaussians: the checked arguments of the call.
        layout: arrangement of the splats.
        arranged: the rendered columns in this arrangement.
        lists: the tile lists.
        lead: batch dimensions, and the number of views that are rendered here.
        arrived: the splats that `lists` refers to, if ranks have exchanged splats; None: those of `layout`.
    """
    splats, packed = layout.splats, layout.packed
    views = gaussians.views

    def flatten_ids() -> Tensor:
        if layout.places is None or arrived is not None:
            return lists.listed()
        return layout.places.flat().index_select(0, lists.listed()).int()

    def batch_ids() -> Tensor:
        if len(gaussians.scenes) == 1:
            return torch.zeros_like(splats.camera_ids, dtype=torch.int64)
        return layout.arrange(layout.images // views)[0]

    def camera_ids() -> Tensor:
        ids = splats.camera_ids.long()
        return layout.arrange(ids if len(gaussians.scenes) == 1 else ids % views)[0]

    entries: dict[str, Any] = {
        "batch_ids": Later(batch_ids) if packed else None,
        "camera_ids": Later(camera_ids) if packed else None,
        "gaussian_ids": Later(lambda: layout.arrange(layout.gaussians)[0]) if packed else None,
        "radii": Later(lambda: layout.arrange(splats.radii)[0]),
        **arranged,
        "tile_width": lists.tiles_x,
        "tile_height": lists.tiles_y,
        "tiles_per_gauss": Later(lambda: layout.arrange(splats.tiles_touched)[0]),
        "isect_ids": Later(lambda: _isect_ids((arrived or splats).depths, lists, math.prod(lead))),
        "flatten_ids": Later(flatten_ids),
        "isect_offsets": Later(lambda: lists.offsets[:-1].reshape(*lead, lists.tiles_y, lists.tiles_x)),
        "width": lists.width,
        "height": lists.height,
        "tile_size": lists.tile_size,
        "n_batches": len(gaussians.scenes),
        "n_cameras": lead[-1],
    }
    if torch.compiler.is_compiling():
        return {key: value.compute() if isinstance(value, Later) else value for key, value in entries.items()}
    entries["non_finite"] = LateMapping(lambda: non_finite(gaussians))
    return LazyDict(entries)


def _isect_ids(depths: Tensor, lists: Lists, images: int) -> Tensor:
    """Return gsplat's sort keys, int64: image | tile | float32 depth bits, from high to low."""
    depths = depths.detach().index_select(0, lists.listed())
    entries = torch.arange(len(depths), device=depths.device)
    keys = torch.searchsorted(lists.offsets[1:], entries, right=True)
    n_tiles = lists.tiles_x * lists.tiles_y
    if images > 1:
        keys = keys + keys // n_tiles * ((1 << n_tiles.bit_length()) - n_tiles)
    return keys.bitwise_left_shift(32).bitwise_or(depths.float().view(torch.int32))
