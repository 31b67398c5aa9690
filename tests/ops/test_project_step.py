# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from blitzgs.ops.lazy_adam import (
    AdamSchedule,
    AdamState,
    lazy_adam_catch_up_,
    lazy_adam_step_,
    project_bwd_step_,
)
from blitzgs.ops.project import project
from blitzgs.ops.projection_types import ProjectionOptions
from blitzgs.ops.rasterize import SplatGradients
from tests.helpers import refused

BETA1, BETA2, EPS = 0.9**2, 0.999**2, 1e-15 / math.sqrt(2)
STEP, WIDTH, HEIGHT, EPS2D = 70, 90, 60, 0.3


class Scene:
    """Gaussians before some cameras, an optimiser's state, and gradients of the splats."""

    def __init__(self, n, k, views, device="cpu", dtype=torch.float32, degree=None, antialiased=False):
        generator = torch.Generator().manual_seed(n + k)
        normal = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
        params = [normal(n, 3), normal(n, 4), 0.5 * normal(n, 3) - 3, normal(n), 0.3 * normal(n, k, 3)]
        sizes = [1e-4 * torch.exp(normal(*p.shape)) for p in params]
        to = lambda tensors: [t.to(device, dtype) for t in tensors]  # noqa: E731
        moments = to([size * normal(*size.shape) for size in sizes]), to([size**2 for size in sizes])
        steps = torch.arange(n, dtype=torch.int32, device=device) % 40 + 1
        self.state = AdamState(to(params), *moments, steps, steps.clone())
        self.lr_table = torch.full((200, 6), 1e-3, device=device)
        viewmats = torch.eye(4).repeat(views, 1, 1)
        viewmats[:, 2, 3] = 4 + torch.arange(views)
        self.viewmats = viewmats.to(device, dtype)
        K = torch.tensor([[80.0, 0, 45], [0, 80, 30], [0, 0, 1]])
        self.Ks = K.repeat(views, 1, 1).to(device, dtype)
        lazy_adam_catch_up_(self.state, self.schedule(), STEP - 1)
        self.degree = min(3, math.isqrt(k) - 1) if degree is None else degree
        self.antialiased = antialiased
        self.scale_reg = torch.linspace(0.1, 0.2, views).to(device, dtype)
        self.opacity_reg = torch.linspace(0.3, -0.2, views).to(device, dtype)
        self.seed = generator
        self.render()

    def render(self):
        self.splats = project(
            *self.state.params, self.viewmats, self.Ks, WIDTH, HEIGHT, sh_degree=self.degree, eps2d=EPS2D,
            antialiased=self.antialiased,
        )  # fmt: skip
        shapes = (self.splats.means2d, self.splats.conics, self.splats.opacities, self.splats.colors)
        self.v = SplatGradients(
            [torch.randn(s.shape, generator=self.seed, dtype=torch.float64).to(s) for s in shapes]
        )
        self.options = ProjectionOptions(
            WIDTH, HEIGHT, sh_degree=self.degree, eps2d=EPS2D, antialiased=self.antialiased
        )

    def splat_ids(self):
        return [self.splats.camera_ids, self.splats.visible_ids, self.splats.splat_offsets]

    def views(self):
        return self.viewmats, self.Ks, self.scale_reg, self.opacity_reg

    def schedule(self):
        return AdamSchedule(self.lr_table, BETA1, BETA2, EPS, self.state.params[0].dtype)

    def backward_arguments(self, need_viewmats=False):
        return (
            self.state.params, *self.views(), *self.splat_ids(), None, *self.options,
            list(self.v.parts), None, need_viewmats,
        )  # fmt: skip

    def backward(self, need_viewmats=False):
        return torch.ops.blitzgs.project_bwd(*self.backward_arguments(need_viewmats))

    def one_after_the_other(self):
        *gradients, _ = self.backward()
        lazy_adam_step_(self.state, self.schedule(), STEP, gradients, self.splats.visible_ids)

    def at_once(self):
        project_bwd_step_(
            self.state, self.schedule(), STEP, self.views(), self.splats, self.options, self.v
        )  # fmt: skip

    def pack(self, width):
        """Put the gradients into the first columns of one table; its other columns have other values."""
        parts = self.v.parts
        table = torch.full((len(parts[0]), width), 1e9).to(parts[0])
        table[:, :9] = torch.cat([v[:, None] if v.dim() == 1 else v for v in parts], 1)
        if width == 12 and table.is_cuda:
            self.v = SplatGradients([table])
        else:  # columns that are not contiguous
            self.v = SplatGradients([table[:, :2], table[:, 2:5], table[:, 5], table[:, 6:9]])


