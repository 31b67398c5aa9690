# SPDX-License-Identifier: Apache-2.0
"""Gains of photographs are found from the colours of the points in their tracks."""

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.training.inputs import open_capture
from blitzgs.training.track_gains import _log_gains, differ, track_gains
from blitzgs_synth.generate import generate_city
from tests.training.tiny import tiny_config


def test_gains_are_found_where_each_photograph_has_other_points():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.2, (12, 3))
    truth -= truth.mean(0)
    colors = rng.normal(4, 0.5, (900, 3))
    rows = []
    for view in range(12):
        points = np.sort((np.arange(300) + 55 * view) % 900)
        shown = colors[points] + truth[view] + rng.normal(0, 0.01, (300, 3))
        shown[::10] += 2  # something stands before the point
        rows.append((points, shown))
    assert np.abs(_log_gains(rows, 900) - truth).max() < 0.05


@pytest.mark.parametrize("exposure", [0.0, 0.2])
def test_photographs_of_fields_differ_if_their_exposures_do(tmp_path, exposure):
    pytest.importorskip("embreex")
    folder = generate_city(
        tmp_path / "fields", extent=60, views=8, width=96, height=64, points_per_view=80, oblique=0,
        built=False, grain=2.0, exposure=exposure,
    )  # fmt: skip
    config = tiny_config(f"data.path={str(folder)!r}", "data.split=0")
    capture, images = open_capture(config, Ranks())
    gains = track_gains(capture, images, Ranks())
    images.close()
    assert gains is not None and torch.allclose(gains.mean(0), torch.ones(3).double())
    assert differ(gains) == (exposure > 0)
