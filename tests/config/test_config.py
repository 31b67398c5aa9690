# SPDX-License-Identifier: Apache-2.0
"""Fields of the configuration: files, overrides, help, and the recipes that have names."""

import dataclasses
import json
import re
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from blitzgs.cli import main
from blitzgs.config.fields import BLACK, Config
from blitzgs.config.files import (
    REMOVED,
    ConfigError,
    changed,
    config_hash,
    from_dict,
    load_config,
    recipe_names,
    recipe_path,
    save_config,
    to_dict,
)
from blitzgs.config.ranges import RANGES, describe, describe_all, flat, problems
from blitzgs.config.schedule import Schedule
from blitzgs.optim.table_adam import BETA1, BETA2, EPS
from tests.helpers import refused

FOLDER = Path(__file__).parents[2] / "configs"
AERIAL = FOLDER / "aerial.yaml"
FIELDS = list(flat(dataclasses.asdict(Config())))


def test_file_then_overrides(tmp_path):
    (tmp_path / "base.yaml").write_text("schedule: {iterations: 7500, batch_size: 2}\nseed: 5\n")
    (tmp_path / "child.yaml").write_text("base: base.yaml\nschedule: {batch_size: 4}\nloss: {scale: 1e-3}\n")
    config = load_config(
        tmp_path / "child.yaml",
        ["--data.downscale=2", "--model.background=[1, 1, 1]", "--data.masks=null", "--log.every=1e3"],
    )
    assert (config.schedule.iterations, config.schedule.batch_size, config.seed) == (7500, 4, 5)
    assert config.log.every == 1000 and isinstance(config.log.every, int)
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
    ("overrides", "message"),
    [
        ("--schedule.iteratons=3", "schedule.iteratons: unknown field; did you mean 'iterations'"),
        ("--shedule.iterations=3", "shedule: unknown field; did you mean 'schedule'"),
        ("--max_gaussians=3", "max_gaussians: unknown field; did you mean 'population.max_gaussians'"),
        ("--schedule.max_gaussians=3", "max_gaussians: .*; did you mean 'population.max_gaussians'"),
        ("--nonsense=3", "nonsense: unknown field; known: data, model"),
        ("--schedule.iterations=many", r"schedule.iterations: must be an integer, got 'many' \(str\)"),
        ("--schedule.iterations=25e-1", "schedule.iterations: must be an integer, got 2.5"),
        ("--schedule.batch_size=true", "schedule.batch_size: must be an integer, got True"),
        ("--loss.ssim=high", "loss.ssim: must be a number, got 'high'"),
        ("--loss.ssim=1.5", r"loss.ssim: must be in \[0, 1\], got 1.5"),
        ("--model.background=[0, 0]", "model.background: must be a list of 3 values"),
        ("--loss=3", "loss: must be a section with ssim"),
        ("--log.tensorboard=1", "log.tensorboard: must be true or false, got 1"),
        ("--seed", "not an override: write --section.field=value"),
        ("--seed=[", "seed: cannot read the value"),
        ("--schedule.scale=" + "9" * 400, "schedule.scale: 9+ is too large"),
        ("--log=&all {every: *all}", "log: cannot read .* a reference repeats this section"),
        # Eleven lines of nine references each would stand for 31 billion values.
        ("--seed=[&a [1], [*a, *a]]", "seed: cannot read .* a reference repeats this section"),
        ("--seed=[" + "1, " * 500 + "]", r"seed: must be an integer, got \[[1, ]{79} \(list\)$"),
        ("--" + "a." * 5000 + "b=1", "a: unknown field"),
        ("--schedule.iterations=999999999", "times schedule.scale must be at most 10,000,000 images"),
        ("--view.lod=fade", "view.lod: must be true, false or smooth, got fade"),
        ("--lod.visible_threshold=1", r"lod.visible_threshold: must be in \[0, 1\), got 1.0"),
        ("--data.exif=maybe", "data.exif: must be one of auto, apply, ignore, got maybe"),
        ("--view.cull=true", "view.cull: needs population.importance=true"),
        ("--population.importance=true --schedule.t1=9 --schedule.t2=9", "schedule.t2: the second pass"),
        ("--population.strategy=relocation --population.gate=a.json", "gate: .* relocation has none"),
        (
            "--loss.opacity=0.03 --loss.opacity_total=1",
            "loss.opacity: .* for 0.03, add --loss.opacity_total=0",
        ),
        (
            "--population.min_opacity=0.02 --schedule.reset_every=9",
            "min_opacity: must be below 0.01, .* got 0.02",
        ),
        ("--schedule.resolution=[[3, 100]]", r"factors must be 8, 4 or 2 and decrease, got \[3\]"),
        ("--schedule.resolution=[[2, 100], [4, 200]]", r"must be 8, 4 or 2 and decrease, got \[2, 4\]"),
        ("--schedule.resolution=[[4, 200], [2, 200]]", r"times must increase, got \[200, 200\]"),
        ("--schedule.resolution=[[2, 0]]", r"must be in \[1, 1,000,000,000\], got \(\(2, 0\),\)"),
        ("--schedule.resolution=[2, 100]", r"resolution\[0\]: must be a list of 2 values, got 2"),
        ("--schedule.pace=[[16, 1], [16, 2]]", r"schedule.pace: .* above 0 and increase, got \[16, 16\]"),
        ("--schedule.pace=[[16, 1e5]]", r"schedule.pace: its factors must be in .*, got 100000.0"),
        ("--schedule.pace=[[1.5, 2]]", r"schedule.pace\[0\]\[0\]: must be an integer, got 1.5"),
        ("--schedule.pace=[[16, 9e3]]", r"times schedule.scale must be at most 10,000,000 images"),
        ("--schedule.minutes=3 --schedule.scale=0.5", r"schedule.scale: must be 1 .*--minutes.* got 0.5"),
    ],
)
def test_errors_name_the_field(overrides, message):
    refused(ConfigError, message, load_config, None, overrides.split(" --"))


