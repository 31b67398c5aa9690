# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest
import torch

from blitzgs.ops.intersect import intersect
from blitzgs.ops.project import project, queue_projection
from blitzgs.ops.projection_types import (
    VIEW_TOTALS,
    ProjectionInputs,
    ProjectionOptions,
    Sizes,
)
from tests.helpers import (
    PARAMETERS,
    on_threads,
    orbit_camera,
    random_scene,
    reference_images,
    refused,
    relative_error,
)

FLOATS = ("means2d", "conics", "depths", "opacities", "colors")


def project_scene(scene, **options):
    colors = options.pop("sh", scene.colors)
    return project(
        scene.means, scene.quats, scene.scales, scene.opacities, colors, scene.viewmats, scene.Ks,
        scene.width, scene.height, **{"sh_degree": 3, "raw": False, **options},
    )  # fmt: skip


def before_activation(scene):
    scene.scales = scene.scales.log()
    scene.opacities = scene.opacities.logit()
    return scene


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 3e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_splats_match_the_reference(dtype, tolerance, antialiased, degree):
    scene = random_scene(n=200, cameras=3, dtype=dtype)
    scene.sh_degree = degree
    splats = project_scene(scene, sh_degree=degree, antialiased=antialiased)
    assert len(splats.means2d) > 100
    for c, image in enumerate(reference_images(scene, antialiased=antialiased)):
        seen = (splats.camera_ids == c).nonzero()[:, 0]
        place = {g: i for i, g in enumerate(image.splats.ids.tolist())}
        same = [place[g] for g in splats.gaussian_ids[seen].tolist()]
        for name in FLOATS:
            actual, expected = getattr(splats, name)[seen], getattr(image.splats, name)[same]
            assert relative_error(actual, expected) < tolerance, name


@pytest.mark.parametrize("antialiased", [False, True])
def test_only_what_cannot_touch_a_pixel_is_culled(antialiased):
    scene = random_scene(n=400, cameras=3, width=24, height=20, dtype=torch.float64, scale=0.05)
    scene.means *= 2.5
    splats = project_scene(scene, antialiased=antialiased)
    pairs = set(zip(splats.camera_ids.tolist(), splats.gaussian_ids.tolist(), strict=True))
    x, y = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(20) + 0.5, indexing="xy")
    culled = 0
    for c, image in enumerate(reference_images(scene, antialiased=antialiased)):
        s = image.splats
        d = torch.stack([x, y], dim=-1).reshape(1, -1, 2) - s.means2d[:, None]
        a, b, k = s.conics[:, None].unbind(dim=-1)
        q = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + k * d[..., 1] ** 2
        drawn = (s.opacities[:, None] * torch.exp(-q / 2) >= 1 / 255).any(dim=1)
        for gaussian, seen in zip(s.ids.tolist(), drawn.tolist(), strict=True):
            assert not seen or (c, gaussian) in pairs
            culled += (c, gaussian) not in pairs
    assert culled > 100


def test_splats_are_ordered_and_indexed_by_gaussian():
    splats = project_scene(random_scene(n=3000, cameras=3))
    U, P, tiles = splats.counts.tolist()
    assert (len(splats.visible_ids), len(splats.gaussian_ids)) == (U, P)
    assert tiles == splats.tiles_touched.sum().item() > 0
    key = splats.gaussian_ids.long() * 32 + splats.camera_ids
    assert (key[1:] > key[:-1]).all()
    assert splats.splat_offsets[0] == 0 and splats.splat_offsets[-1] == P
    counts = splats.splat_offsets[1:] - splats.splat_offsets[:-1]
    assert torch.equal(splats.visible_ids.repeat_interleave(counts.long()), splats.gaussian_ids)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_splat_depends_on_its_gaussian_and_view_alone(dtype):
    scene = random_scene(n=2100, cameras=3, dtype=dtype)
    full = project_scene(scene)
    generator = torch.Generator().manual_seed(1)
    ids = torch.randperm(2100, generator=generator)[:700].sort().values.int()
    masks = torch.randint(0, 8, (700,), generator=generator, dtype=torch.int32)
    part = project_scene(scene, active_ids=ids, active_views=masks)
    allowed = dict(zip(ids.tolist(), masks.tolist(), strict=True))
    keep = torch.tensor(
        [
            bool(allowed.get(g, 0) >> c & 1)
            for g, c in zip(full.gaussian_ids.tolist(), full.camera_ids.tolist(), strict=True)
        ]
    )
    assert keep.sum() > 100
    for name in ("gaussian_ids", "camera_ids", *FLOATS, "radii", "tiles_touched"):
        assert torch.equal(getattr(part, name), getattr(full, name)[keep]), name


