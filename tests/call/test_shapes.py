# SPDX-License-Identifier: Apache-2.0
"""Batches, any number of views, colours per view and covariances work; wrong shapes are refused."""

import math
from dataclasses import replace

import pytest
import torch

import blitzgs
from blitzgs.reference.projection import covariance_factors
from tests.call.test_lenses import RollingShutterType
from tests.helpers import PARAMETERS, agree, random_scene, rasterize_scene, refused, relative_error

PER_ROW = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")


def batch_of(scenes):
    """Stack scenes: a leading dimension for all tensors."""
    stacked = {name: torch.stack([getattr(s, name) for s in scenes]) for name in (*PARAMETERS, "Ks")}
    return replace(scenes[0], **stacked)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("colors", ["sh", "values", "values per view", "sh per view"])
def test_a_batch_renders_as_its_scenes_alone(device, packed, colors):
    scenes = [random_scene(n=40, cameras=2, seed=seed, device=device) for seed in range(3)]
    generator = torch.Generator().manual_seed(4)
    for scene in scenes:
        lead = (2, 40) if colors.endswith("per view") else (40,)
        if colors.startswith("values"):
            scene.sh_degree, scene.colors = None, torch.rand(*lead, 4, generator=generator).to(device)
        else:
            scene.colors = torch.randn(*lead, 16, 3, generator=generator).to(device)
    batch = batch_of(scenes).leaves()
    backgrounds = torch.rand(3, 2, batch.colors.shape[-1], generator=generator).to(device)
    renders, alphas, meta = rasterize_scene(
        batch, packed=packed, backgrounds=backgrounds, render_mode="RGB+ED"
    )
    renders.square().sum().backward()
    singles = []
    for index, scene in enumerate(scenes):
        leaves = scene.leaves()
        singles.append(
            rasterize_scene(leaves, packed=packed, backgrounds=backgrounds[index], render_mode="RGB+ED")
        )
        assert torch.equal(renders[index], singles[-1][0])
        assert torch.equal(alphas[index], singles[-1][1])
        singles[-1][0].square().sum().backward()
        agree([gradient[index] for gradient in batch.gradients()], leaves.gradients(), 1e-4)
    together = torch.cat if packed else torch.stack
    for name in PER_ROW + (("camera_ids", "gaussian_ids") if packed else ()):
        assert torch.equal(meta[name], together([single[2][name] for single in singles])), name
    assert meta["isect_offsets"].shape == (3, 2, 2, 3)
    assert (meta["n_batches"], meta["n_cameras"]) == (3, 2)
    if packed:
        lengths = torch.tensor([len(single[2]["camera_ids"]) for single in singles])
        assert torch.equal(meta["batch_ids"].cpu(), torch.arange(3).repeat_interleave(lengths))


def test_a_batch_may_have_several_dimensions():
    scenes = [random_scene(n=20, cameras=1, seed=seed) for seed in range(4)]
    flat = batch_of(scenes)
    folded = replace(flat, **{k: getattr(flat, k).unflatten(0, (2, 2)) for k in (*PARAMETERS, "Ks")})
    for packed, rows in ((True, 1), (False, 4)):
        expected, _, flat_meta = rasterize_scene(flat, packed=packed)
        renders, alphas, meta = rasterize_scene(folded, packed=packed)
        assert renders.shape == (2, 2, 1, 32, 40, 3) and alphas.shape == (2, 2, 1, 32, 40, 1)
        assert torch.equal(renders.flatten(0, 1), expected)
        assert meta["means2d"].dim() == rows + 1
        assert torch.equal(meta["means2d"].reshape(-1, 2), flat_meta["means2d"].reshape(-1, 2))


@pytest.mark.parametrize("with_sh", [True, False])
def test_any_number_of_views(device, with_sh):
    scene = random_scene(n=30, cameras=70, width=9, height=8, device=device)
    if not with_sh:
        scene.sh_degree, scene.colors = None, scene.colors[:, 0].abs()
    leaves = scene.leaves()
    renders, _, meta = rasterize_scene(leaves)
    renders.square().sum().backward()
    assert renders.shape == (70, 8, 9, 3)
    assert (meta["camera_ids"].diff() >= 0).all() and meta["camera_ids"].max() == 69
    parts = scene.leaves()
    for view in (slice(0, 32), slice(32, 64), slice(64, 70)):
        some = replace(parts, viewmats=parts.viewmats[view], Ks=parts.Ks[view])
        expected, _, _ = rasterize_scene(some)
        assert torch.equal(renders[view], expected)
        expected.square().sum().backward()
    agree(leaves.gradients(), parts.gradients(), 1e-4)