def test_what_is_refused_beside_another_field_is_taken_alone():
    for flag in ("population.strategy=relocation", "loss.opacity=0.03", "population.min_opacity=0.02"):
        assert load_config(None, [flag]) != Config()
    assert load_config(AERIAL, ["loss.opacity=0.03", "loss.opacity_total=0"]).loss.opacity == 0.03


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("loss:\n  sim: 1", "loss.sim: unknown field"),
        ("loss: 5", "loss: must be a section"),
        ("a: [", "not valid YAML"),
        ("loss:\n  ssim: 0.5\nloss:\n  scale: 1", "not valid YAML: the key 'loss' is given twice"),
        ("base: mine.yaml", "'base' leads back"),
        ("base: smok", r"base: smok: no such file in .*did you mean 'smoke'\? recipes are"),
        (None, "cannot read the configuration"),
    ],
)
def test_an_error_of_a_file_names_the_file(tmp_path, content, message):
    file = tmp_path / "mine.yaml"
    if content is not None:
        file.write_text(content)
    refused(ConfigError, f"^{file}: {message}", load_config, file)


NUMBERS = [
    (name, value)
    for name, value in flat(dataclasses.asdict(changed(Config(), "model", background=BLACK))).items()
    if isinstance(value, (int, float, tuple)) and not isinstance(value, bool)
]


def test_a_removed_field_is_named_unless_it_had_no_effect():
    old = ["optimiser.beta1=0.9", "model.far=1e6", "schedule.placed=[]", "schedule.adaptive_limit=0.3"]
    old += ["data.threads=4", "population.relocate=false", "population.opacity_decay=0", "view.most_kept=0.8"]
    old += ["population.reset_opacity=1e-2", "ranks.max_imbalance=1.02"]
    old += ["optimiser.position_final=1.6e-6", "optimiser.sh_rest=1.25e-4"]
    assert load_config(None, old) == from_dict({"loss": {"size": 0.0}}) == Config()
    proportional = ["optimiser.position=3e-4", "optimiser.position_final=3e-6", "optimiser.sh_rest=1.25e-4"]
    assert load_config(None, proportional) == load_config(None, proportional[:1])
    with pytest.raises(ConfigError, match=r"position_final: .* what 0.01 times optimiser.position stood for"):
        load_config(None, proportional[1:2])
    for name, value in (("schedule.adaptive", "true"), ("ranks.half_exchange", "true"), ("loss.size", "0.1")):
        with pytest.raises(ConfigError, match=rf"{name}: this field was removed: .* leave the field out, or"):
            load_config(None, [f"{name}={value}"])
    assert not set(REMOVED) & set(FIELDS)