def test_gradcheck_of_clamped_slopes():
    """A large Gaussian centred outside the image, where the Jacobian does not follow its position."""
    K = torch.tensor([[[30.0, 0, 10], [0, 30.0, 8], [0, 0, 1]]], dtype=torch.float64)
    means = torch.tensor([[2.0, 0.3, 2.0], [-0.2, -1.8, 2.0], [-2.5, 2.0, 1.9]], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.2, -0.4, 0.3]] * 3, dtype=torch.float64)
    scales = torch.tensor([[1.0, 0.5, 0.8]] * 3, dtype=torch.float64)

    def splats(means, quats, scales, viewmats):
        result = project(
            means, quats, scales, torch.full((3,), 0.7).double(), None, viewmats, K, 20, 16, raw=False
        )
        assert len(result.depths) == 3
        return result.means2d, result.conics, result.depths

    inputs = [t.requires_grad_() for t in (means, quats, scales, orbit_camera(0.0, 0.01)[None])]
    assert torch.autograd.gradcheck(splats, inputs)


def test_gradients_are_repeatable_and_sum_over_views():
    scene = random_scene(n=1500, cameras=2).leaves()

    def gradients(scene):
        splats = project_scene(scene)
        loss = (
            splats.means2d.square().mean()
            + splats.conics.sum()
            + splats.colors.sum()
            + splats.opacities.sum()
        )
        return torch.autograd.grad(loss, scene.parameters())

    first, second = on_threads(lambda: gradients(scene), (1, 3))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert all(a.abs().sum() > 0 for a in first)


@pytest.mark.parametrize("degree, coefficients", [(3, 16), (1, 16), (2, 9), (0, 1), (None, 0)])
def test_dense_gradients_equal_scattered_compact_ones(backend, degree, coefficients):
    device, dtype = backend
    scene = random_scene(n=701, cameras=2, width=20, height=16, dtype=dtype, device=device)
    scene.means[::2] *= 20.0  # seen by no view
    sh = None if degree is None else scene.colors[:, :coefficients].contiguous()
    splats = project_scene(scene, sh=sh, sh_degree=degree or 0)
    generator = torch.Generator().manual_seed(1)
    means2d, conics, depths, opacities, colors = (
        torch.randn(len(splats.depths), width, generator=generator).to(device, dtype)
        for width in (2, 3, 1, 1, 3)
    )
    options = ProjectionOptions(scene.width, scene.height, sh_degree=degree or 0, antialiased=True, raw=False)
    gaussians = [scene.means, scene.quats, scene.scales, scene.opacities]
    v_splats = [means2d, conics, opacities[:, 0]]
    if sh is not None:
        gaussians, v_splats = [*gaussians, sh], [*v_splats, colors]
    arguments = (
        gaussians, scene.viewmats, scene.Ks, None, None, splats.camera_ids, splats.visible_ids,
        splats.splat_offsets, None, *options, v_splats, depths[:, 0], True,
    )  # fmt: skip
    compact = torch.ops.blitzgs.project_bwd(*arguments)
    # The memory that is freed here, and probably used for the gradients, is not zero.
    del [part.new_full((701, *part.shape[1:]), torch.nan) for part in compact][:]
    dense = torch.ops.blitzgs.project_bwd(*arguments, dense=True)
    ids = splats.visible_ids.long()
    assert 10 < len(ids) < 600
    for part, whole in zip(compact[:5], dense[:5], strict=True):
        expected = part.new_zeros(701, *part.shape[1:]).index_copy(0, ids, part)
        assert torch.equal(whole, expected)
    assert torch.equal(compact[5], dense[5])
    if degree in (3, None) and dtype == torch.float32:
        torch.library.opcheck(torch.ops.blitzgs.project_bwd, arguments, {"dense": True})


