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
    sees_any,
)
from blitzgs.capture.files import find_mask
from blitzgs.capture.image_files import ImageHeader, read_header
from blitzgs.capture.layouts import SourcePoints, SourceView, read_layout
from blitzgs.capture.lens import Lens
from blitzgs.capture.splits import split_views
from blitzgs.capture.undistort import Rectification, rectify
from blitzgs.util.arguments import check_number

# In pixels. SSIM compares windows of 11 pixels, and a much smaller image shows too little to train on.
_LEAST_SIDE = 8
_HEADER_THREADS = 16
_SAMPLED_POINTS = 2000
_MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".gif", ".webp")
# Cameras whose distance is below this share of the points' distance count as being in one place: the parallax
# between them is far below a pixel.
_LEAST_SPREAD = 1e-6
# Coordinates from here on are damage; the squares of smaller ones are finite.
_FARTHEST = 1e100


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
    """INRIA's: 1.1 x the largest distance of a training camera from their mean centre, in world units."""
    has_alpha: bool
    """Whether some image has an alpha channel; `ImageStore` composites it over its background."""


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
    ):
        if value not in allowed:
            raise ValueError(f"{option} must be one of {', '.join(allowed)}, got {value!r}")
    views, points = read_layout(root, images, downscale)
    if not views:
        raise ValueError(f"{root}: its COLMAP model or transforms.json lists no images")
    views = sorted(_with_finite_poses(views), key=lambda view: view.name)
    # Use all views, so that a photograph that is lost later changes neither the origin nor the split.
    centres = camera_centres(np.stack([view.world_to_camera for view in views]))
    offset = centres.mean(axis=0)
    train, test = _split(views, root, split)
    train_centres = centres[train] - offset
    kept = _existing(views, root, images, allow_missing)
    place = {index: position for position, index in enumerate(kept)}
    views = [views[index] for index in kept]
    train, test = ([place[index] for index in part if index in place] for part in (train, test))
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
    points = _finite_points(points)
    if len(points.positions) == 0:
        points = _random_points(root, cameras, offset)
    points.positions = points.positions - offset
    _warn_of_blind_views(cameras, points.positions)
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
        extent=_extent(train_centres, points.positions),
        has_alpha=any(header.has_alpha for header in headers),
    )


def _warn_of_blind_views(cameras: list[Camera], points: Float64) -> None:
    """Warn if most views see no point: poses and points may have different worlds or axis conventions."""
    sample = points[:: max(1, len(points) // _SAMPLED_POINTS)]
    blind = [camera.name for camera in cameras if not sees_any(camera, sample)]
    if 2 * len(blind) > len(cameras):
        warnings.warn(
            f"{len(blind)} of {len(cameras)} views (first: {blind[0]}) see none of the points: do the poses "
            "and the points belong together, and do the cameras look along +z?",
            stacklevel=3,
        )


def _is_usable(coordinates: Float64) -> npt.NDArray[np.bool_]:
    return np.asarray(np.abs(coordinates) < _FARTHEST)  # false for NaN


def _with_finite_poses(views: list[SourceView]) -> list[SourceView]:
    finite = [view for view in views if _is_usable(view.world_to_camera).all()]
    if not finite:
        raise ValueError(f"none of the {len(views)} views has a pose (a finite rotation and translation)")
    if len(finite) < len(views):
        first = next(v.name for v in views if not _is_usable(v.world_to_camera).all())
        warnings.warn(
            f"{len(views) - len(finite)} of {len(views)} views have no finite pose and were dropped "
            f"(first: {first})",
            stacklevel=3,
        )
    return finite


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


def _split(views: Sequence[SourceView], root: Path, spec: int | str | Path) -> tuple[list[int], list[int]]:
    if spec == "auto" and any(view.is_test is not None for view in views):
        test = [i for i, view in enumerate(views) if view.is_test]
        train = [i for i, view in enumerate(views) if not view.is_test]
        if not train:
            raise ValueError(f"{root}: the files hold out every view: no training view is left")
        return train, test
    return split_views([v.name for v in views], [v.path for v in views], root, spec)


def _finite_points(points: SourcePoints) -> SourcePoints:
    finite: npt.NDArray[np.bool_] = np.asarray(_is_usable(points.positions).all(axis=1))
    if finite.all():
        return points
    warnings.warn(
        f"{int((~finite).sum())} of {finite.size} points are not finite and were dropped", stacklevel=3
    )
    return SourcePoints(
        points.positions[finite],
        points.colors[finite],
        points.track_lengths[finite] if points.track_lengths is not None else None,
        points.errors[finite] if points.errors is not None else None,
    )


def _random_points(
    root: Path, cameras: Sequence[Camera], offset: Float64, count: int = 100_000
) -> SourcePoints:
    """Return uniform points of random colours in the region that the cameras look at."""
    warnings.warn(
        f"{root}: the capture has no points; {count:,} random ones take their place. Points of the "
        "reconstruction give a better start",
        stacklevel=3,
    )
    poses = np.stack([camera.world_to_camera for camera in cameras])
    centres, axes = camera_centres(poses), poses[:, 2, :3]
    # The point nearest to all optical axes by least squares; the tiny term keeps parallel axes solvable.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    target = np.linalg.solve(
        across.sum(axis=0) + 1e-6 * np.eye(3),
        np.einsum("nij,nj->i", across, centres) + 1e-6 * centres.mean(axis=0),
    )
    half = 0.35 * float(np.linalg.norm(centres - target, axis=1).mean())
    if half <= _LEAST_SPREAD * (1 + float(np.abs(offset).max())):
        raise ValueError(
            f"{root}: the capture has no points and all its cameras are in one place, so the position of the "
            "scene is unknown: add points to the capture"
        )
    random = np.random.default_rng(0)
    positions = target + offset + random.uniform(-half, half, (count, 3))
    return SourcePoints(positions, random.integers(0, 256, (count, 3), dtype=np.uint8))


def _extent(centres: Float64, points: Float64) -> float:
    extent = 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    distance = float(np.median(np.linalg.norm(points - centres[0], axis=1)))
    if extent > _LEAST_SPREAD * distance:
        return extent
    extent = distance
    warnings.warn(
        f"all training cameras are in one place: extent is the points' median distance, {extent:g}",
        stacklevel=3,
    )
    return extent or 1.0
