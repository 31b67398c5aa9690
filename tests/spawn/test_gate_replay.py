# SPDX-License-Identifier: Apache-2.0
"""`blitzgs gate replay`: continuations of one checkpoint with different vetoes."""

import json
import shutil
from dataclasses import replace
from itertools import islice
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.config.files import load_config, save_config
from blitzgs.distributed.group import Ranks
from blitzgs.runs import folder_checks
from blitzgs.spawn.candidates import Candidates
from blitzgs.spawn.fit import read_spawns
from blitzgs.spawn.gate import SpawnGate, gate_file
from blitzgs.training.inputs import open_capture
from blitzgs.training.replay import OracleVeto, branch_point, event_keys, label_events, replay
from blitzgs.training.trainer import Trainer
from tests.capture.helpers import write_image
from tests.conftest import LINEAGE
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused
from tests.spawn.test_spawn_gate import candidates
from tests.training.tiny import HEIGHT, OVERRIDES, WIDTH, as_flags, at_step, events_of, tiny_config

pytest.importorskip("pyarrow")
pytest.importorskip("xgboost")


def test_a_replay_that_repeats_the_reference_matches_it_though_the_population_is_limited(
    lineage_run, tmp_path
):
    """Candidates that the limit held back are candidates of both continuations."""
    limited, out = str(tmp_path / "run"), tmp_path / "replay"
    flags = as_flags("config=defaults", *OVERRIDES, *LINEAGE, "population.max_gaussians=420")
    assert main(["train", "--data", str(lineage_run / "capture"), "--out", limited, *flags]) == 0
    # At a rate of 0, an oracle vetoes nothing.
    arguments = ["gate", "replay", "default", limited, "--out", str(out), "--rate", "0"]
    with pytest.warns(UserWarning, match="the limit of the population held back 75% of the reference's"):
        assert main(arguments) == 0
    arms = {row["arm"]: row for row in json.loads((out / "replay.json").read_text())}
    for name in ("psnr", "final"):
        assert arms["oracle_rate"][name] == arms["reference"][name]
    assert arms["oracle_rate"]["matched"] == 1.0
    events = events_of(out / "reference", "densify")
    held = sum(event["held_back"] for event in events)
    born = sum(event["cloned"] + event["split"] for event in events)
    assert arms["reference"]["held_back"] == pytest.approx(held / (born + held)) and born > 0


def test_a_replay_begins_again_if_it_has_trained_no_arm(lineage_run, tmp_path, monkeypatch):
    """Files that the replay did not write stay, and the arms are those of a replay without interruption."""
    out, calls = tmp_path / "replay", []
    arguments = ["gate", "replay", "default", str(lineage_run / "run"), "--out", str(out)]

    def fails(_):
        raise RuntimeError("no memory")

    at_step(monkeypatch, 70, fails)
    for _ in range(2):
        refused(RuntimeError, "no memory", main, arguments)
        calls.append(sorted(path.name for path in (out / "reference").iterdir()))
    assert calls[0] == calls[1]
    monkeypatch.undo()
    notes = [out / "notes.txt", out / "reference" / "notes.txt"]
    for path in notes:
        path.write_text("mine")
    assert main(arguments) == 0
    assert [path.read_text() for path in notes] == ["mine", "mine"]
    arms = {row["arm"]: row for row in json.loads((out / "replay.json").read_text())}
    summary = json.loads((lineage_run / "run" / "summary.json").read_text())
    assert arms["reference"]["psnr"] == summary["psnr"] and len(arms) == 6
    assert [r["t"] for r in events_of(out / "reference", "densify")] == [60, 80]
    assert main(arguments) == 1


def _replay(ranks, run, capture, out, fails):
    """The first arms of a replay: the names of those that were trained, and their Gaussians."""
    config = load_config(run / "config.yaml")
    opened = open_capture(replace(config, data=replace(config.data, path=str(capture))), ranks)
    with pytest.MonkeyPatch.context() as patch:
        if fails:
            patch.setattr(Trainer, "train", lambda self: None)  # as if stopped by a signal
        arms = replay(config, *opened, run, out, SpawnGate(gate_file("default")), 0.5, ranks)
        try:
            return [(arm["arm"], arm["final"]) for arm in islice(arms, 2)]
        except InterruptedError as error:
            return str(error)


def test_two_ranks_replay_a_run_of_one_and_begin_again_together(lineage_run, tmp_path):
    arguments = lineage_run / "run", lineage_run / "capture", tmp_path / "out"
    assert run_ranks(_replay, 2, *arguments, True) == ["arm reference was stopped by a signal"] * 2
    first, second = run_ranks(_replay, 2, *arguments, False)
    assert first == second and [name for name, _ in first] == ["reference", "oracle"]
    assert first[1][1] < first[0][1]


