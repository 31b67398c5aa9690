# SPDX-License-Identifier: Apache-2.0
"""A capture: posed images and a point cloud, ready to train on.

`load_capture` reads a COLMAP model or transforms.json, finds every image file, decides how each becomes a
pinhole image of the wanted size, re-centres the world in float64 and splits the views. No image is decoded.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import (
    MOST_SIDE,
    Camera,
    Float64,
    camera_centres,
    downscaled_size,
    same_shape,
    scaled_matrix,
)
from blitzgs.capture.files import find_mask
from blitzgs.capture.image_files import ImageHeader, read_header
from blitzgs.capture.layouts import Source, SourceView, read_layout
from blitzgs.capture.lengths import Sight, StrayCamera, find_apart, measured_extent
from blitzgs.capture.lens import Lens
from blitzgs.capture.splits import split_capture, without_unused
from blitzgs.capture.undistort import Rectification, rectify
from blitzgs.capture.usable import (
    check_lenses,
    finite_points,
    points_at_random,
    with_finite_poses,
    without_strays,
)
from blitzgs.util.arguments import check_number

# In pixels. SSIM compares windows of 11 pixels, and a much smaller image shows too little to train on.
_LEAST_SIDE = 8
_HEADER_THREADS = 16
_MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".gif", ".webp")


@dataclass(eq=False)
class Capture:
    """Posed views and points of a re-centred world: world position = re-centred position + `offset`."""

    root: Path
    cameras: list[Camera]
    """Sorted by name."""
    points: Float64
    """[M, 3] re-centred."""
    colors: npt.NDArray[np.uint8]
    """[M, 3]."""
    track_lengths: npt.NDArray[np.int64] | None
    """[M] number of images that saw each point, where the capture says so."""
    errors: Float64 | None
    """[M] mean reprojection errors in pixels, where the capture says so."""
    offset: Float64
    """[3] the mean camera centre of the capture's own world."""
    train: list[int]
    test: list[int]
    extent: float
    """INRIA's: 1.1 x the largest distance of a training camera from their mean centre, in world units;
    without the cameras of `apart`."""
    has_alpha: bool
    """Whether some image has an alpha channel; `ImageStore` composites it over its background."""
    near: float
    """Near plane by the depths of the points that training views see (`Sight.near`), in world units."""
    apart: list[int]
    """Cameras that are so far from the others that no length is measured by them."""
    about: About
    """What was read and what was left out."""


@dataclass(frozen=True)
class About:
    """What `load_capture` decided, for messages."""

    source: Source
    split: str
    """What decided on the held-out views."""
    strays: list[StrayCamera]
    """The cameras whose pose is wrong; they are left out unless `stray_cameras` keeps them."""
    unused: int
    """Number of frames that are in no list of the file's own split."""
    missing: int
    """Number of views whose image is not on disk."""
    blind: int
    """Number of views that see none of the points."""
    random_points: bool
    """Whether the capture has no points, so that training starts from random ones."""


class MissingImagesError(FileNotFoundError):
    """Some of the images that a capture names are not on disk."""


