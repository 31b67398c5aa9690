# SPDX-License-Identifier: Apache-2.0
"""Finds the images and masks of a COLMAP capture on disk."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePath

from blitzgs.capture.image_files import read_header
from blitzgs.capture.lens import Lens

_SUFFIXES = (".jpg", ".JPG", ".jpeg", ".png", ".PNG")


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
        return [self._find(name) for name in names]

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


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of an image, or None: NAME.png (as in COLMAP), STEM.png or the image's own name.

    Of a name that is absolute or leads out of its folder, only the last part is used: the whole name, joined
    to the folder of masks, could be the path of the photograph itself.
    """
    pure = PurePath(name)
    leads_out = pure.is_absolute() or ".." in pure.parts
    for candidate in (f"{name}.png", str(pure.with_suffix(".png")), name):
        inner = folder / PurePath(candidate).name
        for path in (inner,) if leads_out else (folder / candidate, inner):
            if path.is_file():
                return path
    return None
