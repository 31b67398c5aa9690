# SPDX-License-Identifier: Apache-2.0
"""A call of `blitzgs.rasterization` makes few torch operations; each takes host time."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.helpers import PARAMETERS, random_scene, rasterize_scene


class Count(TorchDispatchMode):
    """Counts the operations that reach a backend."""

    def __init__(self):
        super().__init__()
        self.number = 0

    def __torch_dispatch__(self, operation, types, arguments=(), keywords=None):
        self.number += 1
        return operation(*arguments, **(keywords or {}))


def operations(cameras, sh, read_meta, **options):
    """The numbers of operations of a forward pass, with or without reading meta, and of a backward pass."""
    scene = random_scene(n=40, cameras=cameras).leaves()
    if not sh:
        scene.colors = scene.colors[:, 0].detach().requires_grad_()
        options["sh_degree"] = None
    parameters = [getattr(scene, name) for name in PARAMETERS]
    with Count() as forward:
        renders, _, meta = rasterize_scene(scene, **options)
        if read_meta:
            list(meta.values())
    v_renders = torch.ones_like(renders)
    with Count() as backward:
        torch.autograd.grad(renders, parameters, v_renders)
    return forward.number, backward.number


@pytest.mark.parametrize(
    ("cameras", "options", "forward", "backward"),
    [
        (1, {}, 31, 2),
        (1, {"sparse_grad": True}, 31, 13),
        (1, {"packed": False}, 32, 8),
        (2, {}, 33, 4),
        (2, {"packed": False}, 32, 8),
        (1, {"sh": False}, 38, 6),
        (1, {"read_meta": True}, 48, 2),
    ],
    ids=str,
)
def test_a_call_makes_few_operations(cameras, options, forward, backward):
    made = operations(cameras, **{"sh": True, "read_meta": False, **options})
    assert made[0] <= forward and made[1] <= backward, made
