# SPDX-License-Identifier: Apache-2.0
from fractions import Fraction

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.distributed.selection import mass_prefix, smallest
from blitzgs.ops.counter_random import sampling_keys
from tests.distributed.rank_harness import run_ranks

ALONE = Ranks()


def brute_smallest(keys, ids, k):
    order = sorted(range(len(keys)), key=lambda i: (keys[i].item(), ids[i].item()))
    return {ids[i].item() for i in order[:k]}


def brute_prefix(scores, ids, fraction):
    values = [Fraction(s) for s in scores.tolist()]
    total, target = sum(values), Fraction(str(fraction)) * sum(values)
    order = sorted(range(len(values)), key=lambda i: (-values[i], ids[i].item()))
    chosen, mass = set(), Fraction(0)
    for i in order:
        if mass >= target or total == 0:
            break
        mass += values[i]
        chosen.add(ids[i].item())
    return chosen


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


def test_segments_select_independently():
    ids, columns = cases()
    scores = columns["wide"]
    segments = torch.arange(len(ids)) % 4
    segments[segments == 2] = 1  # segment 2 is empty
    scores[segments == 3] = 0
    together = mass_prefix(scores, ids, 0.9, ALONE, segments, 4)
    for segment in (0, 1, 3):
        rows = segments == segment
        assert torch.equal(together[rows], mass_prefix(scores[rows], ids[rows], 0.9, ALONE))
    assert not together[segments == 3].any()


def test_empty_and_invalid():
    none = torch.empty(0)
    no_ids = torch.empty(0, dtype=torch.int64)
    assert smallest(none, no_ids, 3, ALONE).shape == (0,)
    assert mass_prefix(none, no_ids, 0.5, ALONE).shape == (0,)
    ids = torch.arange(3)
    with pytest.raises(ValueError, match="1 of 3 keys are NaN"):
        smallest(torch.tensor([1.0, float("nan"), 2.0]), ids, 1, ALONE)
    with pytest.raises(ValueError, match="2 scores are negative or not finite"):
        mass_prefix(torch.tensor([1.0, -1.0, float("inf")]), ids, 0.5, ALONE)
    with pytest.raises(ValueError, match="k must not be negative"):
        smallest(torch.ones(3), ids, -1, ALONE)
    with pytest.raises(ValueError, match=r"fraction must be in \[0, 1\], got 2"):
        mass_prefix(torch.ones(3), ids, 2, ALONE)


def test_sampling_is_proportional_and_skips_zero():
    n, k = 400, 100
    weights = torch.ones(n)
    weights[:40] = 5.0
    weights[-40:] = 0.0
    ids = torch.arange(n)
    hits = torch.zeros(n)
    for event in range(200):
        hits += smallest(sampling_keys(weights, ids, 3, event), ids, k, ALONE)
    assert hits[-40:].sum() == 0
    heavy, light = hits[:40].mean() / 200, hits[40:-40].mean() / 200
    # Without replacement: 1 - exp(-w t) with 40 (1 - exp(-5 t)) + 320 (1 - exp(-t)) = 100, t = 0.2523.
    assert abs(heavy - 0.717) < 0.03
    assert abs(light - 0.223) < 0.01
    everything = smallest(sampling_keys(weights, ids, 3, 0), ids, n - 20, ALONE)
    assert everything[:-40].all()
    assert everything[-40:].sum() == 20


def _select(ranks):
    ids, columns = cases()
    mine = (torch.arange(len(ids)) * 7 // 5) % ranks.world_size == ranks.rank
    if ranks.world_size == 4:
        mine = torch.tensor([0, 0, 0, 3])[torch.arange(len(ids)) % 4] == ranks.rank  # 3 : 0 : 0 : 1
    chosen = []
    segments = torch.arange(len(ids)) % 3
    for scores in columns.values():
        own, own_ids = scores[mine], ids[mine]
        chosen.append(own_ids[smallest(own, own_ids, 217, ranks)])
        chosen.append(own_ids[smallest(sampling_keys(own, own_ids, 1, 2), own_ids, 217, ranks)])
        chosen.append(own_ids[mass_prefix(own, own_ids, 0.6, ranks)])
        chosen.append(own_ids[mass_prefix(own, own_ids, 0.6, ranks, segments[mine], 3)])
    return chosen


def test_the_same_ids_at_every_world_size():
    results = []
    for world_size in (1, 2, 4):
        answers = run_ranks(_select, world_size)
        results.append([torch.cat(parts).sort().values.tolist() for parts in zip(*answers, strict=True)])
    assert results[0] == results[1] == results[2]
    assert len(results[0][0]) == 217
