# SPDX-License-Identifier: Apache-2.0
"""One stage of a reconstruction with pycolmap: `python -m blitzgs.sfm.pycolmap_stage JOB`.

A stage has a process of its own, so that Ctrl-C stops compiled code at once and an error in it ends only the
stage. JOB is a JSON file of a `blitzgs.sfm.engine.Job`. COLMAP's messages tell the progress.
"""

from __future__ import annotations

import copy
import json
import sys
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from blitzgs.sfm.engine import LIKE_NAMES, MANY, adopt, camera_of, lack_places, least_model, lens_model

# The standard deviations of a position by GPS in metres, across and up; the second of an altitude that says
# nothing. Drones state altitudes by barometer, which drift between flights.
_ACROSS, _UP, _UNKNOWN = 3.0, 15.0, 1e4
# All of a growing model is adjusted when it has grown by this factor, at most so often, and until the error
# falls by less than this share: COLMAP's own 1.1, 5 and 0 take half as long again for the same poses.
_GROWTH, _ADJUSTMENTS, _TOLERANCE = 1.3, 2, 1e-6
# A model is refined in rounds. The scale of Cauchy's loss is the median miss, in pixels, or at least this;
# after each round, observations that miss by so many times the scale are left out.
_ROUNDS, _ITERATIONS, _LEAST_SCALE, _WRONG = 2, 40, 0.5, 4.0
_POORER = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # special cases of OPENCV


def features(job: dict[str, Any]) -> None:
    """Find the features of the photographs that have none; photographs of one camera share its parameters."""
    photos = Path(job["photos"])

    def look(name: str) -> tuple[str, float | None, float | None]:
        bitmap = pycolmap.Bitmap.read(photos / name, False)
        if bitmap is None:
            return "", None, None
        # Without EXIF, cameras of the same size are told apart by their folders.
        camera = bitmap.exif_camera_model() or f"{bitmap.width}x{bitmap.height} {Path(name).parent}"
        return camera, bitmap.exif_latitude(), bitmap.exif_longitude()

    with ThreadPoolExecutor() as pool:
        seen = dict(zip(job["names"], pool.map(look, job["names"]), strict=True))
    groups: dict[str, list[str]] = defaultdict(list)
    for name, (camera, _, _) in seen.items():
        groups[camera].append(name)
    for names in groups.values():
        options = pycolmap.ImageReaderOptions()
        options.camera_model = lens_model(job["camera_model"], len(names))
        if job["masks"]:
            options.mask_path = job["masks"]
        if (camera_id := camera_of(Path(job["database"]), names)) is not None:
            options.existing_camera_id = camera_id
        pycolmap.extract_features(
            job["database"], photos, names, pycolmap.CameraMode.SINGLE, reader_options=options
        )
    with pycolmap.Database.open(job["database"]) as database:
        # COLMAP leaves out a position without an altitude.
        known = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
        for image in database.read_all_images():
            _, latitude, longitude = seen.get(image.name, ("", None, None))
            prior = known.get(image.image_id)
            if (latitude, longitude) == (0, 0):  # a receiver without a fix
                if prior is not None:
                    prior.position = np.full(3, np.nan)
                    database.update_pose_prior(prior)
                continue
            if latitude is None or longitude is None or (prior is not None and prior.has_position()):
                continue
            added = prior or pycolmap.PosePrior(corr_data_id=image.data_id)
            added.position = np.array([latitude, longitude, 0.0])
            added.coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
            (database.update_pose_prior if prior else database.write_pose_prior)(added)


