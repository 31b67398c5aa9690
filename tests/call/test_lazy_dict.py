# SPDX-License-Identifier: Apache-2.0
"""Lazy dicts read like dicts and compute their values or contents once, when they are read."""

import copy
import json
import pickle

import pytest
from torch.utils._pytree import tree_map

from blitzgs.call.meta import LATER, LateMapping, LazyDict

PLAIN = {"image": 1, "ids": [2, 3], "mask": None}
READERS = {
    "dict": dict,
    "unpacked": lambda d: {**d},
    "keyword arguments": lambda d: dict(**d),
    "update": lambda d: updated({}, d),
    "union": lambda d: d | {},
    "union of another": lambda d: {} | d,
    "copy": lambda d: d.copy(),
    "shallow copy": copy.copy,
    "deep copy": copy.deepcopy,
    "pickle": lambda d: pickle.loads(pickle.dumps(d)),
    "json": lambda d: json.loads(json.dumps(d)),
    "repr": lambda d: eval(repr(d)),
    "items": lambda d: dict(d.items()),
    "values": lambda d: dict(zip(d, d.values(), strict=True)),
    "get": lambda d: {key: d.get(key) for key in d},
    "setdefault": lambda d: {key: d.setdefault(key, 0) for key in d},
    "pop": lambda d: {key: d.pop(key) for key in list(d)},
    "popitem": lambda d: dict(reversed([d.popitem() for _ in range(len(d))])),
}


def updated(target, source):
    target.update(source)
    return target


def lazy():
    """A `LazyDict` that reads as PLAIN, and the keys it has computed so far."""
    computed = []

    def compute(key):
        computed.append(key)
        return PLAIN[key]

    return LazyDict({"image": 1, "ids": LATER, "mask": LATER}, compute), computed


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
def test_every_reader_finds_values(reader):
    result = reader(lazy()[0])
    assert type(result) is dict
    assert list(result.items()) == list(PLAIN.items())


def test_a_value_is_computed_once_and_only_when_read():
    values, computed = lazy()
    assert list(values) == list(values.keys()) == list(PLAIN)
    assert len(values) == 3 and "ids" in values and isinstance(values, dict)
    assert values["image"] == 1 and values.get("depths", 7) == 7
    assert computed == []
    assert values["ids"] is values["ids"] is values.get("ids")
    assert computed == ["ids"]


def test_equality_compares_values():
    empty, plain = {}, dict(PLAIN)
    assert lazy()[0] == plain and plain == lazy()[0] and lazy()[0] == lazy()[0]
    assert lazy()[0] != empty and empty != lazy()[0]
    with pytest.raises(TypeError, match="unhashable"):
        hash(lazy()[0])


def test_values_may_be_replaced_and_deleted():
    values, computed = lazy()
    values["ids"] = 4
    del values["mask"]
    values |= {"depths": 5}
    assert values == {"image": 1, "ids": 4, "depths": 5} and computed == []
    assert values.pop("mask", None) is None and values.setdefault("mask", 6) == 6
    with pytest.raises(KeyError):
        values["radii"]


LATE_READERS = (
    "dict",
    "unpacked",
    "keyword arguments",
    "update",
    "shallow copy",
    "deep copy",
    "pickle",
    "repr",
)


@pytest.mark.parametrize("reader", [READERS[name] for name in (*LATE_READERS, "items", "values")])
def test_a_mapping_is_computed_once_and_only_when_it_is_looked_into(reader):
    computed, plain = [], dict(PLAIN)
    late = LateMapping(lambda: computed.append(0) or PLAIN)
    whole = LazyDict({"found": late}, PLAIN.get)
    assert list(whole.values())[0] is late and computed == []
    result = reader(late)
    assert type(result) is dict and list(result.items()) == list(PLAIN.items())
    assert len(late) == 3 and "ids" in late and late == PLAIN and plain == late and late != {}
    assert tree_map(lambda value: value, whole) == {"found": PLAIN}
    assert computed == [0]