def compare(a, b, exact):
    for x, y in zip(a.state.tensors, b.state.tensors, strict=True):
        if exact or not x.is_floating_point():
            assert torch.equal(x, y)
        else:
            torch.testing.assert_close(x, y, rtol=1e-5, atol=2e-6 * float(y.abs().max()))


@pytest.mark.parametrize(
    "n,k,degree,views",
    [
        (1, 16, 3, 1), (1007, 16, 3, 3), (1007, 16, 2, 1), (1007, 16, 1, 2), (333, 16, 0, 1), (333, 4, 1, 2),
        (333, 25, 3, 1),
    ],
)  # fmt: skip
def test_equals_backward_and_step(device, n, k, degree, views):
    scenes = [Scene(n, k, views, device, degree=degree, antialiased=views == 3) for _ in range(2)]
    before = [p.clone() for p in scenes[0].state.params]
    scenes[0].one_after_the_other()
    scenes[1].at_once()
    compare(*scenes, exact=device == "cpu")
    visible = scenes[0].splats.visible_ids.long()
    assert len(visible) and bool((scenes[1].state.moment_step[visible] == STEP).all())
    if k > (degree + 1) ** 2:  # coefficients not in use yet still decay
        assert not torch.equal(before[4][visible][:, -1], scenes[1].state.params[4][visible][:, -1])
    untouched = torch.ones(n, dtype=torch.bool, device=device)
    untouched[visible] = False
    for x, y in zip(before, scenes[1].state.params, strict=True):
        assert torch.equal(x[untouched], y[untouched])


@pytest.mark.parametrize("width", [10, 12])
@pytest.mark.parametrize(
    "n,k,degree,views", [(1, 16, 3, 1), (3000, 16, 3, 3), (700, 16, 2, 1), (700, 4, 1, 2), (700, 16, 0, 1)]
)
def test_gradients_are_read_where_they_are(device, width, n, k, degree, views):
    """Gradients in the columns of one table give the same result as separate tensors."""
    plain, other = (Scene(n, k, views, device, degree=degree) for _ in range(2))
    other.pack(width)
    for x, y in zip(plain.backward(True), other.backward(True), strict=True):
        assert len(x) and (torch.equal(x, y) or device != "cpu")
        torch.testing.assert_close(x, y, rtol=1e-5, atol=2e-6 * float(x.abs().max()))
    plain.at_once()
    other.at_once()
    compare(plain, other, device == "cpu")


def test_repeats_bit_for_bit(device):
    scenes = [Scene(5000, 16, 2, device) for _ in range(2)]
    for scene in scenes:
        scene.at_once()
    compare(*scenes, exact=True)


def test_float64_and_nothing_visible():
    scenes = [Scene(200, 16, 1, dtype=torch.float64) for _ in range(2)]
    scenes[0].one_after_the_other()
    scenes[1].at_once()
    compare(*scenes, exact=True)
    scene = scenes[1]
    scene.viewmats[:, 2, 3] = -100  # all behind the camera
    scene.render()
    before = [p.clone() for p in scene.state.params]
    scene.at_once()
    assert len(scene.splats.visible_ids) == 0
    assert all(torch.equal(x, y) for x, y in zip(before, scene.state.params, strict=True))