def test_non_finite_gaussians_are_dropped_and_others_are_unchanged():
    scene = random_scene(n=40, cameras=2)
    clean = project_scene(scene)
    poisoned = {3: "means", 7: "quats", 11: "scales", 13: "opacities", 17: "colors"}
    for splat, name in poisoned.items():
        getattr(scene, name)[splat] = math.nan if splat % 2 else math.inf
    scene.means[19] = math.inf
    scene.scales[23, 1] = -math.inf
    gone = torch.tensor([*(set(poisoned) - {17}), 19, 23], dtype=torch.int32)
    leaves = scene.leaves()
    splats = project_scene(leaves)
    keep = ~torch.isin(clean.gaussian_ids, gone)
    assert torch.equal(splats.gaussian_ids, clean.gaussian_ids[keep])
    # Where only the colour is not finite there are splats, but nothing composites them.
    hidden = splats.gaussian_ids == 17
    assert hidden.any()
    for name in ("opacities", "colors", "radii", "tiles_touched"):
        assert (getattr(splats, name)[hidden] == 0).all()
    for name in FLOATS:
        assert torch.equal(getattr(splats, name)[~hidden], getattr(clean, name)[keep][~hidden]), name
    sum(getattr(splats, name).square().sum() for name in FLOATS).backward()
    for name in PARAMETERS:
        assert getattr(leaves, name).grad.isfinite().all(), name
        if name != "viewmats":
            assert (getattr(leaves, name).grad[gone.long()] == 0).all()
    assert (leaves.colors.grad[17] == 0).all()


def test_each_splat_knows_the_ranks_that_composite_its_tiles():
    scene = random_scene(n=500, cameras=2, width=70, height=40)  # 5 x 3 tiles a view
    ranges = [(0, 18), (12, 12), (12, 30)]
    inputs = inputs_of(scene)
    splats, ids, totals = queue_projection(inputs._replace(ids=torch.arange(500) + 7), None, ranges)
    assert torch.equal(ids, splats.gaussian_ids + 7)
    masks = torch.zeros_like(splats.rank_masks)
    for rank, (begin, end) in enumerate(ranges):
        listed, _ = intersect(
            splats.means2d, splats.conics, splats.opacities, splats.depths, splats.camera_ids, n_cameras=2,
            width=70, height=40, tile_begin=begin, tile_end=end,
        )  # fmt: skip
        masks[listed.long().unique()] |= 1 << rank
        assert totals[VIEW_TOTALS + 2 + 2 * rank :][:2].tolist() == [len(listed.unique()), len(listed)]
    assert torch.equal(splats.rank_masks, masks) and masks.unique().numel() > 2
    assert torch.equal(totals[VIEW_TOTALS:][:2], torch.bincount(splats.camera_ids, minlength=2))
    assert totals[:3].tolist() == [len(splats.visible_ids), len(splats.depths), splats.tiles_touched.sum()]


@pytest.mark.parametrize("n", [0, 3])
def test_all_columns_that_are_sent_have_the_room_that_was_asked_for(n, device):
    scene = random_scene(n=n, cameras=2, device=device)
    inputs = inputs_of(scene)._replace(ids=torch.arange(n, device=device))
    projected = queue_projection(inputs, Sizes(64, 64, 0), [(0, 4), (4, 9)])
    room = 64 if device == "cuda" else int(projected.n_splats)
    assert {len(column) for column in (*projected.for_compositing, projected.splats.rank_masks)} == {room}


@pytest.mark.parametrize("n, cameras", [(0, 2), (5, 0), (0, 0)])
def test_empty_input(n, cameras):
    leaves = random_scene(n=n, cameras=cameras).leaves()
    splats = project_scene(leaves)
    assert splats.counts.tolist() == [0, 0, 0] and splats.splat_offsets.tolist() == [0]
    splats.means2d.sum().backward()
    assert leaves.means.grad.shape == (n, 3) and (leaves.means.grad == 0).all()


def test_near_plane_behind_and_opacity_below_the_cut():
    scene = random_scene(n=6, cameras=1)
    scene.viewmats = torch.eye(4)[None]
    near = 0.25
    z = torch.tensor([-1.0, 0.0, near, math.nextafter(near, 1.0) + 1e-7, 1.0, 1.0])
    scene.means = torch.stack([torch.zeros(6), torch.zeros(6), z], dim=1)
    scene.opacities = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.5, 0.0039])
    assert project_scene(scene, near_plane=near).visible_ids.tolist() == [3, 4]
    assert project_scene(scene, near_plane=near, far_plane=0.999).visible_ids.tolist() == [3]


@pytest.mark.parametrize("above", [-0.5, 0.0, 0.5])
def test_radius_clip_drops_small_splats_only(above):
    """As gsplat's kernels, it compares the radii after they are rounded up."""
    scene = random_scene(n=200, cameras=1)
    splats = project_scene(scene)
    clip = splats.radii.max(dim=1).values.median().item() + above
    kept = project_scene(scene, radius_clip=clip)
    assert set(kept.gaussian_ids.tolist()) == set(
        splats.gaussian_ids[splats.radii.max(dim=1).values > clip].tolist()
    )
    assert 0 < len(kept.depths) < len(splats.depths)


