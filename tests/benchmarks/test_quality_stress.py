# SPDX-License-Identifier: Apache-2.0
"""The stress grid: its recipes, its parts and its table."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import quality_stress  # noqa: E402
from quality_plan import SAFE, runs_of  # noqa: E402


def test_parts_make_up_the_grid_and_every_recipe_can_be_configured(tmp_path):
    grid = quality_stress.recipes(str(ROOT / "configs" / "aerial.yaml"))
    assert len(grid) == 9 * 4 * 3 and all(set(name) <= SAFE for name in grid)
    parts = [quality_stress.part_of(grid, (k, 5)) for k in range(1, 6)]
    assert {name: text for part in parts for name, text in part.items()} == grid
    some = dict(list(grid.items())[::17])
    specs = runs_of({"x": str(tmp_path)}, some, [0], [], None, "cpu")
    assert len(specs) == len(some)
    doubled = quality_stress.recipes(str(ROOT / "configs" / "aerial.yaml"))["position=200+schedule=25+B=1"]
    assert "--optimiser.position=0.00032" in doubled and "--schedule.scale=0.25" in doubled


def test_refuses_parts_that_there_are_not():
    with pytest.raises(ValueError, match="3/2"):
        quality_stress.parse_part("3/2")
    assert quality_stress.parse_part("2/2") == (2, 2)


def test_the_table_compares_the_worst_seed_with_its_column():
    def run(change, psnr, fall, seed):
        recipe = f"{change}+schedule=50+B=4"
        evaluations = [{"test": {"psnr": psnr}}]
        return {
            "capture": "park", "recipe": recipe, "seed": seed, "status": "done",
            "evaluations": evaluations, "largest_fall": fall,
        }  # fmt: skip

    runs = [run("base", 30.0, 0.1, 0), run("base", 29.5, 0.4, 1), run("position=200", 27.0, 3.5, 0)]
    text = quality_stress.markdown([*runs, {"capture": "park", "recipe": "aerial", "status": "done"}])
    assert "| park | schedule=50+B=4 | base | 2 | 29.50 | 0.00 | 0.40 |" in text
    assert "| park | schedule=50+B=4 | position=200 | 1 | 27.00 | 2.50 | 3.50 |" in text
