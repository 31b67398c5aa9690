# SPDX-License-Identifier: Apache-2.0
"""Images through distorting lenses and rolling shutters: `rasterization(with_ut=True)`."""

import enum
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

import blitzgs
from tests.helpers import PARAMETERS, random_scene, rasterize_scene, refused

BROWN = (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.005, -0.008, 0.002, 0.0, -0.003, 0.0)
FISHEYE = (0.05, -0.02, 0.01, 0.0)
BLUR = 0.01  # of eps2d: so small that an enlarged image has the same splats


def ut_params(**changes):
    """Parameters with gsplat's names and values."""
    default = {
        "alpha": 0.1, "beta": 2.0, "kappa": 0.0, "in_image_margin_factor": 0.1,
        "require_all_sigma_points_valid": False,
    }  # fmt: skip
    return SimpleNamespace(**default | changes)


class RollingShutterType(enum.Enum):
    """As gsplat has it."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


def wide_scene(**options):
    """Small Gaussians in front of a camera, also beside its image."""
    scene = random_scene(**{"n": 800, "cameras": 1, "width": 60, "height": 48, "scale": 0.06, **options})
    across = 1.5 * torch.randn(len(scene.means), 3, generator=torch.Generator().manual_seed(5)).clamp(-1, 1)
    scene.means = (across + torch.tensor([0.0, 0.0, 4.5])).to(scene.means)
    scene.means[:, :2] *= scene.means[:, 2:]
    scene.viewmats = torch.eye(4).expand(len(scene.viewmats), 4, 4).to(scene.means)
    scene.Ks = torch.tensor([[35.0, 0, 29], [0, 36, 25], [0, 0, 1]]).expand_as(scene.Ks).to(scene.means)
    return scene


def lens_arguments(scene, fisheye):
    rows = scene.means.new_tensor(FISHEYE if fisheye else BROWN).expand(len(scene.viewmats), -1)
    if fisheye:
        return {"with_ut": True, "camera_model": "fisheye", "radial_coeffs": rows}
    radial, tangential, thin_prism = rows.split((6, 2, 4), dim=1)
    return {
        "with_ut": True, "radial_coeffs": radial, "tangential_coeffs": tangential,
        "thin_prism_coeffs": thin_prism,
    }  # fmt: skip


def warped(scene, fisheye, enlarged=6):
    """A larger pinhole image, sampled by OpenCV where the lens sees each pixel."""
    K, size = scene.Ks[0].double().numpy(), np.array([132, 106]) * enlarged
    big = np.array([[enlarged * K[0, 0], 0, size[0] / 2], [0, enlarged * K[1, 1], size[1] / 2], [0, 0, 1]])
    arguments = list(scene.arguments())
    arguments[6:] = torch.from_numpy(big)[None].to(scene.means), *size.tolist()
    image = blitzgs.rasterization(*arguments, sh_degree=3, eps2d=BLUR * enlarged**2)[0][0].numpy()
    pixels = np.stack(np.meshgrid(np.arange(60) + 0.5, np.arange(48) + 0.5), axis=-1).reshape(-1, 1, 2)
    if fisheye:
        seen = cv2.fisheye.undistortPoints(pixels, K, np.array(FISHEYE))
    else:
        seen = cv2.undistortPoints(pixels, K, np.array(BROWN)[[0, 1, 6, 7, 2, 3, 4, 5, 8, 9, 10, 11]])
    at = (seen.reshape(48, 60, 2) * big[[0, 1], [0, 1]] + big[:2, 2] - 0.5).astype(np.float32)
    return torch.from_numpy(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC))


@pytest.mark.parametrize("fisheye", [False, True])
def test_images_are_warped_pinhole_images(fisheye):
    scene = wide_scene()
    expected = warped(scene, fisheye)
    image = rasterize_scene(scene, eps2d=BLUR, **lens_arguments(scene, fisheye))[0][0]
    plain = rasterize_scene(scene, eps2d=BLUR)[0][0]
    assert (image - expected).abs().mean() < 0.003
    assert (plain - expected).abs().mean() > 0.03


def poses_between(viewmat, viewmat_rs, times):
    """Poses of a camera that only moves."""
    return viewmat + torch.as_tensor(times).to(viewmat)[:, None, None] * (viewmat_rs - viewmat)


@pytest.mark.parametrize("shutter", list(RollingShutterType)[:4])
def test_each_row_of_a_rolling_shutter_is_that_of_the_pose_at_its_time(shutter):
    scene = wide_scene(n=500, dtype=torch.float64)
    scene.sh_degree = 0  # colours are those from the first pose
    rows = shutter.value in (0, 2)
    count = 48 if rows else 60
    moved = scene.viewmats.clone()
    moved[:, 0, 3], moved[:, 1, 3] = 0.4, -0.2
    # A wide margin: a splat from beside the image is in all of the images or in none.
    options = {"with_ut": True, "ut_params": ut_params(in_image_margin_factor=1.0)}
    image = rasterize_scene(scene, rolling_shutter=shutter, viewmats_rs=moved, **options)[0][0]
    times = torch.arange(count) / (count - 1)
    times = times if shutter.value < 2 else times.flip(0)
    arguments = list(scene.arguments())
    arguments[5] = poses_between(scene.viewmats[0], moved[0], times)  # more views than one launch has
    arguments[6] = scene.Ks.expand(count, 3, 3)
    images = blitzgs.rasterization(*arguments, sh_degree=0, **options)[0]
    places = torch.arange(count)
    expected = images[places, places] if rows else images[places, :, places].transpose(0, 1)
    assert (image - expected).abs().mean() < 0.002
    assert (image - images[0]).abs().mean() > 0.02
    same = rasterize_scene(
        scene, with_ut=True, rolling_shutter=shutter.name, viewmats_rs=scene.viewmats, render_mode="RGB+ED"
    )[0][0]
    still = rasterize_scene(scene, with_ut=True, render_mode="RGB+ED")[0][0]
    assert (same - still).abs().max() < 1e-12


def test_batches_arrangements_and_pixels_have_the_same_image(backend):
    device, dtype = backend
    scene = wide_scene(n=200, cameras=2, dtype=dtype, device=device)
    lens = lens_arguments(scene, False)
    lens |= {
        "rolling_shutter": RollingShutterType.ROLLING_TOP_TO_BOTTOM,
        "viewmats_rs": scene.viewmats + 0.01,
    }
    leaf = scene.means.clone().requires_grad_()
    scene.means = leaf
    image, _, meta = rasterize_scene(scene, **lens)
    meta["means2d"].retain_grad()
    image.square().sum().backward()
    assert leaf.grad.norm() > 0 and meta["means2d"].grad.norm() > 0
    assert meta["tiles_per_gauss"].sum() == len(meta["flatten_ids"]) > 0
    dense, _, arranged = rasterize_scene(scene, packed=False, **lens)
    assert torch.equal(dense, image) and arranged["means2d"].shape == (2, 200, 2)
    batch = [torch.stack([t, t]) if isinstance(t, torch.Tensor) else t for t in scene.arguments()]
    stacked = {k: torch.stack([v, v]) if isinstance(v, torch.Tensor) else v for k, v in lens.items()}
    assert torch.equal(blitzgs.rasterization(*batch, sh_degree=3, **stacked)[0], torch.stack([image, image]))
    pixels = torch.tensor([[5, 7], [20, 33]], device=device)
    some = rasterize_scene(scene, pixels=pixels, image_ids=torch.tensor([0, 1], device=device), **lens)[0]
    assert torch.equal(some, image[[0, 1], [5, 20], [7, 33]])


def test_parameters_of_the_transform_are_those_of_gsplat():
    scene = wide_scene(n=300, scale=0.3)
    lens = lens_arguments(scene, True)
    image, _, meta = rasterize_scene(scene, **lens)
    assert torch.equal(rasterize_scene(scene, ut_params=ut_params(), **lens)[0], image)
    strict = ut_params(require_all_sigma_points_valid=True)
    fewer = rasterize_scene(scene, ut_params=strict, **lens)[2]
    assert 0 < len(fewer["means2d"]) < len(meta["means2d"])
    assert not torch.equal(rasterize_scene(scene, ut_params=ut_params(alpha=1.0), **lens)[0], image)


def test_lenses_that_are_not_finite_are_named():
    scene = wide_scene(n=20, cameras=2)
    lens = lens_arguments(scene, True)
    lens["radial_coeffs"] = lens["radial_coeffs"].clone()
    lens["radial_coeffs"][1, 2] = torch.nan
    with pytest.warns(RuntimeWarning, match="values in radial_coeffs;"):
        image, _, meta = rasterize_scene(scene, **lens)
    assert meta["non_finite"]["radial_coeffs"].tolist() == [1]
    assert image[0].sum() > 0 and (image[1] == 0).all()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"camera_model": "fisheye"}, "camera_model='fisheye' needs with_ut=True"),
        ({"radial_coeffs": torch.zeros(1, 6)}, "radial_coeffs needs with_ut=True"),
        ({"rolling_shutter": RollingShutterType(1)}, "rolling_shutter needs with_ut=True"),
        ({"rolling_shutter": "SLOW"}, "rolling_shutter must be one of ROLLING_TOP_TO_BOTTOM"),
        ({"with_ut": True, "covars": torch.zeros(4, 3, 3)}, "with_ut does not support covars"),
        ({"with_ut": True, "sparse_grad": True}, "with_ut does not support sparse_grad"),
        ({"with_ut": True, "distributed": True}, "with_ut does not support distributed"),
        (
            {"with_ut": True, "viewmats": torch.eye(4)[None].requires_grad_()},
            "with_ut does not support a gradient of viewmats",
        ),
        (
            {"with_ut": True, "radial_coeffs": torch.zeros(1, 4)},
            r"radial_coeffs must be \[..., C, 6\] = \[1, 6\], got \[1, 4\]",
        ),
        (
            {"with_ut": True, "camera_model": "fisheye", "tangential_coeffs": torch.zeros(1, 2)},
            "a fisheye has no tangential_coeffs",
        ),
        ({"with_ut": True, "viewmats_rs": torch.eye(4)[None]}, "a rolling shutter needs viewmats_rs"),
        ({"with_ut": True, "rolling_shutter": RollingShutterType(0)}, "a rolling shutter needs viewmats_rs"),
        ({"with_ut": True, "with_eval3d": True}, "does not support with_eval3d=True"),
        ({"with_ut": True, "camera_model": "ftheta"}, "camera_model must be one of pinhole, fisheye, got"),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(options, message):
    scene = wide_scene(n=4)
    refused(ValueError, message, blitzgs.rasterization, **{**vars(scene), **options})


@pytest.mark.parametrize("name", PARAMETERS)
def test_forward_mode_derivatives_are_refused_by_name(name):
    scene = wide_scene(n=4)
    value = getattr(scene, name)
    with forward_ad.dual_level():
        dual = {name: forward_ad.make_dual(value, torch.ones_like(value))}
        message = "with_ut does not support forward-mode derivatives"
        refused(ValueError, message, blitzgs.rasterization, **{**vars(scene), **dual, "with_ut": True})
        with pytest.raises(NotImplementedError, match="jvp"):  # torch's words
            blitzgs.rasterization(**{**vars(scene), **dual})
