# SPDX-License-Identifier: Apache-2.0
"""Kernels that are launched while the kernel before them still ends (csrc/common/cuda.cuh)."""

import torch

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
