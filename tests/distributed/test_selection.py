# SPDX-License-Identifier: Apache-2.0
"""Selections, calls and hosts of several ranks."""

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import psutil
import pytest
import torch

import blitzgs
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import mass_prefix, smallest
from blitzgs.ops.counter_random import sampling_keys
from blitzgs.reference.render import top_mass
from blitzgs.runs import trained_model
from tests.distributed.rank_harness import RankError, on_each_device, run_ranks
from tests.helpers import PARAMETERS, random_scene, rasterize_scene, refused, relative_error
from tests.training.tiny import OVERRIDES, as_flags, write_tiny_capture

ALONE = Ranks()


def brute_smallest(keys, ids, k):
    order = sorted(range(len(keys)), key=lambda i: (keys[i].item(), ids[i].item()))
    return {ids[i].item() for i in order[:k]}


def brute_prefix(scores, ids, fraction):
    values = [Fraction(score) for score in scores.tolist()]
    chosen = top_mass(values, ids.tolist(), Fraction(str(fraction)))
    return set(ids[torch.tensor(chosen)].tolist())


def cases():
    generator = torch.Generator().manual_seed(0)
    n = 600
    ids = torch.randint(0, 2**62, (n,), generator=generator)
    wide = torch.randn(n, generator=generator).mul(20).exp()
    few = torch.randint(0, 3, (n,), generator=generator).float()
    tiny = torch.rand(n, generator=generator) * 1e-41  # denormals
    sparse = torch.where(torch.rand(n, generator=generator) < 0.9, 0.0, torch.rand(n, generator=generator))
    equal = torch.full((n,), 0.3)
    return ids, {"wide": wide, "few": few, "tiny": tiny, "sparse": sparse, "equal": equal}


@pytest.mark.parametrize("name", ["wide", "few", "tiny", "sparse", "equal"])
def test_selection_equals_sorting(name):
    ids, columns = cases()
    scores = columns[name]
    signed = torch.where(ids % 2 == 0, scores, -scores)
    signed[::50] = float("inf")
    signed[1::50] = -float("inf")
    signed[2::50] = -0.0
    for k in (0, 1, 17, 300, 599, 600, 1000):
        assert set(ids[smallest(signed, ids, k, ALONE)].tolist()) == brute_smallest(signed, ids, k)
    for fraction in (0.0, 0.01, 0.5, 0.99, 1.0):
        got = set(ids[mass_prefix(scores, ids, fraction, ALONE)].tolist())
        assert got == brute_prefix(scores, ids, fraction)


def test_empty_and_invalid():
    none = torch.empty(0)
    no_ids = torch.empty(0, dtype=torch.int64)
    assert smallest(none, no_ids, 3, ALONE).shape == (0,)
    assert mass_prefix(none, no_ids, 0.5, ALONE).shape == (0,)
    ids = torch.arange(3)
    refused(ValueError, "1 of .* NaN", smallest, torch.tensor([1.0, float("nan"), 2.0]), ids, 1, ALONE)
    with pytest.raises(ValueError, match="2 scores are negative or not finite"):
        mass_prefix(torch.tensor([1.0, -1.0, float("inf")]), ids, 0.5, ALONE)
    refused(ValueError, "k must not be negative", smallest, torch.ones(3), ids, -1, ALONE)
    refused(ValueError, r"fraction must be in \[0, 1\], got 2", mass_prefix, torch.ones(3), ids, 2, ALONE)


def _select(ranks):
    ids, columns = cases()
    mine = (torch.arange(len(ids)) * 7 // 5) % ranks.world_size == ranks.rank
    if ranks.world_size == 4:
        mine = torch.tensor([0, 0, 0, 3])[torch.arange(len(ids)) % 4] == ranks.rank  # 3 : 0 : 0 : 1
    chosen = []
    for scores in columns.values():
        own, own_ids = scores[mine], ids[mine]
        chosen.append(own_ids[smallest(own, own_ids, 217, ranks)])
        chosen.append(own_ids[smallest(sampling_keys(own, own_ids, 1, 2), own_ids, 217, ranks)])
        chosen.append(own_ids[mass_prefix(own, own_ids, 0.6, ranks)])
    return chosen


def test_the_same_ids_at_every_world_size():
    results = []
    for world_size in (1, 2, 4):
        answers = run_ranks(_select, world_size)
        results.append([torch.cat(parts).sort().values.tolist() for parts in zip(*answers, strict=True)])
    assert results[0] == results[1] == results[2]
    assert len(results[0][0]) == 217


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
    refused(RankError, r"all ranks have to give the same number of views.*\(2, .*\(1, ", run_ranks, differ, 2)


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
    refused(ValueError, "supports no batch dimensions", blitzgs.rasterization, **arguments, distributed=True)


ROOT = Path(__file__).parents[2]
SETTINGS = (
    *OVERRIDES, "schedule.iterations=1500", "population.max_gaussians=500",
    "log.checkpoint_seconds=1", "ranks.timeout_seconds=20",
)  # fmt: skip


def start_host(port, arguments, output):
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1"]
    command += ["--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{port}", "--rdzv-id=run", "train.py"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command + arguments, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT
    )


def lose(host):
    """End an agent and its workers at once, as a host that loses power."""
    if host.poll() is not None:
        return
    agent = psutil.Process(host.pid)
    for process in [*agent.children(recursive=True), agent]:
        process.kill()
    host.wait()


def free_port():
    with socket.socket() as chosen:
        chosen.bind(("127.0.0.1", 0))
        return chosen.getsockname()[1]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_host_is_lost_and_both_resume(tmp_path):
    data, out = tmp_path / "data", tmp_path / "run"
    write_tiny_capture(data)
    arguments = ["--data", str(data), "--out", str(out), "--resume", "--device", "cpu"]
    arguments += as_flags("config=defaults", *SETTINGS)
    hosts = []
    try:
        # The first agent serves the rendezvous, so the second one is killed.
        port = free_port()
        with open(tmp_path / "first", "wb") as first, open(tmp_path / "second", "wb") as second:
            hosts = [start_host(port, arguments, first)]
            time.sleep(2)
            hosts.append(start_host(port, arguments, second))
        deadline = time.monotonic() + 180
        while len(list((out / "checkpoints").glob("checkpoint_*"))) < 2:
            assert time.monotonic() < deadline and hosts[0].poll() is None, (tmp_path / "first").read_text()
            time.sleep(0.1)
        lose(hosts[1])
        deadline = time.monotonic() + 90
        while "Ending the job" not in (text := (tmp_path / "first").read_text()) and hosts[0].poll() is None:
            assert time.monotonic() < deadline, text
            time.sleep(0.2)
        text = (tmp_path / "first").read_text()
        assert "rank" in text and ("has stopped reporting" in text or "connection" in text)
        lose(hosts[0])  # where torchrun still waits for the other host
        saved = trained_model.restore(out, Ranks()).progress.step
        assert 0 < saved < 1500

        port = free_port()
        with open(tmp_path / "third", "wb") as third:
            hosts = [start_host(port, arguments, third)]
            time.sleep(2)
            hosts.append(start_host(port, arguments, subprocess.DEVNULL))
        for host in hosts:
            assert host.wait(300) == 0, (tmp_path / "third").read_text()
    finally:
        for host in hosts:
            if host.poll() is None:
                lose(host)
    text = (tmp_path / "third").read_text()
    assert "resumed from checkpoint_" in text and f"after {saved:,} steps" in text
    assert trained_model.restore(out, Ranks()).progress.step == 1500
