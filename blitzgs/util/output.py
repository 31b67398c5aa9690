# SPDX-License-Identifier: Apache-2.0
"""Writes output files: completely or not at all, inside the requested folder, and never over an input.

Image names come from captures, and so from other programs: they may be absolute, contain `..`, or become
equal when their suffix is replaced. `OutputFolder` makes paths of them for which none of this is true.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import secrets
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath

# A file that `OutputFolder` leaves in its folder. Where it is missing, existing files belong to another
# program or to the user.
MARK = ".blitzgs"
_MARK_TEXT = "blitzgs wrote the files of this folder, and replaces them when it writes here again.\n"
# Largest number of bytes in a file name on common file systems, minus those for a suffix and a number.
_LONGEST_NAME = 200
# Name of the temporary file of `new_file`.
PARTIAL = re.compile(r"\.[0-9a-f]{12}\.partial")


@contextmanager
def new_file(
    path: Path,  # the final name; its folder must exist
    sync: bool = True,  # wait until the file is on disk, so that the same holds after a power failure
) -> Iterator[Path]:
    """Yield a temporary file to write; it gets its final name when the context ends without an error.

    A reader of `path` sees the old file or the complete new one. Only a regular file is replaced. Yields the
    temporary file, empty, in the same folder. OSError: `path` is a link, a device or a folder, or cannot be
    written; an existing file is unchanged.
    """
    check_replaceable(path)
    partial = path.with_name(f".{secrets.token_hex(6)}.partial")
    try:
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    except OSError as error:
        error.filename = str(path)  # the name that the caller knows
        raise
    try:
        yield partial
        if sync:
            sync_to_disk(partial)
        check_replaceable(path)
        os.replace(partial, path)
        if sync:
            sync_to_disk(path.parent)
    except OSError as error:
        # A write to a full disk names no file.
        if error.errno is not None and error.filename in (None, str(partial)):
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_file(path: Path, content: bytes | str, sync: bool = True) -> None:
    """Write a file completely or not at all; see `new_file`."""
    with new_file(path, sync) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def check_replaceable(path: Path, ours: tuple[bytes, ...] = (), otherwise: str = "") -> None:
    """Check that `path` does not exist, or is a regular file that may be replaced (else OSError).

    If there are marks, `ours`, a file that is not empty must have one in its first 2000 bytes, or at its
    start if the mark has 8 bytes or fewer; else FileExistsError says "FILE exists" and `otherwise`.
    """
    try:
        mode = path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFLNK: "a symbolic link", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe"}
        kind = kinds.get(stat.S_IFMT(mode), "a device or socket")
        remedy = "name a file in it" if stat.S_ISDIR(mode) else "remove it or choose another name"
        raise OSError(f"{path} is {kind}, which is not overwritten: {remedy}")
    if ours:
        with open(path, "rb") as file:
            start = file.read(2000)
        if start and not any(start.startswith(mark) if len(mark) <= 8 else mark in start for mark in ours):
            raise FileExistsError(f"{path} exists{otherwise}: choose another name")


class OutputFolder:
    """A folder for one output file per name; no file is written outside it or over an input.

    Existing files are replaced only in a folder that an `OutputFolder` has written to before, which has a
    file `MARK`. So a copy of the photographs is safe as well.
    """

    def __init__(self, root: Path, inputs: Iterable[Path] = ()) -> None:
        """Prepare the folder; the first write creates it."""
        self.root = root
        self._inputs: dict[tuple[int, int], Path] = {}
        self._input_folders: dict[str, Path] = {}
        for path in inputs:
            self._input_folders.setdefault(os.path.dirname(os.path.realpath(path)), path)
            if (identity := _identity(path)) is not None:
                self._inputs[identity] = path

    def paths(self, names: Sequence[str], suffix: str, flat: bool = False) -> list[Path]:
        """Return a path below the folder for each name, all different, none of them an input.

        `photos/a.jpg` becomes `photos/a` + suffix. Parts that lead out of the folder (`/`, `..`) are dropped,
        and so are the folders that all absolute names have in common. If two names would give the same path,
        each keeps its own suffix before the new one; if they are still equal, later ones get a number. The
        same names always give the same paths.

        `names`: names of images, as in their capture. `suffix`: suffix of the new files, with its dot.
        `flat`: put every file into the folder itself, `a/b.jpg` as `a_b` + suffix. OSError: a path is an
        input, is no regular file, leaves the folder through a link, or exists in a folder without `MARK`.
        """
        above = [_inner_parts(name)[:-1] for name in names if name.startswith("/")]
        shared = len(os.path.commonprefix(above)) if above else 0  # leading folders that all have
        parts = [_inner_parts(name, shared if name.startswith("/") else 0) for name in names]
        if flat:
            parts = [("_".join(inner),) for inner in parts]
        short = [_key(PurePath(*inner).with_suffix("")) for inner in parts]
        counts = Counter(short)
        taken: set[str] = set()
        folders = {_key(PurePath(*inner[:end])) for inner in parts for end in range(1, len(inner))}
        relatives = []
        for inner, key in zip(parts, short, strict=True):
            whole = PurePath(*inner)
            stem = whole if counts[key] > 1 else whole.with_suffix("")
            relative, number = _with_name(stem, suffix), 1
            while _key(relative) in taken or _key(relative) in folders:
                number += 1
                relative = _with_name(whole, f"_{number}{suffix}")
            taken.add(_key(relative))
            relatives.append(relative)
        found = [self.root / relative for relative in relatives]
        for path in found:
            self.check(path)
        return found

    def check(self, path: Path) -> None:
        """Check that a path below the folder may be written (OSError: see `paths`)."""
        root, folder = os.path.realpath(self.root), os.path.realpath(path.parent)
        if os.path.commonpath([root, folder]) != root:
            raise OSError(
                f"{path.parent} leads out of {self.root} to {folder}: remove that link or choose another "
                "--out"
            )
        for place in (root, folder):
            if place in self._input_folders:
                raise OSError(
                    f"{path} would lie among the inputs ({self._input_folders[place]}): choose another --out"
                )
        check_replaceable(path)
        # The path may be another name of an input, by a hard link.
        source = self._inputs.get(identity) if (identity := _identity(path)) is not None else None
        if source is not None:
            raise OSError(f"{path} would overwrite the input {source}: choose another --out")
        if os.path.lexists(path) and not (self.root / MARK).exists():
            raise FileExistsError(
                f"{path} exists, and no earlier call of blitzgs wrote to {self.root}: choose another --out"
            )

    def write(self, path: Path, content: bytes) -> None:
        """Write the file of one of `paths`; the folder is checked again before."""
        self.check(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not (self.root / MARK).exists():
            write_file(self.root / MARK, _MARK_TEXT, sync=False)
        self.check(path)
        write_file(path, content, sync=False)


def _inner_parts(name: str, shared: int = 0) -> tuple[str, ...]:
    """Return the parts of a name that stay inside a folder, without the first `shared`; at least one."""
    parts = [part for part in PurePath(name.replace("\0", "_")).parts if part not in ("/", "//", "..", ".")]
    return tuple(_shortened(part) for part in parts[shared:]) or ("image",)


def _shortened(part: str) -> str:
    """Return a part that file systems accept: a long one is cut, and a digest of the whole is appended."""
    data = os.fsencode(part)
    if len(data) <= _LONGEST_NAME:
        return part
    digest = hashlib.sha256(data).hexdigest()[:12]
    return f"{data[: _LONGEST_NAME - 13].decode(errors='ignore')}_{digest}"


def _with_name(path: PurePath, suffix: str) -> PurePath:
    return path.with_name(_shortened(path.name) + suffix)


def _key(path: PurePath) -> str:
    # Some file systems do not tell upper from lower case.
    return str(path).casefold()


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def check_outside(path: Path, inputs: Path) -> None:
    """Check that new files in `path` would not lie in a folder of inputs (else ValueError)."""
    if path.resolve().is_relative_to(inputs.resolve()):
        raise ValueError(f"{path} is in {inputs}, whose files are read: choose a folder outside it")


def is_lack_of_space(error: OSError) -> bool:
    """Tell whether an error would not have happened with more space on the disk."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def locked(path: Path, busy: str = "") -> Iterator[int]:
    """Hold the lock of a folder, or of a file that is made for it; yields its descriptor.

    Processes that inherit the descriptor hold the lock too, until they end. BlockingIOError: another process
    has it; `busy` is the message.
    """
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(busy) from None
        yield descriptor
    finally:
        os.close(descriptor)


def sync_to_disk(path: Path) -> None:
    """Sync a file, or the entries of a folder, so that they survive a power failure."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
