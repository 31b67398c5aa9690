# SPDX-License-Identifier: Apache-2.0
"""Checkpoints that survive crashes and load at any world size.

A checkpoint is a folder: one safetensors file per rank with the columns of its shard, and `manifest.json`
with the training state, the size and SHA-256 of each file, and the SHA-256 of its own content. It is written
to a temporary folder, synced to disk, and renamed, so a folder with the final name is complete. Loading
compares the files with the digests. The folder must be on a file system that every rank sees.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

import torch
from torch import Tensor

from blitzgs.distributed.group import Ranks
from blitzgs.runs.checkpoint_files import DAMAGE, Manifest, Shard, finish, opened, verified, write_shard
from blitzgs.table.placement import global_positions
from blitzgs.util.errors import UserError, warn
from blitzgs.util.output import is_lack_of_space

T = TypeVar("T")

SHARED = "shared.safetensors"
_NAME = re.compile(r"checkpoint_(\d{6,})")
_UNFINISHED = ".unfinished_"


class CheckpointError(UserError):
    """A checkpoint could not be written or read; the message names the checkpoint and the reason."""

    def __init__(self, message: str, lacks_space: bool = False) -> None:
        super().__init__(message)
        self.lacks_space = lacks_space  # whether it could be written if there were more space on the disk


class Saving:
    """A checkpoint that a thread of each rank writes; there is none until `finish` has returned."""

    def __init__(
        self,
        directory: str | os.PathLike[str],
        columns: Mapping[str, Tensor],
        state: Mapping[str, Any],
        ranks: Ranks,
        keep: int = 3,
        shared: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Begin to write a checkpoint. Collective.

        Args:
            directory: folder of checkpoints, made if missing.
            columns: name -> [N_rank, ...], this rank's shard; the same names, dtypes and widths on every
                rank. They must not change before `finish` has returned, and neither must the following two.
            state: the rest of what a resumed run needs, as JSON values; rank 0's is stored.
            keep: newest checkpoints to keep; older ones are deleted after the new one is on disk.
            shared: tensors that are the same on all ranks; rank 0's are stored, in a separate file.

        Raises:
            CheckpointError: rank 0 cannot read the folder.
        """
        self._directory, self._state, self._ranks, self._keep = Path(directory), state, ranks, keep
        name, problem = "", None
        if ranks.rank == 0:
            try:
                names = names_of(self._directory)
                name = f"checkpoint_{_number(names[-1]) + 1 if names else 0:06d}"
                _delete(self._directory.glob(_UNFINISHED + "*"))  # of interrupted saves and deletions
            except OSError as error:
                problem = f"no checkpoint was saved, because rank 0 could not read {directory}: {error}."
        self._name, problem = ranks.broadcast_object((name, problem))
        if problem:
            raise CheckpointError(problem)
        self._folder = self._directory / (_UNFINISHED + self._name)
        shared = shared if ranks.rank == 0 else None
        device = next(iter(columns.values())).device
        ready = torch.cuda.current_stream(device).record_event() if device.type == "cuda" else None
        pool = ThreadPoolExecutor(1, "blitzgs-checkpoint")
        self.deleting: Thread | None = None  # deletes older checkpoints on rank 0, after `finish`
        self._written = pool.submit(self._write, columns, shared or {}, device, ready)
        pool.shutdown(wait=False)

    @property
    def is_written(self) -> bool:
        """Whether this rank has written its files, or has failed to."""
        return self._written.done()

    def wait(self) -> None:
        """Wait until this rank has written its files; the columns may change afterwards."""
        self._written.exception()

    def _write(
        self,
        columns: Mapping[str, Tensor],
        shared: Mapping[str, Tensor],
        device: torch.device,
        ready: torch.cuda.Event | None,
    ) -> tuple[Shard, Shard | None]:
        self._folder.mkdir(parents=True, exist_ok=True)
        file = f"shard_{self._ranks.rank:04d}_of_{self._ranks.world_size:04d}.safetensors"
        # On a stream of its own, copies to the host wait for no later work.
        with torch.cuda.stream(None if ready is None else torch.cuda.Stream(device)):
            if ready is not None:
                ready.wait()
            rows = len(next(iter(columns.values())))
            mine = Shard(file, rows, *write_shard(self._folder / file, columns))
            common = Shard(SHARED, 0, *write_shard(self._folder / SHARED, shared)) if shared else None
        return mine, common

    def finish(self) -> Path:
        """Wait until all ranks have written, and give the checkpoint its name. Collective.

        Returns the folder of the new checkpoint, `directory/checkpoint_NNNNNN`; later numbers may have more
        digits. CheckpointError: on every rank, if any rank could not write; earlier checkpoints are
        unchanged.
        """
        ranks, path = self._ranks, self._directory / self._name
        mine = common = problem = None
        lacks_space = True
        try:
            with ranks.watchdog.working("writing a checkpoint"):
                mine, common = self._written.result()
        except OSError as error:
            problem = f"rank {ranks.rank} could not write: {_explain(error)}"
            lacks_space = is_lack_of_space(error)
        results = ranks.all_gather_object((mine, problem, lacks_space))
        problems = [text for _, text, _ in results if text]
        lacks_space = all(lacks for _, _, lacks in results)
        if not problems and ranks.rank == 0:
            try:
                with ranks.watchdog.working("finishing a checkpoint"):
                    shards = [shard for shard, _, _ in results if shard]
                    finish(self._folder, path, Manifest(shards, common, self._state))
            except OSError as error:
                problems.append(f"rank 0 could not write: {_explain(error)}")
                lacks_space = is_lack_of_space(error)
        problems, lacks_space = ranks.broadcast_object((problems, lacks_space))
        if problems:
            if ranks.rank == 0:
                shutil.rmtree(self._folder, ignore_errors=True)
            raise CheckpointError(
                f"checkpoint {path} was not saved: {'; '.join(problems)}. Earlier checkpoints are untouched.",
                lacks_space,
            )
        if ranks.rank == 0:
            try:
                self.deleting = _delete_old(self._directory, self._keep)
            except OSError as error:
                # The new checkpoint is complete; the next save tries to delete the old ones again.
                warn(f"an older checkpoint could not be deleted: {error}")
        return path


