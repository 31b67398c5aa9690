# SPDX-License-Identifier: Apache-2.0
"""The library runs the branches that it was built with (docs/testing.md)."""

import ctypes

import pytest
import torch

from blitzgs import _library
from tests.cuda.scenes import Scene, ops


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
