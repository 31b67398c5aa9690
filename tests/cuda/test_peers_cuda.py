# SPDX-License-Identifier: Apache-2.0
"""Rows written to other ranks' memory, and their gradients read there: ranks take turns on one GPU."""

from types import SimpleNamespace

import pytest
import torch
from cuda_scenes import Scene, ops

from blitzgs.distributed.rows import PeerSpace, Traffic
from blitzgs.ops.host import tell_host
from blitzgs.ops.project import rows_of
from blitzgs.ops.scatter import runs_of
from tests.helpers import sum_tables

VIEWS, WIDTH, HEIGHT = 2, 150, 100
TILES = VIEWS * 10 * 7
# Overlapping, as a rank composites some tiles around its own; the third composites nothing.
BEGINS, ENDS = [0, 60, 100, 100], [70, 110, 100, TILES]


class Rank:
    """One rank's Gaussians, and what its counting pass found."""

    def __init__(self, number, n):
        scene = Scene(n, VIEWS, WIDTH, HEIGHT, seed=number)
        scene.sh[5:n:50] = float("nan")  # such rows are hidden
        self.number = number
        self.ids = (torch.arange(n, device="cuda") * 7919 + number) % 100_003
        self.arguments = (
            *scene.parameters("cuda"), None, None, WIDTH, HEIGHT, 16, scene.degree, 0.1, 1e10, 0.3, 0.0,
            False, True, BEGINS, ENDS, None,
        )  # fmt: skip
        self.plan, self.carry, self.totals, _ = ops.project_count(*self.arguments)

    def rows(self):
        return ops.project_emit(*self.arguments, self.plan, self.carry, self.totals.cpu())[:12]

    def send(self, everyone, buffers, capacity, apart):
        _, _, totals, rows = ops.project_count(*self.arguments, capacity, capacity, self.ids)
        assert torch.equal(totals, self.totals)
        second = torch.cuda.Stream()
        places, admitted = ops.project_rows_to_peers_(
            *self.arguments[:7], WIDTH, HEIGHT, self.arguments[12], everyone, self.number, rows, buffers,
            capacity, second.cuda_stream if apart else 0,
        )  # fmt: skip
        torch.cuda.current_stream().wait_stream(second)
        counts, rest = totals[:3].cpu(), everyone[:, 3 + VIEWS :]
        most = max(everyone[:, 1].max(), rest[:, ::2].sum(0).max(), rest[:, ::2].sum(1).max())
        assert admitted[0] == (rest[:, 2 * self.number].sum() if most <= capacity else 0)
        return [*rows_of(rows, counts)[:12], places[: runs_of(int(counts[1]))]]


