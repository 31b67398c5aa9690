# SPDX-License-Identifier: Apache-2.0
"""Whether a checkpoint fits on its disk, and what a failed write of one means."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from blitzgs.util.output import is_lack_of_space


def check_space(folder: Path, columns: Mapping[str, Tensor]) -> None:
    """Raise the error of a full disk if columns do not fit into the free space."""
    needed = sum(column.numel() * column.element_size() for column in columns.values())
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            errno.ENOSPC, f"{needed / 1e9:.2f} GB are needed and {free / 1e9:.2f} GB are free", str(folder)
        )


def explain(error: OSError) -> str:
    """Return why a file was not written, and what to do where that is known."""
    if is_lack_of_space(error):
        return f"the disk is full ({error}); free some space or lower the number of checkpoints kept"
    if error.errno == errno.EFBIG:
        return f"a file is larger than is allowed ({error}); raise the limit (ulimit -f) or use another disk"
    return str(error)
