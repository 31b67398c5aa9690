# SPDX-License-Identifier: Apache-2.0
"""A training of 100 steps on the CPU must follow the curves in golden.json.

After an intended change of training, write the file again, from the repository's root:

    python -m tests.training.test_golden

golden.json has the whole configuration, so changed defaults do not change the run; fields that were added
later have their defaults. Rounding differs between processors, and its effect grows from step to step. The
command therefore also prints the differences between runs whose first parameters differ by 1e-7 to 1e-5;
they are at most half of the tolerances. `test_the_tolerance_tells_a_small_change` shows that a small change
exceeds the tolerances.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import torch

from blitzgs.config.files import from_dict, to_dict
from blitzgs.distributed.group import Ranks
from blitzgs.training.trainer import Trainer
from tests.training.tiny import events_of, read_log, steps_of, tiny_config, tiny_scene

GOLDEN = Path(__file__).with_name("golden.json")
# 100 steps of 2 views: cloning, splitting, pruning by opacity and size, a reset of opacities, all SH degrees.
OVERRIDES = (
    "schedule.iterations=200", "schedule.batch_size=2", "schedule.densify_from=80",
    "schedule.densify_until=150", "schedule.densify_every=20", "schedule.reset_every=120",
    "schedule.size_prune_after=110", "schedule.sh_every=40", "schedule.position_decay=200",
    "population.grad_threshold=1e-3", "population.clone_scale=0.025", "population.prune_screen_radius=12",
    "population.min_opacity=0.0099", "loss.scale=1.0", "loss.opacity=0.2", "model.antialiased=true",
    "log.every=10",
)  # fmt: skip
# Up to the first density event, small differences stay small. After it, rounding occasionally decides
# whether a Gaussian near a threshold grows.
SMOOTH_UNTIL = 80  # images
SMOOTH, ROUGH = (0.0015, 0.012), (0.02, 0.2)  # loss, relative; PSNR, dB
COUNT_TOLERANCE = 0.02  # relative
DENSIFIED_TOLERANCE = (0.1, 5)  # of all Gaussians cloned, split and pruned: relative, and in number
# Events that change the Gaussians.
CHANGES = ("densify", "reset_opacities")
Curves = dict[str, Any]


def train(config: dict[str, Any], folder: Path, jitter: float = 0.0) -> Curves:
    """Train the tiny capture; return its curves.

    Args:
        config: as `to_dict` gives it.
        folder: for the run.
        jitter: relative change of each parameter at the start.
    """
    trainer = Trainer(from_dict(config), *tiny_scene(), folder, Ranks())
    generator = torch.Generator().manual_seed(1)
    for values in trainer.state.table.parameters:
        values *= 1 + jitter * torch.randn(values.shape, generator=generator)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        summary = trainer.train()
    finally:
        torch.set_num_threads(threads)
    assert summary is not None
    steps, densified = steps_of(folder), events_of(folder, "densify")
    return {
        "images": [record["t"] for record in steps],
        "loss": [record["loss"] for record in steps],
        "psnr": [record["psnr"] for record in steps],
        "gaussians": [record["gaussians"] for record in steps],
        "events": [
            [record["t"], record["event"]] for record in read_log(folder) if record.get("event") in CHANGES
        ],
        "densified": {
            name: sum(event[name] for event in densified) for name in ("cloned", "split", "pruned")
        },
        "held_out": {name: summary[name] for name in ("psnr", "ssim", "psnr_corrected")},
    }


def differences(found: Curves, golden: Curves) -> list[str]:
    """Describe all values that exceed the tolerances."""
    if found["images"] != golden["images"]:
        return [f"logged after {found['images']} images, not {golden['images']}"]
    wrong = []
    if found["events"] != golden["events"]:
        wrong.append(f"events {found['events']}, not {golden['events']}")
    rows = zip(
        *(curves[key] for key in ("images", "loss", "psnr", "gaussians") for curves in (found, golden)),
        strict=True,
    )
    for images, _, loss, old_loss, psnr, old_psnr, count, old_count in rows:
        loss_tolerance, psnr_tolerance = SMOOTH if images <= SMOOTH_UNTIL else ROUGH
        if abs(loss / old_loss - 1) > loss_tolerance:
            wrong.append(f"after {images} images: loss {loss:.5f}, not {old_loss:.5f}")
        if abs(psnr - old_psnr) > psnr_tolerance:
            wrong.append(f"after {images} images: PSNR {psnr:.3f}, not {old_psnr:.3f}")
        if abs(count / old_count - 1) > COUNT_TOLERANCE:
            wrong.append(f"after {images} images: {count} Gaussians, not {old_count}")
    for name, value in golden["densified"].items():
        relative, number = DENSIFIED_TOLERANCE
        if abs(found["densified"][name] - value) > relative * value + number:
            wrong.append(f"{found['densified'][name]} {name}, not {value}")
    for name, value in golden["held_out"].items():
        if abs(found["held_out"][name] - value) > (0.005 if name == "ssim" else ROUGH[1]):
            wrong.append(f"held-out {name} {found['held_out'][name]:.4f}, not {value:.4f}")
    return wrong


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    return json.loads(GOLDEN.read_text())


def test_training_repeats_the_golden_curves(golden, tmp_path):
    wrong = differences(train(golden["config"], tmp_path), golden["curves"])
    assert not wrong, "\n".join([*wrong, "Meant so? python -m tests.training.test_golden writes it anew."])


@pytest.mark.parametrize(
    "section, field, factor",
    [
        ("optimiser", "position", 1.1),
        ("optimiser", "scale", 1.1),
        ("loss", "scale", 1.1),
        ("loss", "ssim", 1.2),
        ("schedule", "reset_every", 1.1),
    ],
)
def test_the_tolerance_tells_a_small_change(golden, tmp_path, section, field, factor):
    config = json.loads(json.dumps(golden["config"]))
    config[section][field] *= factor
    assert differences(train(config, tmp_path), golden["curves"])


def spread(found: Curves, other: Curves) -> str:
    """Return the largest differences of two runs before and after the first density event."""
    loss = [abs(a / b - 1) for a, b in zip(found["loss"], other["loss"], strict=True)]
    psnr = [abs(a - b) for a, b in zip(found["psnr"], other["psnr"], strict=True)]
    smooth = sum(images <= SMOOTH_UNTIL for images in found["images"])
    parts = ((loss[:smooth], psnr[:smooth]), (loss[smooth:], psnr[smooth:]))
    return ", then ".join(f"loss {max(a):.3%}, PSNR {max(b):.4f} dB" for a, b in parts)


def write(path: Path) -> None:
    """Write golden.json, and print the differences that rounding causes."""
    config = to_dict(tiny_config(*OVERRIDES))
    with tempfile.TemporaryDirectory() as folder:
        curves = train(config, Path(folder) / "golden")
        for seed, jitter in enumerate((1e-7, 1e-6, 1e-5)):
            other = train(config, Path(folder) / str(seed), jitter)
            print(f"first parameters changed by {jitter}: {spread(other, curves)}, {other['densified']}")
    path.write_text(json.dumps({"config": config, "curves": curves}, indent=1) + "\n")


if __name__ == "__main__":
    write(GOLDEN)
    print(f"wrote {GOLDEN}", file=sys.stderr)
