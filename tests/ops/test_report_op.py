# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from blitzgs.ops.photometric import report_
from tests.helpers import DEVICES, sum_parts


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("n_parts", [0, 1, 3000])
def test_each_target_gets_this_ranks_share(device, n_parts):
    g = torch.Generator().manual_seed(1)
    parts = torch.rand(3, n_parts, 2, generator=g, dtype=torch.float64).to(device)
    work = torch.randint(0, 1000, (777,), generator=g, dtype=torch.int32).to(device)
    targets = [torch.full((2 * 3 * 4 + 777,), -1.0, device=device) for _ in range(4)]
    report_(parts, work, (100, 500), 2, 4, targets)
    expected = torch.full_like(targets[0], -1.0)
    expected[12:18] = parts.sum(1).T.flatten().float()
    expected[24 + 100 : 24 + 500] = work[100:500].float()
    for target in targets:
        torch.testing.assert_close(target, expected, rtol=1e-6, atol=0)
    assert torch.equal(torch.cat(sum_parts(parts)), targets[0][12:18])


@pytest.mark.parametrize("device", DEVICES)
def test_a_report_of_tiles_alone_and_of_nothing(device):
    work = torch.arange(5, dtype=torch.int32, device=device)
    target = torch.zeros(5, device=device)
    report_(None, work, (1, 3), 0, 1, [target])
    assert target.tolist() == [0, 1, 2, 0, 0]
    report_(None, None, (0, 0), 0, 1, [target[:0]])


def test_errors_name_the_value():
    work, target = torch.zeros(5, dtype=torch.int32), torch.zeros(5)
    with pytest.raises(RuntimeError, match=r"must be a range of the 5 tiles, got \[3, 6\)"):
        report_(None, work, (3, 6), 0, 1, [target])
    with pytest.raises(RuntimeError, match=r"a target must have shape \[9\], got \[5\]"):
        report_(torch.zeros(1, 2, 2, dtype=torch.float64), work, (0, 5), 1, 2, [target])
    with pytest.raises(RuntimeError, match=r"rank must be in \[0, 2\), got 2"):
        report_(None, work, (0, 5), 2, 2, [target])
    with pytest.raises(RuntimeError, match="parts must be Double, got Float"):
        report_(torch.zeros(1, 2, 2), None, (0, 0), 0, 1, [target])
