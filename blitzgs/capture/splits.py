# SPDX-License-Identifier: Apache-2.0
"""Chooses the held-out views: every n-th, those of a list file, or those in Mega-NeRF's `val/` folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from blitzgs.capture.cameras import SourceView
from blitzgs.capture.names import read_lines

DEFAULT_EVERY = 8


def every_nth(count: int, n: int) -> list[int]:
    """Return the test views 0, n, 2n, ... of `count` (views sorted by name); none if n is 0."""
    if n < 0 or n == 1:
        raise ValueError(f"data.split: must be 0 (no view is held out) or at least 2, got {n}")
    return list(range(0, count, n)) if n else []


def from_list(names: Sequence[str], path: Path) -> list[int]:
    """Return the test views that a text file names, one per line, with or without folder and suffix."""
    lookup: dict[str, set[int]] = {}
    for index, name in enumerate(names):
        pure = PurePath(name)
        for key in {name, pure.name, pure.stem, str(pure.with_suffix(""))}:
            lookup.setdefault(key, set()).add(index)
    test: set[int] = set()
    for number, line in enumerate(read_lines(path), start=1):
        entry = line.split("#")[0].strip().replace("\\", "/")
        if not entry:
            continue
        found = lookup.get(entry, set())
        exact = {index for index in found if names[index] == entry}
        found = exact or found
        if len(found) != 1:
            problem = f"names {len(found)} views" if found else "names no view of the capture"
            raise ValueError(
                f"{path}: line {number}: '{entry}' {problem} (views are called like '{names[0]}')"
            )
        test |= found
    if not test:
        raise ValueError(f"{path} names no view: list the held-out ones, or set --data.split=0 for none")
    return sorted(test)


def is_val(name: str, image_path: Path, root: Path) -> bool:
    """Tell whether an image is in Mega-NeRF's `val/` folder of the capture."""
    inside = image_path.relative_to(root) if image_path.is_relative_to(root) else PurePath(name)
    return ("val",) in (inside.parts[:1], PurePath(name).parts[:1])


def split_views(
    names: Sequence[str], paths: Sequence[Path], root: Path, spec: int | str | Path = "auto"
) -> tuple[list[int], list[int]]:
    """Return train and test views, both ascending.

    `spec` is n (every n-th), "val" (Mega-NeRF's layout), a list file (relative to `root` or as it is), or
    "auto": "val" if such a folder has views, else every 8th. ValueError: the list names unknown views, or no
    training view is left.
    """
    if isinstance(spec, str) and spec.removeprefix("-").isdigit():
        spec = int(spec)
    if isinstance(spec, int):
        test = every_nth(len(names), spec)
    else:
        test = [i for i in range(len(names)) if is_val(names[i], paths[i], root)]
        if spec == "val" and not test:
            raise ValueError(f"split 'val': no view's image is in {root / 'val'}")
        if spec == "auto" and not test:
            test = every_nth(len(names), DEFAULT_EVERY) if len(names) > 1 else []
        if spec not in ("val", "auto"):
            candidates = [root / spec, Path(spec)]
            found = next((path for path in candidates if path.is_file()), None)
            if found is None:
                raise ValueError(
                    f"split '{spec}': must be a whole number n (every n-th view is held out; 0: none), "
                    f"'auto', 'val' or a file in {root}"
                )
            test = from_list(names, found)
    held_out = set(test)
    train = [i for i in range(len(names)) if i not in held_out]
    if not train:
        raise ValueError(f"split '{spec}' leaves no training view of {len(names)}")
    return train, test


def without_unused(views: list[SourceView], spec: int | str | Path) -> list[SourceView]:
    """Return the views without those that the capture's own lists leave out, if these decide."""
    if spec != "auto":
        return views
    both = [view.name for view in views if view.part == "both"]
    if both:
        raise ValueError(
            f"{len(both)} views are in train_filenames and also in val_filenames or test_filenames (first: "
            f"{both[0]}): a view that is trained on cannot measure the result; remove them from one of the "
            "lists, or choose the held-out views with --data.split"
        )
    return [view for view in views if view.part != "unused"]


def split_capture(
    views: Sequence[SourceView], root: Path, spec: int | str | Path
) -> tuple[list[int], list[int], str]:
    """Return train and test views, both ascending, and what decided on them; see `split_views`."""
    if spec == "auto" and any(view.part is not None for view in views):
        test = [i for i, view in enumerate(views) if view.part == "test"]
        train = [i for i, view in enumerate(views) if view.part != "test"]
        if not train:
            raise ValueError(f"{root}: the files hold out every view: no training view is left")
        return train, test, "the capture's own split"
    names, paths = [view.name for view in views], [view.path for view in views]
    train, test = split_views(names, paths, root, spec)
    if spec != "auto":
        return train, test, f"data.split={spec}"
    in_val = bool(test) and is_val(names[test[0]], paths[test[0]], root)
    return train, test, "the images in val/" if in_val else f"every {DEFAULT_EVERY}th view by name"
