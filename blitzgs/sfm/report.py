# SPDX-License-Identifier: Apache-2.0
"""Checks a reconstruction: errors, stray cameras, photographs without a pose and why; draws a plan."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from blitzgs.capture.cameras import SourceView, camera_centres
from blitzgs.capture.colmap import ColmapModel, Float64, count_images, read_model, world_to_camera
from blitzgs.capture.image_files import UInt8
from blitzgs.capture.lengths import find_apart
from blitzgs.capture.lens import lenses_of
from blitzgs.sfm.engine import Found, Job, read_found, read_positions
from blitzgs.sfm.photographs import Photographs
from blitzgs.util.output import write_file

# A photograph with fewer points is held weakly. One whose error is so many times the median is doubtful.
_FEW_POINTS, _FEW_FEATURES, _DOUBTFUL = 50, 100, 3.0
# A warning is given if a smaller share has a pose, or the mean error is larger, in pixels.
_MOST, _LARGE = 0.9, 2.0
_APART = "that nothing connects with the others"
_SIDE, _BAR, _LINE, _NAMED = 900, 420, 18, 40


@dataclass(frozen=True)
class Reconstruction:
    """What was reconstructed."""

    capture: Path  # its folder
    errors: dict[str, float]  # mean reprojection error of each photograph with a pose, in pixels, by name
    points: dict[str, int]  # how many points each of them observes
    unregistered: dict[str, str]  # why each other photograph has no pose
    doubtful: dict[str, str]  # photographs with a pose that may be wrong, and why
    total: int  # number of points
    # Which pairs were matched, by which mapper, and what positions by GPS were used for.
    decisions: dict[str, str]
    # Medians of the distances to GPS, across and up, in metres; None where unused.
    gps_residuals: tuple[float, float | None] | None = None

    @property
    def error(self) -> float:
        """Mean reprojection error of all observations, in pixels."""
        return float(np.average(list(self.errors.values()), weights=list(self.points.values())))

    def lines(self) -> list[str]:
        """Return the summary for the user."""
        found, count = len(self.errors), len(self.errors) + len(self.unregistered)
        observed = float(np.median(list(self.points.values())))
        lines = [
            f"{'photographs:':15}{found:,} of {count:,} have a pose ({', '.join(self.decisions.values())})",
            f"{'points:':15}{self.total:,}; a photograph observes {observed:,.0f} (median)",
            f"{'error:':15}{self.error:.2f} pixels, {max(self.errors.values()):.2f} in the worst photograph",
        ]
        if self.gps_residuals is not None:
            across, up = self.gps_residuals
            height = "altitudes not used" if up is None else f"{up:.1f} m up"
            lines.append(f"{'GPS:':15}median distance {across:.1f} m across, {height}")
        for title, reasons in (("no pose", self.unregistered), ("doubtful", self.doubtful)):
            lines += [f"{title + ':':15}{name}: {why}" for name, why in list(reasons.items())[:_NAMED]]
            if len(reasons) > _NAMED:
                rest = len(reasons) - _NAMED
                lines.append(f"{'':15}and {rest} others, all in {self.capture / 'sfm/report.json'}")
        if found < _MOST * count:
            pairs = "" if "exhaustive" in self.decisions["pairs"] else " or --pairs exhaustive (slow)"
            apart = any(_APART in why for why in self.unregistered.values())
            between = "photographs from in between would connect them; " if apart else ""
            remedy = f"{between}another --camera-model{pairs} may find more"
            lines.append(f"warning: {count - found} of {count} photographs have no pose; {remedy}")
        if not self.error < _LARGE:
            lines.append(f"warning: {self.error:.1f} pixels are much: check lens, sharpness and masks")
        return lines


def examine(
    capture: Path, work: Path, photographs: Photographs, job: Job, models: Sequence[Path]
) -> Reconstruction:
    """Check the largest of several models, and write report.json and cameras.png into the folder `work`."""
    model = read_model(models[0], points2d=True)
    lenses = lenses_of(model.cameras)
    poses, names = world_to_camera(model.images), model.images.names
    views = [
        SourceView(name, photographs.folder / name, None, lenses[camera], pose)
        for name, camera, pose in zip(names, model.images.camera_ids.tolist(), poses, strict=True)
    ]
    seen = {name: missed[~np.isnan(missed)] for name, missed in distances(model).items()}
    points = {name: len(missed) for name, missed in seen.items()}
    errors = {name: float(missed.mean()) if len(missed) else 0.0 for name, missed in seen.items()}
    doubtful = {
        s.name: f"lies at {s.distance:.6g} from the middle, the others within {s.others:.6g}"
        for s in find_apart(views, model.points.positions)[1]
    }
    usual = float(np.median(list(errors.values())))
    for name, error in errors.items():
        if not error <= _DOUBTFUL * usual:
            doubtful.setdefault(name, f"error of {error:.2f} pixels, {error / usual:.1f} times the median")
        elif points[name] < _FEW_POINTS:
            doubtful.setdefault(name, f"held by {points[name]} points only")
    counts, priors = read_found(Path(job.database)), read_positions(Path(job.database)) if job.gps else {}
    others = {name: count_images(path) for path in models[1:] for name in read_model(path).images.names}
    unregistered = dict(photographs.damage)
    for name in photographs.names:
        if name not in errors:
            unregistered[name] = _reason(counts.get(name, Found()), others.get(name, 0))
    used = "without GPS" if not job.gps else "GPS" if job.use_altitude else "GPS without its altitudes"
    decisions = {"pairs": f"pairs: {job.pairs}", "mapper": f"mapper: {job.mapper}", "gps": used}
    centres = dict(zip(names, camera_centres(poses), strict=True))
    residuals = None
    if both := [centres[name] - place for name, place in priors.items() if name in centres]:
        away = np.array(both)
        up = float(np.median(np.abs(away[:, 2]))) if job.use_altitude else None
        residuals = (float(np.median(np.hypot(away[:, 0], away[:, 1]))), up)
    found = Reconstruction(
        capture, errors, points, unregistered, doubtful, len(model.points.ids), decisions, residuals
    )
    lost = {name: priors[name] for name in unregistered if name in priors}
    plan = draw_plan(found, poses, model.points.positions, model.points.colors, lost)
    write_file(work / "cameras.png", bytes(cv2.imencode(".png", plan)[1]))
    figures = {name: {"error": errors[name], "points": points[name]} for name in sorted(errors)}
    content = {"photographs": figures, "error": found.error, "points": found.total, **decisions}
    content |= {"no_pose": unregistered, "doubtful": doubtful, "gps_residuals": residuals}
    write_file(work / "report.json", json.dumps(content, indent=1))
    return found


def misses(model: ColmapModel) -> Float64:
    """Return from each observation to its point's image, in pixels [O, 2].

    NaN: it has no point, or the lens does not see the point.
    """
    lenses = lenses_of(model.cameras)
    order = np.argsort(model.points.ids)
    ids, positions = model.points.ids[order], model.points.positions[order]
    offsets, found = model.images.point2d_offsets.tolist(), np.full((len(model.images.points2d), 2), np.nan)
    has_point = np.isin(model.images.point3d_ids, ids)
    rows = zip(offsets, offsets[1:], model.images.camera_ids.tolist(), strict=False)
    for (begin, end, camera), pose in zip(rows, world_to_camera(model.images), strict=True):
        at = begin + np.flatnonzero(has_point[begin:end])
        world = positions[np.searchsorted(ids, model.images.point3d_ids[at])]
        x, y, depth = pose[:3, :3] @ world.T + pose[:3, 3:]
        pixels = np.stack(lenses[camera].project(x / depth, y / depth), axis=1)
        found[at] = pixels - model.images.points2d[at]
    return found


def distances(model: ColmapModel) -> dict[str, Float64]:
    """Return the lengths of each photograph's misses, by its name."""
    lengths = np.linalg.norm(misses(model), axis=1)
    parts = np.split(lengths, model.images.point2d_offsets[1:-1].tolist())
    return dict(zip(model.images.names, parts, strict=True))


