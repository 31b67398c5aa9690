# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.rasterization` under autograd, checkpointing and torch.compile."""

from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.utils.checkpoint
from torch._dynamo.testing import CompileCounterWithBackend

import blitzgs
from blitzgs.call.arguments import warn_of_gradient
from blitzgs.ops.photometric import photometric_loss
from blitzgs.reference.projection import covariance_factors
from tests.call.test_raw_rasterization import raw, raw_parameters
from tests.helpers import PARAMETERS, agree, random_scene, rasterize_scene, refused


def render_raw(scene):
    return raw(raw_parameters(scene), scene)


def loss_of(function, scene):
    image = torch.rand(1, 20, 20, 3, device=scene.means.device, requires_grad=True)
    return function(image, torch.zeros_like(image)).sum(), [image], [image]


def of_a_gradient(scene):
    return rasterize_scene(scene)[0].square().sum(), [scene.means], [scene.means]


def of_a_linear_loss(scene):
    image, alphas, _ = rasterize_scene(scene)
    return image.sum() + alphas.sum(), [scene.colors], [scene.means]


def through_arranged_splats(scene):
    image, _, meta = rasterize_scene(scene, packed=False)
    return image.square().sum(), [meta["means2d"]], [scene.means]


def of_raw_parameters(scene):
    parameters = raw_parameters(scene)
    tensors = list(parameters.values())
    return raw(parameters, scene, sparse_grad=False)[0].square().sum(), tensors, tensors


@pytest.mark.parametrize(
    "value",
    [
        of_a_gradient,
        of_a_linear_loss,
        through_arranged_splats,
        of_raw_parameters,
        partial(loss_of, photometric_loss),
        partial(loss_of, blitzgs.l1_ssim),
    ],
)
def test_a_second_derivative_is_refused(device, value):
    scene = random_scene(n=6, width=8, height=8, device=device).leaves()
    for _ in range(2):  # on CUDA the second call is queued
        loss, first, second = value(scene)
        gradients = torch.autograd.grad(loss, first, create_graph=True)
        loss = sum(gradient.square().sum() for gradient in gradients)
        refused(RuntimeError, "has first derivatives only", torch.autograd.grad, loss, second)


def test_a_hessian_is_refused(device):
    scene = random_scene(n=6, width=8, height=8, device=device)
    loss = lambda means: rasterize_scene(replace(scene, means=means))[0].sum()  # noqa: E731
    hessian = torch.autograd.functional.hessian
    refused(RuntimeError, "has first derivatives only", hessian, loss, scene.means)


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev, torch.func.jacfwd, torch.vmap])
def test_transforms_of_torch_func_are_refused(transform):
    scene = random_scene(n=6, width=8, height=8)

    def loss(means):
        return rasterize_scene(replace(scene, means=means))[0].sum()

    means = scene.means[None] if transform is torch.vmap else scene.means
    refused(RuntimeError, r"blitzgs does not support the transforms of torch\.func", transform(loss), means)
    images = torch.rand(1, 1, 12, 12, 3)
    with pytest.raises(RuntimeError, match=r"blitzgs does not support the transforms of torch\.func"):
        transform(lambda renders: blitzgs.l1_ssim(renders, images[0]))(images)


def test_a_gradient_with_a_graph_may_be_used_as_a_value():
    scene = random_scene(n=20).leaves()
    expected, created = (
        torch.autograd.grad(rasterize_scene(scene)[0].square().sum(), scene.means, create_graph=graph)[0]
        for graph in (False, True)
    )
    assert torch.equal(created, expected)