def test_the_unit_of_the_scale_term_in_earlier_versions():
    assert load_config(None, ["loss.scale=6", "loss.scale_reference=3"]).loss.scale == 20
    assert from_dict({"loss": {"scale_reference": 4.0}}).loss.scale == 2.5 * Config().loss.scale
    with pytest.raises(ConfigError, match="loss.scale_reference: this field was removed"):
        load_config(None, ["loss.scale_reference=0"])


def test_every_number_has_a_range_and_every_default_lies_in_it():
    assert sorted(name for name, _ in NUMBERS) == sorted(RANGES)
    assert list(problems(Config())) == []


@pytest.mark.parametrize(("name", "default"), NUMBERS, ids=lambda value: str(value))
@pytest.mark.parametrize("value", [".nan", ".inf", "-.inf", "-1", "1e40", "-1e-9", str(10**30), "2e15"])
def test_senseless_numbers_are_refused_by_name(name, default, value):
    number = float(value.replace(".nan", "nan").replace(".inf", "inf"))
    if not isinstance(default, tuple) and number in RANGES[name]:
        assert name.startswith(("population.grad", "seed")) and number >= 0
        return
    text = f"[{value}, 0, 0]" if isinstance(default, tuple) else value
    refused(ConfigError, rf"{name}.*: must be .*got", load_config, None, [f"--{name}={text}"])


def test_a_position_rate_of_zero_keeps_the_means_in_place():
    config = load_config(None, ["--optimiser.position=0"])
    rates = Schedule(config.schedule).learning_rates(config.optimiser, 3.0)
    assert rates.isfinite().all() and not rates[:, 0].any() and rates[1:, 1:].all()


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        *(("data.images", name, name) for name in ("100_0001", "0042", "2024-01-05", "1.50", "12:30")),
        *(("data.masks", text, value) for text, value in (("false", False), ("true", True), ("a", "a"))),
        ("seed", "9_223_372_036_854_775_807", 2**63 - 1),
        ("log.every", "010", 10),
        ("model.near", "1.5e-01", 0.15),
    ],
)
def test_texts_are_read_by_the_kind_of_their_field(tmp_path, name, text, value):
    file, content = tmp_path / "c.yaml", name.replace(".", ": {") + f": {text}" + "}" * name.count(".")
    file.write_text(content, encoding="utf-8-sig")  # with a mark of its byte order
    for config in (load_config(None, [f"--{name}={text}"]), load_config(file)):
        assert flat(dataclasses.asdict(config))[name] == value


VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=4,
)


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(FIELDS + ["loss", "seed.x", "", "data."]), VALUES)
def test_any_value_is_taken_or_refused_by_name(name, value):
    try:
        config = load_config(None, [f"{name}={json.dumps(value)}"])
    except ConfigError as error:
        assert str(error)
        return
    assert list(problems(config)) == []


@settings(max_examples=400, deadline=None)
@given(st.binary(max_size=60))
@example(b"loss: &a {ssim: *a}")
@example(b"? {a: 1}\n: 2")
@example(b"<<: {seed: 3}")
@example(b"base: [1]")
def test_any_file_is_taken_or_refused(content):
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "config.yaml"
        file.write_bytes(content)
        try:
            load_config(file)
        except ConfigError as error:
            assert "config.yaml" in str(error) or ":" in str(error)


