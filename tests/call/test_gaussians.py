# SPDX-License-Identifier: Apache-2.0
"""Functions of Gaussians without a view, SH, and the Gaussians of each pixel, by definition and by SciPy."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

import blitzgs
from blitzgs.call.covariances import decompose
from blitzgs.reference.projection import covariance_factors
from tests.helpers import agree, random_scene, rasterize_scene, refused, relative_error
from tests.population.test_relocation import by_the_double_sum


def shapes(*lead, dtype=torch.float64, device="cpu"):
    generator = torch.Generator().manual_seed(0)
    quats = 3 * torch.randn(*lead, 4, generator=generator, dtype=torch.float64)
    scales = 0.1 + torch.rand(*lead, 3, generator=generator, dtype=torch.float64)
    return quats.to(device, dtype), scales.to(device, dtype)


@pytest.mark.parametrize("triu", [False, True])
def test_covariances_and_their_inverses(backend, triu):
    device, dtype = backend
    quats, scales = shapes(2, 7, dtype=dtype, device=device)
    covars, precis = blitzgs.quat_scale_to_covar_preci(quats, scales, triu=triu)
    matrices = Rotation.from_quat(quats.double().cpu().reshape(-1, 4).numpy(), scalar_first=True).as_matrix()
    rotations = torch.from_numpy(matrices).view(2, 7, 3, 3)
    bound = 1e-13 if dtype == torch.float64 else 1e-5
    for actual, power in ((covars, 2), (precis, -2)):
        expected = rotations @ torch.diag_embed(scales.double().cpu() ** power) @ rotations.mT
        if triu:
            expected = expected[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        assert actual.dtype == dtype and relative_error(actual, expected) < bound


def test_covariances_have_gradients():
    quats, scales = (t.requires_grad_() for t in shapes(4))
    assert torch.autograd.gradcheck(blitzgs.quat_scale_to_covar_preci, (quats, scales))
    assert blitzgs.quat_scale_to_covar_preci(quats, scales, False, False) == (None, None)
    with pytest.raises(ValueError, match=r"quats must be \[..., 4\] and scales \[..., 3\], got \[4, 3\]"):
        blitzgs.quat_scale_to_covar_preci(scales, scales)


@pytest.mark.parametrize("min_opacity", [0.0, 0.005])
def test_relocation_is_the_paper_s_double_sum(backend, min_opacity):
    device, dtype = backend
    opacities = torch.tensor([0.006, 0.1, 0.5, 0.9, 0.99, 0.5, 1.0], device=device, dtype=dtype)
    ratios = torch.tensor([3, 2, 1, 20, 51, 99, 4], device=device)
    scales = torch.rand(len(opacities), 3, device=device, dtype=dtype)
    own, sizes = blitzgs.relocate(opacities, scales, ratios, min_opacity)
    bound = 1e-7 if dtype == torch.float64 else 1e-5
    for i, (o, n) in enumerate(zip(opacities.tolist(), ratios.clamp(max=51).tolist(), strict=True)):
        new, factor = by_the_double_sum(o, n, min_opacity)
        assert math.isclose(own[i].item(), new, rel_tol=bound)
        assert relative_error(sizes[i], scales[i] * factor) < bound
    assert own.dtype == dtype and ratios.max() == 99
    with pytest.raises(TypeError, match=r"number, got \[51, 51\]; leave out binoms"):
        blitzgs.relocate(torch.rand(51), torch.rand(51, 3), torch.ones(51), torch.zeros(51, 51))
    refused(ValueError, r"ratios must be \[N\]", blitzgs.relocate, opacities[:, None], scales, ratios)


def test_noise_has_the_covariance_of_the_paper(device):
    n, scaler, threshold = 40_000, 2.5, 0.01
    quats, scales = (t[:1].expand(n, -1).contiguous() for t in shapes(1, dtype=torch.float32, device=device))
    opacity = 0.02
    logits = torch.full((n, 1), math.log(opacity / (1 - opacity)), device=device)
    options = {"seed": 5, "step": 7, "threshold": threshold}
    noise = blitzgs.position_noise(quats, scales.log(), logits, scaler, **options)
    assert torch.equal(noise, blitzgs.position_noise(quats, scales.log(), logits[:, 0], scaler, **options))
    assert not torch.equal(
        noise, blitzgs.position_noise(quats, scales.log(), logits, scaler, **{**options, "step": 8})
    )
    covars, precis = blitzgs.quat_scale_to_covar_preci(quats[:1].double(), scales[:1].double())
    share = scaler / (1 + math.exp(-100 * (threshold - opacity)))
    normal = noise.double() @ precis[0] / share
    assert (normal.mean(0).abs() < 5 / math.sqrt(n)).all()
    assert relative_error(normal.T @ normal / n, torch.eye(3)) < 0.04


def test_wrong_points_and_opacities_are_named():
    refused(TypeError, "points must be a torch.Tensor, got list", blitzgs.knn, [[1.0, 2.0, 3.0]], 1)
    with pytest.raises(ValueError, match=r"opacities must be \[N\] or \[N, 1\] with N = 5, got \[4\]"):
        blitzgs.position_noise(torch.ones(5, 4), torch.ones(5, 3), torch.ones(4), 1.0, seed=0, step=0)


@pytest.mark.parametrize(
    "scales",
    [(3, 2, 1), (1, 1e-5, 2e-5), (1, 2, 1e-7), (1, 1, 1), (1, 1, 0.5), (1, 0.5, 0.5), (1, 0, 0), (0, 0, 0)],
    ids=str,
)
@pytest.mark.parametrize("size", [1e-20, 1, 1e15])
def test_decomposed_covariances_are_the_given_ones(device, size, scales):
    g = torch.Generator().manual_seed(0)
    quats = torch.randn(500, 4, generator=g, dtype=torch.float64)
    quats[0] = torch.tensor([1.0, 0, 0, 0])  # the axes are those of the world
    jitter = torch.randn(500, 3, generator=g) * torch.tensor([0, 1e-9, 1e-15])[torch.arange(500) % 3, None]
    factors = covariance_factors(quats, size * torch.tensor(scales).double() * (1 + jitter.double()))
    covars = (factors @ factors.mT).to(device)
    found = decompose(covars)
    again = covariance_factors(found.quats, found.scales)
    assert (again @ again.mT - covars).abs().max() <= 1e-14 * (size * max(scales)) ** 2


def arguments(meta):
    """What gsplat's functions take of `meta`."""
    names = ("means2d", "conics", "opacities", "isect_offsets", "flatten_ids", "width", "height", "tile_size")
    return [meta[name] for name in names]


