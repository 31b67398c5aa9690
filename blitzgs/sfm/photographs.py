# SPDX-License-Identifier: Apache-2.0
"""The photographs of a folder: which can be used, their masks, and their positions by GPS."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from blitzgs.capture.colmap import Float64, find_incomplete_model, find_models
from blitzgs.capture.image_files import decode_mask, in_threads, read_header, read_whole
from blitzgs.capture.masks import damaged, find_masks
from blitzgs.capture.names import BY_PRODUCTS, IMAGE_SUFFIXES, files_below, to_convert
from blitzgs.capture.projects.find import find_project
from blitzgs.capture.transforms import find_transforms
from blitzgs.sfm.engine import MOST_IN_ALL_PAIRS
from blitzgs.util.errors import warn
from blitzgs.util.output import write_file

# Files and folders of what programs write beside photographs.
_BY_PRODUCT = re.compile(rf"(?i)(^|/)({BY_PRODUCTS})s?(_?\d+)?[./]|_mask\.|\.mask\.")
# What COLMAP reads.
_READ = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
# A place by GPS is right to some metres: photographs within fewer metres say nothing of each other.
_LEAST_SPREAD = 30.0
_METRES_PER_DEGREE = 111_000.0


def photograph_folder(root: Path, images: str = "images") -> Path:
    """Return the folder of the photographs of a capture: `images` in it, or itself."""
    return root / images if (root / images).is_dir() else root


def _photographs_of(files: Iterable[str]) -> list[str]:
    """Return the photographs among files; by-products are left out."""
    found = (name for name in files if name.lower().endswith(IMAGE_SUFFIXES))
    return [name for name in found if not _BY_PRODUCT.search(name)]


def has_photographs_alone(root: Path, images: str) -> bool:
    """Tell whether a folder has photographs and nothing that says where they were taken from.

    ValueError: it has several projects of other programs.
    """
    if not root.is_dir() or find_incomplete_model(root) or find_transforms(root):
        return False
    # Models anywhere below; behind links only where a capture has them.
    models = any(any(root.rglob(f"cameras{suffix}")) for suffix in (".bin", ".txt"))
    if models or any(find_models(root / part) for part in ("", "train", "val")) or find_project(root):
        return False
    return bool(_photographs_of(files_below(photograph_folder(root, images))))


@dataclass(frozen=True)
class Photographs:
    """Photographs that can be used, and why others cannot."""

    folder: Path  # folder of them all
    names: list[str]  # relative to the folder
    sizes: list[tuple[int, int]]  # width and height in pixels as stored
    masks: list[Path | None]  # of each, or None
    damage: dict[str, str]  # what is wrong with the others, by name

    @classmethod
    def of(cls, folder: Path) -> Photographs:
        """Read the photographs of a folder; masks are searched in `masks/` in it and beside it.

        FileNotFoundError: there are none. ValueError: fewer than three can be used, or masks belong to none
        of them.
        """
        files = files_below(folder) if folder.is_dir() else [folder.name]
        names = _photographs_of(files) if folder.is_dir() else []
        # A folder may be called Alpha after the camera.
        images = (name for name in files if name.lower().endswith(IMAGE_SUFFIXES))
        if maps := [name for name in images if _BY_PRODUCT.search(name) and "mask" not in name.lower()]:
            warn(
                f"{folder}: {len(maps)} images are called like maps of depth, alpha or the like, and are "
                f"left out (first: {maps[0]}); if they are photographs, call their folder or them otherwise"
            )
        # Many cameras write a photograph as JPEG and as raw data beside it.
        known = {PurePosixPath(name).with_suffix("") for name in names}
        others = to_convert(name for name in files if PurePosixPath(name).with_suffix("") not in known)
        if not names:
            what = "has no photographs" if folder.is_dir() else "is no folder of photographs"
            raise FileNotFoundError(f"{folder} {what} ({', '.join(IMAGE_SUFFIXES)}){others}")
        if others:
            warn(f"{folder}: only its {len(names)} photographs are used{others}")
        root = folder if (folder / "masks").is_dir() else folder.parent
        masks = find_masks(root, None, names, [None] * len(names))
        problems = damaged([(folder / name, mask) for name, mask in zip(names, masks, strict=True)])
        for i, name in enumerate(names):
            if not name.lower().endswith(_READ):
                suffix = PurePosixPath(name).suffix
                problems.setdefault(i, f"COLMAP reads no {suffix} files: convert it to JPEG or PNG")
        sound = [i for i in range(len(names)) if i not in problems]
        if len(sound) < 3:
            why = f"; {next(iter(problems.values()))}" if problems else ""
            raise ValueError(f"{folder}: 3 photographs are needed, {len(sound)} can be used{why}")
        headers = in_threads(read_header, [folder / names[i] for i in sound])
        return cls(
            folder,
            [names[i] for i in sound],
            [(header.width, header.height) for header in headers],
            [masks[i] for i in sound],
            {names[i]: text for i, text in problems.items()},
        )

    def identity(self) -> dict[str, list[int]]:
        """Return by which a changed photograph or mask is found: sizes and times of the files, by name."""
        both = zip(self.names, self.masks, strict=True)
        return {name: _stamp(self.folder / name) + (_stamp(mask) if mask else []) for name, mask in both}

    def write_masks(self, folder: Path) -> Path | None:
        """Write masks as COLMAP reads them: NAME.png of each photograph's size; None if there are none."""
        if not any(self.masks):
            return None
        for name, size, mask in zip(self.names, self.sizes, self.masks, strict=True):
            path = folder / f"{name}.png"
            if path.exists():
                continue
            counted = np.ones((1, 1), np.uint8) if mask is None else decode_mask(read_whole(mask))
            pixels = 255 * cv2.resize(counted, size, interpolation=cv2.INTER_NEAREST)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, bytes(cv2.imencode(".png", pixels)[1]), sync=False)
        return folder


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def judge_positions(degrees: Float64, photographs: int) -> tuple[bool, bool]:
    """Return whether positions by GPS [N, 3] tell neighbours apart, and whether their altitudes can be used.

    Altitudes mislead if some are missing or all are equal, or if they differ by more than the places do: then
    they are of several references (ground, sea level, ellipsoid).
    """
    if len(degrees) < max(3, 0.9 * photographs):
        return False, False
    inner = np.nanquantile(degrees, [0.05, 0.95], axis=0)
    scale = _METRES_PER_DEGREE * np.array([1.0, np.cos(np.radians(inner[0, 0]))])
    across = float(np.hypot(*((inner[1] - inner[0])[:2] * scale)))
    up = degrees[:, 2]
    altitude = bool(np.isfinite(up).all() and np.ptp(up) > 0 and not (up == 0).any())
    return across > _LEAST_SPREAD, altitude and float(inner[1, 2] - inner[0, 2]) < across


def estimate(sizes: Sequence[tuple[int, int]]) -> str:
    """Return roughly how long the reconstruction takes without a GPU."""
    cores, count = len(os.sched_getaffinity(0)), len(sizes)
    pairs = count * ((count - 1) / 2 if count <= MOST_IN_ALL_PAIRS else _PAIRS_OF_ONE)
    shared = sum(width * height for width, height in sizes) / 1e6 * _FEATURES + pairs * _PAIR
    seconds = shared / cores + count * _POSE
    minutes = max(1, round(seconds / 60))
    taken = "a minute" if minutes == 1 else f"{minutes:,} minutes"
    return f"{taken} on {cores} CPU cores (rough: within a factor of 3)"


# Seconds of a core for a megapixel and a pair, which cores share, and seconds for a pose, which they hardly
# do: COLMAP finds one after the other.
_FEATURES, _PAIR, _POSE = 1.8, 0.13, 2.0
_PAIRS_OF_ONE = 30
