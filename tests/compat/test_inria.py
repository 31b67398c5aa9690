# SPDX-License-Identifier: Apache-2.0
"""INRIA's interface renders, in float64, what the formulas of INRIA's code give, gradients included."""

import re

import pytest
import torch

from blitzgs.compat import inria
from blitzgs.reference.projection import sh_colors
from blitzgs.util.rotations import quaternion_matrices
from tests.helpers import orbit_camera, other_defaults, refused, relative_error, ssim_map


def camera(angle=0.3, distance=3.0, tanfovx=0.5, tanfovy=0.4, shift=(0.0, 0.0), dtype=torch.float64):
    """Return the matrices of a trainer for row vectors: view, full projection, and the centre."""
    view = orbit_camera(angle, distance).T
    centre = -view[:3, :3] @ view[3, :3]
    near, far = 0.01, 100.0
    clip = torch.zeros(4, 4, dtype=torch.float64)
    clip[0, 0], clip[1, 1] = 1 / tanfovx, 1 / tanfovy
    clip[0, 2], clip[1, 2] = shift
    clip[2, 2], clip[2, 3], clip[3, 2] = far / (far - near), -far * near / (far - near), 1
    return view.to(dtype), (view @ clip.T).to(dtype), centre.to(dtype)


def covariances(scales, rotations, modifier):
    """The 3D covariances; the quaternions are not normalised."""
    scaled = quaternion_matrices(rotations) @ torch.diag_embed(modifier * scales)
    return scaled @ scaled.transpose(1, 2)


