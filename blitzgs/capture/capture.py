# SPDX-License-Identifier: Apache-2.0
"""A capture: posed images and a point cloud, ready to train on.

`load_capture` reads a COLMAP model or transforms.json, finds every image file, decides how each becomes a
pinhole image of the wanted size, re-centres the world in float64 and splits the views. No image is decoded.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import (
    MAX_SIDE,
    Camera,
    Float64,
    SourceView,
    camera_centres,
    downscaled_size,
    rectify,
    same_shape,
    scaled_matrix,
)
from blitzgs.capture.image_files import ImageHeader, in_threads, read_header
from blitzgs.capture.layouts import About, read_layout
from blitzgs.capture.lengths import blind_views, find_apart, measured_extent, near_plane, nearest_depths
from blitzgs.capture.masks import FindDamage, check_mask_sizes, check_masks, damaged, find_masks
from blitzgs.capture.names import MissingImagesError as MissingImagesError
from blitzgs.capture.names import check_inside, existing, relative_to
from blitzgs.capture.projects.find import named_project
from blitzgs.capture.splits import split_views, without_unused
from blitzgs.capture.usable import finite_points, points_at_random, usable_views, without_strays
from blitzgs.config.ranges import CHOICES
from blitzgs.util.errors import check_number, located, warn

# In pixels. SSIM compares windows of 11 pixels, and a much smaller image shows too little to train on.
_LEAST_SIDE = 8


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
    """Near plane (`lengths.near_plane`) by the depths of the points that training views see, world units."""
    apart: list[int]
    """Cameras that are so far from the others that no length is measured by them."""
    about: About
    """What was read and what was left out."""


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
    inside_only: bool = False,
    find_damage: FindDamage = damaged,
) -> Capture:
    """Load a capture without decoding its images.

    Args:
        path: folder with a COLMAP sparse model (sparse/0, sparse, ...; or train/ and val/ folders that have
            one each), transforms.json / transforms_train.json, or another program's project; or the file of
            such a project.
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
        allow_missing: drop views whose image is not on disk, or whose image or mask is damaged, with a
            warning, instead of failing; all files are read for that. The world's
            origin, the extent and the split are still computed from all views with a pose.
        sparse: which of several COLMAP models is read: the "largest", "all" of them, which must have the same
            world coordinates, or a folder such as "sparse/1", relative to `path`.
        stray_cameras: "drop" the cameras that lie apart from all others and hardly show a point, or "keep"
            them; no length is measured by them either way.
        inside_only: refuse names that lead outside the capture, for captures that somebody else has made;
            otherwise they are read with a warning.
        find_damage: see `masks.damaged`; called with `allow_missing` only. The ranks of a job divide
            the files among them.

    Raises:
        FileNotFoundError: the folder has no capture, or images are missing on disk (`MissingImagesError`).
        ValueError: a file is damaged, or sizes, poses or options are invalid.
    """
    root, project = named_project(Path(path), images) if Path(path).is_file() else (Path(path), None)
    _check_options(downscale, exif, undistort, stray_cameras)
    views, points, about = read_layout(root, images, downscale, sparse, project)
    if not views:
        raise ValueError(f"{root}: its COLMAP model or transforms.json lists no images")
    listed = len(views)
    views = without_unused(views, split)
    unused = listed - len(views)
    views = usable_views(views)
    points = finite_points(points)
    # Use all views, so that a photograph that is lost later changes neither the origin nor the split.
    train, test, why = split_views(views, root, split)
    apart, strays = find_apart(views, points.positions)
    centres = camera_centres(np.stack([view.world_to_camera for view in views]))
    offset = centres[~apart].mean(axis=0)
    train_centres = centres[[i for i in train if not apart[i]] or train] - offset
    # The folders that the options name may be anywhere.
    folders = [root / images, *([root / masks] if isinstance(masks, str) else [])]
    named = [path for view in views for path in (view.path, view.mask_path)] + [points.path]
    check_inside([path for path in named if path is not None], root, folders, inside_only)
    held_out, far = ({views[index].name for index in some} for some in (test, np.flatnonzero(apart)))
    posed, views = len(views), existing(views, root, images, allow_missing)
    missing = posed - len(views)
    views, damage = _with_masks(views, root, masks, find_damage if allow_missing else None)
    views = without_strays(views, strays, posed, keep=stray_cameras == "keep")
    train, test = ([i for i, v in enumerate(views) if (v.name in held_out) is part] for part in (False, True))
    apart_left = [index for index, view in enumerate(views) if view.name in far]
    if not train:
        raise MissingImagesError(f"{root}: no image of a training view is on disk and whole")
    headers = _headers(views)
    cameras = [
        _camera(view, header, offset, downscale, undistort, exif)
        for view, header in zip(views, headers, strict=True)
    ]
    check_mask_sizes(cameras)
    has_points = len(points.positions) > 0
    if not has_points:
        points = points_at_random(root, [c for i, c in enumerate(cameras) if i not in apart_left], offset)
    points.positions = points.positions - offset
    extent = measured_extent(train_centres, points.positions)
    nearest = nearest_depths(cameras, points.positions)
    blind = blind_views(nearest, cameras, points.positions)
    near = near_plane(nearest[[i for i in train if has_points and i not in apart_left]], extent)
    with_alpha = sum(header.has_alpha for header in headers)
    about = replace(
        about,
        split=why,
        strays=strays,
        unused=unused,
        missing=missing,
        blind=blind,
        random_points=not has_points,
        points_from="" if points.path is None else str(relative_to(root, points.path)),
        colors_from=points.colors_from,
        with_alpha=with_alpha,
        extra_bands=sum(header.extra_bands > 0 for header in headers),
        damaged=len(damage),
    )
    return Capture(
        root,
        cameras,
        points.positions,
        points.colors,
        points.track_lengths,
        points.errors,
        offset,
        train,
        test,
        extent,
        has_alpha=with_alpha > 0,
        near=near,
        apart=apart_left,
        about=about,
    )


def _check_options(downscale: float, exif: str, undistort: str, stray_cameras: str) -> None:
    check_number("downscale", downscale)
    if not downscale >= 1:  # NaN too
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    for option, value in (("exif", exif), ("undistort", undistort), ("stray_cameras", stray_cameras)):
        if value not in (allowed := CHOICES[f"data.{option}"]):
            raise ValueError(f"{option} must be one of {', '.join(allowed)}, got {value!r}")


def _headers(views: list[SourceView]) -> list[ImageHeader]:
    """Read the headers of the photographs and check their masks; warn of unused or misleading bands."""
    headers = in_threads(read_header, [view.path for view in views])
    check_masks([view.mask_path for view in views])
    extra_bands = [view.name for view, header in zip(views, headers, strict=True) if header.extra_bands]
    if extra_bands:
        warn(
            f"{len(extra_bands)} of {len(views)} photographs have a further band that their file does not "
            f"call alpha (first: {extra_bands[0]}), near infrared for example; it is not used"
        )
    grey = [view.name for view, header in zip(views, headers, strict=True) if header.is_grey]
    if 0 < len(grey) < len(views):
        warn(
            f"{len(grey)} of {len(views)} photographs are grey (first: {grey[0]}), and the model will be "
            "grey in part: leave out the bands of a multispectral camera"
        )
    return headers


def _with_masks(
    views: list[SourceView], root: Path, masks: str | bool | None, find_damage: FindDamage | None
) -> tuple[list[SourceView], dict[int, str]]:
    """Return the views that are whole, with their masks, and what is wrong with the others."""
    found = find_masks(root, masks, [view.name for view in views], [view.mask_path for view in views])
    views = [replace(view, mask_path=mask) for view, mask in zip(views, found, strict=True)]
    if find_damage is None:
        return views, {}
    if damage := find_damage([(view.path, view.mask_path) for view in views]):
        warn(
            f"{len(damage)} of {len(views)} images or their masks are damaged; dropped (first: "
            f"{next(iter(damage.values()))})"
        )
    return [view for index, view in enumerate(views) if index not in damage], damage


def _camera(
    view: SourceView, header: ImageHeader, offset: Float64, downscale: float, policy: str, exif: str
) -> Camera:
    orientation = _orientation(view, header, exif)
    width, height = (header.height, header.width) if orientation >= 5 else (header.width, header.height)
    full = (view.lens.width, view.lens.height)
    if not same_shape((width, height), full) or min(width, height) < min(_LEAST_SIDE, *full):
        raise ValueError(
            f"{view.path} is {width} x {height}, which does not fit its camera of {view.lens.width} x "
            f"{view.lens.height}: the image was cropped or turned after the poses were found"
        )
    if max(width, height) > MAX_SIDE:
        raise ValueError(
            f"{view.path} is {width} x {height}: no side may be longer than {MAX_SIDE:,} pixels; put a "
            "smaller copy in its place"
        )
    with located(f"the camera of {view.path}"):
        plan = rectify(view.lens.scaled(width, height), policy)
    # Images from images_N are downscaled already; only the rest of the factor is applied while decoding.
    already = max(1.0, view.lens.width / width) if downscale > 1 else 1.0
    left = downscale / already if downscale / already > 1.01 else 1.0
    size = downscaled_size(plan.width, plan.height, left)
    if downscale > 1 and min(size) < _LEAST_SIDE:
        raise ValueError(
            f"downscale {downscale} leaves {size[0]} x {size[1]} pixels of {view.path}, which is {width} x "
            f"{height}: choose a smaller one"
        )
    return Camera(
        name=view.name,
        width=size[0],
        height=size[1],
        K=scaled_matrix(plan.K, (plan.width, plan.height), size),
        world_to_camera=view.pose_from(offset),
        image_path=view.path,
        mask_path=view.mask_path,
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


def capture_fingerprint(capture: Capture) -> str:
    """Return a digest of the cameras, the points and the split."""
    digest = hashlib.sha256()
    for camera in capture.cameras:
        digest.update(os.fsencode(f"{camera.name} {camera.width} {camera.height}"))
        digest.update(camera.K.tobytes() + camera.world_to_camera.tobytes())
    digest.update(np.ascontiguousarray(capture.points).data)  # without a copy of them
    digest.update(np.ascontiguousarray(capture.colors).data)
    digest.update(repr((capture.train, capture.test)).encode())
    return digest.hexdigest()[:12]


def train_views_fingerprint(capture: Capture) -> str:
    """Return a digest of the names of the training views, in their order."""
    names = [capture.cameras[index].name for index in capture.train]
    return hashlib.sha256(repr(names).encode()).hexdigest()[:12]