@pytest.mark.parametrize(
    "options", [{}, {"packed": False}, *({"render_mode": mode} for mode in ("RGB+ED", "ED", "D"))], ids=str
)
def test_images_may_be_changed_in_place(device, options):
    """As gsplat's trainer does with the pixels outside of a mask."""
    scene = random_scene(n=40, device=device)
    mask = torch.rand(2, 32, 40, generator=torch.Generator().manual_seed(0)).to(device) > 0.3
    gradients = []
    for in_place in (True, False):
        leaves = scene.leaves()
        renders, alphas, _ = rasterize_scene(leaves, **options)
        if in_place:
            renders[~mask] = 0
            alphas.mul_(mask[..., None])
        else:
            renders, alphas = renders * mask[..., None], alphas * mask[..., None]
        (renders.square().sum() + alphas.square().sum()).backward()
        gradients.append(leaves.gradients())
    agree(*gradients, 1e-5)


@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "ED"}], ids=str)
@pytest.mark.parametrize("with_sh", [True, False])
def test_sparse_gradients_are_the_dense_ones(device, options, with_sh):
    scene = random_scene(n=80, width=20, height=16, device=device)
    scene.means[::2] *= 8.0  # some are seen by no view
    if not with_sh:
        scene.sh_degree, scene.colors = None, scene.colors[:, 0]
    dense, sparse = scene.leaves(), scene.leaves()
    for leaves, flag in ((dense, False), (sparse, True)):
        rasterize_scene(leaves, sparse_grad=flag, **options)[0].square().sum().backward()
    sparse_names = ["means", "quats", "scales"]
    if with_sh and "render_mode" not in options:
        sparse_names += ["opacities", "colors"]
    found = sparse.gradients()
    for name, gradient in zip(PARAMETERS, found, strict=True):
        assert gradient is None or gradient.is_sparse == (name in sparse_names), name
        assert name not in sparse_names or gradient.coalesce().values().shape[0] < 80
    agree([None if g is None else g.to_dense() for g in found], dense.gradients(), 1e-6)


def test_sparse_gradients_pass_what_was_made_of_opacities_and_colours(device):
    """A sparse gradient can go neither through a sigmoid nor through a concatenation."""
    scene = random_scene(n=30, device=device)
    names = ("means", "quats", "scales")
    results = []
    for sparse in (False, True):
        leaves = scene.leaves()
        logits = scene.opacities.logit().requires_grad_()
        dc, rest = (part.detach().clone().requires_grad_() for part in scene.colors.split([1, 15], dim=1))
        called = replace(leaves, opacities=logits.sigmoid(), colors=torch.cat([dc, rest], 1))
        rasterize_scene(called, sparse_grad=sparse)[0].square().sum().backward()
        inputs = [*(getattr(leaves, name) for name in names), logits, dc, rest]
        assert [x.grad.is_sparse for x in inputs] == [sparse] * 3 + [False] * 3
        results.append([x.grad.to_dense() for x in inputs])
    agree(*results, 1e-5)


@pytest.mark.parametrize("name", [*PARAMETERS, "Ks"])
def test_an_argument_may_have_the_negative_bit(device, name):
    """Torch negates such a tensor, as the imaginary part of a conjugate, only when it is read."""
    results = []
    for with_bit in (False, True):
        leaves = random_scene(n=30, device=device).leaves()
        called = leaves
        if with_bit:
            called = replace(leaves, **{name: torch._neg_view(-getattr(leaves, name))})
        rasterize_scene(called)[0].square().sum().backward()
        results.append(leaves.gradients())
    agree(*results, 1e-5)


@pytest.mark.parametrize("render", [rasterize_scene, render_raw], ids=["rasterization", "raw_rasterization"])
def test_intrinsics_that_require_a_gradient_are_named_once(render, recwarn):
    warn_of_gradient.cache_clear()
    scene = random_scene(n=20)
    for tensor in (scene.means, scene.Ks):
        tensor.requires_grad_()
    with torch.no_grad():
        render(scene)
    assert not recwarn.list
    with pytest.warns(RuntimeWarning, match="Ks requires a gradient and gets none, as in gsplat") as found:
        render(scene)[0].sum().backward()
    assert found[0].filename.endswith(("helpers.py", "test_raw_rasterization.py")) and scene.Ks.grad is None
    render(scene)
    assert not recwarn.list


