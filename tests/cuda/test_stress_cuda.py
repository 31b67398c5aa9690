# SPDX-License-Identifier: Apache-2.0
"""Hard inputs on CUDA: finite everywhere, and the image of the CPU kernels in float64."""

import pytest
import torch
from cuda_scenes import Scene, ops, relative_error


def render(scene, device, dtype=torch.float32):
    """Project, list and composite; returns (rows, lists, saved)."""
    rows = scene.project(device, dtype)
    means2d, conics, depths, opacities, colors = rows[4:9]
    count = int(rows.counts[2])
    lists = ops.intersect(means2d, conics, opacities, depths, rows[1], None, *scene.grid(), count)
    saved = ops.rasterize_fwd(means2d, conics, opacities, colors, None, *lists, *scene.grid())
    return rows, lists, saved


def gradients(scene, device, rows, lists, saved, v_renders):
    """Differentiate back to the parameters."""
    means2d, conics, _, opacities, colors = rows[4:9]
    renders, rest, last, _, aux = saved
    v = ops.rasterize_bwd(
        means2d, conics, opacities, colors, None, *lists, renders, rest, last, aux, v_renders, None,
        *scene.grid(), False, False,
    )  # fmt: skip
    parameters = scene.parameters(device, means2d.dtype)
    return ops.project_bwd(
        *parameters, rows[1], rows[2], rows[3], scene.width, scene.height, scene.degree, 0.3, False, True,
        v[0], v[1], None, v[2], v[3], None, True,
    )  # fmt: skip


CASES = {
    "tiny": lambda s: s.scales.fill_(-18.4),
    "huge": lambda s: s.scales.fill_(4.6),
    "mixed scales": lambda s: s.scales.copy_(torch.empty_like(s.scales).uniform_(-18.4, 2.0)),
    "needles": lambda s: s.scales.copy_(torch.tensor([-9.2, -9.2, 0.0]).expand_as(s.scales)),
    "zero quaternions": lambda s: s.quats.zero_(),
    "huge quaternions": lambda s: s.quats.mul_(1e30),
    "tiny quaternions": lambda s: s.quats.mul_(1e-30),
    "opaque": lambda s: s.opacities.fill_(20.0),
    "transparent": lambda s: s.opacities.fill_(-5.4),
    "invisible": lambda s: s.opacities.fill_(-30.0),
    "at the near plane": lambda s: s.viewmats[:, 2, 3].fill_(1.0),
    "short focal length": lambda s: s.Ks[:, :2, :2].mul_(10 / 180),
    "long focal length": lambda s: s.Ks[:, :2, :2].mul_(1e5 / 180),
    "equal depths": lambda s: s.means[:, 2].zero_(),
}


@pytest.mark.parametrize("case", CASES)
def test_matches_float64(case):
    torch.manual_seed(0)
    scene = Scene(1500)
    CASES[case](scene)
    _, _, exact = render(scene, "cpu", torch.float64)
    rows, lists, saved = render(scene, "cuda")
    error = (saved[0].cpu().double() - exact[0]).abs().amax(dim=-1)
    assert torch.isfinite(saved[0]).all()
    assert (error > 1e-4).float().mean() < 0.02
    v = torch.randn(saved[0].shape, device="cuda")
    for gradient in gradients(scene, "cuda", rows, lists, saved, v):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (17, 16)])
def test_odd_image_sizes(size):
    scene = Scene(500, width=size[0], height=size[1])
    scene.Ks[:, 0, 0] = scene.Ks[:, 1, 1] = 30.0
    _, _, exact = render(scene, "cpu", torch.float64)
    _, _, saved = render(scene, "cuda")
    assert ((saved[0].cpu() - exact[0]).abs().amax(dim=-1) > 2e-5).float().mean() < 0.02


def test_a_million_gaussians_on_one_tile():
    scene = Scene(1_000_000, views=1, width=16, height=16)
    scene.means.mul_(0.01)
    scene.opacities.fill_(-5.0)
    scene.scales.fill_(-3.0)
    scene.degree = 0
    _, lists, exact = render(scene, "cpu", torch.float64)
    rows, _, saved = render(scene, "cuda")
    assert len(lists[0]) > 900_000
    assert relative_error(saved[0], exact[0]) < 1e-3  # some rows lie on the cut at 1/255
    v = torch.ones_like(saved[0])
    entries = ops.intersect(rows[4], rows[5], rows[7], rows[6], rows[1], None, *scene.grid(), -1)
    for gradient in gradients(scene, "cuda", rows, entries, saved, v):
        assert torch.isfinite(gradient).all()


def test_an_image_of_16k_by_16k():
    scene = Scene(2000, views=1, width=16384, height=16384)
    _, lists, saved = render(scene, "cuda")
    assert len(lists[1]) == 1024 * 1024 + 1
    assert torch.isfinite(saved[0]).all()
    assert saved[1].min() >= 1e-4 * 0.999 and saved[1].max() <= 1
