# SPDX-License-Identifier: Apache-2.0
"""Finds files whose names on disk differ in notation from those that a capture's file gives them.

The file may have been written on another system (backslashes, upper and lower case, composed letters), or the
photographs may have been converted or moved since. A file is taken only if it is the only one that fits.
"""

from __future__ import annotations

import os
import re
import stat
import unicodedata
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".avif", ".jp2", ".gif")
# Folders of what belongs to photographs and has their names, but shows something else.
_BY_PRODUCT = re.compile(r"(?i)(^|/)(depth|normal|disp|mask|alpha|segmentation|semantic)[^/]*/")
# Of folders in each other.
_DEEPEST = 8


def unified(name: str) -> str:
    """Return a path with slashes, without `.` parts, and with composed letters."""
    return unicodedata.normalize("NFC", str(PurePosixPath(name.replace("\\", "/"))))


def _any_case(name: str) -> str:
    return unified(name).casefold()


def _without_suffix(name: str) -> str:
    path = PurePosixPath(_any_case(name))
    return str(path.with_suffix("")) if path.suffix in IMAGE_SUFFIXES else str(path)


def _last(name: str) -> str:
    return PurePosixPath(_any_case(name)).name


def _joined(name: str) -> str:
    return _any_case(name).replace("/", "_")


# What is ignored, and whether files that were found by stricter rules rule it out: where some photographs are
# in the folders that the names say, one of the same name in another folder is another photograph.
_Rule = tuple[str, Callable[[str], str], bool]
_RULES: tuple[_Rule, ...] = (
    ("slashes and composed letters", unified, False),
    ("upper and lower case", _any_case, False),
    ("suffixes", _without_suffix, True),
    ("folders", _last, True),
    ("folders that became part of the name", _joined, True),
    ("folders and suffixes", lambda name: _without_suffix(_last(name)), True),
)


def match_names(names: Iterable[str], found: Sequence[str], folder: Path) -> dict[str, Path]:
    """Return the file of each of the names for which exactly one file of a folder fits.

    Args:
        names: relative to `folder`; no such files exist.
        found: further names, whose files exist; these are not taken for other names.
        folder: with its subfolders.
    """
    wanted = list(dict.fromkeys(names))
    if not wanted or not folder.is_dir():
        return {}
    taken = {unified(name) for name in found}
    suffixes = {PurePosixPath(unified(name)).suffix.lower() for name in found}
    free = [file for file in files_below(folder) if unified(file) not in taken]
    matches: dict[str, Path] = {}
    for ignored, key, is_last_resort in _RULES:
        files, claims = defaultdict(list), defaultdict(list)
        for file in free:
            files[key(file)].append(file)
        for name in wanted:
            if not (is_last_resort and PurePosixPath(unified(name)).suffix.lower() in suffixes):
                claims[key(name)].append(name)
        new = {
            claimed[0]: files[place][0]
            for place, claimed in claims.items()
            if _is_alike(claimed[0], files.get(place, [""])[0])
            and len(claimed) == 1
            and len(files.get(place, ())) == 1
            and (folder / files[place][0]).is_file()
        }
        if not new:
            continue
        _say(new, len(found) + len(wanted), folder, ignored)
        matches |= {name: folder / file for name, file in new.items()}
        used = set(new.values())
        free = [file for file in free if file not in used]
        wanted = [name for name in wanted if name not in new]
        suffixes |= {PurePosixPath(unified(name)).suffix.lower() for name in new}
        if not wanted:
            break
    return matches


def _is_alike(name: str, file: str) -> bool:
    return bool(_BY_PRODUCT.search(unified(name))) == bool(_BY_PRODUCT.search(file))


def _say(new: dict[str, str], count: int, folder: Path, ignored: str) -> None:
    name, file = next(iter(new.items()))
    warnings.warn(
        f"{len(new)} of {count} files have other names in {folder} than in the capture's file: {file} is "
        f"used for {name} (names that differ only in {ignored})",
        stacklevel=4,
    )


def files_below(folder: Path) -> list[str]:
    """Return the files of a folder and its subfolders, sorted, as paths relative to it with slashes."""
    out = []
    for place, folders, files in os.walk(folder, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if len(Path(place).relative_to(folder).parts) > _DEEPEST:  # a link to a folder above itself
            folders.clear()
        base = Path(place).relative_to(folder).as_posix()
        out += [name if base == "." else f"{base}/{name}" for name in files]
    return sorted(out)


def what_is_at(path: Path) -> str | None:
    """Return what a path is instead of a file, as text; None: nothing is there, or a file."""
    try:
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            target = os.readlink(path)
            try:
                mode = path.stat().st_mode
            except FileNotFoundError:
                return f"a link to {target}, which does not exist"
            except OSError as error:
                return f"a link to {target}: {os.strerror(error.errno or 0)}"
    except (OSError, ValueError):
        return None
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISFIFO, "a named pipe"),
        (stat.S_ISSOCK, "a socket"),
        (stat.S_ISCHR, "a device"),
        (stat.S_ISBLK, "a device"),
    )
    return next((text for is_kind, text in kinds if is_kind(mode)), None)


def check_inside(paths: Iterable[Path], root: Path, allowed: Sequence[Path], refuse: bool) -> None:
    """Warn of files that names lead to outside the capture, or refuse them.

    Args:
        paths: files that the capture names.
        root: folder of the capture.
        allowed: further folders that the caller chose.
        refuse: refuse them, also those to which links lead.

    Raises:
        ValueError: a file is outside, and `refuse` is set.
    """
    bases = [os.path.normpath(folder.absolute()) for folder in (root, *allowed)]
    outside = [path for path in paths if not _is_below(os.path.normpath(path.absolute()), bases)]
    if not refuse:
        if outside:
            warnings.warn(
                f"{len(outside)} names of the capture lead outside {root} (first: {outside[0]}); "
                "--data.inside_only=true refuses them",
                stacklevel=3,
            )
        return
    # A link inside the capture belongs to the capture, so it must not lead outside either.
    chosen = [folder for folder in allowed if not _is_below(os.path.normpath(folder.absolute()), bases[:1])]
    real = [os.path.realpath(folder) for folder in (root, *chosen)]
    outside += [path for path in paths if not _is_below(os.path.realpath(path), real)]
    if outside:
        raise ValueError(
            f"{root}: a name of the capture leads outside it, to {outside[0]}, and data.inside_only refuses "
            "that; put the file into the capture, or leave out data.inside_only if you trust the capture"
        )


def _is_below(path: str, folders: Sequence[str]) -> bool:
    return any(os.path.commonpath([path, folder]) == folder for folder in folders)
