# SPDX-License-Identifier: Apache-2.0
"""Configurations by name, and the one that a run gets without a name."""

import json

import pytest
import torch

from blitzgs.cli import main
from blitzgs.config.files import ConfigError, load_config, to_dict
from blitzgs.config.recipes import default_recipe, recipe_names, recipe_path


def shown(capsys, *flags):
    assert main(["train", "--show-config", *flags]) == 0
    printed = capsys.readouterr()
    return json.loads(printed.out), printed.err


def test_every_recipe_has_a_name_and_can_be_loaded():
    assert {"aerial", "aerial_cpu", "city", "compact", "paper", "smoke"} <= set(recipe_names())
    for name in recipe_names():
        assert recipe_path(name).name == f"{name}.yaml"
        load_config(recipe_path(name))


@pytest.mark.parametrize(
    ("device", "recipe"), [("cpu", "aerial_cpu"), ("cuda", "aerial"), ("cuda:1", "aerial")]
)
def test_a_run_without_a_configuration_gets_the_recipe_of_its_device(capsys, device, recipe):
    config, said = shown(capsys, "--device", device)
    assert config == to_dict(load_config(recipe_path(recipe)))
    assert f"recipe: {recipe} (choose another one with --config)" in said


def test_the_recipe_follows_the_device_that_auto_finds(capsys, monkeypatch):
    for has_gpu in (True, False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda has_gpu=has_gpu: has_gpu)
        assert f"recipe: {default_recipe(has_gpu)} " in shown(capsys)[1]


def test_names_files_and_the_defaults_of_fields(capsys, tmp_path):
    assert shown(capsys, "--config", "compact") == (to_dict(load_config(recipe_path("compact"))), "")
    assert shown(capsys, "--config", "defaults")[0] == to_dict(load_config())
    file = tmp_path / "aerial.yaml"
    file.write_text("schedule: {iterations: 77}\n")
    assert shown(capsys, "--config", str(file))[0]["schedule"]["iterations"] == 77
    with pytest.raises(ConfigError, match="arial.yaml: no such file or recipe; did you mean 'aerial'"):
        recipe_path("configs/arial.yaml")
