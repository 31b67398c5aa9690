# SPDX-License-Identifier: Apache-2.0
"""The sweep equals brute force, with the same bits at every world size; draws match the theory."""

import numpy as np
import pytest
import torch

from blitzgs import rasterization
from blitzgs.call import contributions
from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import integer_mass_prefix
from blitzgs.frame.ownership import TileOwners
from blitzgs.frame.render import RenderOptions, survey
from blitzgs.ops.projection_types import Views
from blitzgs.population import importance
from blitzgs.population.importance import (
    PHI_EPS,
    SCORE_EPS,
    ViewBatch,
    is_culled,
    sample_by_score,
    sweep,
    top_by_score,
)
from blitzgs.reference.render import scores as by_definition
from blitzgs.table.table import GaussianTable
from tests.distributed.rank_harness import on_cuda, on_each_device, run_ranks
from tests.helpers import look_at_origin
from tests.training.tiny import random_gaussians

ALONE = Ranks()
OPTIONS = RenderOptions(sh_degree=0, near_plane=0.05, far_plane=100.0)
N_VIEWS = 37  # two words of the cull matrix


def cameras(count, device, width=64, height=48):
    poses = [look_at_origin(np.array([3 * np.cos(a), 3 * np.sin(a), 1.5])) for a in np.linspace(0, 5, count)]
    K = torch.tensor([[60.0, 0, 0.48 * width], [0, 61.0, 0.53 * height], [0, 0, 1]])
    viewmats = torch.from_numpy(np.stack(poses)).float()
    return Views(viewmats.to(device), K.repeat(count, 1, 1).to(device), width, height)


def view_batches(device):
    """37 views in batches of several lengths; every third is of another size."""
    views, wide = cameras(N_VIEWS, device), cameras(N_VIEWS, device, 80, 40)
    groups = [[i for i in range(N_VIEWS) if i % 3], [i for i in range(N_VIEWS) if i % 3 == 0]]
    batches = []
    for source, columns in zip((views, wide), groups, strict=True):
        for begin in range(0, len(columns), 5):
            some = columns[begin : begin + 5]
            picked = Views(source.viewmats[some], source.Ks[some], source.width, source.height)
            batches.append(ViewBatch(some, picked))
    return batches


def population(ranks, layout=(0,)):
    """This rank's Gaussians: with some far outside, equal ones, faint ones, and ids in no order."""
    table = random_gaussians(500)
    table["means"][:20] += 50.0
    table["means"][100:160] = table["means"][40:100]
    table["scales"][100:160] = table["scales"][40:100]
    table["opacities"][200:230] = -6.0
    table["id"].copy_((table["id"] * 7919 + 5) % 100003)
    mine = torch.tensor(layout)[torch.arange(len(table)) % len(layout)] == ranks.rank
    table.keep(mine)
    return GaussianTable({name: table[name].to(ranks.device) for name in table})


def dense_survey(table):
    """Units, pixels, visibility and squares [V, N] of the views one by one."""
    units = torch.zeros(N_VIEWS, len(table), dtype=torch.int64)
    pixels, squares = torch.zeros_like(units), torch.zeros_like(units)
    visible = torch.zeros_like(units, dtype=torch.bool)
    for batch in view_batches(table.device):
        for k, column in enumerate(batch.columns):
            one = slice(k, k + 1)
            views = Views(
                batch.views.viewmats[one], batch.views.Ks[one], batch.views.width, batch.views.height
            )
            found = survey(table, views, OPTIONS, squares=True)
            ids = found.splats.gaussian_ids.long().cpu()
            units[column, ids], pixels[column, ids] = found.weights.cpu(), found.pixels.long().cpu()
            squares[column, ids] = found.squares.cpu()
            visible[column, ids] = True
    return units, pixels, visible, squares


def test_sweep_is_the_definition(device):
    ranks = Ranks(device=torch.device(device))
    table = population(ranks)
    found = sweep(table, view_batches(device), N_VIEWS, OPTIONS, ranks)
    units, pixels, visible, squares = dense_survey(table)
    expected = by_definition(units, pixels, visible, table["id"].cpu(), SCORE_EPS, PHI_EPS)
    assert torch.allclose(found.score.cpu().double(), expected.score, rtol=1e-6, atol=1e-9)
    for rule, terms, power in (("root", units, 0.5), ("weight", units, 0.0), ("energy", squares, 0.0)):
        other = sweep(table, view_batches(device), N_VIEWS, OPTIONS, ranks, rule=rule)
        wanted = (terms.double() / 2.0**32 / (pixels.double() + SCORE_EPS) ** power).sum(0)
        assert torch.allclose(other.score.cpu().double(), wanted, rtol=1e-6, atol=1e-5)
        assert torch.equal(other.phi, found.phi) and torch.equal(other.cull, found.cull)
    assert torch.allclose(found.phi.cpu().double(), expected.phi, rtol=1e-6, atol=0)
    culled = torch.stack([is_culled(found.cull, v) for v in range(N_VIEWS)]).cpu()
    assert torch.equal(culled, ~expected.c_vis)
    assert found.cull.shape == (500, 2) and not (found.cull[:, 1] >> 5).any()  # nothing from V on
    assert 0.02 < culled.double().mean() < 0.98 and 0 == found.phi.min() < 0.5 < found.phi.max() < 1
    assert not found.score[:20].any() and found.score[300:].min() > 0