def load_capture(
    path: Path | str,
    *,
    images: str = "images",
    downscale: float = 1,
    split: int | str | Path = "auto",
    masks: str | bool | None = None,
    undistort: str = "crop",
    exif: str = "auto",
    allow_missing: bool = False,
    sparse: str = "largest",
    stray_cameras: str = "drop",
) -> Capture:
    """Load a capture without decoding its images.

    Args:
        path: folder with a COLMAP sparse model (sparse/0, sparse, ...; or train/ and val/ folders that have
            one each) or transforms.json / transforms_train.json.
        images: folder of the images, relative to `path`; not used for transforms.json, which has paths.
        downscale: reduce both sides of the camera model's size by this factor. A folder such as images_4 is
            used for 4 if it contains every image at the right size; otherwise images are downscaled by
            averaging areas when they are decoded.
        split: see `splits.split_views`: n, "val", a list file, or "auto" (the split of the files, or every
            8th view).
        masks: folder of masks (NAME.png or STEM.png; black = excluded). None uses `masks/` when it exists;
            True requires it; False uses none.
        undistort: "crop" or "mask" the part of a pinhole image that the distorted image does not cover.
        exif: "auto" turns an image by its EXIF orientation only if its stored size does not fit the camera
            and its turned size does (COLMAP itself ignores the tag); "apply" always turns it, "ignore" never.
        allow_missing: drop views whose image is not on disk, with a warning, instead of failing. The world's
            origin, the extent and the split are still computed from all views with a pose.
        sparse: which of several COLMAP models is read: the "largest", "all" of them, which must have the same
            world coordinates, or a folder such as "sparse/1", relative to `path`.
        stray_cameras: "drop" the cameras that lie apart from all others and hardly show a point, or "keep"
            them; no length is measured by them either way.

    Raises:
        FileNotFoundError: the folder has no capture, or images are missing on disk (`MissingImagesError`).
        ValueError: a file is damaged, or sizes, poses or options are invalid.
    """
    root = Path(path)
    check_number("downscale", downscale)
    if not downscale >= 1:  # NaN too
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    for option, value, allowed in (
        ("exif", exif, ("auto", "apply", "ignore")),
        ("undistort", undistort, ("crop", "mask")),
        ("stray_cameras", stray_cameras, ("drop", "keep")),
    ):
        if value not in allowed:
            raise ValueError(f"{option} must be one of {', '.join(allowed)}, got {value!r}")
    views, points, source = read_layout(root, images, downscale, sparse)
    if not views:
        raise ValueError(f"{root}: its COLMAP model or transforms.json lists no images")
    listed = len(views)
    views = without_unused(views, split)
    unused = listed - len(views)
    check_lenses(views)
    views = sorted(with_finite_poses(views), key=lambda view: view.name)
    points = finite_points(points)
    # Use all views, so that a photograph that is lost later changes neither the origin nor the split.
    train, test, why = split_capture(views, root, split)
    apart, strays = find_apart(views, points.positions)
    centres = camera_centres(np.stack([view.world_to_camera for view in views]))
    offset = centres[~apart].mean(axis=0)
    train_centres = centres[[i for i in train if not apart[i]] or train] - offset
    kept = _existing(views, root, images, allow_missing)
    missing = len(views) - len(kept)
    kept = without_strays(views, kept, strays, keep=stray_cameras == "keep")
    place = {index: position for position, index in enumerate(kept)}
    views = [views[index] for index in kept]
    train, test = ([place[index] for index in part if index in place] for part in (train, test))
    apart_left = [place[index] for index in kept if apart[index]]
    if not train:
        raise MissingImagesError(f"{root}: no image of a training view is on disk")
    with ThreadPoolExecutor(_HEADER_THREADS) as pool:  # the files may be on a slow network disk
        headers = list(pool.map(lambda view: read_header(view.path), views))
    mask_folder = _mask_folder(root, masks)
    if masks is False:
        views = [replace(view, mask_path=None) for view in views]
    plans: dict[Lens, Rectification] = {}
    cameras = [
        _camera(view, header, offset, downscale, undistort, exif, mask_folder, plans)
        for view, header in zip(views, headers, strict=True)
    ]
    _check_masks(cameras, mask_folder)
    has_points = len(points.positions) > 0
    if not has_points:
        points = points_at_random(root, [c for i, c in enumerate(cameras) if i not in apart_left], offset)
    points.positions = points.positions - offset
    extent = measured_extent(train_centres, points.positions)
    sight = Sight.of(cameras, points.positions)
    blind = sight.blind(cameras, points.positions)
    near = sight.near([i for i in train if i not in apart_left] if has_points else [], extent)
    return Capture(
        root=root,
        cameras=cameras,
        points=points.positions,
        colors=points.colors,
        track_lengths=points.track_lengths,
        errors=points.errors,
        offset=offset,
        train=train,
        test=test,
        extent=extent,
        has_alpha=any(header.has_alpha for header in headers),
        near=near,
        apart=apart_left,
        about=About(source, why, strays, unused, missing, blind, not has_points),
    )


def _existing(views: list[SourceView], root: Path, images: str, allow_missing: bool) -> list[int]:
    """Return the indices of the views whose image is on disk."""
    exists = [view.path.is_file() for view in views]
    missing = [view.name for view, there in zip(views, exists, strict=True) if not there]
    found = [index for index, there in enumerate(exists) if there]
    if not missing:
        return found
    shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
    # The names of a transforms.json are paths in the capture; those of a COLMAP model, in its image folder.
    are_paths = all(view.path == root / view.name for view in views if not view.path.is_file())
    folder = root if are_paths else root / images
    message = f"{len(missing)} of {len(views)} images are not in {folder}: {shown}"
    if not found and are_paths:
        raise FileNotFoundError(f"{message}; put them there, or correct file_path in its transforms.json")
    if not found:
        # A user may name the folder of the model, CAPTURE/sparse/0.
        above = next((folder for folder in root.resolve().parents[:2] if (folder / images).is_dir()), None)
        if above is not None and not (root / images).is_dir():
            raise FileNotFoundError(f"{message}; the capture may be the folder above: --data={above}")
        raise FileNotFoundError(
            f"{message}; name their folder, relative to the capture, with --data.images=FOLDER"
        )
    if not allow_missing:
        raise MissingImagesError(f"{message}; put them back, or leave those views out with allow_missing")
    warnings.warn(f"{message}; dropped", stacklevel=3)
    return found