def image_of(ids, weights, values):
    """Composite values [N, D] by ids and weights [..., K]."""
    shown = torch.where((ids < 0)[..., None], 0, values[ids.clamp(min=0).long()])
    return (shown * weights[..., None]).sum(dim=-2)


@pytest.mark.parametrize("packed", [True, False])
def test_the_image_is_the_sum_over_all_contributors(backend, packed):
    scene = random_scene(cameras=3).to(backend[1], backend[0])
    values = torch.rand(60, 3, generator=torch.Generator().manual_seed(2)).to(scene.means)
    image, alphas, meta = blitzgs.rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, values, scene.viewmats, scene.Ks, 40, 32,
        packed=packed,
    )  # fmt: skip
    counts, also = blitzgs.rasterize_num_contributing_gaussians(*arguments(meta))
    assert torch.equal(also, alphas[..., 0]) and counts.shape == (3, 32, 40)
    ids, weights = blitzgs.rasterize_contributing_gaussian_ids(*arguments(meta), counts)
    assert ids.shape == weights.shape == (3, 32, 40, int(counts.max())) and ids.dtype == torch.int32
    assert torch.equal((ids >= 0).sum(dim=-1), counts)
    gaussians = torch.where(ids < 0, ids, meta["gaussian_ids"][ids.clamp(min=0).long()]) if packed else ids
    most = 1e-12 if backend[1] == torch.float64 else 1e-5
    assert (image_of(gaussians, weights, values) - image).abs().max() < most
    top, best = blitzgs.rasterize_top_contributing_gaussian_ids(*arguments(meta), 2)
    assert torch.equal(best.sort(dim=-1).values, weights.sort(dim=-1).values[..., -2:])
    assert torch.equal(top[..., 0] >= 0, counts > 0) and torch.equal(top[..., 1] >= 0, counts > 1)