def test_errors_name_the_argument():
    scene = random_scene(n=4, cameras=1)
    with pytest.raises(RuntimeError, match=r"project_fwd: quats must have shape \[4, 4\], got \[4, 3\]"):
        project(
            scene.means, scene.means, scene.scales, scene.opacities, None, scene.viewmats, scene.Ks, 8, 8
        )  # fmt: skip
    refused(RuntimeError, "sh has 4 .*, sh_degree 3 needs 16", project_scene, scene, sh=scene.colors[:, :4])
    refused(RuntimeError, "sh_degree must be 0 to 3, got 4", project_scene, scene, sh_degree=4)
    with pytest.raises(RuntimeError, match="near_plane must be less than far_plane, got nan and 1e"):
        project_scene(scene, near_plane=math.nan)
    for wrong in ({"eps2d": -0.3}, {"eps2d": math.nan}, {"eps2d": math.inf}, {"radius_clip": math.nan}):
        refused(RuntimeError, "eps2d must .* radius_clip at least 0", project_scene, scene, **wrong)
    refused(RuntimeError, "at most 32 views in .*, got 33", project_scene, random_scene(n=1, cameras=33))
    refused(RuntimeError, "active_ids must .* got Long", project_scene, scene, active_ids=torch.arange(2))
    for ids in ([-1, 3], [1, 1, 3], [1, 4], [2, 1]):
        wrong = torch.tensor(ids, dtype=torch.int32)
        refused(RuntimeError, "active_ids must be rows 0 to 3, asc", project_scene, scene, active_ids=wrong)
    refused(TypeError, "Ks must be a torch.Tensor, got NoneType", project_scene, replace(scene, Ks=None))


def inputs_of(scene):
    options = ProjectionOptions(scene.width, scene.height, sh_degree=3, antialiased=True, raw=False)
    gaussians = [scene.means, scene.quats, scene.scales, scene.opacities, scene.colors]
    return ProjectionInputs(gaussians, [scene.viewmats, scene.Ks], options)


def test_opcheck():
    op = torch.ops.blitzgs.project_fwd
    for with_gradients in (False, True):
        scene = random_scene(n=10, cameras=2)
        inputs = inputs_of(scene.leaves() if with_gradients else scene)
        options = inputs.options
        ids = torch.arange(10)
        arguments = (
            inputs.gaussians, *inputs.cameras, *[None] * 4, ids, None, *options, [0, 6], None, None,
        )  # fmt: skip
        # With gradients opcheck's own traced comparison cannot sum integer outputs; the next test is that
        # check.
        utilities = ("test_schema", "test_autograd_registration", "test_faketensor")
        if not with_gradients:
            utilities = (*utilities, "test_aot_dispatch_dynamic")
        torch.library.opcheck(op, arguments, test_utils=utilities)


def test_groups_of_arguments_are_checked():
    inputs = inputs_of(random_scene(n=4, cameras=1))
    for change, text in (
        ({"gaussians": inputs.gaussians[:3]}, r"\(means, quats, scales, opacities\[, sh\]\), got 3 entries"),
        ({"active": (None, torch.arange(2, dtype=torch.int32))}, "active_views, .* need active_ids"),
        ({"ids": torch.arange(3)}, r"ids must have shape \[4\], got \[3\]"),
    ):
        refused(RuntimeError, text, queue_projection, inputs._replace(**change), None)
    refused(
        RuntimeError, "a begin .* at most 63 ranks, got 128", queue_projection, inputs, None, [(0, 1)] * 64
    )


def test_compiles_into_one_graph_with_the_same_gradients():
    scene = random_scene(n=30, cameras=2).leaves()
    inputs = scene.parameters()

    def loss(means, quats, scales, opacities, colors, viewmats):
        splats = project(
            means, quats, scales, opacities, colors, viewmats, scene.Ks, 40, 32, sh_degree=3, raw=False
        )
        return (
            splats.means2d.sum()
            + (splats.conics * splats.opacities[:, None]).sum()
            + splats.colors.square().sum()
        )

    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        actual = torch.autograd.grad(compiled(*inputs), inputs)
    expected = torch.autograd.grad(loss(*inputs), inputs)
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))