def test_energy_is_the_squared_error_of_removing(device):
    """White Gaussians that do not overlap, on black: without one, the image's squared error is its energy."""
    x, y = torch.meshgrid(torch.arange(-2.0, 3), torch.arange(-2.0, 3), indexing="ij")
    means = torch.stack([0.4 * x.flatten(), 0.4 * y.flatten(), torch.zeros(25)], 1)
    table = random_gaussians(25)
    table["means"].copy_(means)
    table["scales"].sub_(1.0)
    table["opacities"].copy_(torch.linspace(-2, 4, 25))
    table = GaussianTable({name: table[name].to(device) for name in table})
    view = cameras(1, device, 256, 192)
    view.Ks[:, [0, 1], [0, 1]] *= 4
    batches = [ViewBatch([0], view)]
    energy = sweep(table, batches, 1, OPTIONS, Ranks(device=torch.device(device)), rule="energy").score

    def image(kept):
        return rasterization(
            table["means"][kept], table["quats"][kept], table["scales"][kept].exp(),
            table["opacities"][kept].sigmoid(), torch.ones(len(kept), 1, device=device),
            view.viewmats, view.Ks, view.width, view.height, near_plane=0.05, far_plane=100.0,
        )[0]  # fmt: skip

    everything = torch.arange(25, device=device)
    full = image(everything)
    errors = [(full - image(everything[everything != i])).double().square().sum() for i in range(25)]
    assert energy.min() > 0.2 and energy.max() > 10
    assert torch.allclose(energy.double(), torch.stack(errors), rtol=1e-4)


def test_survey_equals_contributions(device):
    """They agree up to rounding of the activations; one orders equal depths by id, the other by row."""
    table = population(Ranks(device=torch.device(device)))
    table.permute(table["id"].argsort())
    units, pixels, visible, _ = dense_survey(table)
    for batch in view_batches(device):
        weights, counts, seen = contributions(
            table["means"], table["quats"], table["scales"].exp(), table["opacities"].sigmoid(),
            batch.views.viewmats, batch.views.Ks, batch.views.width, batch.views.height,
            near_plane=OPTIONS.near_plane, far_plane=OPTIONS.far_plane,
        )  # fmt: skip
        for k, column in enumerate(batch.columns):
            assert torch.equal(seen[k].cpu(), visible[column])
            assert (counts[k].cpu() - pixels[column]).abs().max() <= 2
            difference = weights[k].cpu() - units[column] / 2.0**32
            assert difference.abs().max() <= 1e-5 * counts[k].max() + 0.02


def test_a_survey_reads_no_colours(device):
    table = population(Ranks(device=torch.device(device)))
    views = cameras(3, device)
    before = survey(table, views, OPTIONS)
    table["sh"].fill_(float("nan"))
    after = survey(table, views, OPTIONS)
    assert before.weights.any() and len(after.splats.colors) == 0
    assert torch.equal(before.weights, after.weights) and torch.equal(before.pixels, after.pixels)


@pytest.mark.cuda
def test_cuts_that_lag_behind_the_surveys_change_no_bit(monkeypatch):
    ranks, add = Ranks(device=torch.device("cuda")), importance._Sums.add
    table = population(ranks)
    expected = sweep(table, view_batches("cuda"), N_VIEWS, OPTIONS, ranks)

    def late(*arguments):
        torch.cuda._sleep(20_000_000)  # longer than the next survey takes
        add(*arguments)

    monkeypatch.setattr(importance._Sums, "add", late)
    found = sweep(table, view_batches("cuda"), N_VIEWS, OPTIONS, ranks)
    assert all(torch.equal(getattr(found, n), getattr(expected, n)) for n in ("score", "phi", "cull"))


def layouts(world_size):
    return {1: [0], 2: [0, 0, 0, 1], 3: [0, 2, 2], 4: [0, 3, 1, 0, 0, 3]}[world_size]