def pairs(job: dict[str, Any]) -> None:
    """Match features of pairs of photographs, without those that were matched before."""
    with pycolmap.Database.open(job["database"]) as database:
        if job["gps"]:
            _set_priors(database, Path(job["georeference"]), job["use_altitude"])
    if job["pairs"] == "gps":
        # The number of neighbours limits the pairs: the flying height decides on a good distance.
        spatial = pycolmap.SpatialPairingOptions(ignore_z=True, max_distance=1e9)
        pycolmap.match_spatial(job["database"], pairing_options=spatial)
        if lack_places(job["database"], job["names"]):
            by_name = pycolmap.SequentialPairingOptions(overlap=LIKE_NAMES, quadratic_overlap=False)
            pycolmap.match_sequential(job["database"], pairing_options=by_name)
    elif job["pairs"] == "sequence":
        sequence = pycolmap.SequentialPairingOptions(overlap=20, quadratic_overlap=True)
        pycolmap.match_sequential(job["database"], pairing_options=sequence)
    else:
        # Blocks that are small enough to show progress.
        block = max(2, min(50, len(job["names"]) // 5))
        every = pycolmap.ExhaustivePairingOptions(block_size=block)
        pycolmap.match_exhaustive(job["database"], pairing_options=every)


def _set_priors(database: Any, georeference: Path, use_altitude: bool) -> None:
    """Replace positions by GPS by metres east, north and up of the first one, with their uncertainty."""
    names = {image.image_id: image.name for image in database.read_all_images()}
    # After an interruption only some are left to be replaced, and the origin is chosen.
    left = [prior for prior in database.read_all_pose_priors() if prior.coordinate_system.name == "WGS84"]
    left.sort(key=lambda prior: names[prior.corr_data_id.id])
    if priors := [prior for prior in left if prior.has_position()]:
        _move_to_metres(priors, georeference, use_altitude)
    for prior in left:
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        database.update_pose_prior(prior)


def _move_to_metres(priors: list[Any], georeference: Path, use_altitude: bool) -> None:
    degrees = np.stack([prior.position for prior in priors])
    if not use_altitude:
        degrees[:, 2] = 0.0
    if not georeference.exists():
        origin = dict(zip(("latitude", "longitude", "altitude"), degrees[0].tolist(), strict=True))
        georeference.write_text(json.dumps({"axes": "metres east, north and up of the origin", **origin}))
    place = json.loads(georeference.read_text())
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(
        degrees, place["latitude"], place["longitude"], place["altitude"]
    )
    variance = np.diag([_ACROSS**2, _ACROSS**2, (_UP if use_altitude else _UNKNOWN) ** 2])
    for prior, position in zip(priors, metres, strict=True):
        prior.position, prior.position_covariance = position, variance


def cameras(job: dict[str, Any]) -> None:
    """Find poses, lenses and points from the matches; writes one model for each connected part."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = least_model(len(job["names"]))
    options.ba_use_gpu = gpu = pycolmap.has_cuda
    options.use_prior_position = options.use_robust_loss_on_prior_position = job["gps"]
    if job["mapper"] == "incremental":
        growing = copy.deepcopy(options)
        growing.ba_global_frames_ratio = growing.ba_global_points_ratio = _GROWTH
        growing.ba_global_max_refinements, growing.ba_global_function_tolerance = _ADJUSTMENTS, _TOLERANCE
        models = pycolmap.incremental_mapping(job["database"], job["photos"], job["models"], growing)
    else:
        models = _all_at_once(job, gpu)
    for number in models:
        _centre_lenses(job["database"], Path(job["models"]) / str(number), options)


def _all_at_once(job: dict[str, Any], gpu: bool) -> dict[int, Any]:
    with pycolmap.Database.open(job["database"]) as database:
        guessed = not all(camera.has_prior_focal_length for camera in database.read_all_cameras())
        known = {
            database.read_image(prior.corr_data_id.id).name: prior.position
            for prior in database.read_all_pose_priors()
            if job["gps"] and prior.has_position()
        }
    if guessed:
        pycolmap.calibrate_view_graph(job["database"])
    wide = pycolmap.GlobalPipelineOptions()
    wide.mapper.global_positioning.use_gpu = wide.mapper.bundle_adjustment.ceres.use_gpu = gpu
    models = pycolmap.global_mapping(job["database"], job["photos"], job["models"], wide)
    for number, model in models.items():
        # The global mapper knows no priors: its result is moved, turned and scaled to them.
        names = [image.name for image in model.images.values() if image.name in known]
        if len(names) >= 3:
            places, robust = np.stack([known[name] for name in names]), pycolmap.RANSACOptions()
            robust.max_error = 5 * _ACROSS
            moved = pycolmap.align_reconstruction_to_locations(model, names, places, 3, robust)
            if moved is not None:
                model.transform(moved)
            model.write(Path(job["models"]) / str(number))
    return dict(models)


def _centre_lenses(database: str, folder: Path, options: Any) -> None:
    """Find the principal points as well, and all else once more.

    The mappers leave them in the middle of the image, as a few photographs do not tell them from a turn of
    the camera. Many do, and a lens whose axis is 35 pixels off costs half of the exactness of the poses.
    """
    model = pycolmap.Reconstruction(folder)
    counts = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    options.constant_cameras = {number for number in model.cameras if counts[number] < MANY}
    if options.constant_cameras == set(model.cameras):
        return
    options.ba_refine_principal_point = True
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.get_mapper(),
        options.get_global_bundle_adjustment(),
        options.get_triangulation(),
        normalize_reconstruction=not options.use_prior_position,
    )
    mapper.end_reconstruction(False)
    (refined := folder.with_name("refined")).mkdir(exist_ok=True)
    model.write(refined)
    adopt(refined, folder)


def refine(job: dict[str, Any]) -> None:
    """Find lenses, poses and points of a model once more, from the pixels at which its points were seen.

    Lenses without tangential distortion get one if the error falls by a tenth more: their photographs must
    then be undistorted, which smooths them.
    """
    model = pycolmap.Reconstruction(job["model"])
    posed = [image for image in model.images.values() if image.has_pose]
    before = np.stack([image.projection_center() for image in posed])
    model.normalize()  # far from the origin, turns and shifts of a camera are hardly told apart
    counts = Counter(image.camera_id for image in posed)
    few = [number for number in model.cameras if counts[number] < MANY]
    scale = max(job["miss"], _LEAST_SCALE)
    _adjust(model, few, scale, 0)
    richer = copy.deepcopy(model)
    for number, camera in richer.cameras.items():
        if number not in few and camera.model.name in _POORER:
            radial = [*camera.params[list(camera.extra_params_idxs())], 0.0, 0.0][:2]
            lengths = camera.params[list(camera.focal_length_idxs())]
            centre = camera.params[list(camera.principal_point_idxs())]
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [lengths[0], lengths[-1], *centre, *radial, 0.0, 0.0]
    _adjust(richer, few, scale, _ROUNDS)
    if richer.compute_mean_reprojection_error() < 0.9 * model.compute_mean_reprojection_error():
        model = richer
    now = np.stack([model.images[image.image_id].projection_center() for image in posed])
    moved = pycolmap.estimate_sim3d(now, before)
    if moved is not None:
        model.transform(moved)
    model.write(job["refined"])


def _adjust(model: Any, few: list[int], scale: float, done: int) -> None:
    """Adjust all but the lenses of the cameras `few`, and leave out what misses by far; tell the rounds."""
    wanted = pycolmap.BundleAdjustmentConfig()
    for image in model.images.values():
        if image.has_pose:
            wanted.add_image(image.image_id)
    wanted.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for number in few:
        wanted.set_constant_cam_intrinsics(number)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale
    options.ceres.use_gpu = pycolmap.has_cuda
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    for number in range(done, done + _ROUNDS):
        pycolmap.create_default_bundle_adjuster(options, wanted, model).solve()
        pycolmap.ObservationManager(model).filter_all_points3D(_WRONG * scale, 0.0)
        print(f"[{number + 1}/{2 * _ROUNDS}]", flush=True)


if __name__ == "__main__":
    work = json.loads(Path(sys.argv[1]).read_text())
    {"features": features, "pairs": pairs, "cameras": cameras, "refine": refine}[work["stage"]](work)