def test_batches_and_lists_of_pixels():
    scene = random_scene(n=30)
    both = [torch.stack([t, t.flip(0)]) for t in scene.arguments()[:5]]
    cameras = [t.expand(2, *t.shape) for t in (scene.viewmats, scene.Ks)]
    _, _, meta = blitzgs.rasterization(*both, *cameras, 40, 32, sh_degree=3, packed=False)
    counts, alphas = blitzgs.rasterize_num_contributing_gaussians(*arguments(meta))
    assert counts.shape == (2, 2, 32, 40)
    ids, weights = blitzgs.rasterize_top_contributing_gaussian_ids(*arguments(meta), 3)
    assert ids.max() == 29
    pixels, images = torch.tensor([[3, 4], [31, 39], [16, 20]]), torch.tensor([0, 3, 2])
    at = (images // 2, images % 2, *pixels.T)
    some, own = blitzgs.rasterize_num_contributing_gaussians(
        *arguments(meta), pixels=pixels, image_ids=images
    )
    assert torch.equal(some, counts[at]) and torch.equal(own, alphas[at])
    chosen = blitzgs.rasterize_top_contributing_gaussian_ids(
        *arguments(meta), 3, pixels=pixels, image_ids=images
    )
    assert torch.equal(chosen[0], ids[at]) and torch.equal(chosen[1], weights[at])
    listed, shares = blitzgs.rasterize_contributing_gaussian_ids(
        *arguments(meta), some, pixels=pixels, image_ids=images
    )
    assert listed.shape == shares.shape == (3, int(some.max()))


@pytest.mark.parametrize(
    "change,error,message",
    [
        ({0: torch.zeros(3, 3)}, ValueError, "means2d must be"),
        ({3: torch.zeros(2, 1, 2, dtype=torch.int64)}, ValueError, r"tile_offsets must be \[2, 2, 3\]"),
        ({4: torch.zeros(3)}, TypeError, "flatten_ids must be a tensor of integers"),
        ({5: 40.0}, ValueError, "image_width must be a whole number of at least 1, got 40.0"),
        ({7: 0}, ValueError, "tile_size must be a whole number of at least 1, got 0"),
    ],
)
def test_wrong_arguments_are_named(change, error, message):
    _, _, meta = rasterize_scene(random_scene(n=5))
    given = arguments(meta)
    for at, value in change.items():
        given[at] = value
    refused(error, message, blitzgs.rasterize_num_contributing_gaussians, *given)


def test_wrong_numbers_of_contributors_are_named():
    given = arguments(rasterize_scene(random_scene(n=5))[2])
    message = "num_depth_samples must be a whole number of at least 0, got -1"
    refused(ValueError, message, blitzgs.rasterize_top_contributing_gaussian_ids, *given, -1)
    message = "num_contributing_gaussians must be what"
    refused(TypeError, message, blitzgs.rasterize_contributing_gaussian_ids, *given, 3)


def test_entries_of_two_calls_are_refused():
    metas = [rasterize_scene(random_scene(n=n))[2] for n in (5, 60)]
    few, many = (arguments(meta) for meta in metas)
    count = blitzgs.rasterize_num_contributing_gaussians
    refused(RuntimeError, "tile_offsets must ascend", count, *many[:4], few[4], *many[5:])
    refused(RuntimeError, "isect_splats must be numbers of the", count, *few[:3], *many[3:])


def by_scipy(dirs, degree):
    """The basis from complex spherical harmonics, [N, K]."""
    x, y, z = torch.nn.functional.normalize(dirs, dim=1).unbind(1)
    polar, azimuth = torch.acos(z).numpy(), torch.atan2(y, x).numpy()
    basis = []
    for degree_l in range(degree + 1):
        for m in range(-degree_l, degree_l + 1):
            value = sph_harm_y(degree_l, abs(m), polar, azimuth)
            basis.append(math.sqrt(2 if m else 1) * (value.imag if m < 0 else value.real))
    return torch.stack([torch.from_numpy(values) for values in basis], dim=1)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_values_are_those_of_scipy(degree, channels):
    generator = torch.Generator().manual_seed(degree)
    dirs = 3 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    coeffs = torch.randn(30, 25, channels, generator=generator, dtype=torch.float64)
    masks = torch.rand(30, generator=generator) > 0.4
    basis = by_scipy(dirs, degree)
    expected = torch.einsum("nk,nkd->nd", basis, coeffs[:, : basis.shape[1]])
    assert relative_error(blitzgs.spherical_harmonics(degree, dirs, coeffs), expected) < 1e-14
    masked = blitzgs.spherical_harmonics(degree, dirs, coeffs, masks)
    assert torch.equal(masked[~masks], torch.zeros_like(expected[~masks]))
    assert relative_error(masked[masks], expected[masks]) < 1e-14


def test_gradients():
    dirs = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(4, 25, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, c: blitzgs.spherical_harmonics(4, d, c), (dirs, coeffs))
    at_zero = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    blitzgs.spherical_harmonics(4, at_zero, coeffs[:1].float()).sum().backward()  # the dtypes may differ
    assert at_zero.grad.isfinite().all()


@pytest.mark.parametrize("bad", ["dirs", "coeffs"])
def test_what_is_masked_has_no_gradient_even_if_it_is_not_finite(bad):
    given = {"dirs": torch.randn(4, 2, 3), "coeffs": torch.randn(4, 1, 9, 3)}  # coefficients of both views
    masks = torch.tensor([[True, False]] * 3 + [[False, False]])
    given[bad][~masks if bad == "dirs" else 3] = torch.nan
    leaves = {name: value.requires_grad_() for name, value in given.items()}
    blitzgs.spherical_harmonics(2, **leaves, masks=masks).sum().backward()
    for name, value in leaves.items():
        assert value.grad.isfinite().all(), name
    assert not leaves["dirs"].grad[~masks].any() and leaves["coeffs"].grad[:3].any()


@pytest.mark.parametrize(
    ("degree", "dirs", "coeffs", "message"),
    [
        (5, (4, 3), (4, 36, 3), "degree must be 0 to 4, got 5"),
        (1, (4, 2), (4, 4, 3), r"dirs must be \[..., 3\], got \[4, 2\]"),
        (2, (4, 3), (4, 8, 3), r"coeffs must be \[..., K, D\] with K >= 9, got \[4, 8, 3\]"),
    ],
)
def test_errors(degree, dirs, coeffs, message):
    refused(ValueError, message, blitzgs.spherical_harmonics, degree, torch.zeros(dirs), torch.zeros(coeffs))


def test_masks_and_coefficients_of_other_rows_are_refused():
    message = r"leading dimensions must broadcast: dirs \[4, 3\], coeffs \[{}, 4, 3\], masks {}"
    for rows, masks, shown in ((5, None, "None"), (4, torch.ones(3, dtype=torch.bool), r"\[3\]")):
        arguments = 1, torch.zeros(4, 3), torch.zeros(rows, 4, 3), masks
        refused(ValueError, message.format(rows, shown), blitzgs.spherical_harmonics, *arguments)


@pytest.mark.parametrize(
    ("function", "names"),
    [
        (
            lambda dirs, coeffs, masks: blitzgs.spherical_harmonics(0, dirs, coeffs, masks),
            "dirs coeffs masks",
        ),
        (blitzgs.quat_scale_to_covar_preci, "quats scales"),
        (blitzgs.relocate, "opacities scales ratios"),
    ],
    ids=["spherical_harmonics", "quat_scale_to_covar_preci", "relocate"],
)
def test_what_is_no_tensor_is_named(function, names):
    for name in names.split():
        given = {other: torch.ones(1, 3) for other in names.split()}
        if "masks" in given:
            given |= {"coeffs": torch.ones(1, 1, 3), "masks": torch.ones(1, dtype=torch.bool)}
        refused(TypeError, f"{name} must be a torch.Tensor, got list", function, **{**given, name: [1.0]})


def test_masks_of_another_dtype_are_named():
    message = "masks must be bool, got torch.int64; pass masks != 0"
    arguments = 1, torch.zeros(4, 3), torch.zeros(4, 4, 3), torch.ones(4, dtype=torch.int64)
    refused(TypeError, message, blitzgs.spherical_harmonics, *arguments)


def with_channels(scene, channels):
    """The scene with other SH channels; the last ones are those that it had."""
    extra = torch.randn(*scene.colors.shape[:-1], channels - 3, dtype=scene.colors.dtype)
    scene.colors = torch.cat([extra, scene.colors], dim=-1)
    return scene


@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}], ids=str)
@pytest.mark.parametrize("cameras", [1, 3])
def test_images_and_gradients_of_more_channels_are_those_of_the_kernels(options, cameras):
    scene = random_scene(n=60, cameras=cameras, dtype=torch.float64)
    results = []
    for channels in (3, 5):
        leaves = with_channels(scene, channels).leaves() if channels > 3 else scene.leaves()
        image = rasterize_scene(leaves, **options)[0][..., channels - 3 :]
        gradients = torch.autograd.grad(image.sin().sum(), leaves.parameters())
        results.append([image, *(g[..., -3:] if g.shape[-1] == channels else g for g in gradients)])
    agree(*results, 1e-10)


