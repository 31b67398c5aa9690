# SPDX-License-Identifier: Apache-2.0
"""`blitzgs gate`: from the lineage of runs to a gate and its figures."""

import io
import json
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest

from blitzgs.capture.colmap import read_model, write_model
from blitzgs.cli import main
from blitzgs.spawn.fit import correlation, read_spawns, region_rates, survival_by_cohort
from blitzgs.spawn.samples import read_sample
from tests.conftest import LINEAGE
from tests.spawn.test_spawn_gate import spawns
from tests.training.tiny import OVERRIDES, as_flags, events_of

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("xgboost")


def test_a_run_that_is_not_finished_is_no_example(lineage_run, tmp_path, failure):
    folder = shutil.copytree(lineage_run / "run", tmp_path / "run")
    (folder / "summary.json").unlink()
    for arguments in (["fit", folder], ["evaluate", "default", folder]):
        error = failure("gate", *arguments, "--out", tmp_path / "out.json")
        assert "is not finished (it has no summary.json)" in error.replace("\n", " ")


def test_fit_evaluate_and_replay(lineage_run, tmp_path, capsys, failure):
    folder, run = lineage_run, str(lineage_run / "run")
    gate = str(tmp_path / "gates" / "tiny.json")
    assert main(["gate", "fit", run, "--out", gate]) == 0
    assert "a quarter of the parents held out:\n  capture: AUC 0." in capsys.readouterr().out
    assert main(["gate", "evaluate", gate, run, "--out", str(tmp_path / "judged")]) == 0
    assert "the gate was fitted on this scene" in capsys.readouterr().out
    (entry,) = json.loads((tmp_path / "judged" / "evaluation.json").read_text())
    own = read_spawns(folder / "run" / "lineage")
    assert entry["spawns"] == len(own.survived) and entry["seen"]
    late = own.only(own.times >= 60)
    assert entry["judged"]["spawns"] == len(late.survived) < entry["spawns"]
    assert entry["judged"]["survived"] == late.survived.mean() and entry["judged"]["auc"] > 0.5
    assert sum(cohort["born"] for cohort in entry["cohorts"]) == entry["spawns"]
    for name in ("survival.svg", "regions_capture.svg"):
        ElementTree.parse(tmp_path / "judged" / name)

    assert main(["gate", "replay", gate, run, "--out", str(tmp_path / "replay"), "--rate", "0.5"]) == 0
    arms = {row["arm"]: row for row in json.loads((tmp_path / "replay" / "replay.json").read_text())}
    assert list(arms) == ["reference", "oracle", "oracle_rate", "gate", "gate_sampled", "random"]
    # Training repeats bit for bit, so the reference is the run itself.
    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert arms["reference"]["psnr"] == summary["psnr"]
    assert arms["reference"]["final"] == summary["gaussians"]
    assert 0 < arms["reference"]["dead"] < 1
    assert arms["oracle"]["matched"] > 0.5 and arms["reference"]["held_back"] == 0
    for name in list(arms)[1:]:
        assert arms[name]["peak"] < arms["reference"]["peak"]
    table = (tmp_path / "replay" / "replay.md").read_text()
    printed = capsys.readouterr().out
    assert table.count("\n") == 8 and table in printed
    assert all(f"arm {name}:\n" in printed for name in arms)
    # The first gated event is the same as in the reference, so the oracle knows each of its candidates.
    assert [r["t"] for r in events_of(tmp_path / "replay" / "oracle", "densify")] == [60, 80]
    error = failure("gate", "replay", gate, run, "--out", tmp_path / "replay")
    assert "already holds a replay: choose another --out" in error.replace("\n", " ")