def _reason(found: Found, part: int) -> str:
    """Return why a photograph that is not damaged has no pose; `part` is the size of its own model."""
    if found.features < _FEW_FEATURES:
        return f"{found.features} features: blurred, dark, masked, or without texture"
    if part:
        return f"belongs to {part} photographs {_APART}"
    if not found.neighbours:
        return f"none of its {found.features:,} features was found in another photograph: it has no overlap"
    return (
        f"{found.matches:,} matches with {found.neighbours} photographs are too few, or contradict the others"
    )


def draw_plan(
    found: Reconstruction, poses: Float64, points: Float64, colors: UInt8, lost: Mapping[str, Float64]
) -> UInt8:
    """Draw points and cameras from above, and list the photographs without a pose; BGR [H, W, 3].

    "Above" is the side of the points' plane on which the cameras are. Cameras are coloured by their error,
    blue to red, doubtful ones crossed out; `lost` are places of photographs without a pose, drawn as squares.
    """
    centres = camera_centres(poses)
    middle = np.median(points, axis=0) if len(points) else centres.mean(axis=0)
    sample = slice(None, None, max(1, len(points) // 50_000))
    cloud = points[sample] if len(points) else centres
    near = np.linalg.norm(cloud - middle, axis=1)
    spread = cloud[near <= np.quantile(near, 0.9)] - middle
    # With GPS the world has its axes; else the points' plane is that of their two largest spreads.
    axes = np.eye(3) if found.gps_residuals else np.linalg.eigh(spread.T @ spread)[1].T[::-1]
    if (centres - middle).mean(axis=0) @ np.cross(axes[0], axes[1]) < 0:
        axes = axes[[1, 0, 2]]
    places = np.array(list(lost.values())).reshape(-1, 3)
    shown = np.concatenate([centres, places, cloud[near <= np.quantile(near, 0.95)]]) @ axes[:2].T
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = (_SIDE - 80) / max(float((high - low).max()), 1e-12)

    def place(world: Float64) -> npt.NDArray[np.int64]:
        flat = (world @ axes[:2].T - (low + high) / 2) * scale
        return np.stack([_SIDE / 2 + flat[:, 0], _SIDE / 2 - flat[:, 1]], axis=1).round().astype(np.int64)

    canvas = np.full((_SIDE, _SIDE + _BAR, 3), 255, dtype=np.uint8)
    at = place(points[sample])
    inside = ((at >= 0) & (at < _SIDE - 1)).all(axis=1)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        canvas[at[inside, 1] + down, at[inside, 0] + right] = colors[sample][inside][:, ::-1]
    errors = np.array(list(found.errors.values()))
    share = np.clip(errors / (2 * np.median(errors)), 0, 1)
    shades = cv2.applyColorMap((share * 255).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0].tolist()
    for name, (x, y), shade in zip(found.errors, place(centres).tolist(), shades, strict=True):
        cv2.circle(canvas, (x, y), 5, shade, -1, cv2.LINE_AA)
        if name in found.doubtful:
            cv2.drawMarker(canvas, (x, y), (0, 0, 255), cv2.MARKER_TILTED_CROSS, 18, 2)
    for x, y in place(places).tolist():
        cv2.rectangle(canvas, (x - 5, y - 5), (x + 5, y + 5), (0, 0, 0), 1)
    texts = [f"{len(found.errors)} of {len(found.errors) + len(found.unregistered)} photographs have a pose"]
    texts += [f"mean error {found.error:.2f} pixels (blue 0, red {2 * np.median(errors):.2f} or more)", ""]
    texts += [f"no pose: {name}: {why}" for name, why in found.unregistered.items()]
    texts += [f"doubtful (cross): {name}: {why}" for name, why in found.doubtful.items()]
    for row, text in enumerate(texts[: _SIDE // _LINE - 1]):
        shown_text = text.encode("ascii", "replace").decode()[:70]
        spot = (_SIDE + 6, _LINE * (row + 1))
        cv2.putText(canvas, shown_text, spot, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
    return canvas
