# SPDX-License-Identifier: Apache-2.0
"""`rasterization(distributed=True)`: several ranks render what one rank renders alone."""

from dataclasses import replace

import pytest
import torch

import blitzgs
from tests.distributed.rank_harness import RankError, on_each_device, run_ranks
from tests.helpers import PARAMETERS, random_scene, rasterize_scene, relative_error

GAUSSIANS = PARAMETERS[:5]
VIEWS = 2
OPTIONS = [
    {},
    {"packed": False, "render_mode": "RGB+ED"},
    {"rasterize_mode": "antialiased", "sparse_grad": True},
    {"sh_degree": None, "render_mode": "RGB+D"},
    {"render_mode": "D"},
    {"extra_signals_sh_degree": 1, "return_normals": True, "return_median": True},
]


def whole_scene(world_size, options, dtype=torch.float32):
    scene = random_scene(n=90, cameras=VIEWS * world_size, width=40, height=28, dtype=dtype)
    scene.means[30:60] = scene.means[:30]  # equal depths on different ranks
    if "sh_degree" in options:
        scene.colors = scene.colors[:, 0, :2].abs()
    return scene


def part_of(scene, rank, world_size, device="cpu"):
    """A rank's Gaussians, unevenly many, and its views."""
    bounds = [90 * k * k // world_size**2 for k in range(world_size + 1)]
    mine, views = slice(bounds[rank], bounds[rank + 1]), slice(VIEWS * rank, VIEWS * (rank + 1))
    parts = {name: getattr(scene, name)[mine] for name in GAUSSIANS}
    parts |= {name: getattr(scene, name)[views] for name in ("viewmats", "Ks")}
    return replace(scene, **parts).to(scene.means.dtype, device).leaves()


def weights_for(scene, channels):
    generator = torch.Generator().manual_seed(5)
    shape = (len(scene.viewmats), scene.height, scene.width, channels)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def rendered(scene, **options):
    """Images with what stands beside the colours, alphas, and meta."""
    if "extra_signals_sh_degree" not in options:
        return rasterize_scene(scene, **options)
    renders, alphas, meta = rasterize_scene(scene, **options, extra_signals=scene.colors)
    beside = [meta[key] for key in ("render_extra_signals", "normals", "render_median")]
    return torch.cat([renders, *beside], dim=-1), alphas, meta


def render_parts(ranks):
    return [render_part(ranks, options) for options in OPTIONS]


def render_part(ranks, options):
    scene = whole_scene(ranks.world_size, options)
    part = part_of(scene, ranks.rank, ranks.world_size, ranks.device.type)
    backgrounds = torch.full((VIEWS, part.colors.shape[-1]), 0.3, device=ranks.device)
    for _ in range(2):
        renders, alphas, meta = rendered(part, distributed=True, backgrounds=backgrounds, **options)
    meta["means2d"].retain_grad()
    weights = weights_for(scene, renders.shape[-1])[VIEWS * ranks.rank :][:VIEWS]
    ((renders.double().cpu() * weights).sum() + alphas.double().cpu().sum()).backward()
    gradients = {name: getattr(part, name).grad for name in PARAMETERS}
    gradients = {name: None if g is None else g.to_dense().cpu() for name, g in gradients.items()}
    shapes = {key: tuple(v.shape) for key, v in meta.items() if isinstance(v, torch.Tensor)}
    return renders.detach().cpu(), alphas.detach().cpu(), gradients, shapes, meta["n_cameras"]


@pytest.mark.parametrize("world_size, device", on_each_device(1, 3))
def test_ranks_render_what_one_renders(world_size, device):
    of_ranks = run_ranks(render_parts, world_size, device=device)
    for options, *parts in zip(OPTIONS, *of_ranks, strict=True):
        require_whole(parts, options, world_size, device)


def require_whole(parts, options, world_size, device):
    """Check that several ranks and one rank give the same images and gradients with these options."""
    whole = whole_scene(world_size, options).leaves()
    backgrounds = torch.full((VIEWS * world_size, whole.colors.shape[-1]), 0.3)
    renders, alphas, meta = rendered(whole, backgrounds=backgrounds, **options)
    weights = weights_for(whole, renders.shape[-1])
    ((renders.double() * weights).sum() + alphas.double().sum()).backward()
    images, coverage = (torch.cat([part[k] for part in parts]) for k in range(2))
    if device == "cpu":
        assert torch.equal(images, renders) and torch.equal(coverage, alphas), options
    else:
        assert ((images - renders).abs() > 1e-4).double().mean() < 5e-3, options
    bound = 1e-4 if device == "cpu" else 1e-2
    for name in PARAMETERS:
        expected = getattr(whole, name).grad
        found = [part[2][name] for part in parts]
        if expected is None:
            assert found == [None] * world_size
            continue
        assert relative_error(torch.cat(found), expected.to_dense()) < bound, (options, name)
    for _, _, _, shapes, n_cameras in parts:
        assert n_cameras == VIEWS and shapes["isect_offsets"] == (VIEWS, 2, 3)
    if options.get("packed", True):
        assert sum(part[3]["gaussian_ids"][0] for part in parts) == len(meta["gaussian_ids"])
    else:
        assert [part[3]["means2d"][0] for part in parts] == [VIEWS * world_size] * world_size


def differ(ranks):
    part = part_of(whole_scene(2, {}), ranks.rank, 2)
    if ranks.rank == 1:
        part.viewmats, part.Ks = part.viewmats[:1], part.Ks[:1]
    rasterize_scene(part, distributed=True)


def test_ranks_that_differ_are_told():
    with pytest.raises(RankError, match=r"all ranks have to give the same number of views.*\(2, .*\(1, "):
        run_ranks(differ, 2)


def test_one_process_without_a_group_is_one_rank():
    scene = random_scene(n=20)
    assert torch.equal(rasterize_scene(scene, distributed=True)[0], rasterize_scene(scene)[0])


@pytest.mark.parametrize(
    "options",
    [
        {"absgrad": True},
        {"sh_degree": None, "colors": torch.rand(2, 20, 3)},
        {"extra_signals": torch.rand(2, 20, 3)},
    ],
    ids=["absgrad", "colors", "signals"],
)
def test_unsupported_distributed_options_are_refused(options):
    arguments = {**vars(random_scene(n=20)), **options}
    with pytest.raises(ValueError, match="distributed=True supports no batch dimensions"):
        blitzgs.rasterization(**arguments, distributed=True)
