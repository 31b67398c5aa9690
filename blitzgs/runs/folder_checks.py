# SPDX-License-Identifier: Apache-2.0
"""Checks the folder of a training: what is in it, who uses it, whether ranks can write, and space."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from blitzgs.distributed.group import Ranks
from blitzgs.runs.run_files import CHECKPOINTS, WRITTEN
from blitzgs.table.table import GaussianTable
from blitzgs.util import output
from blitzgs.util.errors import UserError, amount, warn

LOCK = ".lock"
# A rank that torchrun restarts may begin before the process that it replaces has ended.
LOCK_SECONDS = 5.0
_PROBE_BYTES = 4096


class FolderError(UserError):
    """The folder of a run cannot be used; the message names the ranks and the reason."""


@contextlib.contextmanager
def locked(folder: Path, ranks: Ranks) -> Iterator[None]:
    """Lock a folder against other runs while the context lasts; every rank calls this.

    The operating system releases the lock when the process ends, also after a crash. FolderError, on every
    rank: another process is training in the folder.
    """
    with contextlib.ExitStack() as stack:
        problem = None
        if ranks.rank == 0:
            folder.mkdir(parents=True, exist_ok=True)
            problem = _lock(folder / LOCK, stack)
        if (problem := ranks.broadcast_object(problem)) is not None:
            raise FolderError(problem)
        yield


def _lock(path: Path, stack: contextlib.ExitStack) -> str | None:
    """Hold a lock until the stack ends; returns why it cannot be had; None, also where there are none."""
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            descriptor = stack.enter_context(output.locked(path))
            break
        except BlockingIOError:
            if time.monotonic() > deadline:
                holder = path.read_text(errors="replace").strip() or "of unknown name"
                return (
                    f"{path.parent} is in use by another run ({holder}): wait for it, stop it, or choose "
                    "another --out"
                )
            time.sleep(0.1)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
                raise
            warn(
                f"{path.parent} is on a file system without locks ({error.strerror}): nothing keeps a second "
                "run out of it"
            )
            return None
    # The name is only for the message above: a full disk is left to `check_writable` to name.
    with contextlib.suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
    return None


def check_unclaimed(folder: Path, resume: bool) -> None:
    """Check that a run replaces nothing in its folder; a folder with checkpoints is a run's.

    FileExistsError: the folder holds checkpoints and `resume` is not set, or files of another program that
    have the names of a run's. NotADirectoryError: the folder or that of its checkpoints is a file.
    """
    try:
        found = os.listdir(folder / CHECKPOINTS)
    except FileNotFoundError:
        for name in WRITTEN:
            if os.path.lexists(folder / name):
                raise FileExistsError(
                    f"{folder} has {name}, which a run would replace, and no checkpoints: choose another "
                    "--out"
                ) from None
        return
    if not resume and any(name.startswith("checkpoint_") for name in found):
        raise FileExistsError(
            f"{folder} already holds a run: add --resume to continue it, or choose another --out"
        )


def check_writable(folder: Path, ranks: Ranks) -> None:
    """Check that all ranks can write to the folder, and see the same one (FolderError names the others)."""
    token = ranks.broadcast_object(f".probe_{secrets.token_hex(6)}")
    problem = None
    own = folder / f"{token}_{ranks.rank}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open(own, "xb", buffering=0) as file:
            written = file.write(bytes(_PROBE_BYTES))
            os.fsync(file.fileno())
        if written != _PROBE_BYTES:
            problem = f"rank {ranks.rank} ({socket.gethostname()}): the disk is full"
    except OSError as error:
        problem = f"rank {ranks.rank} ({socket.gethostname()}): {error.strerror or error}"
    try:
        problems = [text for text in ranks.all_gather_object(problem) if text]
        seen = (folder / f"{token}_0").exists()
        unseen = [rank for rank, there in enumerate(ranks.all_gather_object(seen)) if not there]
    finally:
        with contextlib.suppress(OSError):
            own.unlink(missing_ok=True)
    if problems:
        raise FolderError(f"{folder} cannot be written: {'; '.join(problems)}")
    if unseen:
        raise FolderError(
            f"{folder}: ranks {', '.join(map(str, unseen))} do not see what rank 0 writes there: --out must "
            "be on a file system that all hosts share"
        )


def check_room(folder: Path, table: GaussianTable, ranks: Ranks, most_gaussians: int) -> None:
    """Check that a checkpoint fits on the disk (else FolderError); warn if `most_gaussians` will not fit."""
    row = sum(table.row_bytes.values())
    parts = ranks.all_gather_object((len(table), row))
    rows, row = sum(count for count, _ in parts), max(size for _, size in parts)
    free = ranks.broadcast_object(shutil.disk_usage(folder).free if ranks.rank == 0 else 0)
    if free < rows * row:
        raise FolderError(
            f"{folder}: a checkpoint takes {amount(rows * row)} and {amount(free)} are free: free "
            "some space or choose another --out"
        )
    # A new checkpoint is complete before an old one is deleted.
    most = max(rows, most_gaussians)
    wanted = 2 * most * row
    if free < wanted and ranks.rank == 0:
        warn(
            f"{folder}: {amount(free)} are free; two checkpoints of {most:,} Gaussians take {amount(wanted)}"
        )
