# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.counter_random import normal
from blitzgs.ops.position_noise import position_noise_
from blitzgs.population.density import rotations
from tests.helpers import DEVICES

SEED, STEP, THRESHOLD, STRENGTH = 5, 77, 0.005, 30.0
DRAWS_OF_POSITION_NOISE = 1


def gaussians(count: int = 300, dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    return {
        "means": torch.randn(count, 3, generator=g, dtype=torch.float64).to(dtype),
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64).to(dtype),
        "scales": (torch.rand(count, 3, generator=g, dtype=torch.float64) * 4 - 5).to(dtype),
        "opacities": (torch.rand(count, generator=g, dtype=torch.float64) * 12 - 8).to(dtype),
        "ids": torch.randint(0, 1 << 62, (count,), generator=g),
    }


def expected(rows: dict[str, torch.Tensor], visible: torch.Tensor) -> torch.Tensor:
    """The formula in float64."""
    rows = {name: column if name == "ids" else column.double() for name, column in rows.items()}
    axes = rotations(rows["quats"]) * rows["scales"].exp()[:, None]
    draws = normal(rows["ids"][:, None], SEED, DRAWS_OF_POSITION_NOISE, STEP, torch.arange(3))
    gate = torch.sigmoid(100 * (THRESHOLD - rows["opacities"].sigmoid()))
    moves = STRENGTH * gate[:, None] * (axes @ (axes.mT @ draws[..., None])).squeeze(-1)
    means = rows["means"].clone()
    means[visible.long()] += moves[visible.long()]
    return means


@pytest.mark.parametrize("device", DEVICES)
def test_matches_the_formula(device):
    rows = gaussians()
    visible = torch.arange(0, 300, 2, dtype=torch.int32)
    on_device = {name: column.clone().to(device) for name, column in rows.items()}
    position_noise_(
        *on_device.values(), visible.to(device), seed=SEED, step=STEP, threshold=THRESHOLD, strength=STRENGTH
    )
    wanted = expected(rows, visible)
    moved = (wanted - rows["means"].double()).norm(dim=1)
    assert 20 < int((moved > 1e-3).sum()) < 140
    torch.testing.assert_close(on_device["means"].cpu().double(), wanted, rtol=2e-6, atol=2e-6)
    assert torch.equal(on_device["means"].cpu()[1::2], rows["means"][1::2])


def test_float64_matches_the_formula_closely():
    rows = gaussians(dtype=torch.float64)
    wanted = expected(rows, torch.arange(300))
    visible = torch.arange(300, dtype=torch.int32)
    position_noise_(*rows.values(), visible, seed=SEED, step=STEP, threshold=THRESHOLD, strength=STRENGTH)
    # A gate below 2^-24 moves nothing.
    torch.testing.assert_close(rows["means"], wanted, rtol=0, atol=1e-6)


def test_the_order_of_the_rows_does_not_matter():
    rows = gaussians()
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    shuffled = {name: column[order].contiguous() for name, column in rows.items()}
    visible = torch.arange(300, dtype=torch.int32)
    for table in (rows, shuffled):
        position_noise_(
            *table.values(), visible, seed=SEED, step=STEP, threshold=THRESHOLD, strength=STRENGTH
        )
    assert torch.equal(rows["means"][order], shuffled["means"])


def test_wrong_shapes_are_named():
    rows = gaussians(10)
    rows["scales"] = rows["scales"][:9]
    with pytest.raises(RuntimeError, match="position_noise_: scales"):
        position_noise_(
            *rows.values(), torch.arange(3, dtype=torch.int32), seed=0, step=0, threshold=0.1, strength=1.0
        )