def exchange(counts, slack=0, room=None, apart=False):
    """All ranks' rows are written; also what each would have to be given."""
    ranks = [Rank(m, n) for m, n in enumerate(counts)]
    everyone = torch.stack([rank.totals for rank in ranks])
    traffic = [Traffic.of(everyone.tolist(), torch.empty(VIEWS), m) for m in range(len(ranks))]
    capacity = -(-traffic[0].most // 32) * 32 + slack if room is None else room
    words = 25 * capacity
    buffers = [torch.full((words,), -1, dtype=torch.int32, device="cuda") for _ in ranks]
    spaces = [
        PeerSpace(
            SimpleNamespace(rank=m, columns=[], buffers=buffers, meet=lambda: None),
            capacity,
            exchange=1,
            n_isects=0,
            apart=apart,
            arrived_count=None,
            admitted=None,
            known=None,
            told=None,
            visible=None,
            traffic=its,
        )
        for m, its in enumerate(traffic)
    ]
    return ranks, spaces, [rank.send(everyone, buffers, capacity, apart) for rank in ranks]


@pytest.mark.parametrize("slack", [32, 3200])
@pytest.mark.parametrize("counts", [(3000, 900, 0, 40), (1, 0, 0, 2), (60_000, 0, 3, 90_000)])
@pytest.mark.parametrize("apart", [False, True])
def test_rows_arrive_and_their_gradients_are_found(counts, slack, apart):
    ranks, spaces, sent = exchange(counts, slack, apart=apart)
    expected = [rank.rows() for rank in ranks]
    for got, want in zip(sent, expected, strict=True):
        for a, b in zip(got[:12], want, strict=True):
            assert torch.equal(a, b)
    for m, space in enumerate(spaces):
        wanted = []
        for rank, rows in zip(ranks, expected, strict=True):
            here = (rows[11] >> m & 1).bool()
            columns = (rows[4], rows[5], rows[7], rows[8], rows[6], rows[1], rank.ids[rows[0].long()])
            part = [column[here] for column in columns]
            order = (part[6] * VIEWS + part[5]).argsort()
            wanted.append([column[order] for column in part])
        assert [len(part[0]) for part in wanted] == space.traffic.received
        begin = 0
        for part in wanted:
            arrived = [column[begin : begin + len(part[0])] for column in space.arrived()]
            order = (arrived[6] * VIEWS + arrived[5]).argsort()
            for a, b in zip(arrived, part, strict=True):
                assert torch.equal(a[order], b)
            begin += len(part[0])
    for space in spaces:
        splats, table = space.arrived(), space.clear_table()
        assert table.shape == (len(splats.depths), 12) and not table.any()
        columns = [splats.means2d, splats.conics, splats.opacities[:, None], splats.colors]
        table.copy_(torch.cat([*columns, torch.full_like(splats.conics, torch.nan)], 1))
    for m, (rank, space) in enumerate(zip(ranks, spaces, strict=True)):
        rows, masks, places = expected[m], sent[m][11], sent[m][12]
        tables = space.share_table(places)
        times = sum((masks >> k & 1) for k in range(len(ranks)))[:, None]
        columns = [rows[4], rows[5], rows[7][:, None], rows[8]]
        sums = [times * column for column in columns]
        assert torch.equal(sum_tables(tables, len(masks))[:, :9], torch.cat(sums, 1))
        arguments = (
            *rank.arguments[:7], *rows[1:4], WIDTH, HEIGHT, rank.arguments[12], 0.3, False, True,
        )  # fmt: skip
        means2d, conics, opacities, colors = sums
        want = ops.project_bwd(*arguments, means2d, conics, None, opacities.squeeze(1), colors, None, False)
        got = ops.project_bwd(*arguments, None, None, None, None, None, None, False, *tables)
        for x, y in zip(got, want, strict=True):
            atol = 2e-6 * float(y.nan_to_num().abs().max()) if y.numel() else 0.0
            torch.testing.assert_close(x, y, rtol=1e-5, atol=atol, equal_nan=True)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("counts", [(500, 300, 0, 0), (0, 0, 0, 300)])
def test_nothing_is_written_where_room_is_too_small(counts, apart):
    _, spaces, _ = exchange(counts, room=32, apart=apart)
    assert spaces[0].traffic.most > 32
    torch.cuda.synchronize()
    for buffer in spaces[0].peers.buffers:
        assert (buffer == -1).all()


def test_rows_need_the_room_that_others_count_on():
    rank = Rank(0, 100)
    rows = ops.project_count(*rank.arguments, 64, 63, rank.ids)[3]
    with pytest.raises(RuntimeError, match="rows must have room for 64 visible Gaussians and rows, got 64"):
        ops.project_rows_to_peers_(
            *rank.arguments[:7], WIDTH, HEIGHT, rank.arguments[12], rank.totals[None], 0, rows,
            [torch.zeros(25 * 64, dtype=torch.int32, device="cuda")], 64, 0,
        )  # fmt: skip


@pytest.mark.parametrize("n_values", [0, 5, 100])
def test_a_meeting_with_ranks_that_have_come(n_values):
    mail = [torch.zeros(3 + 3 + 4 * 100, dtype=torch.int64, device="cuda") for _ in range(3)]
    known = torch.zeros(3, n_values, dtype=torch.int64, pin_memory=True)
    for meeting, first in ((4, 3), (5, 6)):
        for rank in range(3):
            others = [m for m in range(3) if m != rank]
            mail[rank][others] = meeting  # as they would announce themselves
            values = torch.arange(n_values, device="cuda") + 1000 * rank + meeting
            ops.meet_peers_(mail, rank, meeting, values if n_values else None, first, 20.0, known)
            for letters in mail:
                assert int(letters[rank]) == meeting
                assert torch.equal(letters[first + rank * n_values :][:n_values], values)
            brought = mail[rank][first:][: 4 * n_values].view(4, n_values)
            assert torch.equal(brought[3], brought[:3].sum(0))
            assert torch.equal(known, brought[:3].cpu())


def test_ranks_on_two_streams_wait_for_each_other():
    mail = [torch.zeros(5, dtype=torch.int64, device="cuda") for _ in range(2)]
    values = torch.tensor([[10], [11]], device="cuda")
    streams = [torch.cuda.Stream() for _ in range(2)]
    # Kernels are loaded at their first launch, for which the device must not be waiting.
    torch.cuda._sleep(1)
    ops.meet_peers_(mail[:1], 0, 0, None, 1, 1.0)
    torch.cuda.synchronize()
    for rank, stream in enumerate(streams):
        with torch.cuda.stream(stream):
            if rank == 1:
                torch.cuda._sleep(20_000_000)
            ops.meet_peers_(mail, rank, 1, values[rank], 2, 20.0)
    torch.cuda.synchronize()
    assert [letters.tolist() for letters in mail] == [[1, 1, 10, 11, 21]] * 2


def test_numbers_for_the_host_go_to_pinned_memory():
    for n in (0, 1, 300):
        values = torch.arange(n, device="cuda") + 7
        with tell_host(values) as told:
            torch.cuda._sleep(20_000_000)
            assert torch.equal(told(), values.cpu())
    with pytest.raises(RuntimeError, match="must be pinned memory"):
        ops.tell_host_(torch.zeros(300, dtype=torch.int64), values)
    torch.cuda._sleep(20_000_000)
    with pytest.raises(ValueError), tell_host(values):
        raise ValueError
    assert torch.cuda.current_stream().query()  # nobody writes to the memory any more
