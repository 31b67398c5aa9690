# SPDX-License-Identifier: Apache-2.0
"""Where the built libraries lie, and which ops they were built with; needs no torch.

The environment variable BLITZGS_LIBRARY_DIR names another folder to load them from, for a build with other
options.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
from pathlib import Path

# The list of ops in a checkout; it must be the one that the libraries were built with.
REGISTRATION = Path(__file__).resolve().parents[1] / "csrc" / "registration.cpp"
LIBRARY_DIR = Path(os.environ.get("BLITZGS_LIBRARY_DIR") or Path(__file__).parent / "_lib")


def schema_digest(path: Path) -> str:
    """Return the `source_digest` of the ops that a library was built with; "" if the library has none."""
    try:
        digest = ctypes.CDLL(str(path)).blitzgs_schema_digest
    except AttributeError:
        return ""
    digest.restype = ctypes.c_char_p
    return str(digest().decode())


def source_digest(registration: Path) -> str:
    """Return the SHA-256 of the schemas of all ops in a registration.cpp; CMakeLists.txt computes the same.

    Comments, white space and the seams of string literals do not count.
    """
    text = re.sub(r"//[^\n]*|[ \n]+", "", registration.read_text()).replace('""', "")
    return hashlib.sha256(";".join(re.findall(r'm\.def\("[^"]*"', text)).encode()).hexdigest()
