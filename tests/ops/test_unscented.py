# SPDX-License-Identifier: Apache-2.0
"""The unscented projection equals its float64 reference, and this OpenCV and the ordinary projection."""

import math

import cv2
import numpy as np
import pytest
import torch

from blitzgs.ops.project import project_splats
from blitzgs.ops.projection_types import ProjectionInputs, ProjectionOptions
from blitzgs.ops.unscented import GLOBAL_SHUTTER, Lenses, largest_angles, project_unscented
from blitzgs.reference.projection import View, lens_pixels, sh_colors, unscented_splats
from tests.helpers import random_scene, refused, relative_error

BROWN = (-0.1, 0.02, 0.003, 0.01, 0.02, 0.001, 0.003, -0.004, 0.001, 0.002, -0.002, 0.003)
FISHEYE = (0.02, -0.03, 0.01, -0.02, *[0.0] * 8)
PARTS = ("means", "quats", "scales", "opacities", "colors")
CASES = [(fisheye, shutter) for fisheye in (False, True) for shutter in range(GLOBAL_SHUTTER + 1)]


def moved(viewmats):
    """Poses a little farther in time: turned, and shifted."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.03, -0.02, 0.05]))[0])
    pose[:3, 3] = torch.tensor([0.05, -0.1, 0.02])
    return (pose @ viewmats.double().cpu()).to(viewmats)


def lenses_of(scene, fisheye, shutter):
    lenses = scene.means.new_zeros(len(scene.viewmats), 13)
    lenses[:, :12] = torch.tensor(FISHEYE if fisheye else BROWN, dtype=torch.float64)
    lenses[:, 12] = largest_angles(lenses[:, :4])
    viewmats_rs = None if shutter == GLOBAL_SHUTTER else moved(scene.viewmats)
    return Lenses(lenses, viewmats_rs, fisheye, shutter)


def views_of(scene, lenses):
    """The views, for the reference."""
    for c in range(len(scene.viewmats)):
        pose = None if lenses.viewmats_rs is None else lenses.viewmats_rs[c].double().cpu()
        viewmat, K, row = (t[c].double().cpu() for t in (scene.viewmats, scene.Ks, lenses.lenses))
        size = (scene.width, scene.height)
        yield View(viewmat, K, *size, row, lenses.fisheye, pose, lenses.shutter)


def project(scene, lenses, **options):
    """Splats of activated Gaussians with SH."""
    options = ProjectionOptions(scene.width, scene.height, **{"sh_degree": 3, "raw": False, **options})
    gaussians = [getattr(scene, name) for name in PARTS]
    return project_unscented(ProjectionInputs(gaussians, (scene.viewmats, scene.Ks), options), lenses)


def expected_columns(parts, view, antialiased):
    """The columns of `columns_of` for Gaussians in a view, their covariances, and which points are valid."""
    means2d, (blurred, plain), depths, valid = unscented_splats(*parts[:3], view)
    inverse, centre = blurred.inverse(), -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=1)
    opacities = parts[3] * ((plain.det() / blurred.det()).sqrt() if antialiased else 1)
    return (means2d, conics, depths, opacities, sh_colors(parts[0], parts[4], centre, 3)), blurred, valid


def columns_of(splats):
    return splats.means2d, splats.conics, splats.depths, splats.opacities, splats.colors


@pytest.mark.parametrize("fisheye", [False, True])
def test_pixels_of_the_reference_are_those_of_opencv(fisheye):
    points = torch.rand(500, 3, dtype=torch.float64) * 2 - 1
    points[:, 2] = points[:, 2].abs() + 0.8
    K = torch.tensor([[70.0, 0, 31], [0, 90, 25], [0, 0, 1]], dtype=torch.float64)
    k = torch.tensor([*(FISHEYE if fisheye else BROWN), math.inf], dtype=torch.float64)
    pixels, _ = lens_pixels(points, View(torch.eye(4), K, 64, 48, k, fisheye))
    zero = np.zeros(3)
    if fisheye:
        expected, _ = cv2.fisheye.projectPoints(points[None].numpy(), zero, zero, K.numpy(), k[:4].numpy())
    else:
        order = [0, 1, 6, 7, 2, 3, 4, 5, 8, 9, 10, 11]
        expected, _ = cv2.projectPoints(points.numpy(), zero, zero, K.numpy(), k[order].numpy())
    assert relative_error(pixels, torch.from_numpy(expected.reshape(-1, 2))) < 1e-12


@pytest.mark.parametrize("fisheye, shutter", CASES)
def test_splats_and_gradients_match_the_reference(backend, fisheye, shutter):
    device, dtype = backend
    exact = dtype == torch.float64
    scene = random_scene(n=150, cameras=3, dtype=dtype, device=device, scale=0.05)
    scene.means = scene.means * 2.5  # also beside the images and behind the cameras
    lenses, antialiased = lenses_of(scene, fisheye, shutter), shutter % 2 == 0
    leaves = [getattr(scene, name).detach().clone().requires_grad_() for name in PARTS]
    for name, leaf in zip(PARTS, leaves, strict=True):
        setattr(scene, name, leaf)
    splats = project(scene, lenses, antialiased=antialiased)
    references = [leaf.detach().double().cpu().requires_grad_() for leaf in leaves]
    generator, loss, expected_loss, seen = torch.Generator().manual_seed(3), 0, 0, 0
    for c, view in enumerate(views_of(scene, lenses)):
        own = (splats.camera_ids == c).nonzero()[:, 0]
        ids = splats.gaussian_ids[own].long()
        (means2d, _, depths, opacities, _), blurred, valid = expected_columns(references, view, antialiased)
        reach = torch.stack([blurred[:, i, i].sqrt() for i in (0, 1)], dim=1)
        reach = reach * (2 * (255 * opacities).clamp(min=1).log()).sqrt()[:, None]
        size = torch.tensor([scene.width, scene.height])
        inside = ((means2d + reach > 0) & (means2d - reach < size)).all(dim=1)
        visible = valid.any(dim=1) & (depths > 0.01) & (opacities >= 1 / 255) & inside
        assert ids.tolist() == visible.nonzero()[:, 0].tolist()
        seen += len(ids)
        columns, _, _ = expected_columns([part[ids.cpu()] for part in references], view, antialiased)
        for actual, expected in zip(columns_of(splats), columns, strict=True):
            assert relative_error(actual[own], expected) < (1e-10 if exact else 3e-6)
            weights = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
            loss = loss + (actual[own] * weights.to(actual)).sum()
            expected_loss = expected_loss + (expected * weights).sum()
    assert 100 < seen < 400 and splats.counts[1] == seen
    assert splats.counts[2] == splats.tiles_touched.sum() > 0
    loss.backward()
    expected_loss.backward()
    for leaf, reference in zip(leaves, references, strict=True):
        assert relative_error(leaf.grad, reference.grad) < (1e-7 if exact else 2e-5)


@pytest.mark.parametrize("fisheye, shutter", [(False, 4), (True, 4), (False, 0), (True, 3)])
def test_gradcheck(fisheye, shutter):
    scene = random_scene(n=4, cameras=2, dtype=torch.float64)
    lenses = lenses_of(scene, fisheye, shutter)
    scene.scales, scene.opacities = scene.scales.log(), scene.opacities.logit()
    leaves = [getattr(scene, name).clone().requires_grad_() for name in PARTS]

    def columns(*parts):
        for name, part in zip(PARTS, parts, strict=True):
            setattr(scene, name, part)
        return columns_of(project(scene, lenses, raw=True, antialiased=True))

    assert torch.autograd.gradcheck(columns, leaves)


def test_opcheck():
    scene = random_scene(n=20, cameras=2)
    lenses = lenses_of(scene, True, 0)
    gaussians = [getattr(scene, name).requires_grad_() for name in PARTS]
    options = ProjectionOptions(scene.width, scene.height, sh_degree=3, raw=False)[:-1]
    given = (gaussians, scene.viewmats, scene.Ks, *lenses, *options)
    ids = torch.arange(20, dtype=torch.int32)
    index = (ids, ids % 2, torch.arange(21, dtype=torch.int32))
    torch.library.opcheck(torch.ops.blitzgs.unscented_visible, given)
    torch.library.opcheck(torch.ops.blitzgs.unscented_fwd, (*given, *index))
    columns = torch.ops.blitzgs.unscented_fwd(*given, *index)[:5]
    detached = ([g.detach() for g in gaussians], *given[1:])
    v = [torch.randn_like(column) for column in columns]
    torch.library.opcheck(torch.ops.blitzgs.unscented_bwd, (*detached, *index[1:], v))


def test_tiny_gaussians_without_distortion_have_the_ordinary_splats():
    scene = random_scene(n=100, cameras=2, dtype=torch.float64, scale=1e-5)
    splats = project(scene, Lenses(torch.zeros(2, 13, dtype=torch.float64)), eps2d=0.0)
    inputs = ProjectionInputs(
        [getattr(scene, name) for name in PARTS], (scene.viewmats, scene.Ks),
        ProjectionOptions(scene.width, scene.height, sh_degree=3, raw=False, eps2d=0.0),
    )  # fmt: skip
    expected = project_splats(inputs)
    assert torch.equal(splats.gaussian_ids, expected.gaussian_ids) and len(expected.gaussian_ids) > 100
    for name in ("visible_ids", "splat_offsets", "camera_ids", "radii", "tiles_touched", "colors"):
        assert torch.equal(getattr(splats, name), getattr(expected, name)), name
    for name, tolerance in (("means2d", 1e-8), ("conics", 1e-4), ("depths", 1e-14), ("opacities", 1e-14)):
        assert relative_error(getattr(splats, name), getattr(expected, name)) < tolerance, name


def test_points_behind_the_camera_and_beside_the_image_are_invalid():
    scene = random_scene(n=3, cameras=1, dtype=torch.float64)
    scene.viewmats = torch.eye(4, dtype=torch.float64)[None]
    scene.Ks = torch.tensor([[[30.0, 0, 20], [0, 30, 16], [0, 0, 1]]], dtype=torch.float64)
    scene.means = torch.tensor([[0, 0, 0.5], [3.24, 0, 4], [0, 0, 2]], dtype=torch.float64)
    scene.scales = torch.tensor([[1.0, 1, 3.5], [0.2, 0.2, 0.2], [0.1, 0.1, 0.1]], dtype=torch.float64)
    scene.quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(3, 1)
    scene.opacities = torch.full((3,), 0.9, dtype=torch.float64)
    plain = Lenses(torch.zeros(1, 13, dtype=torch.float64))
    # A point of the first lies behind the camera; those of the second lie 4 to 5 px beside the image.
    for margin, every, seen in ((0.1, 0, [0, 2]), (0.1, 1, [2]), (0.2, 1, [1, 2])):
        lenses = plain._replace(transform=(0.1, 2.0, 0.0, margin, every))
        assert project(scene, lenses).gaussian_ids.tolist() == seen
    wide = plain._replace(transform=(1.0, 2.0, 0.0, 0.2, 0.0))
    means2d, (blurred, _), _, _ = unscented_splats(
        scene.means, scene.quats, scene.scales, next(views_of(scene, plain))._replace(margin=0.2), alpha=1.0
    )
    splats = project(scene, wide)
    assert splats.gaussian_ids.tolist() == [0, 1, 2]
    assert relative_error(splats.means2d, means2d) < 1e-12
    assert relative_error(splats.conics[:, 1], blurred.inverse()[:, 0, 1]) < 1e-9


@pytest.mark.parametrize("fisheye, shutter", [(False, 4), (True, 0)])
def test_a_gaussian_that_is_not_finite_has_no_splat(fisheye, shutter):
    scene = random_scene(n=60, cameras=2, scale=0.3)
    lenses, whole = lenses_of(scene, fisheye, shutter), project(scene, lenses_of(scene, fisheye, shutter))
    values = torch.tensor([torch.nan, torch.inf, -torch.inf])
    for row, name in zip((0, 3, 6, 9), PARTS[:4], strict=True):
        getattr(scene, name)[row : row + 3].view(3, -1)[:, 0] = values
    for name in PARTS:
        getattr(scene, name).requires_grad_()
    splats = project(scene, lenses)
    kept = whole.gaussian_ids >= 12
    for name in ("gaussian_ids", "camera_ids", "means2d", "conics", "opacities", "colors"):
        assert torch.equal(getattr(splats, name), getattr(whole, name)[kept]), name
    sum(column.sum() for column in columns_of(splats)).backward()
    assert all(getattr(scene, name).grad.isfinite().all() for name in PARTS)


def test_a_fisheye_ends_where_its_polynomial_stops_to_rise():
    radial = torch.tensor([[0.0] * 4, [-0.2, 0, 0, 0], FISHEYE[:4], [-0.3, 0.1, 0.02, -0.05]])
    found = largest_angles(radial.double()).tolist()
    for k, angle in zip(radial.double().tolist(), found, strict=True):
        roots = np.roots([9 * k[3], 0, 7 * k[2], 0, 5 * k[1], 0, 3 * k[0], 0, 1])
        real = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0) & (roots.real < math.pi / 2)]
        assert angle == pytest.approx(min(real, default=math.inf), abs=1e-6)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"lenses": torch.zeros(2, 12)}, r"lenses must have shape \[2, 13\]"),
        ({"shutter": 5}, "shutter must be 0 to 4, got 5"),
        ({"shutter": 0}, "a rolling shutter needs viewmats_rs"),
        ({"transform": (0.0, 2.0, 0.0, 0.1, 0.0)}, r"alpha\^2 \(3 \+ kappa\) must be positive, got 0"),
        ({"transform": (0.1, 2.0)}, "alpha, beta, kappa, margin, all_valid"),
    ],
)
def test_bad_lenses_are_refused_by_name(change, message):
    scene = random_scene(n=5)
    refused(RuntimeError, message, project, scene, Lenses(torch.zeros(2, 13))._replace(**change))
