# SPDX-License-Identifier: Apache-2.0
"""The one loop of a frame; the image has the same bits for any number of ranks."""

import functools
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from blitzgs.config.fields import LossConfig
from blitzgs.distributed.group import Ranks
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import MAX_ATTEMPTS, RenderOptions, render_frame, run_attempts
from blitzgs.frame.tiles import LOSS_HALO, TileAssignment, TileRanges, collect_images
from blitzgs.frame.transport.protocol import CapacityEstimate
from blitzgs.ops.projection_types import Sizes, Views
from blitzgs.table.table import GaussianTable
from blitzgs.training.batches import Batch
from blitzgs.training.loss import SCALE_UNIT, batch_psnr, loss_terms, photometric, scale_term
from tests.distributed.rank_harness import EIGHT, on_each_device, run_ranks
from tests.helpers import look_at_origin, parameter_gradients, sum_parts
from tests.training.tiny import random_gaussians

WIDTH, HEIGHT, EXTENT = 150, 90, 0.3
LOSS = LossConfig(opacity=0.1)
OPTIONS = RenderOptions(sh_degree=0, near_plane=0.05, far_plane=100.0, background=(0.1, 0.2, 0.3))
# Return the owner of each row: shards of several sizes, an empty one and 3 : 1 among them.
LAYOUTS = {1: [0], 2: [0, 0, 0, 1], 3: [0, 2, 2], 4: [0, 3, 1, 0, 0, 3], 8: [0, 7, 5, 1, 1, 1, 2, 3, 4]}


def cameras(n_views, blind=False, device="cpu"):
    """Return views around the scene; with `blind` the first one does not see it."""
    poses = [
        look_at_origin(np.array([3 * np.cos(a), 3 * np.sin(a), 1.5])) for a in np.linspace(0, 5, n_views)
    ]
    if blind:
        poses[0] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ poses[0]
    K = torch.tensor([[110.0, 0, 73.2], [0, 112.0, 46.1], [0, 0, 1]])
    viewmats = torch.from_numpy(np.stack(poses)).float()
    return Views(viewmats.to(device), K.repeat(n_views, 1, 1).to(device), WIDTH, HEIGHT)


def shard(ranks):
    """This rank's part of the scene, with equal depths and ids that are not in row order."""
    table = random_gaussians(700)
    table["means"][100:200] = table["means"][0:100]  # ties of depth
    table["id"].copy_((table["id"] * 7919 + 5) % 100003)
    layout = torch.tensor(LAYOUTS[ranks.world_size])
    table.keep(layout[torch.arange(len(table)) % len(layout)] == ranks.rank)
    return GaussianTable({name: table[name].to(ranks.device) for name in table})


