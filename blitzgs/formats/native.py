# SPDX-License-Identifier: Apache-2.0
"""The compiled readers and writers of files, loaded when they are first needed."""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType


@cache
def native_io() -> ModuleType:
    """Import the compiled readers and writers (`blitzgs._lib._io`).

    Raises:
        ImportError: the module was not built for this Python; says how to build it.
    """
    try:
        module = importlib.import_module("blitzgs._lib._io")
    except ImportError as error:
        raise ImportError(
            f"the host I/O module of blitzgs is missing for this Python ({error}); run `pip install .`, or "
            "`make build` in a checkout (`make io` where the kernels are built already)"
        ) from error
    return module