def test_autocast_changes_nothing(device):
    scene = random_scene(n=40, device=device)
    results = []
    for enabled in (False, True):
        leaves = scene.leaves()
        backgrounds = torch.full((2, 3), 0.5, device=device, requires_grad=True)
        with torch.autocast(device, dtype=torch.bfloat16, enabled=enabled):
            renders, _, _ = rasterize_scene(leaves, backgrounds=backgrounds)
            renders.square().sum().backward()
        results.append([renders.detach(), backgrounds.grad, *leaves.gradients()])
    agree(*results, 1e-5)


@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}], ids=str)
def test_checkpointing_recomputes_the_call(device, options):
    scene = random_scene(n=60, device=device)
    results = []
    for call in (lambda f, *a: f(*a), partial(torch.utils.checkpoint.checkpoint, use_reentrant=False)):
        for _ in range(3):  # on CUDA the capacity is estimated from earlier calls
            leaves = scene.leaves()

            def image(*values):
                changed = replace(scene, **dict(zip(PARAMETERS, values, strict=True)))
                return rasterize_scene(changed, **options)[0]

            call(image, *leaves.parameters()).square().sum().backward()
        results.append(leaves.gradients())
    agree(*results, 1e-5)


COMPILED = [{}, {"packed": False, "render_mode": "RGB+ED", "rasterize_mode": "antialiased"}]


@pytest.mark.parametrize("options", COMPILED, ids=str)
def test_one_graph_is_compiled_of_a_call(device, options):
    torch._dynamo.reset()
    scene = random_scene(n=40, device=device)

    def call(scene):
        renders, alphas, meta = rasterize_scene(scene, **options)
        return renders, alphas, meta["means2d"], meta["radii"], meta["flatten_ids"]

    def gradients(leaves, renders, alphas):
        return torch.autograd.grad(renders.square().sum() + alphas.sum(), leaves.parameters())

    leaves = scene.leaves()
    eager = call(leaves)
    graph = torch.compile(call, fullgraph=True, backend="aot_eager")
    compiled = graph(leaves)
    torch.testing.assert_close(compiled, eager, rtol=0, atol=0)
    renders = compiled[0]
    renders[:, :4] = 0  # may be changed in place here too
    eager[0][:, :4] = 0
    agree(gradients(leaves, *compiled[:2]), gradients(leaves, *eager[:2]), 1e-5)
    with pytest.raises(RuntimeError, match="create_graph=False|double backward"):  # first derivatives alone
        (gradient,) = torch.autograd.grad(graph(leaves)[0].sum(), leaves.means, create_graph=True)
        gradient.sum().backward()


@pytest.mark.parametrize("packed", [True, False])
def test_one_graph_takes_other_numbers_of_gaussians_views_and_pixels(packed):
    torch._dynamo.reset()
    counter, graphs = CompileCounterWithBackend("aot_eager"), set()
    image_of = torch.compile(
        lambda scene: rasterize_scene(scene, packed=packed)[0], fullgraph=True, dynamic=True, backend=counter
    )
    for n, cameras, width, height in ((20, 2, 40, 32), (33, 2, 40, 32), (33, 3, 40, 32), (33, 3, 17, 50)):
        leaves = random_scene(n=n, cameras=cameras, width=width, height=height).leaves()
        image, expected = image_of(leaves), rasterize_scene(leaves, packed=packed)[0]
        assert torch.equal(image, expected)
        agree(*(torch.autograd.grad(x.square().sum(), leaves.parameters()) for x in (image, expected)), 1e-5)
        graphs.add(counter.frame_count)  # forward and backward
    assert graphs == {2}


_views = 1  # for a graph, a global that changed is a number that varies


