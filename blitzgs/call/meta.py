# SPDX-License-Identifier: Apache-2.0
"""Makes the `meta` of `blitzgs.rasterization`, with gsplat's keys."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from blitzgs._torch import register_mapping
from blitzgs.call.arguments import Gaussians
from blitzgs.call.bad_values import non_finite
from blitzgs.call.layout import Layout, Lists
from blitzgs.ops.projection_types import ProjectedSplats

# In place of a value that is computed when it is first read.
LATER = object()
# The keys of `meta`, in this order.
_KEYS = (
    "batch_ids", "camera_ids", "gaussian_ids", "radii", "means2d", "conics", "opacities", "depths",
    "tile_width", "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets",
    "width", "height", "tile_size", "n_batches", "n_cameras",
)  # fmt: skip
_NOTHING_KNOWN = dict.fromkeys((*_KEYS, "non_finite"), LATER)


class LazyDict(dict[str, Any]):
    """A dict with values that are computed when they are first read.

    The modules `copy` and `pickle` make OrderedDicts of it, which `torch.load` reads by default.
    """

    def __init__(self, given: Mapping[str, Any], compute: Callable[[str], Any]) -> None:
        """Begin with values by key; `LATER` for one that `compute` returns, given the key."""
        super().__init__(given)
        self._compute = compute

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        if value is LATER:
            value = self[key] = self._compute(key)
        return value

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys; defined so that `dict(self)` and `**self` read values by `__getitem__`."""
        return super().__iter__()

    # These read values by `__getitem__`; dict's own methods do not.
    get = Mapping.get  # type: ignore[assignment]
    setdefault = MutableMapping.setdefault
    values = Mapping.values  # type: ignore[assignment]
    items = Mapping.items  # type: ignore[assignment]
    __eq__ = Mapping.__eq__
    __ne__ = object.__ne__  # the inverse of `__eq__`

    def pop(self, key: str, *default: Any) -> Any:
        """Remove a key and return its value, or `default`."""
        self.get(key)
        return super().pop(key, *default)

    def popitem(self) -> tuple[str, Any]:
        """Remove the last key and return it and its value."""
        self.get(next(reversed(self), ""))
        return super().popitem()

    def copy(self) -> dict[str, Any]:
        """Return a plain dict of the same values."""
        return dict(self)

    def __or__(self, other: Any) -> Any:
        return dict(self) | other

    def __ror__(self, other: Any) -> Any:
        return other | dict(self)

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return OrderedDict, (), None, None, iter(self.items())


class LateMapping(Mapping[str, Any]):
    """A mapping whose keys and values are computed when it is first looked into; copied as `LazyDict` is."""

    def __init__(self, compute: Callable[[], Mapping[str, Any]]) -> None:
        self._compute = compute

    @cached_property
    def _contents(self) -> Mapping[str, Any]:
        return self._compute()

    def __getitem__(self, key: str) -> Any:
        return self._contents[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._contents)

    def __len__(self) -> int:
        return len(self._contents)

    def __repr__(self) -> str:
        return repr(dict(self))

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return OrderedDict, (), None, None, iter(self.items())


# Register the classes, so that tree_map visits their values: unregistered, they would be leaves.
for _class in (LazyDict, LateMapping):
    register_mapping(_class, dict)


def make_meta(
    gaussians: Gaussians,
    layout: Layout,
    others: Mapping[str, Tensor],  # further images by key
    lists: Lists,
    lead: tuple[int, ...],  # batch dimensions, and the number of views that are rendered here
    arrived: ProjectedSplats | None,  # the splats of `lists`, if ranks exchanged some
) -> dict[str, Any]:
    """Return `meta`; entries that the image did not need are computed when they are first read.

    Under `torch.compile` it is a plain dict, and the compiler removes entries that the caller does not read.
    """
    entries = _Entries(gaussians, layout, lists, lead, arrived)
    known = {
        "tile_size": lists.grid.tile_size, "width": lists.grid.width, "height": lists.grid.height,
        "n_batches": len(gaussians.scenes), "n_cameras": lead[-1], **layout.rendered, **others,
    }  # fmt: skip
    if torch.compiler.is_compiling():
        return {**{key: known[key] if key in known else entries.of(key) for key in _KEYS}, **known}
    return LazyDict({**_NOTHING_KNOWN, **known}, entries.of)


class _Entries(NamedTuple):
    """Computes entries of `meta`, each by the method of its name, from arguments of `make_meta`."""

    gaussians: Gaussians
    layout: Layout
    lists: Lists
    lead: tuple[int, ...]
    arrived: ProjectedSplats | None

    def of(self, key: str) -> Any:
        return getattr(self, key)()

    def batch_ids(self) -> Tensor | None:
        return self._of_packed(self.layout.splats.camera_ids.long() // self.gaussians.views)

    def camera_ids(self) -> Tensor | None:
        return self._of_packed(self.layout.splats.camera_ids.long() % self.gaussians.views)

    def gaussian_ids(self) -> Tensor | None:
        return self._of_packed(self.layout.splats.gaussian_ids.long())

    def _of_packed(self, column: Tensor) -> Tensor | None:
        return self.layout.arrange(column)[0] if self.layout.packed else None

    def radii(self) -> Tensor:
        return self.layout.arrange(self.layout.splats.radii)[0]

    def tiles_per_gauss(self) -> Tensor:
        return self.layout.arrange(self.layout.splats.tiles_touched)[0]

    def tile_width(self) -> int:
        return self.lists.grid.tiles[0]

    def tile_height(self) -> int:
        return self.lists.grid.tiles[1]

    def isect_ids(self) -> Tensor:
        """Return gsplat's sort keys, int64: image | tile | float32 depth bits, from high to low."""
        splats, grid = self.layout.splats if self.arrived is None else self.arrived, self.lists.grid
        depths = splats.depths.detach().index_select(0, self.lists.listed())
        entries = torch.arange(len(depths), device=depths.device)
        keys = torch.searchsorted(self.lists.offsets[1:], entries, right=True)
        if grid.n_cameras > 1:
            # The bits of n_tiles. Its `bit_length()` would compile a graph for every number of tiles.
            n_tiles = math.prod(grid.tiles)
            tiles = torch.full((), n_tiles, dtype=torch.float64, device=depths.device)
            keys = (keys // n_tiles << torch.frexp(tiles).exponent) | keys % n_tiles
        return keys.bitwise_left_shift(32).bitwise_or(depths.float().view(torch.int32))

    def flatten_ids(self) -> Tensor:
        listed, places = self.lists.listed(), self.layout.places
        if places is None or self.arrived is not None:
            return listed
        return places.flat().index_select(0, listed).int()

    def isect_offsets(self) -> Tensor:
        return self.lists.offsets[:-1].reshape(*self.lead, *self.lists.grid.tiles[::-1])

    def non_finite(self) -> LateMapping:
        return LateMapping(lambda: non_finite(self.gaussians))
