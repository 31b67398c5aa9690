# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from blitzgs.training.config import Config
from blitzgs.training.config_io import ConfigError, config_hash, from_dict, load_config, save_config, to_dict

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


def test_file_then_overrides(tmp_path):
    (tmp_path / "base.yaml").write_text("schedule: {iterations: 7500, batch_size: 2}\nseed: 5\n")
    (tmp_path / "child.yaml").write_text("base: base.yaml\nschedule: {batch_size: 4}\nloss: {scale: 1e-3}\n")
    config = load_config(
        tmp_path / "child.yaml", ["--data.downscale=2", "--model.background=[1, 1, 1]", "--data.masks=null"]
    )
    assert (config.schedule.iterations, config.schedule.batch_size, config.seed) == (7500, 4, 5)
    assert config.loss.scale == 1e-3
    assert config.data.downscale == 2
    assert config.model.background == (1.0, 1.0, 1.0)


def test_saved_configuration_reads_back_to_the_same(tmp_path):
    config = load_config(None, ["--schedule.scale=0.3", "--data.masks=masks"])
    save_config(config, tmp_path / "config.yaml")
    again = load_config(tmp_path / "config.yaml")
    assert again == config == from_dict(to_dict(config))
    assert config_hash(again) == config_hash(config) != config_hash(Config())


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("--schedule.iteratons=3", "schedule.iteratons: unknown field; did you mean 'iterations'"),
        ("--shedule.iterations=3", "shedule: unknown field; did you mean 'schedule'"),
        ("--schedule.iterations=many", r"schedule.iterations: must be an integer, got 'many' \(str\)"),
        ("--schedule.iterations=3.5", "schedule.iterations: must be an integer, got 3.5"),
        ("--schedule.batch_size=true", "schedule.batch_size: must be an integer, got True"),
        ("--schedule.batch_size=33", "schedule.batch_size: must be 1 to 32, got 33"),
        ("--loss.ssim=high", "loss.ssim: must be a number, got 'high'"),
        ("--loss.ssim=1.5", "loss.ssim: must be between 0 and 1, got 1.5"),
        ("--optimiser.opacity=-0.01", "optimiser.opacity: must be 0 or more, and finite, got -0.01"),
        ("--optimiser.sh_dc=.inf", "optimiser.sh_dc: must be 0 or more, and finite, got inf"),
        ("--optimiser.beta2=1.0", r"optimiser.beta2: must be in \[0, 1\), got 1.0"),
        ("--model.background=[0, 0]", "model.background: must be a list of 3 values"),
        ("--loss=3", "loss: must be a section with ssim"),
        ("--log.tensorboard=1", "log.tensorboard: must be true or false, got 1"),
        ("--seed", "not an override: write --section.field=value"),
        ("--seed=[", "seed: cannot read the value"),
    ],
)
def test_errors_name_the_field(override, message):
    with pytest.raises(ConfigError, match=message):
        load_config(None, [override])


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        load_config(tmp_path / "missing.yaml")
    (tmp_path / "broken.yaml").write_text("a: [")
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_config(tmp_path / "broken.yaml")
    (tmp_path / "loop.yaml").write_text("base: loop.yaml")
    with pytest.raises(ConfigError, match="leads back"):
        load_config(tmp_path / "loop.yaml")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_configurations_load(path):
    assert load_config(path).schedule.iterations > 0