def test_a_gate_can_be_fitted_on_samples(lineage_run, tmp_path, capsys, failure):
    run = read_spawns(lineage_run / "run" / "lineage")
    sample, part = tmp_path / "all.parquet", tmp_path / "part.parquet"
    flags = ["gate", "sample", str(lineage_run / "run"), "--out"]
    assert main([*flags, str(sample)]) == 0
    assert f"100.00% of {len(run.survived):,} spawns of capture" in capsys.readouterr().out
    read = read_sample(sample)
    for name in ("features", "survived", "parents", "positions"):
        np.testing.assert_array_equal(getattr(read, name), getattr(run, name))
    assert (read.name, read.scene, read.schedule) == (run.name, run.scene, run.schedule)
    assert read.initial_survival == run.initial_survival
    assert main([*flags, str(part), "--rows", str(len(run.survived) // 2)]) == 0
    drawn = set(read_sample(part).parents.tolist())
    # The sample has whole families, about as many as requested.
    assert len(read_sample(part).parents) == np.isin(run.parents, list(drawn)).sum()
    assert 0.35 < len(read_sample(part).parents) / len(run.parents) < 0.65
    # A feature that the log does not have is unknown.
    old = parquet.read_table(sample).drop_columns(["parent_flatness"])
    parquet.write_table(old, tmp_path / "old.parquet")
    features = read_sample(tmp_path / "old.parquet").features
    assert np.isnan(features[:, -1]).all()
    np.testing.assert_array_equal(features[:, :-1], run.features[:, :-1])
    gates = [tmp_path / name for name in ("run.json", "sample.json")]
    for source, gate in zip((lineage_run / "run", sample), gates, strict=True):
        assert main(["gate", "fit", str(source), "--out", str(gate)]) == 0
    assert gates[0].read_bytes() == gates[1].read_bytes()
    none = tmp_path / "none.parquet"
    assert "there is no such sample of spawns" in failure("gate", "fit", none, "--out", gates[0])
    (tmp_path / "text.parquet").write_text("text")
    assert "is not a Parquet file" in failure("gate", "fit", tmp_path / "text.parquet", "--out", gates[0])
    births = str(next((lineage_run / "run" / "lineage").glob("births*.parquet")))
    assert "is not a sample of spawns" in failure("gate", "fit", births, "--out", gates[0]).replace("\n", " ")


def test_no_other_file_is_replaced(lineage_run, tmp_path, failure):
    run, gate = shutil.copytree(lineage_run / "run", tmp_path / "run"), tmp_path / "gate.json"
    assert main(["gate", "fit", str(run), "--out", str(gate)]) == 0
    births = next((run / "lineage").glob("births*.parquet"))
    before = births.read_bytes()
    error = failure("gate", "sample", run, "--out", births)
    assert "is not a sample of spawns: choose another --out" in error
    assert births.read_bytes() == before
    sample = str(tmp_path / "sample.parquet")
    for _ in range(2):
        assert main(["gate", "sample", str(run), "--out", sample]) == 0
    mine = tmp_path / "mine"
    mine.mkdir()
    for name in ("evaluation.json", "survival.svg", "regions_capture.svg"):
        (mine / name).write_text("mine")
        error = f"{mine / name} exists, and no earlier call of blitzgs wrote to {mine}: choose another --out"
        assert error in failure("gate", "evaluate", gate, run, "--out", mine)
        assert [path.read_text() for path in mine.iterdir()] == ["mine"]
        (mine / name).unlink()
    (mine / "replay.json").write_text("mine")
    error = failure("gate", "replay", gate, run, "--out", mine)
    assert "already holds a replay: choose another --out" in error
    assert (mine / "replay.json").read_text() == "mine"


def test_names_need_not_be_utf_8(lineage_run, tmp_path):
    root = tmp_path / "bytes \udcff"
    shutil.copytree(lineage_run / "capture", root / "\udcff")
    sparse = root / "\udcff" / "sparse" / "0"
    model = read_model(sparse)
    model.images.names[0] = "\udcfe.png"
    write_model(sparse, model)
    (root / "\udcff" / "images" / "00.png").rename(root / "\udcff" / "images" / "\udcfe.png")
    flags = as_flags("config=defaults", *OVERRIDES, *LINEAGE)
    run, gate, sample = str(root / "run"), str(root / "gate.json"), str(root / "sample.parquet")
    assert main(["train", "--data", str(root / "\udcff"), "--out", run, *flags]) == 0
    assert main(["gate", "sample", run, "--out", sample]) == 0
    assert main(["gate", "fit", sample, "--out", gate]) == 0
    assert main(["gate", "evaluate", gate, run, "--out", str(root / "judged")]) == 0
    ElementTree.parse(root / "judged" / "survival.svg")


def test_each_run_is_judged_from_its_own_onset_of_the_gate(lineage_run, tmp_path):
    first, later = lineage_run / "run", tmp_path / "later"
    shutil.copytree(first, later)
    config = (later / "config.yaml").read_text()
    (later / "config.yaml").write_text(config.replace("gate_from: 60", "gate_from: 80"))
    out = tmp_path / "judged"
    assert main(["gate", "evaluate", "default", str(first), str(later), "--out", str(out)]) == 0
    times = read_spawns(first / "lineage").times
    entries = json.loads((out / "evaluation.json").read_text())
    assert [entry["judged"]["spawns"] for entry in entries] == [(times >= 60).sum(), (times >= 80).sum()]


def test_runs_of_the_same_name_have_pictures_of_their_own(lineage_run, tmp_path):
    run, out = str(lineage_run / "run"), tmp_path / "judged"
    for _ in range(2):  # what an earlier call wrote is replaced
        assert main(["gate", "evaluate", "default", run, run, "--out", str(out)]) == 0
    entries = json.loads((out / "evaluation.json").read_text())
    assert [entry["run"] for entry in entries] == ["capture", "capture_2"]
    assert {path.name for path in out.glob("*.svg")} == {
        "survival.svg",
        "regions_capture.svg",
        "regions_capture_2.svg",
    }


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("births", lambda data: data[:2000], "is not a Parquet file, or is damaged"),
        ("births", lambda data: without(data, "parent"), "is damaged: it has no column parent"),
        ("births", lambda data: with_text(data, "id"), "the column id has values that are not numbers"),
        ("deaths", lambda data: without(data, "id"), "is damaged: it has no column id"),
        ("about", lambda data: b"", "the description of the run is damaged"),
        ("about", lambda data: b"[" * 100_000, "the description of the run is damaged"),
        ("about", lambda data: b"{}", "the description of the run is damaged: it has no name, scene"),
    ],
)
def test_a_damaged_lineage_is_named(lineage_run, tmp_path, failure, name, damage, message):
    run = shutil.copytree(lineage_run / "run", tmp_path / "run")
    file = next((run / "lineage").glob(f"{name}*"))
    file.write_bytes(damage(file.read_bytes()))
    error = failure("gate", "fit", run, "--out", tmp_path / "gate.json")
    assert str(file) in error and message in error


@pytest.mark.parametrize("table", ["births", "deaths"])
@pytest.mark.parametrize("which", [0, -1])
def test_a_lost_file_of_the_lineage_is_noticed(lineage_run, tmp_path, failure, table, which):
    run = shutil.copytree(lineage_run / "run", tmp_path / "run")
    sorted((run / "lineage").glob(f"{table}*"))[which].unlink()
    error = failure("gate", "fit", run, "--out", tmp_path / "gate.json").replace("\n", " ")
    assert "lineage is not complete: a file of its births or deaths is lost" in error


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: without(data, "survived"), "is damaged: it has no column survived"),
        (lambda data: only_survivors(data), "spawns survived; a gate needs a finished run"),
        (lambda data: with_about(data, b"{}"), "the description of the run is damaged"),
    ],
)
def test_a_damaged_sample_is_named(lineage_run, tmp_path, failure, damage, message):
    sample = tmp_path / "sample.parquet"
    assert main(["gate", "sample", str(lineage_run / "run"), "--out", str(sample)]) == 0
    sample.write_bytes(damage(sample.read_bytes()))
    error = failure("gate", "fit", sample, "--out", tmp_path / "gate.json")
    assert str(sample) in error and message in error


