# SPDX-License-Identifier: Apache-2.0
"""The sparse model of a generated capture, in COLMAP's terms."""

from __future__ import annotations

import numpy as np

from blitzgs.capture.colmap import ColmapCamera, ColmapImages, ColmapModel, ColmapPoints, rotation_to_quat
from blitzgs_synth.arrays import Doubles, Ints
from blitzgs_synth.flight import View
from blitzgs_synth.tracks import Cloud


def colmap_model(views: list[View], cloud: Cloud) -> ColmapModel:
    """Return one PINHOLE camera, the poses with their observations, and the points with their tracks.

    An image lists its matched observations first, by point, and then the corners without a match.
    """
    first = views[0]
    params = np.array([first.focal, first.focal, first.width / 2, first.height / 2])
    camera = ColmapCamera(1, "PINHOLE", first.width, first.height, params)

    matched = np.bincount(cloud.views, minlength=len(views))
    starts = np.concatenate([[0], np.cumsum(matched)])
    pixels, points = [], []
    for i, loose in enumerate(cloud.loose):
        pixels += [cloud.pixels[starts[i] : starts[i + 1]], loose]
        points += [cloud.points[starts[i] : starts[i + 1]] + 1, np.full(len(loose), -1)]
    totals = matched + [len(loose) for loose in cloud.loose]
    image_ids = np.arange(1, len(views) + 1, dtype=np.uint32)
    images = ColmapImages(
        ids=image_ids,
        camera_ids=np.ones(len(views), np.uint32),
        quats=np.stack([rotation_to_quat(v.rotation) for v in views]),
        translations=np.stack([v.translation for v in views]),
        names=[v.name for v in views],
        point2d_offsets=np.concatenate([[0], np.cumsum(totals)]).astype(np.uint64),
        points2d=np.concatenate(pixels),
        point3d_ids=np.concatenate(points).astype(np.int64),
    )

    by_point = np.argsort(cloud.points, kind="stable")
    in_image = np.arange(len(cloud.views)) - starts[cloud.views]
    lengths = np.bincount(cloud.points, minlength=len(cloud.positions))
    return ColmapModel(
        [camera],
        images,
        ColmapPoints(
            ids=np.arange(1, len(cloud.positions) + 1, dtype=np.int64),
            positions=cloud.positions,
            colors=cloud.colors,
            errors=_mean_errors(views, cloud, starts, lengths),
            track_offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.uint64),
            track_image_ids=image_ids[cloud.views[by_point]],
            track_point2d_ids=in_image[by_point].astype(np.uint32),
        ),
    )


def _mean_errors(views: list[View], cloud: Cloud, starts: Ints, lengths: Ints) -> Doubles:
    """Return the mean reprojection error of each point in pixels, [M]."""
    errors = np.empty(len(cloud.views))
    for i, view in enumerate(views):
        rows = slice(starts[i], starts[i + 1])
        projected, _ = view.project(cloud.positions[cloud.points[rows]])
        errors[rows] = np.linalg.norm(projected - cloud.pixels[rows], axis=1)
    mean: Doubles = np.bincount(cloud.points, errors, len(cloud.positions)) / np.maximum(lengths, 1)
    return mean