def photographs(n_views):
    g = torch.Generator().manual_seed(n_views)
    targets = torch.randint(0, 256, (n_views, HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)
    masks = (torch.rand(n_views, HEIGHT, WIDTH, generator=g) > 0.2).byte()
    return targets, masks, (3 * masks.sum((1, 2))).float()


def uneven(world_size, n_views):
    """Return borders in the middle of a tile row, ranks without tiles, a rank with more than a view."""
    total = TileRanges((0,), n_views, WIDTH, HEIGHT).tiles_per_view * n_views
    bounds = (0, *[0, 34, 34, 35, 36, 36, 40][: world_size - 1], total)
    return TileRanges(bounds, n_views, WIDTH, HEIGHT, halo=LOSS_HALO)


def _render(ranks):
    """Images, losses and gradients of several batches, visited twice so that costs are measured."""
    torch.set_num_threads(1)
    table, owners, out = shard(ranks), TileOwners(ranks), []
    for n_views, blind, even in [
        (1, False, True),
        (4, True, True),
        (1, True, True),
        (1, True, True),
        (4, True, True),
        (1, False, True),
        (4, False, False),
    ]:
        views = cameras(n_views, blind, ranks.device)
        keys = [(n_views, blind, view) for view in range(n_views)]
        assignment, ranges = None, None
        if ranks.world_size > 1:
            ranges = uneven(ranks.world_size, n_views)
            if even:
                ranges = owners.divide(keys, WIDTH, HEIGHT, halo=LOSS_HALO)
            assignment = TileAssignment(ranks, ranges)
        frame = render_frame(table, views, OPTIONS, assignment=assignment)
        image, tile_work = frame.renders.clone(), frame.tile_work
        if ranges is not None:
            collect_images(image, ranges, ranks, 0)
            tile_work = tile_work[slice(*assignment.own_tiles)]
        targets, masks, samples = photographs(n_views)
        if ranges is not None:
            for view, (y0, y1) in enumerate(ranges.pixel_rows(ranks.rank)):  # it did not get the other pixels
                targets[view, :y0], targets[view, y1:] = 77, 77
        on_device = [tensor.to(ranks.device) for tensor in (targets, masks, samples)]
        batch = Batch(list(range(n_views)), views, *on_device, ranges)
        terms = loss_terms(frame, batch, LOSS, EXTENT)
        sums = torch.cat(sum_parts(terms.parts)).cpu()
        if ranges is not None:
            sums = owners.record(keys, frame.tile_work, ranges, terms.parts).read()[: 2 * n_views]
        gradients = parameter_gradients(table, frame, terms.v_renders, terms.scale_reg, terms.opacity_reg)
        dense = [torch.zeros_like(column) for column in table.parameters]
        for column, gradient in zip(dense, gradients, strict=True):
            column[frame.projected.visible_ids.long()] = gradient
        tiles = (0, len(frame.tile_work)) if assignment is None else assignment.own_tiles
        composited = tiles if assignment is None else assignment.composited_tiles
        out.append(
            {
                "image": image.cpu(),
                "loss": photometric(sums, samples, LOSS),
                "scale": scale_term(frame, table, EXTENT * SCALE_UNIT).cpu(),
                "psnr": batch_psnr(frame, batch).cpu(),
                "gradients": [gradient.cpu() for gradient in dense],
                "work": int(tile_work.sum()),
                "tiles": tiles,
                "composited": composited,
                "renders": frame.renders.cpu(),
            }
        )
    return table["id"].cpu(), out


@pytest.fixture(scope="module")
def alone():
    return functools.cache(lambda device: _render(Ranks(device=torch.device(device))))


def relative(a, b):
    return ((a - b).norm() / b.norm().clamp(min=1e-30)).item()


@pytest.mark.parametrize("transport", ["auto", "collective"])
@pytest.mark.parametrize(("world_size", "device"), [*on_each_device(2, 3, 4), EIGHT])
def test_images_are_the_same_bits_and_losses_agree(alone, world_size, device, transport):
    if device == "cpu" and transport == "auto":
        pytest.skip("ranks on CPUs share no memory")
    ids, expected = alone(device)
    assert expected[0]["image"].std() > 0.1  # the image is not empty
    assert torch.equal(expected[1]["image"][0], torch.tensor([0.1, 0.2, 0.3]).expand(HEIGHT, WIDTH, 3))
    answers = run_ranks(_render, world_size, device=device, transport=transport)
    rank_ids = torch.cat([a[0] for a in answers])
    order, reference = rank_ids.argsort(), ids.argsort()
    for step, want in enumerate(expected):
        results = [a[1][step] for a in answers]
        assert torch.equal(results[0]["image"], want["image"])
        for result in results:
            n_views = len(result["renders"])
            tiles = TileRanges((0, *result["composited"]), n_views, WIDTH, HEIGHT)
            here = tiles.pixel_mask(1, torch.device("cpu"))[..., None]
            # Own tiles and the ring around them.
            assert torch.equal(result["renders"].where(here, 0.0), want["image"].where(here, 0.0))
            assert relative(result["loss"], want["loss"]) <= 1e-6
            assert relative(result["scale"], want["scale"]) <= 1e-6
            assert abs(result["psnr"] - want["psnr"]) <= 1e-5
        for column, wanted in enumerate(want["gradients"]):
            got = torch.cat([result["gradients"][column] for result in results])
            assert relative(got[order], wanted[reference]) <= 2e-6
        assert sum(result["work"] for result in results) == want["work"]
    # The second visit, with two batches between, is divided by what the first one measured; the scene has
    # few, large tiles.
    first, second = ([a[1][step]["tiles"] for a in answers] for step in (1, 4))
    assert first != second
    work = [a[1][4]["work"] for a in answers]
    # A rank of eight has seven or eight tiles of a batch.
    assert max(work) <= (1.25 if world_size == 8 else 1.15) * sum(work) / len(work)


def _render_plain(ranks):
    table, views = shard(ranks), cameras(3)
    ranges = TileOwners(ranks).divide(range(3), WIDTH, HEIGHT)
    assignment = TileAssignment(ranks, ranges)
    frame = render_frame(table, views, OPTIONS, assignment=assignment)
    with pytest.raises(ValueError, match="the loss reads 10 px beyond"):
        loss_terms(frame, Batch([0, 1, 2], views, *photographs(3), ranges), LOSS, EXTENT)
    collect_images(frame.renders, ranges, ranks, 1)
    return assignment.composited_tiles == ranges.of(ranks.rank), frame.renders


def test_rendering_without_a_loss_composites_no_halo():
    answers = run_ranks(_render_plain, 3)
    assert all(alone for alone, _ in answers)
    assert torch.equal(answers[1][1], render_frame(shard(Ranks()), cameras(3), OPTIONS).renders)


def _gather_all(ranks):
    from blitzgs.table.placement import redistribute

    table = shard(ranks)
    table["extra"] = torch.stack((table["id"] % 251, table["id"] % 7), 1).to(torch.uint8)
    table["flag"] = table["id"] % 2 == 0
    before = {name: table[name].clone() for name in table}
    moved = redistribute(table, ranks)
    again = redistribute(table, ranks)
    forced = redistribute(table, ranks, max_imbalance=0)
    return before, dict(table.columns), (moved, again, forced)


@pytest.mark.parametrize("world_size", [2, 4])
def test_redistribution_conserves_every_row(world_size):
    answers = run_ranks(_gather_all, world_size)
    ids_before = torch.cat([before["id"] for before, _, _ in answers])
    ids_after = torch.cat([after["id"] for _, after, _ in answers])
    for name in answers[0][0]:
        before = torch.cat([before[name] for before, _, _ in answers])[ids_before.argsort()]
        after = torch.cat([after[name] for _, after, _ in answers])[ids_after.argsort()]
        assert torch.equal(before, after), name
    sizes = [len(after["id"]) for _, after, _ in answers]
    assert max(sizes) - min(sizes) <= 1
    assert all(flags == (True, False, True) for _, _, flags in answers)


def test_one_rank_has_nothing_to_redistribute():
    from blitzgs.table.placement import redistribute

    table = random_gaussians(5)
    assert not redistribute(table, Ranks(), 0)
    assert isinstance(table, GaussianTable)


class NeedsMemory:
    """A transport whose exchanges need the sizes that a function returns for each attempt."""

    def __init__(self, needed, sizes=None):
        self.estimate, self._needed, self.given = CapacityEstimate(sizes), needed, []

    def exchange(self, sizes):
        self.given.append(sizes)
        needed = self._needed(len(self.given))
        fits = sizes is not None and sizes.holds(needed)
        return SimpleNamespace(finish=lambda: (needed, "result" if fits else None))


def test_an_estimate_follows_the_largest_recent_sizes():
    estimate = CapacityEstimate()
    assert estimate.sizes is None
    estimate.learn((800, 1600, 0))
    assert estimate.sizes == (900, 1800, 1, 1)  # some more than needed, and at least one
    estimate.learn((80, 3200, 16))
    assert estimate.sizes == (900 - 900 // 256, 3600, 18, 1)
    assert estimate.sizes.holds((897, 3600, 18)) and not estimate.sizes.holds((898,))
    for _ in range(3000):  # the estimate shrinks slowly
        estimate.learn((80, 80, 16))
    assert estimate.sizes.splats < 400


def test_the_next_attempt_gets_the_sizes_the_last_one_needed():
    transport = NeedsMemory(lambda _: Sizes(10, 100, 1000), Sizes(10, 99, 2000))
    found = run_attempts(transport, lambda sizes: (transport.exchange(sizes), len(transport.given)))
    assert found == ("result", 2) and len(transport.given) == 2
    assert transport.given[0] == (10, 99, 2000, 1) and transport.given[1].holds((10, 100, 1000))


def test_attempts_are_bounded_when_the_needed_size_grows():
    transport = NeedsMemory(lambda count: Sizes(1, 10**count, 1))
    with pytest.raises(RuntimeError, match=f"{MAX_ATTEMPTS} attempts .* needs \\(1, 10000, 1, 0\\)"):
        run_attempts(transport, lambda sizes: (transport.exchange(sizes), None))
    assert len(transport.given) == MAX_ATTEMPTS


def test_an_attempt_that_fails_leaves_the_estimate():
    def fail(sizes):
        raise MemoryError

    transport = NeedsMemory(lambda _: Sizes(9, 9, 9), Sizes(1, 2, 3))
    with pytest.raises(MemoryError):
        run_attempts(transport, fail)
    assert transport.estimate.sizes == (1, 2, 3, 1)


def test_threads_may_share_an_estimate():
    estimate = CapacityEstimate()

    def learn(splats):
        for _ in range(2000):
            estimate.learn((1, splats, 1))

    threads = [threading.Thread(target=learn, args=(splats,)) for splats in (8, 80, 80_000)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    estimate.learn((1, 80_000, 1))
    assert estimate.sizes.splats >= 80_000