def _mask_folder(root: Path, masks: str | bool | None) -> Path | None:
    if masks is False:
        return None
    folder = root / (masks if isinstance(masks, str) else "masks")
    if folder.is_dir():
        return folder
    if masks is not None:
        raise FileNotFoundError(f"{folder}: no such folder of masks")
    return None


def _check_masks(cameras: Sequence[Camera], folder: Path | None) -> None:
    """Check that the masks belong to the images, so that no mask is ignored without a message."""
    used = {camera.mask_path for camera in cameras if camera.mask_path is not None}
    missing = sorted(str(path) for path in used if not path.is_file())
    if missing:
        raise FileNotFoundError(
            f"{len(missing)} masks are missing (first: {missing[0]}); use --data.masks=false to train without"
        )
    if folder is None:
        return
    files = {path for path in folder.rglob("*") if path.suffix.lower() in _MASK_SUFFIXES}
    unused = sorted(str(path.relative_to(folder)) for path in files - used)
    if files and not used:
        raise ValueError(
            f"none of the {len(files)} masks in {folder} belongs to an image: they are called like "
            f"{unused[0]}, the images like {cameras[0].name}; rename them to NAME.png, or use "
            "--data.masks=false"
        )
    if unused:
        warnings.warn(
            f"{len(unused)} of {len(files)} masks in {folder} belong to no image (first: {unused[0]})",
            stacklevel=3,
        )


def _camera(
    view: SourceView,
    header: ImageHeader,
    offset: Float64,
    downscale: float,
    policy: str,
    exif: str,
    mask_folder: Path | None,
    plans: dict[Lens, Rectification],
) -> Camera:
    orientation = _orientation(view, header, exif)
    width, height = (header.height, header.width) if orientation >= 5 else (header.width, header.height)
    full = (view.lens.width, view.lens.height)
    if not same_shape((width, height), full) or min(width, height) < min(_LEAST_SIDE, *full):
        raise ValueError(
            f"{view.path} is {width} x {height}, which does not fit its camera of {view.lens.width} x "
            f"{view.lens.height}: the image was cropped or turned after the poses were found"
        )
    if max(width, height) > MOST_SIDE:
        raise ValueError(
            f"{view.path} is {width} x {height}: no side may be longer than {MOST_SIDE:,} pixels; put a "
            "smaller copy in its place"
        )
    lens = view.lens.scaled(width, height)
    if lens not in plans:
        try:
            plans[lens] = rectify(lens, policy)
        except ValueError as error:
            raise ValueError(f"the camera of {view.path}: {error}") from error
    plan = plans[lens]
    # Images from images_N are downscaled already; only the rest of the factor is applied while decoding.
    already = max(1.0, view.lens.width / width) if downscale > 1 else 1.0
    left = downscale / already if downscale / already > 1.01 else 1.0
    size = downscaled_size(plan.width, plan.height, left)
    if downscale > 1 and min(size) < _LEAST_SIDE:
        raise ValueError(
            f"downscale {downscale} leaves {size[0]} x {size[1]} pixels of {view.path}, which is {width} x "
            f"{height}: choose a smaller one"
        )
    pose = view.world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ offset
    mask = view.mask_path
    if mask is None and mask_folder is not None:
        mask = find_mask(mask_folder, view.name)
    return Camera(
        name=view.name,
        width=size[0],
        height=size[1],
        K=scaled_matrix(plan.K, (plan.width, plan.height), size),
        world_to_camera=pose,
        image_path=view.path,
        mask_path=mask,
        orientation=orientation,
        rectification=plan,
    )


def _orientation(view: SourceView, header: ImageHeader, exif: str) -> int:
    """Return the orientation to apply: COLMAP ignores the tag, so the camera's shape decides."""
    if header.orientation == 1 or exif == "ignore":
        return 1
    if exif == "apply":
        return header.orientation
    swaps = header.orientation >= 5 and view.lens.width != view.lens.height
    turned = (view.lens.width > view.lens.height) != (header.width > header.height)
    return header.orientation if swaps and turned else 1
