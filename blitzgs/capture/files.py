# SPDX-License-Identifier: Apache-2.0
"""Finds the images of a capture on disk, and says which are missing."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePath

from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens
from blitzgs.capture.names import match_names, what_is_at

_SUFFIXES = (".jpg", ".JPG", ".jpeg", ".png", ".PNG")


class MissingImagesError(FileNotFoundError):
    """Some of the images that a capture names are not on disk."""


class ImageFinder:
    """Finds a capture's files: in the images folder, a scaled images_N, or Mega-NeRF's train/ and val/."""

    def __init__(self, root: Path, images: str = "images") -> None:
        """Look below `root`; `images` is the folder that the names of the model are relative to."""
        self.root = root
        self.images = images
        self._mapping = _mega_nerf_mapping(root)

    def find_all(self, names: Sequence[str], lenses: Sequence[Lens], downscale: float) -> list[Path]:
        """Return the file of each name, from images_N if it has all images at the right size.

        For an image that is found nowhere the returned path does not exist.
        """
        if downscale > 1 and float(downscale).is_integer():
            folder = self.root / f"{self.images}_{int(downscale)}"
            if folder.is_dir():
                paths = [_with_any_suffix(folder / name) for name in names]
                problem = _first_problem(folder, names, lenses, paths, downscale)
                if problem is None:
                    return [path for path in paths if path is not None]
                warnings.warn(f"{problem}; downscaling {self.images} instead", stacklevel=2)
        files = [self._find(name) for name in names]
        there = [path.is_file() for path in files]
        lost = [name for name, found in zip(names, there, strict=True) if not found]
        found = [name for name, is_there in zip(names, there, strict=True) if is_there]
        matches = match_names(lost, found, self.root / self.images)
        return [matches.get(name, path) for name, path in zip(names, files, strict=True)]

    def _find(self, name: str) -> Path:
        first = self.root / self.images / name
        if first.is_file():
            return first
        mapped = self._mapping.get(name)
        for folder in ("", "train/rgbs", "val/rgbs", "train/images", "val/images", "rgbs"):
            base = self.root / folder
            for path in (base / name, base / PurePath(name).name):
                if path.is_file():
                    return path
            if mapped is not None and (found := _with_any_suffix(base / mapped)) is not None:
                return found
        return first


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


def _with_any_suffix(path: Path) -> Path | None:
    if path.is_file():
        return path
    return next((p for suffix in _SUFFIXES if (p := path.with_suffix(suffix)).is_file()), None)


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


def existing(names: Sequence[str], paths: Sequence[Path], root: Path, images: str, allow: bool) -> list[int]:
    """Return the indices of the views whose image is on disk.

    Args:
        names: of the views.
        paths: of their images.
        root: folder of the capture.
        images: folder of the images, relative to `root`.
        allow: warn of missing images instead of failing.

    Raises:
        MissingImagesError: images are missing.
        FileNotFoundError: all are missing.
        ValueError: two views have one image.
    """
    exists = [path.is_file() for path in paths]
    owners = defaultdict(list)
    for name, path, there in zip(names, paths, exists, strict=True):
        if there:
            owners[path].append(name)
    if twice := next((found for found in owners.values() if len(found) > 1), None):
        raise ValueError(f"{root}: {twice[0]} and {twice[1]} would be the same file; put both images there")
    missing = [(name, path) for name, path, there in zip(names, paths, exists, strict=True) if not there]
    found = [index for index, there in enumerate(exists) if there]
    if not missing:
        return found
    shown = ", ".join(name for name, _ in missing[:5]) + (", ..." if len(missing) > 5 else "")
    # The names of a transforms.json are paths in the capture; those of a COLMAP model, in its image folder.
    are_paths = all(path == root / name for name, path in missing)
    folder = root if are_paths else root / images
    message = f"{len(missing)} of {len(names)} images are not in {folder}: {shown}"
    if instead := _instead(folder, missing):
        message, remedy = f"{message}; {instead}", "put the photographs themselves there"
        if not allow:
            raise MissingImagesError(f"{message}: {remedy}, or leave those views out with allow_missing")
    if not found and are_paths:
        raise FileNotFoundError(f"{message}; put them there, or correct file_path in its transforms.json")
    if not found:
        # A user may name the folder of the model, CAPTURE/sparse/0.
        above = next((folder for folder in root.resolve().parents[:2] if (folder / images).is_dir()), None)
        if above is not None and not (root / images).is_dir():
            raise FileNotFoundError(f"{message}; the capture may be the folder above: --data={above}")
        remedy = "put them there, or name their folder, relative to the capture, with --data.images=FOLDER"
        if not (root / images).is_dir():
            remedy = "name their folder, relative to the capture, with --data.images=FOLDER"
        raise FileNotFoundError(f"{message}; {remedy}")
    if not allow:
        raise MissingImagesError(f"{message}; put them back, or leave those views out with allow_missing")
    warnings.warn(f"{message}; dropped", stacklevel=3)
    return found


def _instead(folder: Path, missing: Sequence[tuple[str, Path]]) -> str | None:
    """Return what is in the place of the images, if something is."""
    if os.path.lexists(folder) and not folder.is_dir():
        return f"{folder} is {what_is_at(folder) or 'a file, no folder'}"
    return next((f"{path} is {what}" for _, path in missing if (what := what_is_at(path))), None)
