# SPDX-License-Identifier: Apache-2.0
"""A run opens its capture with the memory for images that the configuration and the host allow."""

from typing import ClassVar

import cv2
import numpy as np
import pytest

from blitzgs.distributed.group import Ranks
from blitzgs.training import inputs
from tests.training.tiny import tiny_config, write_tiny_capture


@pytest.mark.parametrize(
    ("limit", "cache_bytes", "budget"),
    [("1000000\n", 800_000, 250_000), ("1000000\n", 300_000, 150_000), ("max\n", 300_000, 150_000)],
)
def test_ranks_share_at_most_half_of_the_memory_of_a_container(
    tmp_path, monkeypatch, limit, cache_bytes, budget
):
    write_tiny_capture(tmp_path / "capture")
    (tmp_path / "memory.max").write_text(limit)
    monkeypatch.setattr(inputs, "_CONTAINER_LIMIT", tmp_path / "memory.max")
    config = tiny_config(f"data.path={tmp_path / 'capture'}", f"data.cache_bytes={cache_bytes}")
    _, images = inputs.open_capture(config, Ranks(local_world_size=2))
    assert images.compressed.budget == budget and images.decoded.budget == budget // 4 + budget


def test_without_a_container_the_memory_of_the_host_counts(tmp_path, monkeypatch):
    write_tiny_capture(tmp_path / "capture")
    monkeypatch.setattr(inputs, "_CONTAINER_LIMIT", tmp_path / "missing")
    monkeypatch.setattr(inputs.os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 100}[name])
    _, images = inputs.open_capture(tiny_config(f"data.path={tmp_path / 'capture'}"), Ranks())
    assert images.compressed.budget == 4096 * 50


def test_ranks_whose_photographs_do_not_fit_get_a_hint(tmp_path, monkeypatch):
    write_tiny_capture(tmp_path / "capture")
    _, images = inputs.open_capture(tiny_config(f"data.path={tmp_path / 'capture'}"), Ranks())
    capture, size = images.capture, inputs.size_of(inputs.decoded_shapes(images.capture))
    monkeypatch.setattr(inputs, "_host_memory", lambda: 4 * size)
    assert inputs.sharing_hint(capture, 2 * size, 2) is None
    assert inputs.sharing_hint(capture, 2 * size - 2, 1) is None
    hint = inputs.sharing_hint(capture, 2 * size - 2, 2)
    assert "each rank decodes the photographs for itself" in hint
    assert "--data.cache_bytes=1_000_000_000," in hint  # rounded up to whole gigabytes
    monkeypatch.setattr(inputs, "_host_memory", lambda: 4 * size - 4)
    assert inputs.sharing_hint(capture, 2 * size - 2, 2) is None


def test_the_ranks_of_a_host_divide_the_search_for_damage(tmp_path):
    """Two hosts of two ranks: one rank of each host reads a file, and all ranks know what is wrong."""
    files = [(tmp_path / f"{index}.png", None) for index in range(5)]
    for index, (path, _) in enumerate(files):
        path.write_bytes(
            b"damaged" if index in (1, 4) else cv2.imencode(".png", np.ones((8, 8)))[1].tobytes()
        )

    class Rank(Ranks):
        found: ClassVar = []

        def all_gather_object(self, value):
            self.found.append(value)
            return self.found

    results = [
        inputs._damaged_of_share(Rank(rank=rank, world_size=4, local_world_size=2), files)
        for rank in range(4)
    ]
    assert [list(found) for found in Rank.found] == [[4], [1], [4], [1]]
    assert list(results[-1]) == [1, 4] and "1.png" in results[-1][1]
