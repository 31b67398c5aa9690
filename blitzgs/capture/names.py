# SPDX-License-Identifier: Apache-2.0
"""Finds the images of a capture on disk, also if their names differ in notation from those in its files.

These files may have been written on another system (backslashes, upper and lower case, composed letters), or
the photographs may have been converted or moved since. Only a file that alone fits is taken.
"""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from pathlib import Path, PurePath, PurePosixPath

from blitzgs.capture.cameras import SourceView
from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens
from blitzgs.util.errors import warn

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".avif", ".jp2", ".gif")
# Of photographs that have to be converted; the cameras may have been found before that.
_CONVERTED_SUFFIXES = (".heic", ".heif", ".dng", ".arw", ".cr2", ".cr3", ".nef", ".orf", ".rw2", ".jxl")
_VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".insv", ".360")
# How folders and files are called that belong to photographs and have their names, but show something else.
BY_PRODUCTS = "depth|normal|disp|mask|alpha|segmentation|semantic"
_BY_PRODUCT = re.compile(rf"(?i)(^|/)({BY_PRODUCTS})[^/]*/")
# Folders that systems make beside photographs: small copies of them on network storage, and deleted ones.
_OF_SYSTEMS = ("@eadir", "__macosx", "#recycle", "$recycle.bin")
# Of folders in each other.
_DEEPEST = 8


def unified(name: str) -> str:
    """Return a path with slashes, without `.` parts, and with composed letters."""
    return unicodedata.normalize("NFC", str(PurePosixPath(name.replace("\\", "/"))))


def relative_to(root: Path, path: Path) -> Path:
    """Return a path as one below `root`, where it is below it."""
    return path.relative_to(root) if path.is_relative_to(root) else path


def any_case(name: str) -> str:
    """Return a path as `unified` does, in lower case."""
    return unified(name).casefold()


def by_parts(names: Iterable[str]) -> dict[str, list[int]]:
    """Return the indices of names by their lower-case forms with and without folders and suffix."""
    found = defaultdict(list)
    for index, name in enumerate(names):
        path = PurePosixPath(any_case(name))
        for key in {str(path), str(path).removesuffix(path.suffix), path.name, path.stem}:
            found[key].append(index)
    return found


def _without_suffix(name: str) -> str:
    path = PurePosixPath(any_case(name))
    return str(path.with_suffix("")) if path.suffix in IMAGE_SUFFIXES + _CONVERTED_SUFFIXES else str(path)


def _last(name: str) -> str:
    return PurePosixPath(any_case(name)).name


# What is ignored, and whether files that were found by stricter rules rule it out: where some photographs are
# in the folders that the names say, one of the same name in another folder is another photograph.
_Rule = tuple[str, Callable[[str], str], bool]
_RULES: tuple[_Rule, ...] = (
    ("slashes and composed letters", unified, False),
    ("upper and lower case", any_case, False),
    ("suffixes", _without_suffix, True),
    ("folders", _last, True),
    ("folders that became part of the name", lambda name: any_case(name).replace("/", "_"), True),
    ("folders and suffixes", lambda name: _without_suffix(_last(name)), True),
)


def match_names(names: Iterable[str], found: Sequence[str], folder: Path) -> dict[str, Path]:
    """Return the file below `folder` of each of the names for which exactly one fits; these do not exist.

    Further names, `found`, have files, which are not taken for others.
    """
    wanted = list(dict.fromkeys(names))
    if not wanted or not folder.is_dir():
        return {}
    taken = {unified(name) for name in found}
    suffixes = {_suffix(name) for name in found}
    free = [file for file in files_below(folder) if unified(file) not in taken]
    matches: dict[str, Path] = {}
    for ignored, key, is_last_resort in _RULES:
        files = _alone(free, key, _CONVERTED_SUFFIXES if is_last_resort else ())
        claims = _alone(wanted, key, suffixes if is_last_resort else ())
        new = {
            name: files[place]
            for place, name in claims.items()
            if place in files and _is_alike(name, files[place]) and (folder / files[place]).is_file()
        }
        if not new:
            continue
        name, file = next(iter(new.items()))
        warn(
            f"{len(new)} of {len(found) + len(wanted)} files have other names in {folder} than in the "
            f"capture's file: {file} is used for {name} (names that differ only in {ignored})"
        )
        matches |= {name: folder / file for name, file in new.items()}
        used = set(new.values())
        free = [file for file in free if file not in used]
        wanted = [name for name in wanted if name not in new]
        suffixes |= {_suffix(name) for name in new}
    return matches


