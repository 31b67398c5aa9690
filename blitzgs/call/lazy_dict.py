# SPDX-License-Identifier: Apache-2.0
"""Dicts that compute their values, or all of their contents, only when they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from torch.utils import _pytree as pytree


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
    pytree.register_pytree_node(
        _class,
        lambda values: (list(values.values()), list(values)),
        lambda values, keys: dict(zip(keys, values, strict=True)),
    )