def _sweep(ranks):
    torch.set_num_threads(1)
    table = population(ranks, layouts(ranks.world_size))
    owners = TileOwners(ranks)
    found = sweep(table, view_batches(ranks.device), N_VIEWS, OPTIONS, ranks, owners)
    again = sweep(table, view_batches(ranks.device)[::-1], N_VIEWS, OPTIONS, ranks)
    assert all(torch.equal(getattr(found, n), getattr(again, n)) for n in ("score", "phi", "cull"))
    energy = sweep(table, view_batches(ranks.device), N_VIEWS, OPTIONS, ranks, owners, rule="energy")
    ids = table["id"]
    kept = [
        ids[sample_by_score(found.score, ids, 0.7, 3, 16000, ranks)],
        ids[top_by_score(found.score, ids, 0.99, 1, ranks)],
        ids[top_by_score(found.score, ids, 0.99, 0.3, ranks)],
    ]
    return [t.cpu() for t in (ids, found.score, found.phi, found.cull, energy.score, *kept)]


@pytest.mark.parametrize("transport", ["auto", "collective"])
@pytest.mark.parametrize(("world_size", "device"), [*on_each_device(2, 4), *on_cuda(3)])
def test_the_same_bytes_at_every_world_size(world_size, device, transport):
    if device == "cpu" and transport == "auto":
        pytest.skip("ranks on CPUs share no memory")
    ids, *expected = _sweep(Ranks(device=torch.device(device)))
    answers = run_ranks(_sweep, world_size, device=device, transport=transport)
    joined = [torch.cat(parts) for parts in zip(*answers, strict=True)]
    order, reference = joined[0].argsort(), ids.argsort()
    for got, want in zip(joined[1:5], expected[:4], strict=True):
        assert torch.equal(got[order], want[reference])
    for got, want in zip(joined[5:], expected[4:], strict=True):
        assert torch.equal(got.sort().values, want.sort().values)
    assert len(joined[5]) == 350 and 150 < len(joined[6]) < 480 and len(joined[7]) == 150


def test_pass_1_draws_in_proportion():
    """The first draw has probability s / sum(s): chi-square over 1500 events."""
    score = torch.tensor([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 0.0, 0.05])
    ids = torch.tensor([5, 900, 3, 77, 12, 40, 8, 1 << 61])
    draws = 1500
    hits = torch.zeros(len(ids))
    pairs = torch.zeros(len(ids))
    for event in range(draws):
        hits += sample_by_score(score, ids, 0.125, 11, event, ALONE)
        pairs += sample_by_score(score, ids, 0.25, 11, event, ALONE)
    p = (score / score.sum()).double()
    expected = draws * p
    positive = score > 0
    assert hits.sum() == draws and hits[6] == 0
    chi2 = ((hits - expected) ** 2 / expected)[positive].sum()
    assert chi2 < 22.5  # 6 degrees of freedom, p = 0.001
    # Drawn first, or second behind another.
    others = p[:, None] * p / (1 - p)[:, None]
    inclusion = p + others.sum(0) - others.diagonal()
    deviation = (pairs - draws * inclusion) / (draws * inclusion * (1 - inclusion)).sqrt()
    assert deviation[positive].abs().max() < 4 and pairs[6] == 0


def test_pass_1_keeps_the_floor_and_zeros_last():
    ids = torch.arange(10)
    score = torch.zeros(10)
    score[:4] = 1e-12
    for keep, count in ((0.7, 7), (0.3, 3), (0.29, 2), (0.0, 0), (1.0, 10)):
        kept = sample_by_score(score, ids, keep, 0, 1, ALONE)
        assert kept.sum() == count
        assert kept[:4].all() or not kept[4:].any()


@pytest.mark.parametrize("keep", [1, 0.0085, 0.0004])
def test_pass_2_against_numpy(keep):
    g = torch.Generator().manual_seed(0)
    score = (torch.randn(2000, generator=g) * 3).exp()
    score[::7] = score[1::7][: len(score[::7])]  # ties
    ids = torch.randperm(2000, generator=g)
    kept = top_by_score(score, ids, 0.99, keep, ALONE)
    order = np.lexsort((ids.numpy(), -score.numpy()))
    sums = score.numpy()[order].astype(np.longdouble).cumsum()
    count = int(np.searchsorted(sums, np.longdouble("0.99") * sums[-1])) + 1
    assert 20 < count < 1900
    count = min(count, int(2000 * keep))
    assert set(kept.nonzero().squeeze(1).tolist()) == set(order[:count].tolist())


def test_integer_cut_names_what_is_wrong():
    one = torch.ones(1, dtype=torch.int64)
    with pytest.raises(ValueError, match="at most 9 decimals, got 0.1234567890123"):
        integer_mass_prefix(one, one.int(), one.int(), one, 0.1234567890123, ALONE, 1)