def test_sh_may_differ_from_view_to_view(device):
    scene = random_scene(n=40, cameras=3, device=device)
    per_view = torch.randn(3, 40, 16, 3, generator=torch.Generator().manual_seed(1)).to(device) * 0.4
    leaves = replace(scene, colors=per_view).leaves()
    renders, _, _ = rasterize_scene(leaves)
    renders.square().sum().backward()
    for view in range(3):
        one = replace(scene.view(view), colors=per_view[view]).leaves()
        expected, _, _ = rasterize_scene(one)
        assert torch.equal(renders[view], expected[0])
        expected.square().sum().backward()
        assert relative_error(leaves.colors.grad[view], one.colors.grad) < 1e-5


def test_sh_of_no_views_have_images_and_gradients(device):
    scene = random_scene(n=10, cameras=1, device=device).leaves()
    scene.colors = torch.zeros(0, 10, 16, 3, device=device, requires_grad=True)
    scene.viewmats, scene.Ks = scene.viewmats.detach()[:0], scene.Ks[:0]
    renders, alphas, meta = rasterize_scene(scene)
    renders.sum().backward()
    assert renders.shape[0] == alphas.shape[0] == meta["n_cameras"] == 0
    assert scene.colors.grad.shape == (0, 10, 16, 3) and not scene.means.grad.any()


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depth_needs_no_colours(device, mode):
    scene = random_scene(n=30, device=device)
    expected, _, _ = rasterize_scene(scene, render_mode=mode)
    scene.colors = None
    for degree in (None, 3):
        assert torch.equal(rasterize_scene(scene, render_mode=mode, sh_degree=degree)[0], expected)
    refused(ValueError, "colors may be None for the render modes D and ED alone", rasterize_scene, scene)


def covariances(scene):
    factors = covariance_factors(scene.quats.view(-1, 4), scene.scales.view(-1, 3))
    return (factors @ factors.mT).view(*scene.scales.shape[:-1], 3, 3)


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_covariances_are_rotations_and_scales(device, rasterize_mode):
    dtype = torch.float64 if device == "cpu" else torch.float32
    bound = 1e-10 if device == "cpu" else 1e-4
    scene = random_scene(n=60, cameras=2, dtype=dtype, device=device)
    scene.scales[:20] = scene.scales[:20, :1]  # round: any axes are eigenvectors
    scene.scales[20:40, 1] = scene.scales[20:40, 0]
    expected, given = scene.leaves(), scene.leaves()
    image, alphas, _ = rasterize_scene(expected, rasterize_mode=rasterize_mode)
    own = covariances(expected).detach().requires_grad_()
    given.quats = given.scales = None
    renders, own_alphas, _ = rasterize_scene(given, covars=own, rasterize_mode=rasterize_mode)
    assert relative_error(renders, image) < bound and relative_error(own_alphas, alphas) < bound
    image.square().sum().backward()
    renders.square().sum().backward()
    others = ("means", "opacities", "colors", "viewmats")
    agree(*([getattr(scene, name).grad for name in others] for scene in (given, expected)), 10 * bound)
    assert not own.grad[:, [1, 2, 2], [0, 0, 1]].any()  # the lower triangle is not read
    found = torch.autograd.grad(covariances(expected), [expected.scales, expected.quats], own.grad)
    agree(found, [expected.scales.grad, expected.quats.grad], 10 * bound)


def test_covariances_have_no_sparse_gradients():
    scene = random_scene(n=20)
    scene.quats = scene.scales = None
    covars = torch.eye(3).expand(20, 3, 3)
    with pytest.raises(ValueError, match="sparse_grad does not support covars; leave one of them out"):
        rasterize_scene(scene, covars=covars, sparse_grad=True)


def test_covariances_of_a_batch(device):
    scenes = [random_scene(n=20, cameras=2, seed=seed, device=device) for seed in range(2)]
    batch = batch_of(scenes)
    renders, _, _ = rasterize_scene(replace(batch, quats=None, scales=None), covars=covariances(batch))
    assert relative_error(renders, rasterize_scene(batch)[0]) < 1e-4


@pytest.mark.parametrize("batch", [(), (2,)])
def test_no_covariances_are_an_empty_image(batch):
    scene = random_scene(n=0, cameras=2)
    if batch:
        scene = batch_of([scene, scene])
    scene.quats = scene.scales = None
    covars = torch.zeros(*batch, 0, 3, 3, requires_grad=True)
    renders, _, _ = rasterize_scene(scene, covars=covars)
    renders.sum().backward()
    assert renders.shape[:-3] == (*batch, 2) and not renders.any() and covars.grad.shape == covars.shape


@pytest.mark.parametrize("seed", [10, 18, 25, 28])
def test_covariances_of_needles_whose_tiles_depend_on_rounding(seed):
    scene = random_scene(n=200, cameras=1, seed=seed, scale=0.3)
    scene.scales[:, 1:] *= 1e-3
    renders, _, meta = rasterize_scene(scene, covars=covariances(scene), eps2d=0.0)
    assert renders.isfinite().all() and len(meta["flatten_ids"]) > 300


