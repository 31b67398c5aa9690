# SPDX-License-Identifier: Apache-2.0
"""A finished run is trained longer."""

import json

import pytest
import torch

from blitzgs.config.fields import OptimiserConfig
from blitzgs.config.files import ConfigError, load_config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.runs import files as run_files
from blitzgs.training.extension import extended
from blitzgs.training.trainer import Trainer
from tests.training.tiny import tiny_config, tiny_scene
from tests.training.tiny_runs import stop_at, train


@pytest.mark.parametrize(
    ("overrides", "by", "images"),
    [
        ((), 1.5, 150),
        ((), 2, 200),
        ((), 100, 200),
        ((), 1000, 1100),
        (("schedule.scale=0.5",), 2, 100),
        (("schedule.scale=0.5",), 100, 150),
        (("schedule.batch_size=4",), 1.5, 152),
        (("schedule.pace=[[50, 2.0]]",), 2, 300),
    ],
)
def test_the_new_length(overrides, by, images):
    config = tiny_config(*overrides)
    before = Schedule(config.schedule)
    after = Schedule(extended(config, before.steps, by).schedule)
    assert after.iterations == images
    # Nothing before the old end changes.
    assert after.events(0, before.iterations) == before.events(0, before.iterations)
    old, new = (schedule.learning_rates(OptimiserConfig(final=0.1), 1.0) for schedule in (before, after))
    assert torch.equal(new[: len(old)], old)


def test_a_run_that_is_not_finished_is_not_extended():
    with pytest.raises(ConfigError, match=r"not finished \(50 of 100 images\): continue it with --resume"):
        extended(tiny_config(), 50, 2)
    with pytest.raises(ConfigError, match="schedule"):
        extended(tiny_config(), 100, 1e9)


def extend(folder, by, *overrides):
    config = load_config(folder / run_files.CONFIG, overrides)
    return Trainer(config, *tiny_scene(), folder, Ranks(), resume=True, extend=by)


def test_an_interrupted_extension_ends_as_an_uninterrupted_one(tmp_path, monkeypatch):
    tables = []
    for name in ("whole", "parts"):
        train(tmp_path / name)
        if name == "whole":
            running = extend(tmp_path / name, 1.4)
        else:
            with monkeypatch.context() as patch:
                stop_at(patch, 120)
                assert extend(tmp_path / name, 1.4).train() is None
            with pytest.raises(ConfigError, match=r"not finished \(120 of 140 images\)"):
                extend(tmp_path / name, 2)
            config = load_config(tmp_path / name / run_files.CONFIG)
            running = Trainer(config, *tiny_scene(), tmp_path / name, Ranks(), resume=True)
        assert running.train()["images"] == 140
        tables.append(running.state.table)
        assert json.loads((tmp_path / name / "summary.json").read_text())["images"] == 140
    assert all(torch.equal(tables[0][column], tables[1][column]) for column in tables[0])


def test_an_extension_that_was_killed_before_its_first_checkpoint_can_be_repeated(tmp_path):
    train(tmp_path)
    extend(tmp_path, 1.4).close()  # its configuration is written, its checkpoint is not
    assert extend(tmp_path, 1.4).train()["images"] == 140


def test_there_must_be_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no checkpoint: there is no finished run to extend"):
        Trainer(tiny_config(), *tiny_scene(), tmp_path / "new", Ranks(), resume=True, extend=2.0)
