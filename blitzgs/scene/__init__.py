# SPDX-License-Identifier: Apache-2.0
"""The former name of `blitzgs.capture`: code that imports it gets the same modules, until version 0.3."""

import pkgutil
import sys
import warnings
from importlib import import_module

from blitzgs import capture

warnings.warn("blitzgs.scene is now blitzgs.capture", DeprecationWarning, stacklevel=2)
for _module in pkgutil.iter_modules(capture.__path__):
    sys.modules[f"{__name__}.{_module.name}"] = import_module(f"{capture.__name__}.{_module.name}")