def test_covariances_without_a_determinant_have_finite_gradients():
    scene = random_scene(n=200, cameras=1, dtype=torch.float64)
    scene.scales[:, 1:] *= 1e-9
    covars = covariances(scene).requires_grad_()
    renders, _, _ = rasterize_scene(scene, covars=covars, eps2d=0.0)
    renders.sum().backward()
    assert renders.isfinite().all() and covars.grad.isfinite().all()


def test_a_covariance_that_is_not_finite_is_not_rendered():
    scene = random_scene(n=20, cameras=1)
    covars = covariances(scene)
    covars[3, 0, 1] = torch.nan
    scene.opacities[3] = 0
    expected, _, _ = rasterize_scene(scene, covars=covars)
    scene.opacities[3] = 0.9
    with pytest.warns(RuntimeWarning, match="values in covars;"):
        image, _, meta = rasterize_scene(scene, covars=covars)
    assert torch.equal(image, expected)
    assert meta["non_finite"]["covars"].tolist() == [3]


class RendererConfig_MixedBatch:  # noqa: N801
    """As gsplat's main branch has it."""


DEFAULTS = {
    "packed": True, "tile_size": None, "channel_chunk": 32, "segmented": False, "camera_model": "pinhole",
    "covars": None, "with_ut": False, "with_eval3d": False, "return_normals": False, "global_z_order": True,
    "radial_coeffs": None, "ftheta_coeffs": None, "rolling_shutter": RollingShutterType.GLOBAL,
    "viewmats_rs": None, "extra_signals": None, "renderer_config": RendererConfig_MixedBatch(),
}  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_colours_in_half_precision_are_those_in_single(dtype):
    scene = random_scene(n=40)
    half = scene.colors.to(dtype).requires_grad_()
    single = half.detach().float().requires_grad_()
    images = [rasterize_scene(replace(scene, colors=colors))[0] for colors in (half, single)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert torch.equal(half.grad, single.grad.to(dtype))


def test_the_defaults_of_gsplat_are_accepted():
    scene = random_scene(n=10, cameras=1)
    plain, _, meta = rasterize_scene(scene)
    same, _, _ = rasterize_scene(scene, **DEFAULTS)
    assert torch.equal(plain, same) and meta["tile_size"] == 16
    assert torch.equal(rasterize_scene(scene, channel_chunk=8, segmented=True)[0], plain)


@pytest.mark.parametrize("value", [False, None, "pinhole", True])
def test_an_argument_that_gsplat_has_not_is_refused(value):
    with pytest.raises(TypeError, match=r"rasterization\(\) got an unexpected keyword argument 'packd'"):
        rasterize_scene(random_scene(n=10), packd=value)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"with_eval3d": True}, "does not support with_eval3d=True"),
        ({"global_z_order": False}, "does not support global_z_order=False"),
        ({"rays": torch.zeros(1)}, r"does not support rays=a tensor \[1\]; leave it out"),
        ({"covars": torch.zeros(4, 6)}, r"covars must be \[..., N, 3, 3\] = \[4, 3, 3\], got \[4, 6\]"),
        ({"render_mode": "N"}, "render_mode must be one of"),
        ({"rasterize_mode": "fast"}, "rasterize_mode must be"),
        ({"tile_size": 65}, "tile_size must be 1 to 64 px, got 65"),
        ({"sh_degree": None}, "colors must be .*; SH coefficients need sh_degree"),
        ({"colors": torch.zeros(4, 9, 3)}, "sh_degree 3 needs 16 SH coefficients, got 9"),
        (
            {"sh_degree": None, "colors": torch.zeros(3, 4)},
            r"colors must be \[..., N, D\] or \[..., C, N, D\], here with \[\] before N = 4",
        ),
        ({"colors": torch.zeros(2, 4, 16, 3)}, r"colors must be SH coefficients"),
        ({"sh_degree": None, "colors": torch.zeros(4, 0)}, "colors must have 1 to 4096 channels, got 0"),
        (
            {"sh_degree": None, "colors": torch.zeros(4, 4097)},
            "colors must have 1 to 4096 channels, got 4097",
        ),
        (
            {"sh_degree": None, "colors": torch.zeros(4, 4096), "render_mode": "RGB+D"},
            "colors must have 1 to 4095 channels, got 4096",
        ),
        ({"means": torch.zeros(1, 4, 3)}, r"quats must be \[..., N, 4\] = \[1, 4, 4\], got \[4, 4\]"),
        ({"quats": torch.zeros(4, 3)}, r"quats must be \[..., N, 4\]"),
        ({"Ks": torch.zeros(3, 3)}, r"Ks must be \[..., C, 3, 3\]"),
        ({"opacities": torch.zeros(1)}, r"opacities must be \[..., N\] = \[4\], got \[1\]"),
        ({"opacities": torch.zeros(4, 1)}, r"opacities must be \[..., N\]"),
        ({"Ks": torch.zeros(1, 3, 3, device="meta")}, "Ks is on meta and means on cpu; move one"),
        ({"colors": torch.zeros(4, 16, 3, device="meta")}, "colors is on meta and means on cpu; move one"),
        ({"backgrounds": torch.zeros(2, 3)}, r"backgrounds must be \[..., C, D\]"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(options, message):
    arguments = {**vars(random_scene(n=4, cameras=1)), **options}
    refused(ValueError, message, blitzgs.rasterization, **arguments)


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize(
    ("option", "error", "message"),
    [
        ({"near_plane": math.nan}, ValueError, "near_plane must be less than far_plane, got nan and 1"),
        ({"far_plane": math.nan}, ValueError, "near_plane must be less than far_plane, got 0.01 and nan"),
        ({"near_plane": 2.0, "far_plane": 1.0}, ValueError, "near_plane must be less than far_plane"),
        ({"eps2d": -0.1}, ValueError, "eps2d must be a finite number of px\\^2 of at least 0, got -0.1"),
        ({"eps2d": math.nan}, ValueError, "eps2d must be .* got nan"),
        ({"eps2d": math.inf}, ValueError, "eps2d must be .* got inf"),
        ({"radius_clip": -1.0}, ValueError, "radius_clip must be at least 0 px, got -1.0"),
        ({"radius_clip": math.nan}, ValueError, "radius_clip must be at least 0 px, got nan"),
        ({"sh_degree": -1}, ValueError, "sh_degree must be 0 to 4, got -1"),
        ({"sh_degree": 5}, ValueError, "sh_degree must be 0 to 4, got 5"),
        ({"sh_degree": 3.0}, TypeError, "sh_degree must be a whole number, got 3.0"),
        ({"near_plane": None}, TypeError, "near_plane must be a number, got None"),
        ({"far_plane": "1e10"}, TypeError, "far_plane must be a number, got '1e10'"),
        ({"eps2d": "0.3"}, TypeError, "eps2d must be a number, got '0.3'"),
        ({"radius_clip": None}, TypeError, "radius_clip must be a number, got None"),
        ({"tile_size": 16.0}, TypeError, "tile_size must be a whole number, got 16.0"),
    ],
)
def test_a_number_out_of_range_is_refused_by_name(raw, option, error, message):
    *geometry, colors, viewmats, Ks, width, height = random_scene(n=4, cameras=1).arguments()
    colors = torch.zeros(4, 25, 3)  # enough for degree 4
    given = {"sh_degree": 3, **option}
    with pytest.raises(error, match=message):
        if raw:
            blitzgs.raw_rasterization(
                *geometry, colors[:, :1], colors[:, 1:], viewmats, Ks, width, height, **given
            )
        else:
            blitzgs.rasterization(*geometry, colors, viewmats, Ks, width, height, **given)


@pytest.mark.parametrize("count", [0, 25])
def test_sh_of_an_unsupported_degree_are_refused_by_name(count):
    *geometry, _, viewmats, Ks, width, height = random_scene(n=4, cameras=1).arguments()
    with pytest.raises(ValueError, match=f"sh_degree=None needs 1 to 24 SH coefficients, got {count}"):
        blitzgs.raw_rasterization(*geometry, torch.zeros(4, count, 3), None, viewmats, Ks, width, height)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"Ks": torch.Tensor.double}, ValueError, "Ks is torch.float64 and means torch.float32; convert Ks"),
        ({"colors": torch.Tensor.double}, ValueError, "colors is torch.float64 and means torch.float32"),
        ({"quats": torch.Tensor.numpy}, TypeError, r"quats must be a torch\.Tensor, got ndarray"),
        ({"means": torch.Tensor.half}, TypeError, "means must be float32 or float64, got torch.float16"),
        ({"means": torch.Tensor.long}, TypeError, "means must be float32 or float64, got torch.int64"),
        ({"width": lambda _: 64.5}, TypeError, "width must be a whole number, got 64.5"),
        ({"width": lambda _: (1 << 20) + 1}, ValueError, "width must be 1 to 2\\^20 px"),
        ({"height": lambda _: 0}, ValueError, "height must be 1 to 2\\^20 px, got 0"),
    ],
)
def test_dtypes_and_sizes_that_do_not_fit_are_refused_by_name(changes, error, message):
    scene = random_scene(n=5)
    changed = replace(scene, **{name: change(getattr(scene, name)) for name, change in changes.items()})
    refused(error, message, rasterize_scene, changed)