def test_a_graph_takes_colours_that_were_expanded_to_other_numbers_of_views(monkeypatch):
    torch._dynamo.reset()
    for views in (1, 3):
        scene = random_scene(n=20, cameras=views)
        monkeypatch.setitem(globals(), "_views", views)

        def image(means, scene=scene):
            colors = scene.colors.expand(_views, -1, -1, -1)
            return rasterize_scene(replace(scene, means=means, colors=colors))[0]

        compiled = torch.compile(image, fullgraph=True, backend="eager")
        assert torch.equal(compiled(scene.means), image(scene.means))


def test_a_graph_of_many_views_and_one_of_covariances():
    torch._dynamo.reset()
    views = random_scene(n=20, cameras=34, width=8, height=8).leaves()
    shapes = random_scene(n=20, cameras=1).leaves()
    factors = covariance_factors(shapes.quats.detach(), shapes.scales.detach())
    for scene, options in ((views, {}), (shapes, {"covars": factors @ factors.mT})):
        call = partial(rasterize_scene, **options)
        image = torch.compile(lambda s, call=call: call(s)[0], fullgraph=True, backend="aot_eager")(scene)
        expected = call(scene)[0]
        assert torch.equal(image, expected)
        agree(*(torch.autograd.grad(x.square().sum(), scene.means) for x in (image, expected)), 1e-5)


def test_raw_rasterization_runs_between_two_graphs():
    torch._dynamo.reset()
    scene = random_scene(n=20)

    def loss(means):
        image, _, _ = blitzgs.raw_rasterization(
            means + 0, scene.quats, scene.scales.log(), scene.opacities.logit(), scene.colors, None,
            scene.viewmats, scene.Ks, scene.width, scene.height, sparse_grad=False,
        )  # fmt: skip
        return image.sin().sum()

    means = scene.means.clone().requires_grad_()
    compiled = torch.compile(loss, backend="aot_eager")
    agree(*(torch.autograd.grad(call(means), means) for call in (compiled, loss)), 1e-6)
    torch._dynamo.reset()
    with pytest.raises(Exception, match="blitzgs.raw_rasterization runs between two graphs"):
        torch.compile(loss, fullgraph=True, backend="aot_eager")(means)


def test_gradients_under_vmap_are_refused_by_name():
    leaves = random_scene(n=20).leaves()
    image = rasterize_scene(leaves)[0]
    with pytest.raises(RuntimeError, match="rasterize has no gradients under vmap .* call torch"):
        torch.autograd.grad(image, leaves.colors, torch.rand(3, *image.shape), is_grads_batched=True)


@pytest.mark.parametrize("options", [{"absgrad": True}, {"sparse_grad": True}], ids=str)
def test_options_without_compile_support_are_named(options):
    torch._dynamo.reset()
    leaves = random_scene(n=20).leaves()
    with pytest.raises(Exception, match="not supported under torch.compile"):
        torch.compile(lambda s: rasterize_scene(s, **options)[0], fullgraph=True, backend="aot_eager")(leaves)


@pytest.mark.parametrize("options", [{"absgrad": True}, {"render_mode": "RGB+ED"}, {"channels": 7}], ids=str)
def test_the_gradient_of_a_pixel_without_gaussians_reaches_none(device, options):
    """It is NaN in losses of 1 / depth, as that of gsplat's trainer."""
    scene = random_scene(n=12).to(torch.float32, device)
    options = dict(options)
    if channels := options.pop("channels", 0):
        scene = replace(scene, colors=torch.rand(12, channels, device=device), sh_degree=None)
    gradients = []
    for at_empty_pixels in (0.0, torch.nan):
        own = scene.leaves()
        image, alphas, _ = rasterize_scene(own, **options)
        empty = alphas == 0
        assert 0 < empty.sum() < empty.numel()
        given = torch.where(empty, at_empty_pixels, torch.ones_like(image))
        torch.autograd.backward([image, alphas], [given, given[..., :1]])
        gradients.append(own.gradients())
    for expected, found in zip(*gradients, strict=True):
        assert expected.any()
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
