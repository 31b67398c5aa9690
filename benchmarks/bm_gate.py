# SPDX-License-Identifier: Apache-2.0
"""Measures the spawn gate on many candidates: features, trees, and the veto over ranks.

    python benchmarks/bm_gate.py [--candidates 1000000] [--trees 200] [--repeats 7] [--json FILE]

The trees are complete, of depth 6, with random splits; fitted gates are at most this large. Times are medians
of wall time with the device idle before and after. The goal is 50 ms for a million candidates on one H200.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import torch
from bm_importance import median_ms
from harness import make_parser, report
from scenes import aerial

from blitzgs.distributed.group import Ranks
from blitzgs.spawn.candidates import FEATURES, Candidates, spawn_features
from blitzgs.spawn.gate import GateInfo, RankVeto, SpawnGate, write_info
from blitzgs.table.table import GaussianTable

DEPTH = 6


def random_model(trees: int) -> dict[str, Any]:
    """Return complete trees with random splits, as XGBoost writes them."""
    generator = torch.Generator().manual_seed(0)
    inner, nodes = 2**DEPTH - 1, 2 ** (DEPTH + 1) - 1
    left = [2 * i + 1 if i < inner else -1 for i in range(nodes)]
    return {
        "learner": {
            "objective": {"name": "binary:logistic"},
            "learner_model_param": {"num_feature": str(len(FEATURES))},
            "gradient_booster": {
                "model": {
                    "trees": [
                        {
                            "left_children": left,
                            "right_children": [child + 1 if child >= 0 else -1 for child in left],
                            "split_indices": torch.randint(
                                0, len(FEATURES), (nodes,), generator=generator
                            ).tolist(),
                            "split_conditions": torch.rand(nodes, generator=generator).tolist(),
                            "default_left": [0] * nodes,
                        }
                        for _ in range(trees)
                    ]
                }
            },
        }
    }


def main(arguments: list[str] | None = None) -> None:
    """Run the benchmark."""
    parser = make_parser(__doc__, repeats=7)
    parser.add_argument("--candidates", type=int, default=1_000_000)
    parser.add_argument("--trees", type=int, default=200)
    options = parser.parse_args(arguments)
    table = GaussianTable.create(aerial(options.candidates, options.device).raw())
    ranks, rows = Ranks(device=table.device), torch.arange(options.candidates, device=options.device)
    is_split = rows % 3 == 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gate.json"
        path.write_text(json.dumps(random_model(options.trees)))
        write_info(path, GateInfo(FEATURES, {}, {}))
        gate = SpawnGate(path)

    def features() -> torch.Tensor:
        return spawn_features(table, rows, is_split, 1000, 100.0, 5)

    some = Candidates(table["id"], is_split, features(), 1000)
    veto = RankVeto(gate, 0.6)
    works = {
        "features": features,
        "trees": lambda: gate.scores(some.features),
        "veto, trees included": lambda: veto(some, ranks),
    }
    rows_of_table = [
        {"work": name, "ms": median_ms(work, options.repeats, table.device)} for name, work in works.items()
    ]
    title = f"Spawn gate: {options.candidates:,} candidates, {options.trees} trees of depth {DEPTH}"
    report(title, rows_of_table, options.json, options.device)


if __name__ == "__main__":
    main()
