# SPDX-License-Identifier: Apache-2.0
"""The accuracy benchmark must see an error where there is one."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import bm_accuracy  # noqa: E402
from scenes import aerial  # noqa: E402


@pytest.fixture(scope="module")
def scene():
    return aerial(600, width=24, height=16)


def test_the_default_is_exact_to_float_rounding_and_rounded_sh_is_not(scene):
    default, *_, half = (option for option in bm_accuracy.options_for("cuda") if not option.deterministic)
    image_error, gradient_error, cut = bm_accuracy.errors(scene, default)
    assert 0 < image_error < 1e-5 and 0 < gradient_error < 1e-4 and cut < 0.05
    worse, _, _ = bm_accuracy.errors(scene, half)
    assert worse > 3 * image_error


def test_table_and_figures(scene, tmp_path):
    exact = bm_accuracy.Option("float64", dtype=torch.float64)
    figures = bm_accuracy.measure(exact, scene, scene, repeats=1)
    assert figures.image_error < 1e-12 and figures.milliseconds > 0
    assert bm_accuracy.table([figures]).splitlines()[-1].startswith("| float64 |")
    pytest.importorskip("matplotlib")
    bm_accuracy.plot([figures], tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000
