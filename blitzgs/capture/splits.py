# SPDX-License-Identifier: Apache-2.0
"""Which views of a capture are held out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path, PurePath

from blitzgs.capture.cameras import SourceView
from blitzgs.capture.names import any_case, by_parts, read_lines, relative_to

_EVERY = 8


def split_views(
    views: Sequence[SourceView], root: Path, spec: int | str | Path = "auto"
) -> tuple[list[int], list[int], str]:
    """Return train and test views, both ascending, and what decided on them.

    `spec` is n (every n-th is held out; 0: none), "val" (Mega-NeRF's layout), a list file (relative to `root`
    or as it is), or "auto": the split of the capture's files, else "val" if such a folder has views, else
    every 8th. ValueError: the list names unknown views, or no training view is left.
    """
    count, why = len(views), f"data.split={spec}"
    in_val = [index for index, view in enumerate(views) if _is_val(view, root)]
    if isinstance(spec, str) and spec.removeprefix("-").isdigit():
        spec = int(spec)
    if isinstance(spec, int):
        if spec < 0 or spec == 1:
            raise ValueError(f"data.split: must be 0 (no view is held out) or at least 2, got {spec}")
        test = list(range(0, count, spec)) if spec else []
    elif spec == "auto" and any(view.part is not None for view in views):
        test = [index for index, view in enumerate(views) if view.part == "test"]
        why = "the capture's own split"
    elif spec == "auto":
        test = in_val or list(range(0, count, _EVERY) if count > 1 else ())
        why = "the images in val/" if in_val else f"every {_EVERY}th view by name"
    elif spec == "val":
        if not (test := in_val):
            raise ValueError(f"split 'val': no view's image is in {root / 'val'}")
    else:
        found = next((path for path in (root / spec, Path(spec)) if path.is_file()), None)
        if found is None:
            raise ValueError(
                f"split '{spec}': must be a whole number n (every n-th view is held out; 0: none), "
                f"'auto', 'val' or a file in {root}"
            )
        test = _listed([view.name for view in views], found)
    train = sorted(set(range(count)).difference(test))
    if not train:
        raise ValueError(f"{root}: {why} leaves no training view of {count}")
    return train, test, why


def _is_val(view: SourceView, root: Path) -> bool:
    """Tell whether an image is in Mega-NeRF's `val/` folder of the capture."""
    return ("val",) in (relative_to(root, view.path).parts[:1], PurePath(view.name).parts[:1])


def _listed(names: Sequence[str], path: Path) -> list[int]:
    """Return the test views that a text file names, one per line, with or without folder and suffix."""
    lookup, test = by_parts(names), set()
    for number, line in enumerate(read_lines(path), start=1):
        entry = line.split("#")[0].strip().replace("\\", "/")
        if not entry:
            continue
        of_windows = os.fsencode(entry).decode("cp1252", errors="replace")
        found = lookup.get(any_case(entry)) or lookup.get(any_case(of_windows), [])
        found = [index for index in found if names[index] == entry] or found
        if len(found) != 1:
            problem = f"names {len(found)} views" if found else "names no view of the capture"
            raise ValueError(
                f"{path}: line {number}: '{entry}' {problem} (views are called like '{names[0]}')"
            )
        test.add(found[0])
    if not test:
        raise ValueError(f"{path} names no view: list the held-out ones, or set --data.split=0 for none")
    return sorted(test)


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