@dataclass
class Loaded:
    """A checkpoint in memory."""

    columns: dict[str, Tensor]  # columns of this rank's shard, [N_rank, ...], on the device
    state: Mapping[str, Any]  # the state that was saved with them
    shared: dict[str, Tensor]  # tensors that are the same on all ranks, on the CPU; empty if none were stored


def newest(
    directory: Path, ranks: Ranks, read: Callable[[Path], T], only: str | None = None
) -> tuple[T, Path, list[str]] | None:
    """Read the newest sound checkpoint. Collective.

    A damaged checkpoint is refused, and the one before it is tried. A warning names the refused checkpoints,
    the reasons, and the checkpoint that is used.

    `directory`: folder given to `Saving`. `read`: reads a checkpoint; refuses it on every rank, with a
    CheckpointError. `only`: name of the one checkpoint to read; None: the newest. Returns what `read`
    returned, the checkpoint, and why each newer one was refused; None if the folder has no checkpoint.
    CheckpointError: checkpoints exist, but none is sound, or none has the name.
    """
    found = ranks.broadcast_object(names_of(directory) if ranks.rank == 0 else [])
    if only is not None and only not in found:
        raise CheckpointError(f"{directory} has no checkpoint {only!r}; it has {', '.join(found) or 'none'}")
    refused: list[str] = []
    for name in reversed(found) if only is None else [only]:
        try:
            content = read(directory / name)
        except CheckpointError as error:
            refused.append(str(error))
            continue
        if refused and ranks.rank == 0:
            warn(f"{'; '.join(refused)}; using {name}")
        return content, directory / name, refused
    if refused and ranks.broadcast_object(names_of(directory) if ranks.rank == 0 else []) != found:
        return newest(directory, ranks, read, only)  # a training has replaced them meanwhile
    if refused:
        raise CheckpointError(f"no sound checkpoint in {directory}: {'; '.join(refused)}")
    return None


