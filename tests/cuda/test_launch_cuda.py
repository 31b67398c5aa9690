# SPDX-License-Identifier: Apache-2.0
"""Branches, sorts and launches on CUDA, and the exchange between ranks."""

import ctypes
import weakref

import pytest
import torch

from blitzgs import _library
from blitzgs.frame.transport.peer import WORDS_PER_SPLAT, PeerBuffers
from blitzgs.frame.transport.protocol import Traffic
from blitzgs.ops.exchange import PLACE_SPLATS
from blitzgs.ops.host import HostCopy, PinnedNumbers, current_stream
from blitzgs.ops.photometric import photometric_fwd_bwd
from blitzgs.ops.project import queue_projection
from blitzgs.ops.projection_types import VIEW_TOTALS, Sizes, splats_of
from blitzgs.ops.rasterize import SPLAT_GRADIENT
from tests.cuda.conftest import Scene, ops

SIZES = (3000, 40, 30_000, 700)


class Calls:
    """Lists, image, loss and gradients of some splats, computed without a copy to the host in between."""

    def __init__(self, n: int) -> None:
        g = torch.Generator().manual_seed(n)
        scene = Scene(n, views=2, seed=n)
        projected = [r.cuda() if torch.is_tensor(r) else r for r in scene.project("cpu")]
        self.grid = scene.grid()
        self.splats = (
            projected[4], projected[5], projected[7], torch.rand(len(projected[0]), 3, generator=g).cuda(),
        )  # fmt: skip
        self.depths, self.cameras = projected[6], projected[1]
        means2d, conics, opacities, _ = self.splats
        listed, _ = ops.intersect(means2d, conics, opacities, self.depths, self.cameras, None, *self.grid, -1)
        self.capacity = len(listed)
        size = (2, scene.height, scene.width, 3)
        self.targets = torch.randint(0, 256, size, generator=g, dtype=torch.uint8).cuda()
        self.weights = (torch.full((2,), 0.8, device="cuda"), torch.full((2,), -0.2, device="cuda"))

    def run(self) -> list[torch.Tensor]:
        means2d, conics, opacities, _ = self.splats
        lists = ops.intersect(
            means2d, conics, opacities, self.depths, self.cameras, None, *self.grid, self.capacity, None, True
        )
        image = ops.rasterize_fwd(*self.splats, None, *lists, *self.grid, True, False)
        renders, rest, last, _, packed, order, _ = image
        _, v_renders = photometric_fwd_bwd(renders, self.targets, None, *self.weights)[:2]
        gradients = ops.rasterize_bwd(
            self.splats, None, lists, [rest, last, packed, order], v_renders, None, *self.grid, False, True
        )
        return [*lists, renders, rest, last, v_renders, *gradients[:4]]


def test_early_kernels_read_what_earlier_kernels_wrote():
    """The device is busy while calls are queued, so all launches overlap and calls reuse scratch memory."""
    calls = [Calls(n) for n in SIZES]
    expected = []
    for call in calls:
        expected.append([x.clone() for x in call.run()])
        torch.cuda.synchronize()
    for _ in range(5):
        torch.cuda._sleep(50_000_000)
        got = [call.run() for call in calls]
        for outputs, wanted in zip(got, expected, strict=True):
            for x, y in zip(outputs, wanted, strict=True):
                assert torch.equal(x, y)
    assert all(wanted[-1].any() for wanted in expected)


def test_the_current_stream_is_torchs_and_its_object_is_made_once():
    device, other = torch.device("cuda", torch.cuda.current_device()), torch.cuda.Stream()
    for stream in (torch.cuda.default_stream(), other, torch.cuda.ExternalStream(other.cuda_stream)):
        with torch.cuda.stream(stream):
            found = current_stream(device)
            assert found == torch.cuda.current_stream() and found.cuda_stream == stream.cuda_stream
            assert current_stream(device) is found and current_stream(torch.device("cuda")) is found


def test_an_event_on_the_current_stream_waits_for_its_work():
    event, side = torch.cuda.Event(), torch.cuda.Stream()
    values = torch.zeros(1 << 20, device="cuda")
    values += 0  # loads the kernel, which may take longer than the sleep
    torch.cuda.synchronize()
    with torch.cuda.stream(side):
        torch.cuda._sleep(1_000_000_000)  # longer than a busy host needs for the next lines
        values += 1
        event.record(current_stream(values.device))
    assert not event.query()
    event.synchronize()
    assert values.min() == 1


@pytest.fixture(scope="module")
def library():
    found = ctypes.CDLL(str(_library.LIBRARY_DIR / "libblitzgs_cuda.so"))
    found.blitzgs_small_states.restype = ctypes.c_int64
    return found


def test_the_device_runs_the_branches_that_the_build_asked_for(library):
    torch.cuda.synchronize()
    newest = torch.cuda.get_device_capability() >= (9, 0)
    assert library.blitzgs_sm90_branches() == int(newest and not library.blitzgs_sm80_forced())