def render(s, means, opacities, offsets, sh=None, colors=None, covariance=None, tile_cut=False):
    """Return image [C, H, W], inverse depth and depth [H, W], radii [N], and the marks of cut pixels [H, W].

    `offsets` [N, 2], zeros, are added to the projected means in clip space.
    """
    height, width = s.image_height, s.image_width
    homogeneous = torch.cat([means, torch.ones_like(means[:, :1])], dim=1)
    t = homogeneous @ s.viewmatrix
    clip = homogeneous @ s.projmatrix
    screen = clip[:, :2] / clip[:, 3:] + offsets
    size = means.new_tensor([width, height])
    pixels = ((screen + 1) * size - 1) / 2  # the centre of pixel (i, j) is (i, j) here
    focal = size / (2 * means.new_tensor([s.tanfovx, s.tanfovy]))
    z = t[:, 2]
    slopes = torch.stack(
        [
            (t[:, 0] / z).clamp(-1.3 * s.tanfovx, 1.3 * s.tanfovx),
            (t[:, 1] / z).clamp(-1.3 * s.tanfovy, 1.3 * s.tanfovy),
        ]
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [focal[0] / z, zero, -focal[0] * slopes[0] / z, zero, focal[1] / z, -focal[1] * slopes[1] / z], dim=1
    ).view(-1, 2, 3)
    onto = jacobian @ s.viewmatrix[:3, :3].T
    flat = onto @ covariance @ onto.transpose(1, 2)
    sharp = torch.linalg.det(flat)
    flat = flat + 0.3 * torch.eye(2, dtype=flat.dtype)
    determinant = torch.linalg.det(flat)
    conic = torch.linalg.inv(flat)
    middle = 0.5 * (flat[:, 0, 0] + flat[:, 1, 1])
    radius = (3 * (middle + (middle**2 - determinant).clamp(min=0.1).sqrt()).sqrt()).ceil().detach()
    opacities = opacities.view(-1)
    if s.antialiasing:
        opacities = opacities * (sharp / determinant).clamp(min=0.000025).sqrt()
    if colors is None:
        colors = sh_colors(means, sh, s.campos, s.sh_degree)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = means.new_zeros(colors.shape[1], height, width)
    inverse, depth, left = (means.new_zeros(height, width) for _ in range(3))
    left = left + 1
    done, marks = torch.zeros(height, width, dtype=bool), torch.zeros(height, width, dtype=bool)
    for i in torch.argsort(z.detach(), stable=True).tolist():
        if z[i] <= 0.2:
            continue
        dx, dy = pixels[i, 0] - columns, pixels[i, 1] - rows
        power = -0.5 * (conic[i, 0, 0] * dx**2 + conic[i, 1, 1] * dy**2) - conic[i, 0, 1] * dx * dy
        alpha = (opacities[i] * power.exp()).clamp(max=0.99)
        drawn = (alpha >= 1 / 255) & ~done
        if tile_cut:
            lowest = [int(((p - radius[i]) / 16).clamp(min=0)) for p in pixels[i]]
            highest = [int((p + radius[i] + 15) / 16) for p in pixels[i]]
            drawn &= (columns // 16 >= lowest[0]) & (columns // 16 < highest[0])
            drawn &= (rows // 16 >= lowest[1]) & (rows // 16 < highest[1])
        after = left * (1 - alpha)
        marks |= ((alpha * 255 - 1).abs() < 1e-6) | (drawn & ((after / 1e-4 - 1).abs() < 1e-6))
        done = done | (drawn & (after < 1e-4))
        drawn &= ~done
        weight = torch.where(drawn, alpha * left, 0)
        image = image + weight * colors[i][:, None, None]
        inverse, depth = inverse + weight / z[i], depth + weight * z[i]
        left = torch.where(drawn, after, left)
    return image + left * s.bg[:, None, None], inverse, depth, radius.int(), marks


WIDTH, HEIGHT, COUNT = 34, 27, 28


def settings(shift=(0.0, 0.0), **changes):
    view, full, centre = camera(shift=shift)
    values = {
        "image_height": HEIGHT, "image_width": WIDTH, "tanfovx": 0.5, "tanfovy": 0.4,
        "bg": torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64), "scale_modifier": 1.2, "viewmatrix": view,
        "projmatrix": full, "sh_degree": 1, "campos": centre, "prefiltered": False, "debug": False,
    }  # fmt: skip
    return inria.GaussianRasterizationSettings(**{**values, **changes})


def leaves(seed=0, most_opaque=0.98):
    g = torch.Generator().manual_seed(seed)
    uniform = torch.rand(COUNT, 3, generator=g, dtype=torch.float64)
    normal = torch.randn(COUNT, 24, generator=g, dtype=torch.float64)
    values = {
        "means3D": 2 * uniform - 1,
        "opacities": most_opaque * uniform[:, :1],
        "scales": 0.1 * torch.exp(0.5 * normal[:, :3]),
        "rotations": torch.nn.functional.normalize(normal[:, 3:7], dim=1),
        "shs": 0.3 * normal[:, 7:19].view(COUNT, 4, 3),
        "colors_precomp": normal[:, 19:24].abs(),
    }
    values["means3D"][:2] = camera()[2] * torch.tensor([[0.94], [1.2]])  # nearer than 0.2, and behind
    return {name: value.requires_grad_() for name, value in values.items()}


def compare(setting, given, expected_covariance, bound=1e-9, rasterizer=inria.GaussianRasterizer, **options):
    """Compare images, radii and gradients of the leaves `given`; return the rasteriser's results."""
    used = {name: value for name, value in given.items() if value is not None}
    means2d, offsets = (torch.zeros(COUNT, n, dtype=torch.float64, requires_grad=True) for n in (3, 2))
    results = rasterizer(setting)(means2D=means2d, **used)
    image, inverse, depth, radii, marks = render(
        setting, used["means3D"], used["opacities"], offsets, used.get("shs"), used.get("colors_precomp"),
        expected_covariance(used), **options,
    )  # fmt: skip
    assert marks.sum() == 0 and (image - setting.bg[:, None, None]).abs().max() > 0.2
    expected = [image, inverse[None]] if setting.antialiasing is not None else [image]
    if rasterizer is inria.DepthGaussianRasterizer:
        expected = [image, depth[None]]
    found = [results[0], *results[2:]]
    assert len(found) == len(expected)
    weights = [torch.randn(t.shape, generator=torch.Generator().manual_seed(1)).double() for t in expected]
    inputs = [*used.values()]
    ours = torch.autograd.grad(
        sum((a * w).sum() for a, w in zip(found, weights, strict=True)), [*inputs, means2d], retain_graph=True
    )
    theirs = torch.autograd.grad(
        sum((a * w).sum() for a, w in zip(expected, weights, strict=True)), [*inputs, offsets]
    )
    for actual, wanted in zip(found, expected, strict=True):
        assert relative_error(actual, wanted) < bound
    seen = results[1] > 0
    assert 5 < seen.sum() < COUNT and results[1].dtype == torch.int32 and not seen[:2].any()
    assert torch.equal(results[1][seen], radii[seen])
    assert not ours[-1][:, 2].any()
    pairs = zip([*used, "means2D"], [*ours[:-1], ours[-1][:, :2]], theirs, strict=True)
    for name, actual, wanted in pairs:
        assert wanted.abs().max() > 1e-3, name
        assert relative_error(actual, wanted) < bound * 100, name
    return results


def of_scales(modifier=1.2):
    return lambda used: covariances(used["scales"], used["rotations"], modifier)


def without(given, *names):
    return {name: value for name, value in given.items() if name not in names}


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.1, -0.2)])
def test_rotations_of_any_length_are_not_normalised(shift):
    # With a shifted centre the clamped slopes differ, so only Gaussians inside the image are compared.
    given = without(leaves(), "colors_precomp")
    given["rotations"] = (given["rotations"] * 1.15).detach().requires_grad_()
    if shift != (0.0, 0.0):
        given["means3D"] = (given["means3D"] * torch.tensor([0.4, 0.4, 1])).detach().requires_grad_()
        given["means3D"].data[:2] = camera()[2] * torch.tensor([[0.94], [1.2]])
    compare(settings(shift), given, of_scales())


