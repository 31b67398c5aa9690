# SPDX-License-Identifier: Apache-2.0
"""All tests of this folder need a GPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.cuda.scenes import Scene

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder, and skip them without a GPU."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.cuda)
            if not torch.cuda.is_available():
                item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture
def scene() -> Scene:
    """Return the default scene."""
    return Scene()