def test_errors_name_the_value():
    scene = Scene(20, 16, 2)
    whole, weights = scene.v, scene.opacity_reg
    scene.opacity_reg = weights.double()
    refused(RuntimeError, "project_bwd: opacity_reg must be Float, got Double", scene.backward)
    scene.opacity_reg = weights[:1]
    refused(RuntimeError, r"project_bwd_step_: opacity_reg must have shape \[2\], got \[1\]", scene.at_once)
    scene.opacity_reg = weights
    scene.v = SplatGradients([torch.zeros(len(whole.parts[0]), 12)])
    refused(RuntimeError, "project_bwd_step_: a table of gradients needs CUDA", scene.at_once)
    scene.v = SplatGradients([whole.parts[0], whole.parts[3]])
    refused(RuntimeError, "v_splats must be v_means2d, .* or one table, got 2 tensors", scene.backward)
    scene.v = SplatGradients([whole.parts[0], whole.parts[1][:, :2], *whole.parts[2:]])
    refused(RuntimeError, r"project_bwd_step_: v_conics must have shape \[\d+, 3\]", scene.at_once)
    scene.v = whole
    scene.state.exp_avgs[4] = scene.state.exp_avgs[4][:, :4].contiguous()
    refused(RuntimeError, r"the moments of sh must have its shape \[20, 16, 3\]", scene.at_once)


def test_regularisers_have_the_gradients_of_their_definitions(backend):
    """Regularisers alone, without gradients of splats, agree with autograd in float64."""
    scene, scale = Scene(800, 16, 3, *backend, antialiased=True), 1.0 if backend[1] == torch.float32 else 1e-8
    scene.v = SplatGradients([torch.zeros_like(part) for part in scene.v.parts])
    _, _, v_scales, v_opacities, *_ = scene.backward()
    scales, opacities = (scene.state.params[c].double().requires_grad_() for c in (2, 3))
    r = scene.splats
    weights = [w.double()[r.camera_ids.long()] for w in (scene.scale_reg, scene.opacity_reg)]
    axes = scales[r.gaussian_ids.long()].exp()
    values = axes.amin(1), opacities[r.gaussian_ids.long()].sigmoid()
    sum((w * value).sum() for w, value in zip(weights, values, strict=True)).backward()
    ids = r.visible_ids.long()
    assert len(ids) > 300
    for got, want in ((v_scales, scales.grad[ids]), (v_opacities, opacities.grad[ids])):
        torch.testing.assert_close(
            got.double(), want, rtol=1e-5 * scale, atol=1e-6 * scale * float(want.abs().max())
        )


@pytest.mark.cuda
def test_errors_name_what_does_not_fit():
    scene = Scene(20, 16, 1, "cuda")
    table = torch.zeros(len(scene.splats.means2d), 12, device="cuda")
    for wrong, text in (
        (table[:-1], r"v_splats\[0\] must have shape \[\d+, 12\], got \[\d+, 12\]"),
        (table[:, :9], r"must have shape \[\d+, 12\], got \[\d+, 9\]"),
        (table.double(), "must be Float, got Double"),
        (table.t().contiguous().t(), "must be contiguous"),
    ):
        scene.v = SplatGradients([wrong])
        refused(RuntimeError, text, scene.at_once)


def test_opcheck():
    scene = Scene(20, 16, 1)
    state, schedule = scene.state, scene.schedule()
    torch.library.opcheck(
        torch.ops.blitzgs.project_bwd_step_,
        (state.tensors, schedule.tables[:2], *schedule.constants(STEP), *scene.views(),
         *scene.splat_ids(), None, *scene.options, list(scene.v.parts)),
    )  # fmt: skip
    torch.library.opcheck(torch.ops.blitzgs.project_bwd, scene.backward_arguments(True))