def sound_manifest(path: Path, ranks: Ranks) -> Manifest:
    """Return the manifest of a checkpoint whose files are sound; CheckpointError: on every rank, else."""
    manifest, problem = None, None
    try:
        # Each rank checks some of the files, so that every file is read for its digest once.
        with ranks.watchdog.working("reading a checkpoint"):
            manifest = verified(path, ranks.rank, ranks.world_size)
    except DAMAGE as error:
        problem = str(error) or type(error).__name__
    problems = [text for text in ranks.all_gather_object(problem) if text]
    if problems or manifest is None:
        raise CheckpointError(f"checkpoint {path} is damaged: {'; '.join(sorted(set(problems)))}")
    return manifest


def load(path: Path, ranks: Ranks, device: torch.device | str) -> Loaded:
    """Load this rank's share of one checkpoint. Collective.

    With the world size that it was saved with, each rank gets its own shard unchanged. With another one the
    rows are redistributed: rank m gets the positions = m (mod M) of the global order
    (`placement.global_positions`), and opens only the files that hold some of these rows.

    `path`: folder returned by `Saving.finish`. CheckpointError: on every rank, when a file is missing, torn
    or altered.
    """
    manifest, shared = sound_manifest(path, ranks), {}
    if manifest.shared is not None:
        with opened(path / manifest.shared.file) as file:
            shared = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    return Loaded(read_share(path, manifest.shards, ranks, torch.device(device)), manifest.state, shared)


def read_share(path: Path, shards: list[Shard], ranks: Ranks, device: torch.device) -> dict[str, Tensor]:
    """Read this rank's share of the columns in a folder's shards, as `load` does, without verifying files."""
    sizes = [shard.rows for shard in shards]
    if len(shards) == ranks.world_size:
        with opened(path / shards[ranks.rank].file) as file:
            return {name: file.get_tensor(name).to(device) for name in file.keys()}  # noqa: SIM118
    parts = []
    for index, shard in enumerate(shards):
        order = global_positions(sizes, index)
        rows = (order % ranks.world_size == ranks.rank).nonzero().squeeze(1)
        if len(rows):
            parts.append((shard, rows, order[rows] // ranks.world_size))
    count, none = sum(len(rows) for _, rows, _ in parts), torch.empty(0, dtype=torch.int64)
    columns: dict[str, Tensor] = {}
    for shard, rows, target in parts or [(shards[0], none, none)]:
        with opened(path / shard.file) as file:
            for name in file.keys():  # noqa: SIM118
                part = file.get_tensor(name)[rows].to(device)
                column = columns.setdefault(name, part.new_empty((count, *part.shape[1:])))
                column[target.to(device)] = part
    return columns


def _explain(error: OSError) -> str:
    """Return why a file was not written, and what to do where that is known."""
    if is_lack_of_space(error):
        return f"the disk is full ({error}); free some space or lower the number of checkpoints kept"
    if error.errno == errno.EFBIG:
        return f"a file is larger than is allowed ({error}); raise the limit (ulimit -f) or use another disk"
    return str(error)


def _delete_old(directory: Path, keep: int) -> Thread:
    """Start to delete all but the newest `keep`: deleting gigabytes takes seconds."""
    for name in names_of(directory)[:-keep]:
        # Rename first: an interrupted deletion must not leave half a checkpoint under a final name.
        (directory / name).rename(directory / (_UNFINISHED + name))
    # The next save makes a folder that is not among these.
    deleting = Thread(target=_delete, args=(list(directory.glob(_UNFINISHED + "*")),))
    deleting.start()
    return deleting


def _delete(folders: Iterable[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def names_of(directory: Path) -> list[str]:
    """Return the names of the checkpoints in a folder, oldest first."""
    if not directory.is_dir():
        return []
    names = (entry.name for entry in directory.iterdir() if _NAME.fullmatch(entry.name))
    return sorted(names, key=lambda name: (_number(name), name))


def _number(name: str) -> int:
    return int(name.rpartition("_")[2])