def _alone(names: Iterable[str], key: Callable[[str], str], without: Container[str]) -> dict[str, str]:
    """Return the names whose key no other one has, by their keys; not those of some suffixes."""
    groups = defaultdict(list)
    for name in names:
        if _suffix(name) not in without:
            groups[key(name)].append(name)
    return {place: some[0] for place, some in groups.items() if len(some) == 1}


def _suffix(name: str) -> str:
    return PurePosixPath(any_case(name)).suffix


def _is_alike(name: str, file: str) -> bool:
    return bool(_BY_PRODUCT.search(unified(name))) == bool(_BY_PRODUCT.search(file))


def files_below(folder: Path) -> list[str]:
    """Return the files of a folder and its subfolders, sorted, as paths relative to it with slashes.

    Hidden ones are left out, as macOS writes them beside photographs, and folders of network storage and
    recycle bins. Links are followed, but none to a folder that has the link inside, which would repeat all.
    """
    out = []
    for place, folders, files in os.walk(folder, followlinks=True):
        inside = f"{os.path.realpath(place)}/"
        shown = (n for n in folders if not n.startswith(".") and n.lower() not in _OF_SYSTEMS)
        folders[:] = sorted(n for n in shown if not inside.startswith(f"{os.path.realpath(f'{place}/{n}')}/"))
        if len(Path(place).relative_to(folder).parts) > _DEEPEST:  # links that lead to each other
            folders.clear()
        base = Path(place).relative_to(folder).as_posix()
        visible = (name for name in files if not name.startswith("."))
        out += [name if base == "." else f"{base}/{name}" for name in visible]
    return sorted(out)


def to_convert(names: Iterable[str]) -> str:
    """Return, as the end of an error, what to do with files that are no readable photographs; "": nothing."""
    found = {PurePosixPath(name).suffix.lower() for name in names} & {*_CONVERTED_SUFFIXES, *_VIDEO_SUFFIXES}
    if not found:
        return ""
    return (
        f"; {', '.join(sorted(found))} cannot be read: convert photographs to JPEG, and take frames from a "
        "video (ffmpeg -i VIDEO -vf fps=2 -q:v 2 FRAMES/%05d.jpg)"
    )