def test_the_papers_configuration_has_the_papers_values():
    config = load_config(Path(__file__).parents[2] / "configs" / "paper.yaml", [])
    schedule, rates, population, loss = config.schedule, config.optimiser, config.population, config.loss
    assert config.data.downscale == 4
    assert (schedule.iterations, schedule.batch_size, schedule.scale) == (90_000, 4, 1)
    assert (schedule.densify_from, schedule.densify_until, schedule.densify_every) == (2_000, 32_000, 1_000)
    assert (schedule.t1, schedule.t2, schedule.gate_from) == (16_000, 34_000, 24_000)
    assert (schedule.size_prune_after, schedule.sh_every, schedule.position_decay) == (3_000, 1_000, 50_000)
    assert schedule.reset_every == 0
    assert (rates.position, rates.sh_dc) == (1.6e-4, 7.5e-3)
    assert (rates.opacity, rates.scale, rates.rotation) == (2e-2, 7e-3, 1e-3)
    assert (BETA1, BETA2, EPS) == (0.9, 0.999, 1e-15) and rates.position_noise == 0
    assert (population.grad_threshold, population.min_opacity, population.clone_scale) == (1e-4, 0.005, 0.01)
    assert (population.prune_screen_radius, population.prune_world_scale) == (20, 0.1)
    assert population.importance and population.phi
    assert (population.pass1_keep, population.pass2_mass, population.pass2_keep) == (0.7, 0.99, 1)
    assert population.gate_rate == 0.6
    assert population.max_gaussians == population.pixels_per_gaussian == 0
    assert population.min_observations == 1
    assert (loss.ssim, loss.scale) == (0.2, 10)
    assert not config.model.antialiased and config.model.sh_degree == 3


@pytest.mark.parametrize("base", ["smoke", "smoke.yaml", "aerial_cpu", "aerial_cpu.yaml"])
def test_a_base_may_be_a_recipe(tmp_path, base):
    (tmp_path / "mine.yaml").write_text(f"base: {base}\nseed: 7\n")
    name = base.removesuffix(".yaml")
    expected = dataclasses.replace(load_config(recipe_path(name)), seed=7)
    assert load_config(tmp_path / "mine.yaml") == expected
    # A file beside it has priority.
    (tmp_path / base).write_text("schedule: {batch_size: 9}\n")
    assert load_config(tmp_path / "mine.yaml").schedule.batch_size == 9


PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


@pytest.fixture(scope="module")
def explained():
    return describe_all()


@pytest.mark.parametrize("name", FIELDS)
def test_every_field_is_explained(name, explained):
    head, _, meaning = describe(name).partition("\n")
    assert head.startswith(f"--{name}=") and len(meaning.split()) >= 2
    assert name not in RANGES or str(RANGES[name]) in head
    # The flag that is shown sets the default.
    assert load_config(None, [head.split("   (")[0]]) == Config()
    assert head in explained


def test_the_page_of_the_configuration_is_up_to_date(capsys):
    refused(SystemExit, "0", main, ["train", "--help-fields=markdown"])
    made = capsys.readouterr().out
    assert PAGE.read_text() == made, "blitzgs train --help-fields=markdown > docs/configuration.md"
    rows = [line.split("|") for line in made.splitlines() if line.count("|") == 2]
    assert sorted(re.findall("`([^`]+)`", ",".join(row[0] for row in rows))) == sorted(FIELDS)
    assert all(len(row) == 3 and row[2].count("(") == row[2].count(")") for row in rows)


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
    ("flags", "has_gpu", "recipe"),
    [
        (["--device", "cpu"], True, "aerial_cpu"),
        (["--device", "cuda:1"], False, "aerial"),
        ([], True, "aerial"),
        ([], False, "aerial_cpu"),
    ],
)
def test_a_run_without_a_configuration_gets_the_recipe_of_its_device(
    capsys, monkeypatch, flags, has_gpu, recipe
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_gpu)
    config, said = shown(capsys, *flags)
    assert config == to_dict(load_config(recipe_path(recipe)))
    assert f"recipe: {recipe} (choose another one with --config)" in said


def test_names_files_and_the_defaults_of_fields(capsys, tmp_path):
    assert shown(capsys, "--config", "compact") == (to_dict(load_config(recipe_path("compact"))), "")
    assert shown(capsys, "--config", "defaults")[0] == to_dict(load_config())
    file = tmp_path / "aerial.yaml"
    file.write_text("schedule: {iterations: 77}\n")
    assert shown(capsys, "--config", str(file))[0]["schedule"]["iterations"] == 77
    with pytest.raises(ConfigError, match="arial.yaml: no such file or recipe; did you mean 'aerial'"):
        recipe_path("configs/arial.yaml")