@pytest.mark.parametrize("n", [100, 3000])
def test_sorts_use_wide_states_above_the_limit(n, library):
    """The profiler names the kernels that ran, with the types of their states."""
    scene = Scene(n, views=1)
    rows = [r.cuda() if torch.is_tensor(r) else r for r in scene.project("cpu")]
    splats = (rows[4], rows[5], rows[7], rows[6], rows[1], None, *scene.grid())
    n_isects = len(ops.intersect(*splats, -1)[0])
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        ops.intersect(*splats, n_isects)
        torch.cuda.synchronize()
    sweeps = {event.key for event in profile.key_averages() if "sweep_kernel<" in event.key}
    assert {key.partition("<")[2][0] for key in sweeps} == {"9", "8"}  # bits of depths and of tiles
    wide = max(len(rows[4]), n_isects) >= library.blitzgs_small_states()
    states = {key.partition("<")[2].partition(">")[0].rpartition(",")[2].strip() for key in sweeps}
    assert states == {"unsigned long" if wide else "unsigned int"}


VIEWS, WIDTH, HEIGHT = 2, 150, 100
TILES = VIEWS * 10 * 7
# Overlapping, as a rank composites some tiles around its own; the third composites nothing.
RANGES = [(0, 70), (60, 110), (100, 100), (100, TILES)]