def test_normalised_rotations_and_channels():
    """What a trainer trains is the quaternion before it is normalised."""
    given = without(leaves(), "shs")
    given["quats"] = given.pop("rotations")
    background = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5], dtype=torch.float64)

    def normalised(quats):
        return torch.nn.functional.normalize(quats * 2, dim=1)

    class Normalised(inria.GaussianRasterizer):
        def forward(self, quats, **arguments):
            return super().forward(rotations=normalised(quats), **arguments)

    def covariance(used):
        return covariances(used["scales"], normalised(used["quats"]), 1.2)

    compare(settings(bg=background), given, covariance, rasterizer=Normalised)


@pytest.mark.parametrize("antialiasing", [False, True])
def test_the_newer_interface_has_antialiasing_and_inverse_depth(antialiasing):
    given = without(leaves(3), "colors_precomp")
    given["rotations"] = (given["rotations"] * 0.9).detach().requires_grad_()
    results = compare(settings(antialiasing=antialiasing), given, of_scales())
    assert results[2].shape == (1, HEIGHT, WIDTH)


def test_the_depth_of_the_forks():
    given = without(leaves(4), "colors_precomp")
    given["rotations"] = (given["rotations"] * 0.9).detach().requires_grad_()
    compare(settings(), given, of_scales(), rasterizer=inria.DepthGaussianRasterizer)


@pytest.mark.parametrize("length", [1.0, 1.15])
def test_float32_on_each_device(device, length):
    """Both ways, that of normalised rotations and that of others, against float64."""
    results = []
    for dtype, place in ((torch.float64, "cpu"), (torch.float32, device)):
        given = without(leaves(8), "colors_precomp")
        given["rotations"] = given["rotations"] * length
        given = {name: value.detach().to(place, dtype).requires_grad_() for name, value in given.items()}
        moved = {
            n: v.to(place, dtype) for n, v in settings()._asdict().items() if isinstance(v, torch.Tensor)
        }
        screen, densify = (torch.zeros_like(given["means3D"], requires_grad=True) for _ in range(2))
        image, radii, inverse = inria.GaussianRasterizer(settings(antialiasing=True, **moved))(
            means2D=screen, means2D_densify=densify, **given
        )
        (image.square().sum() + inverse.sum()).backward()
        results.append([image, inverse, radii, *(v.grad for v in (screen, densify, *given.values()))])
    for expected, actual in zip(*results, strict=True):
        assert relative_error(actual, expected) < 1e-4


def test_needles_longer_than_float32_has_digits_are_not_small():
    """A trainer prunes by radius; rounding leaves nothing of the determinant of their covariance."""
    given = without(leaves(8), "colors_precomp")
    scales = torch.tensor([1e3, 1e-3, 1e-3]).expand_as(given["scales"]).double()
    full = covariances(scales, torch.nn.functional.normalize(given["rotations"], dim=1), 1).float()
    used = {name: given[name].detach().float() for name in ("means3D", "opacities", "shs")}
    used["cov3D_precomp"] = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    moved = {n: v.float() for n, v in settings()._asdict().items() if isinstance(v, torch.Tensor)}
    screen = torch.zeros_like(used["means3D"])
    _, radii, _ = inria.GaussianRasterizer(settings(antialiasing=False, **moved))(means2D=screen, **used)
    assert (radii > 0).sum() > 20 and radii[radii > 0].min() > 3_000


def test_precomputed_covariances():
    given = leaves(5)
    full = covariances(given["scales"], given["rotations"], 1).detach()
    used = without(given, "scales", "rotations", "colors_precomp")
    used["cov3D_precomp"] = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].requires_grad_()
    compare(
        settings(scale_modifier=3.0), used,
        lambda values: values["cov3D_precomp"][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3),
    )  # fmt: skip


