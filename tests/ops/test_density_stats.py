# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.density_stats import density_stats_
from tests.helpers import DEVICES

WIDTH, HEIGHT, B = 640, 480, 3


def rows(n=50, dtype=torch.float32, device="cpu"):
    """Some Gaussians of n in one to three views, with anisotropic covariances."""
    generator = torch.Generator().manual_seed(0)
    visible = torch.arange(1, n, 3, dtype=torch.int32)
    counts = torch.randint(1, B + 1, (len(visible),), generator=generator)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)]).int()
    factor = torch.randn(int(offsets[-1]), 2, 2, generator=generator, dtype=torch.float64) * 5
    covariance = factor @ factor.mT + 0.3 * torch.eye(2)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    gradients = torch.randn(len(conics), 2, generator=generator, dtype=torch.float64)
    phi = torch.rand(n, generator=generator, dtype=torch.float64)
    to = lambda t: t.to(device, dtype)  # noqa: E731
    return visible.to(device), offsets.to(device), to(gradients), to(conics), to(phi), covariance


def state(n=50, dtype=torch.float32, device="cpu"):
    zeros = torch.zeros(n, dtype=dtype, device=device)
    return zeros, torch.zeros(n, dtype=torch.int32, device=device), zeros.clone()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("with_phi", [False, True])
def test_matches_the_definition(device, with_phi):
    visible, offsets, gradients, conics, phi, covariance = rows(device=device)
    sums, counts, radii = state(device=device)
    for _ in range(2):
        density_stats_(
            sums,
            counts,
            radii,
            visible,
            offsets,
            gradients,
            conics,
            WIDTH,
            HEIGHT,
            B,
            phi if with_phi else None,
        )
    expected_sum, expected_count, expected_radius = torch.zeros(50), torch.zeros(50), torch.zeros(50)
    largest = torch.linalg.eigvalsh(covariance)[:, 1]
    for u, g in enumerate(visible.tolist()):
        for r in range(int(offsets[u]), int(offsets[u + 1])):
            norm = (gradients[r].cpu() * torch.tensor([WIDTH / 2, HEIGHT / 2])).norm()
            expected_sum[g] += 2 * B * norm * (phi[g].cpu() if with_phi else 1)
            expected_count[g] += 2
            expected_radius[g] = max(expected_radius[g], float((3 * largest[r].sqrt()).ceil()))
    torch.testing.assert_close(sums.cpu(), expected_sum)
    assert counts.tolist() == expected_count.tolist()
    off = (radii.cpu() - expected_radius)[visible.long().cpu()].abs()
    assert off.max() <= 1 and (off == 0).float().mean() > 0.9  # a radius on an integer may round either way


@pytest.mark.parametrize("device", DEVICES)
def test_radii_keep_their_maximum_and_empty_steps_change_nothing(device):
    visible, offsets, gradients, conics, _, _ = rows(device=device)
    sums, counts, radii = state(device=device)
    radii += 1e6
    density_stats_(sums, counts, radii, visible, offsets, gradients, conics, WIDTH, HEIGHT, 1.0)
    assert (radii == 1e6).all()
    before = sums.clone()
    density_stats_(
        sums, counts, radii, visible[:0], offsets[:1], gradients[:0], conics[:0], WIDTH, HEIGHT, 1.0
    )
    assert torch.equal(sums, before)


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_are_read_where_they_are(device):
    """The gradients may be the first columns of a table."""
    visible, offsets, gradients, conics, _, _ = rows(device=device)

    def sums(v_means2d):
        columns = state(device=device)
        density_stats_(*columns, visible, offsets, v_means2d, conics, WIDTH, HEIGHT, 1.0)
        return columns[0]

    expected = sums(gradients)
    assert torch.equal(sums(torch.cat((gradients, gradients.exp()), 1)[:, :2]), expected)
    with pytest.raises(RuntimeError, match=r"v_means2d must have shape \[\d+, 2\]"):
        sums(gradients[1:].contiguous())


def test_errors_name_the_value():
    visible, offsets, gradients, conics, _, _ = rows()
    sums, counts, radii = state()
    with pytest.raises(RuntimeError, match="grad_count must be Int, got Float"):
        density_stats_(sums, sums.clone(), radii, visible, offsets, gradients, conics, WIDTH, HEIGHT, 1.0)
    with pytest.raises(RuntimeError, match=r"splat_offsets must have shape \[18\]"):
        density_stats_(sums, counts, radii, visible, offsets[1:], gradients, conics, WIDTH, HEIGHT, 1.0)


@pytest.mark.parametrize("device", DEVICES)
def test_opcheck(device):
    visible, offsets, gradients, conics, phi, _ = rows(device=device)
    torch.library.opcheck(
        torch.ops.blitzgs.density_stats_,
        (*state(device=device), visible, offsets, gradients, conics, phi, WIDTH, HEIGHT, 2.0),
    )