def test_a_replay_does_not_begin_where_another_one_is_training(lineage_run, tmp_path, monkeypatch, failure):
    monkeypatch.setattr(folder_checks, "LOCK_SECONDS", 0.1)
    out = tmp_path / "replay"
    with folder_checks.locked(out / "reference", Ranks()):
        (out / "reference" / "replay_begun").touch()
        error = failure("gate", "replay", "default", lineage_run / "run", "--out", out)
    assert "is in use by another run" in error
    assert not (out / "reference" / "checkpoints").exists()


@pytest.mark.parametrize("name", ["reference", "oracle", "gate", "random"])
def test_a_replay_leaves_runs_with_the_names_of_its_arms_alone(lineage_run, tmp_path, failure, name):
    """For example `gate`: the folder of a training with a gate, beside the run that is replayed."""
    run = shutil.copytree(lineage_run / "run", tmp_path / name)
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    error = failure("gate", "replay", "default", lineage_run / "run", "--out", tmp_path)
    assert "choose another --out" in error
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_damaged_checkpoint_is_named(lineage_run, tmp_path):
    run = shutil.copytree(lineage_run / "run", tmp_path / "run")
    manifest = next((run / "checkpoints").glob("*/manifest.json"))
    manifest.write_text("{}")
    refused(ValueError, f"{manifest} is damaged", branch_point, run, tiny_config(*LINEAGE))


def test_a_run_without_a_view_to_measure_is_not_replayed(lineage_run, tmp_path, failure):
    capture, run = shutil.copytree(lineage_run / "capture", tmp_path / "capture"), lineage_run / "run"
    write_image(capture / "masks" / "00.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    error = failure("gate", "replay", "default", run, "--data", capture, "--out", tmp_path / "out")
    assert "its arms could not be compared, because the views" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("resident_gb", [0.0, 0.5])
def test_the_ranks_of_a_replay_can_send_tables_that_are_on_the_host(tmp_path, monkeypatch, resident_gb):
    run, asked = tmp_path / "run", {}

    def joined(*_, **options):
        asked.update(options)
        raise ValueError("joined")

    run.mkdir()
    save_config(tiny_config(f"memory.resident_gb={resident_gb}"), run / "config.yaml")
    monkeypatch.setattr(Ranks, "from_environment", joined)
    assert main(["gate", "replay", "default", str(run), "--out", str(tmp_path / "out")]) == 1
    assert asked["tables_on_host"] == (resident_gb > 0)


def test_a_run_that_ends_before_the_gate_is_not_replayed(tmp_path):
    config = tiny_config("schedule.gate_from=1000000")
    with pytest.raises(ValueError, match=r"ends before the gate's onset \(schedule.gate_from 1000000, "):
        branch_point(tmp_path, config)


def test_a_run_without_candidates_for_the_gate_is_not_replayed(lineage_run, tmp_path):
    """Its arms would all be the same run."""
    config = tiny_config(*LINEAGE, "schedule.gate_from=81")
    with pytest.raises(ValueError, match=r"has no density event from .*gate_from 81, the last event 80\)"):
        branch_point(lineage_run / "run", config)
    capture, config = str(lineage_run / "capture"), tiny_config(*LINEAGE, "population.strategy=relocation")
    opened = open_capture(replace(config, data=replace(config.data, path=capture)), Ranks())
    with pytest.raises(ValueError, match="run was trained with population.strategy=relocation, which has no"):
        next(replay(config, *opened, lineage_run / "run", tmp_path / "out", Mock(), 0.5, Ranks()))
    assert not (tmp_path / "out").exists()


def test_events_are_labelled_by_their_children(lineage_run):
    known, dead = label_events(lineage_run / "run" / "lineage")
    own = read_spawns(lineage_run / "run" / "lineage")
    lives = {}
    for parent, row, survived in zip(own.parents, own.features, own.survived, strict=True):
        lives.setdefault((parent, row[6], row[7]), []).append(survived)
    assert len(known) == len(lives)
    assert len(dead) == sum(not any(children) for children in lives.values())
    parent, time, split = next(key for key, children in lives.items() if not any(children))
    key = event_keys(torch.tensor([parent]), int(time), torch.tensor([bool(split)]))
    assert torch.isin(key, dead).all()


def test_an_oracle_vetoes_candidates_that_are_known_to_die():
    some = candidates(200)
    keys = event_keys(some.parents, some.time, some.is_split)
    known, dead = keys[:150], keys[:120]
    oracle = OracleVeto(known, dead, None, 0)
    assert torch.equal(oracle(some, Ranks()), torch.arange(200) < 120)
    assert (oracle.seen, oracle.matched) == (200, 150)
    capped = OracleVeto(known, dead, 0.3, 0)(some, Ranks())
    assert not capped[120:].any()
    for group in (some.is_split, ~some.is_split):
        assert capped[group].sum() == -int(-0.3 * int(group.sum()) // 1)
    later = Candidates(some.parents, some.is_split, some.features, some.time + 100)
    assert not OracleVeto(known, dead, None, 0)(later, Ranks()).any()