def changed(data, change):
    target = io.BytesIO()
    parquet.write_table(change(parquet.read_table(io.BytesIO(data))), target)
    return target.getvalue()


def without(data, name):
    return changed(data, lambda table: table.drop_columns([name]))


def with_text(data, name):
    return changed(
        data,
        lambda table: table.set_column(
            table.column_names.index(name), name, table[name].cast(pyarrow.string())
        ),
    )


def only_survivors(data):
    return changed(data, lambda table: table.filter(table["survived"]))


def with_about(data, text):
    return changed(data, lambda table: table.replace_schema_metadata({b"blitzgs.spawns": text}))


def test_what_is_missing_is_named(tmp_path, failure):
    gate = tmp_path / "g.json"
    fit, evaluate = ["gate", "fit", "--out", gate], ["gate", "evaluate", gate, "x", "--out", tmp_path]
    assert "holds no lineage: train with --population.lineage=true" in failure(*fit, tmp_path)
    assert "no is not the folder of a run" in failure(*fit, tmp_path / "no")
    assert "a gate's file ends in .json" in failure("gate", "fit", tmp_path, "--out", tmp_path / "g.txt")
    assert "g.json: no such gate; `blitzgs gate fit` makes one" in failure(*evaluate)
    gate.write_text("{}")
    assert "g.meta.json is missing: a gate is a model and its metadata" in failure(*evaluate)


def test_regions_and_cohorts_of_a_known_picture():
    run = spawns("a", 60_000)
    run.positions[:, 2] *= 0.01  # seen from above
    run.survived[:] = run.positions[:, 0] > 0.5
    where, actual, predicted = region_rates(run, run.positions[:, 0].astype(float))
    assert where.all() and 30 <= actual.shape[1] <= 32
    assert (actual[:, :10] == 0).all() and (actual[:, -10:] == 1).all()
    assert correlation(actual[where], predicted[where]) > 0.99
    assert correlation(np.ones(3), np.arange(3.0)) is None
    assert sum(c["born"] for c in survival_by_cohort(run)) == 60_000