class Rank:
    """One rank's Gaussians and the number of their splats."""

    def __init__(self, number, n):
        scene = Scene(n, VIEWS, WIDTH, HEIGHT, seed=number)
        scene.sh[5:n:50] = float("nan")  # such splats are hidden
        self.number = number
        ids = (torch.arange(n, device="cuda") * 7919 + number) % 100_003
        self.inputs = scene.inputs("cuda")._replace(ids=ids)
        self.projected = queue_projection(self.inputs, None, RANGES)
        self.totals = self.projected.totals

    def send(self, everyone, buffers, capacity):
        projected = queue_projection(self.inputs, Sizes(capacity, capacity, 0), RANGES)
        splats, _, totals = projected
        assert torch.equal(totals, self.totals)
        places, plan = ops.send_splats_(
            list(projected.for_compositing), splats.rank_masks, everyone, self.number, buffers, capacity
        )
        sizes, rest = Sizes(*totals[:3].tolist()), everyone[:, VIEW_TOTALS + VIEWS :]
        most = max(everyone[:, 1].max(), rest[:, ::2].sum(0).max(), rest[:, ::2].sum(1).max())
        assert plan[0] == (rest[:, 2 * self.number].sum() if most <= capacity else 0)
        return [*splats_of(splats, sizes)[:12], places[: -(-sizes.splats // PLACE_SPLATS)]]


def exchange(counts, slack=0, capacity=None):
    """All ranks' splats are written; also what each would have to be given."""
    ranks = [Rank(m, n) for m, n in enumerate(counts)]
    everyone = torch.stack([rank.totals for rank in ranks])
    traffic = [Traffic.of(everyone.tolist(), VIEWS, m) for m in range(len(ranks))]
    if capacity is None:
        capacity = -(-traffic[0].most // 32) * 32 + slack
    words = WORDS_PER_SPLAT * capacity
    buffers = [torch.full((words,), -1, dtype=torch.int32, device="cuda") for _ in ranks]
    parts = [PeerBuffers(buffers, m) for m in range(len(ranks))]
    assert all(part.length == capacity for part in parts)
    return ranks, traffic, parts, [rank.send(everyone, buffers, capacity) for rank in ranks]


@pytest.mark.parametrize("slack", [32, 3200])
@pytest.mark.parametrize("counts", [(3000, 900, 0, 40), (1, 0, 0, 2), (60_000, 0, 3, 90_000)])
def test_splats_arrive_and_their_gradients_are_found(counts, slack):
    ranks, traffic, buffers, sent = exchange(counts, slack)
    expected = [rank.projected.splats[:12] for rank in ranks]
    for got, want in zip(sent, expected, strict=True):
        for a, b in zip(got[:12], want, strict=True):
            assert torch.equal(a, b)
    for m, (its, place) in enumerate(zip(traffic, buffers, strict=True)):
        wanted = []
        for rank, splats in zip(ranks, expected, strict=True):
            here = (splats[11] >> m & 1).bool()
            columns = rank.projected.for_compositing
            part = [column[here] for column in columns]
            order = (part[6] * VIEWS + part[5]).argsort()
            wanted.append([column[order] for column in part])
        assert [len(part[0]) for part in wanted] == its.received
        begin = 0
        for part in wanted:
            arrived = [column[begin : begin + len(part[0])] for column in place.splats]
            order = (arrived[6] * VIEWS + arrived[5]).argsort()
            for a, b in zip(arrived, part, strict=True):
                assert torch.equal(a[order], b)
            begin += len(part[0])
    for m, (its, place) in enumerate(zip(traffic, buffers, strict=True)):
        splats = place.splats.first(sum(its.received))
        columns = [splats.means2d, splats.conics, splats.opacities[:, None], splats.colors]
        table = place.tables[m][: len(splats.depths)]
        table.copy_(torch.cat([*columns, torch.full_like(splats.conics, torch.nan)], 1))
    for m, (its, place) in enumerate(zip(traffic, buffers, strict=True)):
        splats, masks = expected[m], sent[m][11]
        mine = zip(place.tables, its.starts, its.sent, strict=True)
        rows = [table[start : start + n] for table, start, n in mine]
        [found] = ops.sum_splats(
            rows, sent[m][12][: -(-len(masks) // PLACE_SPLATS)], len(masks), [SPLAT_GRADIENT]
        )
        times = sum((masks >> k & 1) for k in range(len(ranks)))[:, None]
        sums = [times * column for column in (splats[4], splats[5], splats[7][:, None], splats[8])]
        assert torch.equal(found[:, :9], torch.cat(sums, 1))


@pytest.mark.parametrize("counts", [(500, 300, 0, 0), (0, 0, 0, 300)])
def test_nothing_is_written_where_room_is_too_small(counts):
    _, traffic, buffers, _ = exchange(counts, capacity=32)
    assert traffic[0].most > 32
    torch.cuda.synchronize()
    for buffer in buffers[0].buffers:
        assert (buffer == -1).all()


def test_send_refuses_columns_below_the_capacity():
    rank = Rank(0, 100)
    projected = queue_projection(rank.inputs, Sizes(64, 63, 0), RANGES)
    with pytest.raises(RuntimeError, match="columns must have room for 64 splats, got 63"):
        ops.send_splats_(
            list(projected.for_compositing), projected.splats.rank_masks, rank.totals[None], 0,
            [torch.zeros(WORDS_PER_SPLAT * 64, dtype=torch.int32, device="cuda")], 64,
        )  # fmt: skip


@pytest.mark.parametrize("n_values", [0, 5, 100])
def test_a_barrier_exchanges_values_when_all_ranks_have_arrived(n_values):
    control = [torch.zeros(3 + 3 + 4 * 100, dtype=torch.int64, device="cuda") for _ in range(3)]
    host = torch.zeros(3, n_values, dtype=torch.int64, pin_memory=True)
    for number, first in ((4, 3), (5, 6)):
        for rank in range(3):
            others = [m for m in range(3) if m != rank]
            control[rank][others] = number  # as they would announce themselves
            values = torch.arange(n_values, device="cuda") + 1000 * rank + number
            ops.device_barrier_(control, rank, number, values if n_values else None, first, 20.0, host)
            for words in control:
                assert int(words[rank]) == number
                assert torch.equal(words[first + rank * n_values :][:n_values], values)
            brought = control[rank][first:][: 4 * n_values].view(4, n_values)
            assert torch.equal(brought[3], brought[:3].sum(0))
            assert torch.equal(host, brought[:3].cpu())


def test_ranks_on_two_streams_wait_for_each_other():
    control = [torch.zeros(5, dtype=torch.int64, device="cuda") for _ in range(2)]
    values = torch.tensor([[10], [11]], device="cuda")
    streams = [torch.cuda.Stream() for _ in range(2)]
    # Kernels are loaded at their first launch, for which the device must not be waiting.
    torch.cuda._sleep(1)
    ops.device_barrier_(control[:1], 0, 0, None, 1, 1.0)
    torch.cuda.synchronize()
    for rank, stream in enumerate(streams):
        with torch.cuda.stream(stream):
            if rank == 1:
                torch.cuda._sleep(20_000_000)
            ops.device_barrier_(control, rank, 1, values[rank], 2, 20.0)
    torch.cuda.synchronize()
    assert [words.tolist() for words in control] == [[1, 1, 10, 11, 21]] * 2


def test_copies_to_the_host_need_pinned_memory():
    for n in (0, 1, 300):
        values = torch.arange(n, device="cuda") + 7
        copy = HostCopy(values)
        torch.cuda._sleep(20_000_000)
        assert torch.equal(copy.read(), values.cpu())
    with pytest.raises(RuntimeError, match="must be pinned memory"):
        ops.copy_to_host_(torch.zeros(300, dtype=torch.int64), values)


def test_pinned_memory_is_used_again_after_it_was_read():
    device = torch.device("cuda", 0)
    first, second = (PinnedNumbers.take(77, torch.float32, device) for _ in range(2))
    assert first.memory.is_pinned() and first.memory.data_ptr() != second.memory.data_ptr()
    first.give_back()
    for other in ((78, torch.float32), (77, torch.int64)):
        assert PinnedNumbers.take(*other, device).memory is not first.memory
    assert PinnedNumbers.take(77, torch.float32, device).memory is first.memory


def test_deleting_a_copy_that_was_not_read_does_not_wait():
    values = torch.arange(300, device="cuda")
    HostCopy(values).read()
    torch.cuda._sleep(1_000_000_000)
    copy = HostCopy(values)
    memory = weakref.ref(copy._pinned.memory)
    del copy
    assert memory() is not None and not torch.cuda.current_stream().query()
    torch.cuda.synchronize()
    HostCopy(values)  # when it is deleted, it looks for memory that has been written
    assert memory() is None