def test_degree_4_is_degree_3_and_nine_more_functions():
    scene = random_scene(n=60, dtype=torch.float64)
    three = rasterize_scene(scene)[0]
    scene.colors = torch.cat([scene.colors, torch.zeros_like(scene.colors[:, :9])], dim=1)
    assert relative_error(rasterize_scene(scene, sh_degree=4)[0], three) < 1e-12
    scene.colors[:, 16:] = 0.2
    assert relative_error(rasterize_scene(scene, sh_degree=4)[0], three) > 1e-3


@pytest.mark.parametrize("channels", [3, 4])
def test_sh_without_batch_dimensions_are_those_of_all_scenes(channels):
    scene = random_scene(n=30, cameras=2, dtype=torch.float64)
    if channels > 3:
        with_channels(scene, channels)
    leaf = scene.colors.clone().requires_grad_()

    def twice(tensor):
        return torch.stack([tensor, tensor])

    image, _, _ = blitzgs.rasterization(
        *map(twice, (scene.means, scene.quats, scene.scales, scene.opacities)), leaf,
        *map(twice, (scene.viewmats, scene.Ks)), scene.width, scene.height, sh_degree=3,
    )  # fmt: skip
    scene.colors = alone = scene.colors.clone().requires_grad_()
    expected = rasterize_scene(scene)[0]
    assert relative_error(image, twice(expected)) < 1e-12
    (actual,), (one,) = (torch.autograd.grad(x.sin().sum(), y) for x, y in ((image, leaf), (expected, alone)))
    assert relative_error(actual, 2 * one) < 1e-12


@pytest.mark.filterwarnings("ignore:blitzgs.rasterization")
def test_what_is_not_finite_hides_its_own_gaussian_or_view():
    scene = with_channels(random_scene(n=30, cameras=3, dtype=torch.float64), 4)
    scene.means[3], scene.viewmats[1, 0, 3] = math.nan, math.inf
    image, alphas, meta = rasterize_scene(scene)
    assert set(meta["non_finite"]) == {"means", "viewmats"}
    assert image.isfinite().all() and (alphas[1] == 0).all() and (alphas[[0, 2]] > 0).any((1, 2, 3)).all()