def test_the_tiles_of_inria_cut_nothing_of_faint_splats():
    # 3 standard deviations from the mean, an opacity of 0.35 has fallen to 1 / 255.
    given = without(leaves(6, most_opaque=0.35), "colors_precomp")
    given["rotations"] = (given["rotations"] * 1.1).detach().requires_grad_()
    compare(settings(), given, of_scales(), tile_cut=True)


def test_absolute_gradients_for_densification():
    given = without(leaves(7), "colors_precomp")
    zeros = [torch.zeros(COUNT, 3, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    screen, densify = (zero + 0 for zero in zeros)
    screen.retain_grad()
    densify.retain_grad()
    image, *_ = inria.DepthGaussianRasterizer(settings())(means2D=screen, means2D_densify=densify, **given)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(2)).double()
    kept = torch.zeros(HEIGHT, WIDTH, dtype=torch.float64)
    kept[1::4, 1::3] = 1
    weights *= kept
    (image * weights).sum().backward()
    # The sum of |gradient| over the pixels, one pixel at a time.
    offsets = torch.zeros(COUNT, 2, dtype=torch.float64, requires_grad=True)
    expected, *_ = render(
        settings(), given["means3D"], given["opacities"], offsets, given["shs"], None, of_scales()(given)
    )
    pixels = (expected * weights).sum(0).flatten()
    total = torch.zeros(COUNT, 2, dtype=torch.float64)
    for pixel in pixels[weights[0].flatten() != 0]:
        total += torch.autograd.grad(pixel, offsets, retain_graph=True)[0].abs()
    assert relative_error(densify.grad[:, :2], total) < 1e-8
    assert (screen.grad.abs() <= densify.grad + 1e-9).all() and screen.grad.abs().sum() < densify.grad.sum()


@pytest.mark.parametrize("name", ["means2D", "means2D_densify"])
def test_gradients_on_the_screen_are_first_derivatives_only(name):
    screen = torch.zeros(COUNT, 3, dtype=torch.float64, requires_grad=True)
    given = {"means2D": None, **without(leaves(7), "colors_precomp"), name: screen}
    image, *_ = inria.GaussianRasterizer(settings())(**given)
    (gradient,) = torch.autograd.grad(image.sum(), screen, create_graph=True)
    refused(RuntimeError, "GaussianRasterizer has first derivatives only", gradient.sum().backward)


@pytest.mark.parametrize("name", ["means2D", "means2D_densify"])
@pytest.mark.parametrize("shape", [(COUNT + 1, 3), (COUNT, 1), (COUNT,)], ids=str)
def test_screen_tensors_of_another_shape_are_named(name, shape):
    given = {"means2D": None, **without(leaves(7), "colors_precomp"), name: torch.zeros(shape)}
    message = rf"{name} must be \[N, 2 or more\] with N = {COUNT}, got \[{shape[0]}"
    refused(RuntimeError, message, inria.GaussianRasterizer(settings()), **given)


@pytest.mark.parametrize(
    "name, shape",
    [
        ("colors_precomp", (COUNT + 1, 3)), ("cov3D_precomp", (COUNT, 3, 3)), ("scales", (1, 3)),
        ("rotations", (COUNT, 3)), ("bg", (2,)),
    ],
)  # fmt: skip
def test_tables_of_another_shape_are_named(name, shape):
    given, changes = without(leaves(7), "colors_precomp"), {}
    if name == "bg":
        changes = {name: torch.zeros(shape)}
    else:
        replaced = {"colors_precomp": ["shs"], "cov3D_precomp": ["scales", "rotations"]}.get(name, [])
        # Rotations of another length take a path on which rows would broadcast.
        given = {**without(given, *replaced), name: torch.ones(shape, dtype=torch.float64)}
        if name == "scales":
            given["rotations"] = 2 * given["rotations"]
    message = re.escape(f"{name} must be ") + r".*" + re.escape(f", got {[*shape]}")
    refused(RuntimeError, message, inria.GaussianRasterizer(settings(**changes)), means2D=None, **given)


def test_matrices_may_have_a_batch_dimension_of_one():
    given, plain = without(leaves(), "colors_precomp"), settings()
    matrices = {name: getattr(plain, name)[None] for name in ("viewmatrix", "projmatrix")}
    wanted, found = (inria.GaussianRasterizer(s) for s in (plain, settings(**matrices)))
    assert torch.equal(found(means2D=None, **given)[0], wanted(means2D=None, **given)[0])
    assert torch.equal(found.markVisible(given["means3D"]), wanted.markVisible(given["means3D"]))


def test_the_defaults_of_torch_have_no_effect():
    given, rasterizer = without(leaves(), "colors_precomp"), inria.GaussianRasterizer(settings())
    expected, _ = rasterizer(means2D=None, **given)
    with other_defaults():
        image, _ = rasterizer(means2D=None, **given)
    assert torch.equal(image, expected)


def test_visibility():
    given, setting = leaves(), settings()
    means, depths = given["means3D"], given["means3D"] @ setting.viewmatrix[:3, 2] + setting.viewmatrix[3, 2]
    rasterizer = inria.GaussianRasterizer(raster_settings=setting)
    visible = rasterizer.markVisible(means)
    assert torch.equal(visible, depths > 0.2) and 0 < visible.sum() < COUNT
    radii = rasterizer.visible_filter(means, given["scales"], given["rotations"])
    image_radii = rasterizer(
        means, None, given["opacities"], given["shs"], scales=given["scales"], rotations=given["rotations"]
    )[1]
    assert torch.equal(radii[image_radii > 0], image_radii[image_radii > 0]) and not radii.requires_grad
    assert not radii[~visible].any()


def test_the_first_coefficient_may_come_alone():
    given = without(leaves(), "colors_precomp")
    rasterizer = inria.GaussianRasterizer(settings())
    expected, _ = rasterizer(means2D=None, **given)
    rest = {**given, "dc": given["shs"][:, :1], "shs": given["shs"][:, 1:]}
    assert torch.equal(rasterizer(means2D=None, **rest)[0], expected)


def test_no_gaussians_leave_the_background():
    none = {name: value[:0] for name, value in without(leaves(), "colors_precomp").items()}
    image, radii = inria.GaussianRasterizer(settings())(means2D=none["means3D"], **none)
    assert torch.equal(image, settings().bg[:, None, None].expand(3, HEIGHT, WIDTH)) and len(radii) == 0


def test_a_pose_gets_a_gradient():
    view, full, _ = camera()
    pose = view.clone().requires_grad_()
    image, _ = inria.GaussianRasterizer(settings(viewmatrix=pose, projmatrix=full))(
        means2D=None, **without(leaves(), "colors_precomp")
    )
    image.square().sum().backward()
    assert pose.grad[:, :3].abs().max() > 1e-3


@pytest.mark.parametrize(
    "changes, arguments, message",
    [
        ({}, {"colors_precomp": None, "shs": None}, "either shs"),
        ({}, {"cov3D_precomp": torch.zeros(COUNT, 6)}, "either scales and rotations"),
        ({}, {"rotations": None}, "either scales and rotations"),
        ({"tanfovx": 0.7}, {}, "projmatrix does not fit"),
        ({"projmatrix": camera()[1].T}, {}, "projmatrix does not fit"),
        ({"campos": torch.ones(3)}, {}, "campos is"),
    ],
)
def test_contradictions_are_named(changes, arguments, message):
    given = {**without(leaves(), "colors_precomp"), **arguments}
    refused(ValueError, message, inria.GaussianRasterizer(settings(**changes)), means2D=None, **given)


def test_distances_to_neighbours():
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    distances = torch.cdist(points, points).square().sort(dim=1)[0][:, 1:4].mean(dim=1)
    assert relative_error(inria.distCUDA2(points), distances) < 1e-10


def test_fused_ssim_is_the_mean_ssim():
    g = torch.Generator().manual_seed(0)
    x, y = (torch.rand(2, 3, 20, 24, generator=g, dtype=torch.float64) for _ in range(2))
    x.requires_grad_()
    ssim = ssim_map(x.movedim(1, -1), y.movedim(1, -1))
    found = inria.fused_ssim(x, y)
    assert abs((found - ssim.mean()).item()) < 1e-12
    gradients = [torch.autograd.grad(value, x)[0] for value in (found, ssim.mean())]
    assert relative_error(*gradients) < 1e-9
    inner = ssim[:, 5:-5, 5:-5].mean()
    assert abs((inria.fused_ssim(x, y, padding="valid") - inner).item()) < 1e-12
    for shape in ((3, 20, 24), (2, 1, 20, 24)):
        message = r"img1 and img2 must be \[B, 3, H, W\], got"
        refused(ValueError, message, inria.fused_ssim, torch.zeros(shape), torch.zeros(shape))
