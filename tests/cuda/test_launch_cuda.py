# SPDX-License-Identifier: Apache-2.0
"""Streams, branches and early launches of kernels (csrc/common/cuda.cuh)."""

import ctypes

import pytest
import torch

from blitzgs import _library
from blitzgs.ops.host import current_stream
from blitzgs.ops.photometric import photometric_fwd_bwd
from tests.cuda.scenes import Scene, ops

SIZES = (3000, 40, 30_000, 700)


class Calls:
    """Lists, image, loss and gradients of some splats, computed without a copy to the host in between."""

    def __init__(self, n: int) -> None:
        g = torch.Generator().manual_seed(n)
        scene = Scene(n, views=2, seed=n)
        projected = [r.cuda() if torch.is_tensor(r) else r for r in scene.project("cpu")]
        self.grid = scene.grid()
        self.splats = (
            projected[4],
            projected[5],
            projected[7],
            torch.rand(len(projected[0]), 3, generator=g).cuda(),
        )
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
