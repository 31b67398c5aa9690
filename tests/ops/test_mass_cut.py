# SPDX-License-Identifier: Apache-2.0
"""The search for thresholds equals sorting with Python's integers."""

from fractions import Fraction

import pytest
import torch

from blitzgs.ops.mass_cut import CHOICE_STEP, ROUNDS, STEPS, TIES_STEP, MassCut
from tests.helpers import DEVICES

SHARE = 99, 100


def by_sorting(weights, segments, ids, share):
    """Return the chosen items by the definition: sorted by descending weight and ascending id."""
    chosen = [False] * len(weights)
    for segment in set(segments):
        mine = [i for i, s in enumerate(segments) if s == segment]
        mine.sort(key=lambda i: (-weights[i], ids[i]))
        missing = sum(weights[i] for i in mine) * Fraction(*share)
        for i in mine:
            if missing <= 0:
                break
            chosen[i] = True
            missing -= weights[i]
    return chosen


def items(kind, n_segments, seed=0):
    """Weights [P], segments [P], owners [P] and ids [N]; each owner has an item in some of the segments."""
    g = torch.Generator().manual_seed(seed)
    n = 400
    ids = torch.randperm(n, generator=g) * ((1 << 61) // n)
    ids[0] = (1 << 63) - 1
    pairs = torch.rand(n, n_segments, generator=g) < 0.6
    pairs[:, 1:2] = False  # a segment without items
    owners, segments = pairs.nonzero().unbind(1)
    count = len(owners)
    small = torch.randint(0, 1 << 50, (count,), generator=g) >> torch.randint(0, 50, (count,), generator=g)
    weights = {
        "many sizes": small,
        "ties": torch.randint(0, 4, (count,), generator=g) * 1_234_567_890_123,
        "all alike": torch.full((count,), 7),
        "tiny": torch.randint(0, 40, (count,), generator=g),
        "zeros": torch.zeros(count, dtype=torch.int64),
    }[kind]
    weights[:: n + 1] = 1 << 55
    if kind == "zeros":
        weights[:] = 0
    return weights, segments.int(), owners.int(), ids


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n_segments", [1, 3, 11])
@pytest.mark.parametrize("kind", ["many sizes", "ties", "all alike", "tiny", "zeros"])
@pytest.mark.parametrize("share", [(0, 1), (1, 2), (99, 100), (123_456_789, 1_000_000_000), (1, 1)])
def test_equals_sorting(device, n_segments, kind, share):
    weights, segments, owners, ids = items(kind, n_segments)
    expected = by_sorting(weights.tolist(), segments.tolist(), ids[owners].tolist(), share)
    cut = MassCut.begin(*(t.to(device) for t in (weights, segments, owners, ids)), n_segments)
    cut.take_steps(share, 0, STEPS)
    assert cut.chosen.tolist() == expected
    assert not cut.sums.any()


@pytest.mark.parametrize("device", DEVICES)
def test_largest_weights(device):
    weights = torch.tensor([(1 << 61) - 1, 1 << 60, (1 << 60) - 1, 1, 0])
    ids = torch.tensor([4, 0, 3, 2, 1])
    for share in ((1, 2), (3, 4), (999_999_999, 1_000_000_000), (1, 1)):
        items = weights, torch.zeros(5, dtype=torch.int32), torch.arange(5, dtype=torch.int32), ids
        cut = MassCut.begin(*(t.to(device) for t in items), 1)
        cut.take_steps(share, 0, STEPS)
        assert cut.chosen.tolist() == by_sorting(weights.tolist(), [0] * 5, ids.tolist(), share)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", ["many sizes", "ties", "zeros"])
def test_sums_of_parts_add_up(device, kind):
    """Three ranks, the last without items, add up their sums after every scan."""
    weights, segments, owners, ids = (t.to(device) for t in items(kind, 3))
    expected = by_sorting(weights.tolist(), segments.tolist(), ids[owners.long()].tolist(), SHARE)
    part = owners % 2
    cuts = [
        MassCut.begin(weights[part == p], segments[part == p], owners[part == p], ids, 3) for p in range(3)
    ]
    for step in range(0, CHOICE_STEP, 2):
        if step == TIES_STEP:
            assert [cut.has_ties() for cut in cuts] == [kind == "ties"] * 3
        for cut in cuts:
            cut.take_steps(SHARE, step, step + 1)
        total = sum(cut.sums for cut in cuts)
        for cut in cuts:
            cut.sums.copy_(total)
            cut.take_steps(SHARE, step + 1, step + 2)
    for cut in cuts:
        cut.take_steps(SHARE, CHOICE_STEP, STEPS)
    chosen = torch.zeros(len(weights), dtype=torch.bool, device=device)
    for p in range(2):
        chosen[part == p] = cuts[p].chosen
    assert chosen.tolist() == expected and ROUNDS == TIES_STEP // 2


def test_errors_name_the_value():
    def cut(**changes):
        items = {
            "weights": torch.ones(3, dtype=torch.int64),
            "segments": torch.zeros(3, dtype=torch.int32),
            "owners": torch.arange(3, dtype=torch.int32),
            "ids": torch.arange(3),
        }
        return MassCut.begin(*(items | changes).values(), 2)

    with pytest.raises(RuntimeError, match=r"share must be in \[0, 1\] with at most 9 decimals, got 3 / 2"):
        cut().take_steps((3, 2), 0, STEPS)
    with pytest.raises(RuntimeError, match=rf"steps must be in \[0, {STEPS}\], got 0 to {STEPS + 1}"):
        cut().take_steps(SHARE, 0, STEPS + 1)
    with pytest.raises(RuntimeError, match=r"segments must have shape \[3\], got \[2\]"):
        cut(segments=torch.zeros(2, dtype=torch.int32)).take_steps(SHARE, 0, STEPS)
    with pytest.raises(RuntimeError, match="owners must be Int, got Long"):
        cut(owners=torch.arange(3)).take_steps(SHARE, 0, STEPS)


def test_opcheck():
    cut = MassCut.begin(*items("ties", 2), 2)
    arguments = (*cut.items, cut.searches, cut.sums, cut.listed.zero_(), cut.chosen.zero_(), *SHARE, 0, STEPS)
    torch.library.opcheck(torch.ops.blitzgs.mass_cut_, arguments)
