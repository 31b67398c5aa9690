# SPDX-License-Identifier: Apache-2.0
"""Which views and points of a capture are used: what cannot be is left out, some views are held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
import numpy.typing as npt

from blitzgs.capture import transforms
from blitzgs.capture.cameras import Camera, Float64, SourceView, rectify
from blitzgs.capture.layouts import read_layout
from blitzgs.capture.lengths import StrayCamera, random_points
from blitzgs.capture.lens import Lens, check_lens
from blitzgs.capture.names import read_lines
from blitzgs.capture.points import SourcePoints
from blitzgs.util.errors import located, warn

# Coordinates from here on are damage; the squares of smaller ones are finite.
_FARTHEST = 1e100
# As many as give a start where the capture has no points.
_RANDOM_POINTS = 100_000


def _is_usable(coordinates: Float64) -> npt.NDArray[np.bool_]:
    return np.asarray(np.abs(coordinates) < _FARTHEST)  # false for NaN


def with_finite_poses(views: list[SourceView]) -> list[SourceView]:
    """Return the views whose pose is finite; warn of the others (ValueError: there is none)."""
    finite = [view for view in views if _is_usable(view.world_to_camera).all()]
    if not finite:
        raise ValueError(f"none of the {len(views)} views has a pose (a finite rotation and translation)")
    if len(finite) < len(views):
        first = next(v.name for v in views if not _is_usable(v.world_to_camera).all())
        warn(
            f"{len(views) - len(finite)} of {len(views)} views have no finite pose and were dropped "
            f"(first: {first})"
        )
    return finite


def check_lenses(views: list[SourceView]) -> None:
    """Refuse lenses that no camera has, and name those that are unusual."""
    unusual: dict[Lens, str] = {}
    checked: set[Lens] = set()
    for view in views:
        if view.lens in checked:
            continue
        checked.add(view.lens)
        with located(f"the camera of {view.name}"):
            doubt = check_lens(view.lens)
        if doubt:
            unusual[view.lens] = f"{view.name}: {doubt}"
    if unusual:
        warn(f"{len(unusual)} of {len(checked)} cameras are unusual (first: {next(iter(unusual.values()))})")


def without_strays(
    views: list[SourceView], strays: list[StrayCamera], count: int, keep: bool
) -> list[SourceView]:
    """Return those of `count` views whose pose is right, unless the user keeps the others, and name them."""
    if not strays:
        return views
    shown = ", ".join(f"{s.name} at {s.distance:.6g}" for s in strays[:5]) + ", ..." * (len(strays) > 5)
    done = "kept" if keep else "left out; --data.stray_cameras=keep trains on them"
    warn(
        f"{len(strays)} of {count} cameras lie far from the others, which are within "
        f"{strays[0].others:.6g} of their middle, and show hardly a point: {shown} ({done})"
    )
    names = {stray.name for stray in strays}
    return views if keep else [view for view in views if view.name not in names]


def finite_points(points: SourcePoints) -> SourcePoints:
    """Return the points whose position is finite; warn of the others."""
    finite: npt.NDArray[np.bool_] = np.asarray(_is_usable(points.positions).all(axis=1))
    if finite.all():
        return points
    warn(f"{int((~finite).sum())} of {finite.size} points are not finite and were dropped")
    return replace(points, **{name: column[finite] for name, column in points.columns().items()})


def points_at_random(root: Path, cameras: Sequence[Camera], offset: Float64) -> SourcePoints:
    """Return uniform points of random colours in the region that the cameras look at."""
    warn(
        f"{root}: the capture has no points; {_RANDOM_POINTS:,} random ones take their place. Points of the "
        "reconstruction give a better start"
    )
    with located(str(root)):
        return SourcePoints(*random_points(cameras, offset, _RANDOM_POINTS))


def read_cameras(path: Path, offset: Float64) -> list[Camera]:
    """Read the cameras of a transforms file of any name, or of a folder with one or with a COLMAP model.

    Lenses with distortion become pinhole cameras, as in a capture; `offset` [3] is subtracted from the
    positions. FileNotFoundError: there is no such file, or no camera in the folder. ValueError: a file is
    damaged, or has no camera.
    """
    if path.is_file():
        views = transforms.read_transforms(path.parent, [path]).frames
    elif path.is_dir():
        views, _, _ = read_layout(path, "images", 1)
    else:
        raise FileNotFoundError(f"{path}: there is no such transforms file or folder of a COLMAP model")
    if not views:
        raise ValueError(f"{path} has no cameras")
    check_lenses(views)
    views = sorted(with_finite_poses(views), key=lambda view: view.name)
    return [_pinhole(view, offset) for view in views]


def _pinhole(view: SourceView, offset: Float64) -> Camera:
    with located(f"the camera of {view.name}"):
        plan = rectify(view.lens, "crop")
    pose = view.world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ offset
    return Camera(view.name, plan.width, plan.height, plan.K, pose, view.path, None, 1, plan)


DEFAULT_EVERY = 8


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
    given, in_val = spec, [i for i in range(len(names)) if is_val(names[i], paths[i], root)]
    if isinstance(spec, str) and spec.removeprefix("-").isdigit():
        spec = int(spec)
    if spec == "auto" and not in_val:
        spec = DEFAULT_EVERY if len(names) > 1 else 0
    if isinstance(spec, int):
        if spec < 0 or spec == 1:
            raise ValueError(f"data.split: must be 0 (no view is held out) or at least 2, got {spec}")
        test = list(range(0, len(names), spec)) if spec else []
    elif spec in ("auto", "val"):
        test = in_val
        if not test:
            raise ValueError(f"split 'val': no view's image is in {root / 'val'}")
    else:
        found = next((path for path in (root / spec, Path(spec)) if path.is_file()), None)
        if found is None:
            raise ValueError(
                f"split '{spec}': must be a whole number n (every n-th view is held out; 0: none), "
                f"'auto', 'val' or a file in {root}"
            )
        test = from_list(names, found)
    train = sorted(set(range(len(names))).difference(test))
    if not train:
        raise ValueError(f"split '{given}' leaves no training view of {len(names)}")
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
