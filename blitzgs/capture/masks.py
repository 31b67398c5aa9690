# SPDX-License-Identifier: Apache-2.0
"""Finds the mask of each image of a capture, and checks photographs and masks before they are needed."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Container, Iterator, Sequence
from itertools import product
from pathlib import Path, PurePosixPath

from blitzgs.capture.cameras import Camera, same_shape
from blitzgs.capture.image_files import check_photograph, decode_mask, in_threads, read_header, read_whole
from blitzgs.capture.names import IMAGE_SUFFIXES, any_case, files_below, unified, what_is_at
from blitzgs.util.errors import located, warn

# What programs call the mask of a.jpg, the names that are tried first first.
_FORMS: tuple[str, ...] = ("{name}.png", "{stem}.png", "{name}", "{stem}_mask.png", "{stem}_mask{suffix}")
_FORMS += ("{name}_mask.png", "{name}.mask.png", "{stem}.mask.png")
# These with another suffix, after all others.
_FORMS_OF_ANY_SUFFIX = ("{name}", "{stem}", "{stem}_mask")
_FORMS_OF_A_PLACE = len(_FORMS) + 1 + len(_FORMS_OF_ANY_SUFFIX) * len(IMAGE_SUFFIXES)
# Masks are decoded when the capture is loaded to see what they exclude.
_SAMPLED = 8


def find_masks(
    root: Path, masks: str | bool | None, names: Sequence[str], given: Sequence[Path | None]
) -> list[Path | None]:
    """Return the mask of each image, or None.

    Names are relative to the images' folder or to the capture; `given` are the masks that the capture's file
    names. `masks` is a folder relative to `root`; None: `masks/` if it exists; True: `masks/`; False: no
    masks. FileNotFoundError: there is no such folder, or a mask that the file names is missing. ValueError:
    no file of the folder belongs to an image, or a file belongs to several.
    """
    if masks is False:
        return [None] * len(names)
    missing = [path for path in dict.fromkeys(given) if path is not None and not path.is_file()]
    if missing:
        kind = what_is_at(missing[0])
        raise FileNotFoundError(
            f"{len(missing)} masks are missing (first: {missing[0]}{f' is {kind}' if kind else ''}); put "
            "them there, correct mask_path in transforms.json, or use --data.masks=false to train without"
        )
    folder = root / (masks if isinstance(masks, str) else "masks")
    if not folder.is_dir():
        if masks is not None:
            raise FileNotFoundError(f"{folder}: no such folder of masks")
        return list(given)
    files = [name for name in files_below(folder) if name.lower().endswith(IMAGE_SUFFIXES)]
    owners = _owners(folder, files, [None if path else name for name, path in zip(names, given, strict=True)])
    found = [path or (folder / owners[i] if i in owners else None) for i, path in enumerate(given)]
    used = {path for path in found if path is not None}
    unused = [name for name in files if folder / name not in used]
    if files and not used:
        raise ValueError(
            f"none of the {len(files)} masks in {folder} belongs to an image: they are called like "
            f"{unused[0]}, the images like {names[0]}; call the mask of {names[0]} "
            f"{PurePosixPath(unified(names[0])).name}.png, or use --data.masks=false"
        )
    if unused:
        warn(f"{len(unused)} of {len(files)} masks in {folder} belong to no image (first: {unused[0]})")
    return found


def _owners(folder: Path, files: Sequence[str], names: Sequence[str | None]) -> dict[int, str]:
    """Return the file of each image that has one.

    Every place that a mask of an image may have is a claim on the file there. A file belongs to the image
    with the best claim; of two equally good ones neither may be right.
    """
    by_path: dict[str, list[str]] = defaultdict(list)
    for file in files:
        parts = PurePosixPath(any_case(file)).parts
        for begin in range(len(parts)):
            by_path["/".join(parts[begin:])].append(file)
    claims: dict[str, dict[int, int]] = defaultdict(dict)  # by file: the rank of each image
    for index, name in enumerate(names):
        for rank, place in enumerate(_places(name) if name is not None else ()):
            for file in by_path.get(place, ()):
                # The folder of masks may have a folder in front of the whole name: half a rank worse.
                exact = any_case(file) == place
                if exact or rank < _FORMS_OF_A_PLACE:
                    claims[file].setdefault(index, 2 * rank + (not exact))
    owners: dict[int, tuple[int, str]] = {}
    doubtful: list[tuple[str, list[int]]] = []
    for file, claimed in claims.items():
        best = min(claimed.values())
        images = [index for index, rank in claimed.items() if rank == best]
        if len(images) > 1:
            doubtful.append((file, images))
        elif images[0] not in owners or best < owners[images[0]][0]:
            owners[images[0]] = (best, file)
    doubtful = [(file, images) for file, images in doubtful if not all(image in owners for image in images)]
    if doubtful:
        file, images = doubtful[0]
        first, second = (str(names[index]) for index in images[:2])
        raise ValueError(
            f"{folder}: {len(doubtful)} masks could belong to several images: {file} to {first} and {second}"
            f"; put the mask of {first} at {first}.png in that folder, or use --data.masks=false"
        )
    return {index: file for index, (_, file) in owners.items()}


def _places(name: str) -> Iterator[str]:
    """Yield the paths, in the folder of masks, that the mask of an image may have, the best first.

    Folders in front of the name may be missing there: those of a transforms.json begin with that of the
    images. Of a name that is absolute or leads out of its folder, only the last part is used: the whole name,
    joined to the folder of masks, could be the path of the photograph itself.
    """
    path = PurePosixPath(any_case(name))
    parts = path.parts[-1:] if path.is_absolute() or ".." in path.parts else path.parts
    for begin in range(len(parts)):
        # A PNG's own name is better than that stem's: a.png belongs to the image a.png before a.jpg.
        for form in (_FORMS[0], "{name}" if path.suffix == ".png" else "", *_FORMS[1:]):
            own = form.format(name=path.name, stem=path.stem, suffix=path.suffix)
            yield "/".join((*parts[begin:-1], own))
        for form, suffix in product(_FORMS_OF_ANY_SUFFIX, IMAGE_SUFFIXES):
            yield "/".join((*parts[begin:-1], form.format(name=path.name, stem=path.stem) + suffix))


def misfit(camera: Camera, width: int, height: int) -> str | None:
    """Return why a mask file of this stored size does not fit the photograph of its camera; None: it does."""
    lens = camera.rectification.lens
    stored = (lens.width, lens.height) if camera.orientation < 5 else (lens.height, lens.width)
    if (width, height) == stored or same_shape((width, height), (lens.width, lens.height)):
        return None
    return (
        f"the mask {camera.mask_path} is {width} x {height}, which does not fit the photograph of "
        f"{lens.width} x {lens.height} that it masks, {camera.image_path}: make it from that photograph, "
        "or use --data.masks=false"
    )


def check_mask_sizes(cameras: Sequence[Camera]) -> None:
    """Refuse masks whose sizes do not fit (ValueError); damaged ones are left to who needs them."""

    def problem(camera: Camera) -> str | None:
        try:
            header = read_header(camera.mask_path) if camera.mask_path is not None else None
        except (OSError, ValueError):
            return None
        return None if header is None else misfit(camera, header.width, header.height)

    found = [text for text in in_threads(problem, cameras) if text is not None]
    if found:
        more = f" ({len(found)} masks do not fit)" if len(found) > 1 else ""
        raise ValueError(found[0] + more)


def check_masks(masks: Sequence[Path | None]) -> None:
    """Warn if a few of the masks exclude nothing, or everything; damaged ones are left to who needs them."""

    def counted_share(path: Path) -> float | None:
        try:
            return float(decode_mask(read_whole(path)).mean())
        except (OSError, ValueError):
            return None

    paths = [path for path in dict.fromkeys(masks) if path is not None]
    sample = [paths[i * len(paths) // min(_SAMPLED, len(paths))] for i in range(min(_SAMPLED, len(paths)))]
    shares = [share for share in in_threads(counted_share, sample) if share is not None]
    if not shares:
        return
    if min(shares) == 1:
        warn(
            f"the masks exclude nothing ({len(shares)} of {len(paths)} were looked at; first: {sample[0]}): "
            "black or transparent pixels are excluded, all others count"
        )
    elif max(shares) == 0:
        warn(
            f"the masks exclude every pixel ({len(shares)} of {len(paths)} were looked at; first: "
            f"{sample[0]}): black or transparent pixels are excluded, and in lossy files (JPEG) dark ones "
            "too; write masks as PNG with white where pixels count, or use --data.masks=false"
        )


def check_files(photograph: Path, mask: Path | None, is_whole: bool = False) -> bool:
    """Check that a photograph and its mask can be decoded, and tell whether some pixel counts.

    `is_whole`: the photograph is opaque and was checked before. ValueError, OSError: one cannot be decoded.
    """
    has_pixels = is_whole or check_photograph(photograph)
    if mask is None:
        return has_pixels
    with located("the mask"):
        return bool(decode_mask(read_whole(mask)).any()) and has_pixels


# Returns what is wrong with photographs and their masks, as `damaged` does.
FindDamage = Callable[[Sequence[tuple[Path, Path | None]]], dict[int, str]]


def damaged(files: Sequence[tuple[Path, Path | None]]) -> dict[int, str]:
    """Return what is wrong with photographs and their masks, by index; those without damage are left out."""

    def problem(pair: tuple[Path, Path | None]) -> str | None:
        try:
            check_files(*pair)
        except (OSError, ValueError) as error:
            return str(error)
        return None

    return {i: text for i, text in enumerate(in_threads(problem, files)) if text is not None}


class FileCheck:
    """Checks the files of views one after the other in a thread of its own, while others are in use."""

    def __init__(self, cameras: Sequence[Camera], whole: Container[Path]) -> None:
        """Start to check files; `whole` are those of opaque photographs that others have read meanwhile."""
        # What is wrong with the first damaged file that was found; None so far.
        self.damage: str | None = None
        self._cameras, self._whole = cameras, whole
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="blitzgs-check", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread; files that were not checked yet stay unchecked."""
        self._stop.set()
        self._thread.join()

    def wait(self) -> None:
        """Wait until all files are checked or one is damaged."""
        self._thread.join()

    def _run(self) -> None:
        blank = []
        for camera in self._cameras:
            if self._stop.is_set():
                return
            try:
                if not check_files(camera.image_path, camera.mask_path, camera.image_path in self._whole):
                    blank.append(camera.name)
            except (OSError, ValueError) as error:
                self.damage = str(error)
                return
        if blank:
            warn(
                f"{len(blank)} photographs have no pixel that counts, as they are transparent or masked "
                f"everywhere (first: {blank[0]})"
            )