def what_is_at(path: Path) -> str | None:
    """Return what a path is instead of a file, as text; None: nothing is there, or a file."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None)
        return f"a link to {os.readlink(path)}: {why}" if path.is_symlink() else None
    kinds = (
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISFIFO, "a named pipe"),
        (stat.S_ISSOCK, "a socket"),
        (stat.S_ISCHR, "a device"),
        (stat.S_ISBLK, "a device"),
    )
    return next((text for is_kind, text in kinds if is_kind(mode)), None)


def check_inside(paths: Iterable[Path], root: Path, allowed: Sequence[Path], refuse: bool) -> None:
    """Warn of paths that lead outside the capture and the `allowed` folders, or refuse them (ValueError).

    Links that lead outside are refused too.
    """
    bases = [os.path.normpath(folder.absolute()) for folder in (root, *allowed)]
    outside = [path for path in paths if not _is_below(os.path.normpath(path.absolute()), bases)]
    if not refuse:
        if outside:
            warn(
                f"{len(outside)} names of the capture lead outside {root} (first: {outside[0]}); "
                "--data.inside_only=true refuses them"
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


class MissingImagesError(FileNotFoundError):
    """Some of the images that a capture names are not on disk."""


def find_images(
    root: Path, images: str, names: Sequence[str], lenses: Sequence[Lens], downscale: float
) -> list[Path]:
    """Return the file of each name, relative to the folder `images` of a capture.

    It is in a scaled images_N if that has all images at the right size, in the folder itself, or in the
    train/ and val/ of Mega-NeRF. For an image that is found nowhere the returned path does not exist.
    """
    if downscale > 1 and float(downscale).is_integer():
        folder = root / f"{images}_{int(downscale)}"
        if folder.is_dir():
            found = [_first_file(_of_any_suffix(folder / name)) for name in names]
            problem = _first_problem(folder, names, lenses, found, downscale)
            if problem is None:
                return [path for path in found if path is not None]
            warn(f"{problem}; downscaling {images} instead")
    mapping = _mega_nerf_mapping(root)

    def places(name: str) -> Iterator[Path]:
        yield root / images / name
        for folder in ("", "train/rgbs", "val/rgbs", "train/images", "val/images", "rgbs"):
            yield root / folder / name
            yield root / folder / PurePath(name).name
            if name in mapping:
                yield from _of_any_suffix(root / folder / mapping[name])

    files = find_files(names, places, root / images)
    return [files[name] for name in names]


def find_files(
    names: Iterable[str], places: Callable[[str], Iterable[Path]], folder: Path
) -> dict[str, Path]:
    """Return the file of each name: in the first of its places that has one, or what `match_names` finds.

    For a name without a file, it is the first place.
    """
    files = {name: _first_file(places(name)) for name in names}
    there = {name: path for name, path in files.items() if path is not None}
    lost = {name: next(iter(places(name))) for name in files if name not in there}
    found = [relative_to(folder, path).as_posix() for path in there.values()]
    return there | lost | match_names(lost, found, folder)


def _first_file(paths: Iterable[Path]) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


def _of_any_suffix(path: Path) -> Iterator[Path]:
    yield path
    for suffix in (".jpg", ".JPG", ".jpeg", ".png", ".PNG"):
        yield path.with_suffix(suffix)


def _first_problem(
    folder: Path, names: Sequence[str], lenses: Sequence[Lens], paths: Sequence[Path | None], downscale: float
) -> str | None:
    for name, lens, path in zip(names, lenses, paths, strict=True):
        if path is None:
            return f"{folder} lacks {name}"
        header = read_header(path)
        sides = zip(sorted((header.width, header.height)), sorted((lens.width, lens.height)), strict=True)
        if any(abs(side * downscale - whole) >= downscale for side, whole in sides):
            have, full = f"{header.width} x {header.height}", f"{lens.width} x {lens.height}"
            return f"{path} is {have}, not 1/{downscale:g} of {full}"
    return None


def _mega_nerf_mapping(root: Path) -> dict[str, str]:
    """Read Mega-NeRF's mappings.txt, whose lines are "original image name,000123.pt"."""
    path = root / "mappings.txt"
    if not path.is_file():
        return {}
    mapping = {}
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            continue
        original, separator, metadata = line.rpartition(",")
        if not separator:
            raise ValueError(f"{path}: line {number}: expected 'image name,metadata name', got '{line}'")
        mapping[original.strip()] = PurePath(metadata.strip()).stem
    return mapping


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file; bytes that are not UTF-8 are decoded as those of file names are."""
    return os.fsdecode(path.read_bytes()).removeprefix("\ufeff").splitlines()


def existing(views: Sequence[SourceView], root: Path, images: str, allow: bool) -> list[SourceView]:
    """Return the views whose image is on disk; with `allow`, warn of the others.

    MissingImagesError, FileNotFoundError: images are missing, or all are. ValueError: two views have one
    image.
    """
    exists = {view: view.path.is_file() for view in views}
    found, missing = ([view for view in views if exists[view] is there] for there in (True, False))
    owners: dict[Path, str] = {}
    for view in found:
        if (other := owners.setdefault(view.path, view.name)) != view.name:
            raise ValueError(f"{root}: {other} and {view.name} would be the same file; put both images there")
    if not missing:
        return found
    shown = ", ".join(view.name for view in missing[:5]) + (", ..." if len(missing) > 5 else "")
    # The names of a transforms.json are paths in the capture; those of a COLMAP model, in its image folder.
    are_paths = all(view.path == root / view.name for view in missing)
    folder = root if are_paths else root / images
    message = f"{len(missing)} of {len(views)} images are not in {folder}: {shown}"
    if instead := _instead(folder, missing):
        message, remedy = f"{message}; {instead}", "put the photographs themselves there"
    elif found:
        remedy = "put them back"
    elif are_paths:
        remedy = "put them there, or correct file_path in its transforms.json"
    else:
        remedy = "name their folder, relative to the capture, with --data.images=FOLDER"
        # A user may name the folder of the model, CAPTURE/sparse/0.
        above = next((folder for folder in root.resolve().parents[:2] if (folder / images).is_dir()), None)
        if (root / images).is_dir():
            remedy = f"put them there, or {remedy}"
        elif above is not None:
            remedy = f"the capture may be the folder above: --data={above}"
    if not found:
        raise FileNotFoundError(f"{message}; {remedy}")
    if not allow:
        raise MissingImagesError(f"{message}; {remedy}, or leave those views out with allow_missing")
    warn(f"{message}; dropped")
    return found


def _instead(folder: Path, missing: Sequence[SourceView]) -> str | None:
    """Return what is in the place of the images, if something is."""
    if os.path.lexists(folder) and not folder.is_dir():
        return f"{folder} is {what_is_at(folder) or 'a file, no folder'}"
    return next((f"{v.path} is {what}" for v in missing if (what := what_is_at(v.path))), None)
