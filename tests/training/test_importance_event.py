# SPDX-License-Identifier: Apache-2.0
"""The importance passes in a training: the Gaussians that they keep, their log, and their ablations."""

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from blitzgs.capture.images import PhotographError
from blitzgs.config.files import ConfigError
from blitzgs.distributed.group import Ranks
from blitzgs.population.importance import PHI
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.guard import ModelLostError
from blitzgs.spawn.candidates import FEATURES
from blitzgs.spawn.fit import fit, read_spawns
from blitzgs.spawn.gate import (
    GateError,
    GateInfo,
    info_path,
    life_fields,
    random_veto,
    reasons_against,
    sampled_veto,
)
from blitzgs.spawn.lineage import ABOUT, Cause, read_lineage
from blitzgs.table.table import CULL
from blitzgs.training.events import importance
from blitzgs.util import progress
from tests.distributed.rank_harness import on_each_device, run_ranks
from tests.helpers import refused
from tests.training import tiny
from tests.training.tiny import (
    Images,
    assert_same_table,
    events_of,
    make_trainer,
    read_log,
    stop_at,
    tiny_config,
    tiny_scene,
)

# Density events at 20, 40, 60 and 80; the passes after those at 40 and 80.
PASSES = ("population.importance=true", "schedule.t1=40", "schedule.t2=80")


def train(folder, *overrides, **how):
    return tiny.train(folder, *PASSES, *overrides, **how)


def pass_events(folder):
    return {r["event"]: r for r in read_log(folder) if str(r.get("event")).startswith("pass")}


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, *train(folder)


def test_how_many_gaussians_the_importance_passes_keep(whole_run):
    folder, trainer, summary = whole_run
    events = pass_events(folder)
    first, second = events["pass_1"], events["pass_2"]
    assert first["t"] == 40 and second["t"] == 80 and first["views"] == 7
    assert first["gaussians"] == int(0.7 * first["before"])
    assert second["gaussians"] < second["before"]
    table = trainer.state.table
    assert summary["gaussians"] == len(table) == second["gaussians"]
    assert table[PHI].shape == (len(table),)
    assert CULL not in table  # no view uses the mask, which has a bit for each Gaussian and view
    assert ((table[PHI] >= 0) & (table[PHI] < 1)).all()
    assert trainer.state.progress.milestones == {
        "initial": 400, "before_pass_1": first["before"], "after_pass_1": first["gaussians"],
        "before_pass_2": second["before"], "after_pass_2": second["gaussians"],
    }  # fmt: skip


def test_the_population_is_reported(whole_run):
    folder, trainer, summary = whole_run
    report, milestones = summary["population"], trainer.state.progress.milestones
    assert list(report)[:7] == [
        "initial", "before_pass_1", "after_pass_1", "peak", "before_pass_2", "after_pass_2", "final",
    ]  # fmt: skip
    assert {name: report[name] for name in milestones if name != "found"} == {
        name: count for name, count in milestones.items() if name != "found"
    }
    assert report["final"] == summary["gaussians"] and report["peak"] == summary["peak_gaussians"]
    assert len(report["peak_memory_bytes"]) == 1 and report["peak_memory_bytes"][0] > 0
    picture = ElementTree.parse(folder / "trajectory.svg").getroot()
    (line,) = picture.iter("{http://www.w3.org/2000/svg}polyline")
    points = [tuple(map(float, p.split(","))) for p in line.get("points").split()]
    # The start, density events at 20, 40, 60 and 80, before and after each pass, and the end.
    assert len(points) == 1 + 4 + 4 + 1
    assert points == sorted(points, key=lambda point: point[0])
    # Smaller y is higher in the chart. The first pass makes the population fall at one time, from 40's peak.
    (x1, top), (x2, low) = points[3:5]
    assert x1 == x2 and low > top


RELOCATION = ("population.strategy=relocation", "population.pass1_keep=1")


@pytest.mark.parametrize(
    ("flags", "views"),
    [
        (("population.pass2_views=8",), (0, 0)),
        (("population.pass2_mass=1",), (0, 0)),
        (("population.pass2_views=8", "view.cull=true"), (7, 7)),
        (("population.pass2_views=7", "population.pass2_mass=1", "population.pass2_keep=0.5"), (0, 7)),
    ],
)
def test_views_are_surveyed_only_for_what_is_used(tmp_path, flags, views):
    trainer, _ = train(tmp_path, *RELOCATION, *flags)
    events = [pass_events(tmp_path)[name] for name in ("pass_1", "pass_2")]
    assert tuple(event["views"] for event in events) == views
    assert (PHI in trainer.state.table) == any(views)
    kept = [event["gaussians"] == event["before"] > 0 for event in events]
    assert kept == [True, "population.pass2_keep=0.5" not in flags]
    assert trainer.state.progress.milestones["after_pass_2"] == events[1]["gaussians"]


def test_a_pass_says_what_it_keeps_and_how_many_views_are_done(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    flags = ("population.pass1_keep=1", "population.pass2_mass=1", "population.pass2_keep=0.5")
    train(tmp_path / "half", *flags, "population.min_opacity=1e-6")
    second = pass_events(tmp_path / "half")["pass_2"]
    assert second["gaussians"] == second["before"] // 2
    kept = f"the importance pass keeps {second['gaussians']:,} of {second['before']:,} Gaussians"
    out = capsys.readouterr().out
    assert kept in out and out.count("the importance pass") == 1
    assert out.count("7 of 7 views surveyed") == 2
    train(tmp_path / "few", *flags, "population.pass2_views=8")
    few = "keeps all Gaussians: 7 training views are fewer than population.pass2_views (8)"
    assert few in capsys.readouterr().out


def test_phi_weighs_the_gradients_from_the_first_pass_on(tmp_path):
    sums = {}
    for phi in ("true", "false"):
        flags = [f"population.phi={phi}", "schedule.iterations=55", "population.pass1_keep=1"]
        trainer, _ = train(tmp_path / phi, *flags)
        sums[phi] = trainer.state.table
    weighed, plain = sums["true"], sums["false"]
    assert torch.equal(weighed["id"], plain["id"])  # the density event at 40 came before the pass
    assert torch.allclose(weighed["grad_sum"], plain["grad_sum"] * plain[PHI], rtol=1e-5)
    assert torch.equal(weighed["means"], plain["means"]) and torch.equal(weighed[PHI], plain[PHI])
    assert plain["grad_sum"].max() > 0 and plain[PHI].std() > 0.01


# There are checkpoints before the first pass, too.
EARLY = ("schedule.checkpoint_every=30", "log.keep_checkpoints=9")


def _passes_from(ranks, folder):
    """Make both passes on a model that is divided among the ranks; return ids and their columns."""
    trainer = make_trainer(folder, *PASSES, *EARLY, "view.cull=true", ranks=ranks, resume=True)
    state, out = trainer.state, []
    for event in state.schedule.events(0, 100):
        if event.kind.startswith("pass"):
            importance.run_importance_pass(state, event)
            table = state.table
            out.append([table[name].cpu() for name in ("id", PHI, CULL, "means")])
            sizes = [int(n) for n in ranks.all_gather(torch.tensor([len(table)], device=ranks.device))]
            assert max(sizes) - min(sizes) <= 1  # redistributed
    trainer.close()
    return out, state.progress.milestones


@pytest.mark.parametrize(("world_size", "device"), on_each_device(2, 4))
def test_passes_are_the_same_at_every_world_size(tmp_path, world_size, device):
    train(tmp_path, *EARLY, "view.cull=true")
    for later in sorted((tmp_path / "checkpoints").glob("checkpoint_*"))[1:]:
        shutil.rmtree(later)
    expected, milestones = _passes_from(Ranks(device=torch.device(device)), tmp_path)
    answers = run_ranks(_passes_from, world_size, tmp_path, device=device)
    assert all(found == milestones for _, found in answers)
    for k, want in enumerate(expected):
        got = [torch.cat([out[k][c] for out, _ in answers]) for c in range(4)]
        order, reference = got[0].argsort(), want[0].argsort()
        for a, b in zip(got, want, strict=True):
            assert torch.equal(a[order], b[reference])


def lineage_of_the_resumed(folder):
    """Resume a run, check that its births less its deaths are its final model, and return both."""
    trainer, _ = train(folder, "population.lineage=true", resume=True)
    tables = read_lineage(folder / run_files.LINEAGE)
    births, deaths = tables["births"]["id"], tables["deaths"]["id"]
    assert sorted(set(births) - set(deaths)) == sorted(trainer.state.table["id"].tolist())
    ledger = trainer.state.progress.ledger
    assert ledger["births"] == len(births) and ledger["deaths"] == len(deaths)
    return tables


def test_lineage_of_a_run_that_was_stopped_adds_up(tmp_path, monkeypatch):
    """Every Gaussian of the final model was born and did not die; each death has its mechanism."""
    pytest.importorskip("pyarrow")
    stop_at(monkeypatch, 50)
    train(tmp_path, "population.lineage=true")
    monkeypatch.undo()
    tables = lineage_of_the_resumed(tmp_path)
    causes = dict(zip(*np.unique(tables["deaths"]["cause"], return_counts=True), strict=True))
    events = pass_events(tmp_path)
    assert causes[Cause.PASS_1] == events["pass_1"]["before"] - events["pass_1"]["gaussians"]
    late = causes.get(Cause.PASS_2, 0) + causes.get(Cause.LATE_OPACITY, 0)
    assert late == events["pass_2"]["before"] - events["pass_2"]["gaussians"]
    assert causes[Cause.SPLIT] + causes.get(Cause.OPACITY, 0) > 0


def test_lineage_of_a_run_that_was_saved_before_its_first_step_adds_up(tmp_path, monkeypatch):
    """The first Gaussians were logged before a photograph could not be read, and stay logged."""
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(Images, "get", lambda self, index, factor=1: Path("/photos/00.png").read_bytes())
    refused(PhotographError, "put the photograph back", train, tmp_path, "population.lineage=true")
    monkeypatch.undo()
    lineage_of_the_resumed(tmp_path)


def require_vetoes_from_60(folder):
    """Check that the density events from image 60 on, and only these, vetoed half of their candidates."""
    events = {r["t"]: r for r in events_of(folder, "densify")}
    assert events[20]["vetoed"] == events[40]["vetoed"] == 0
    for t in (60, 80):
        grown = events[t]["cloned"] + events[t]["split"]
        assert grown > 10 and grown <= events[t]["vetoed"] <= grown + 2
    return events


def test_a_gate_withholds_candidates_from_its_onset_on(tmp_path):
    """A gate that is fitted on the lineage of one run is used in another run, which prints both warnings."""
    pytest.importorskip("pyarrow")
    pytest.importorskip("xgboost")
    train(tmp_path / "lineage", "population.lineage=true", "population.grad_threshold=1e-4")
    run_of = read_spawns(tmp_path / "lineage" / run_files.LINEAGE)
    assert run_of.features.shape[1] == len(FEATURES) and run_of.times.max() == 80
    path = tmp_path / "gate.json"
    figures = fit([run_of], path)
    assert figures["protocol"] == "a quarter of the parents held out"
    flags = [f"population.gate={path}", "schedule.gate_from=60", "population.gate_rate=0.5"]
    with pytest.warns(UserWarning) as warned:
        gated, _ = train(tmp_path / "gated", *flags)
    texts = [str(w.message) for w in warned if "spawn gate" in str(w.message)]
    assert any("fitted on this very capture" in text for text in texts)
    assert any("population.grad_threshold (0.0001, here 0.002)" in text for text in texts)
    events = require_vetoes_from_60(tmp_path / "gated")
    assert events[60]["held_back"] == events[80]["held_back"] == 0
    # The other rule withholds as many candidates, and other ones.
    with pytest.warns(UserWarning, match="spawn gate"):
        sampled, _ = train(tmp_path / "sampled", *flags, "population.gate_rule=sample")
    assert sampled.state.veto.func is sampled_veto
    others = require_vetoes_from_60(tmp_path / "sampled")
    assert others[60]["vetoed"] == events[60]["vetoed"] and others[60]["split"] == events[60]["split"]
    assert not torch.equal(sampled.state.table["id"].sort().values, gated.state.table["id"].sort().values)
    # The gate decides the result, so a run continues only with the gate's files that it began with.
    for file in (path, info_path(path)):
        content = file.read_text()
        file.write_text(content + " ")
        with pytest.raises(GateError, match=r"gate.meta.json beside it has changed .* put the files"):
            train(tmp_path / "gated", *flags, resume=True)
        file.write_text(content)
    assert train(tmp_path / "gated", *flags, resume=True)[1] is not None


@pytest.mark.parametrize("rule", ["rank", "sample"])
def test_a_run_that_is_stopped_between_gated_events_resumes_exactly(tmp_path, monkeypatch, rule):
    """The rule and the draws of the gate are those of the run; with another rule it is not resumed."""
    flags = ["population.gate=default", f"population.gate_rule={rule}", "schedule.gate_from=40"]
    other = [flags[0], f"population.gate_rule={'rank' if rule == 'sample' else 'sample'}", flags[2]]
    with pytest.warns(UserWarning, match="spawn gate"):
        whole, _ = train(tmp_path / "whole", *flags)
        stop_at(monkeypatch, 65)
        assert train(tmp_path / "cut", *flags)[1] is None
        monkeypatch.undo()
        with pytest.raises(ConfigError, match="population.gate_rule: the checkpoint was trained with"):
            train(tmp_path / "cut", *other, resume=True)
        resumed, _ = train(tmp_path / "cut", *flags, resume=True)
    assert [event["vetoed"] > 0 for event in events_of(tmp_path / "cut", "densify")] == [False] + [True] * 3
    assert_same_table(resumed.state.table, whole.state.table)


def test_a_random_veto_takes_the_place_of_a_gate(tmp_path):
    """It withholds as many candidates as a gate, and the same ones in a repeated run."""
    flags = ["population.gate=random", "schedule.gate_from=60", "population.gate_rate=0.5"]
    ids = []
    for name in ("first", "again"):
        trainer, _ = train(tmp_path / name, *flags)
        assert trainer.state.veto.func is random_veto
        require_vetoes_from_60(tmp_path / name)
        ids.append(trainer.state.table["id"].sort().values)
    assert torch.equal(*ids)
    assert train(tmp_path / "first", *flags, resume=True)[1] is not None


def test_a_schedule_that_a_gate_was_not_fitted_for_is_named():
    """The fields of all sections that decide how long Gaussians live, and values that only a run knows."""
    capture, _ = tiny_scene()

    def gate_of(fitted):
        return SimpleNamespace(info=GateInfo(FEATURES, fitted, {}))

    here = tiny_config()
    assert reasons_against(gate_of(life_fields(here)), here, capture) == []
    for change in ("optimiser.opacity=0.01", "loss.scale=1", "view.lod=true", "schedule.scale=0.5"):
        name, _, value = change.partition("=")
        (text,) = reasons_against(gate_of(life_fields(tiny_config(change))), here, capture)
        assert f"{name} ({value}" in text.lower() and "here" in text
    # A field that is newer than the gate has its default, because it had no effect when the gate was fitted.
    older = {name: value for name, value in life_fields(here).items() if name != "optimiser.position_noise"}
    assert reasons_against(gate_of(older), here, capture) == []
    (text,) = reasons_against(gate_of(older), tiny_config("optimiser.position_noise=5"), capture)
    assert "optimiser.position_noise (0.0, here 5.0)" in text
    (text,) = reasons_against(gate_of(life_fields(here)), tiny_config("schedule.minutes=3"), capture)
    assert "with schedule.minutes the run finds its pace while it trains" in text


def test_lineage_says_at_what_pace_its_run_went(tmp_path):
    """`schedule.minutes` changes the pace during the run, and survival depends on the pace."""
    pytest.importorskip("pyarrow")
    trainer, _ = train(tmp_path, "population.lineage=true", "schedule.minutes=0.02")
    pace = [[image, factor] for image, factor in trainer.state.config.schedule.pace]
    assert pace
    about = json.loads((tmp_path / run_files.LINEAGE / ABOUT).read_text())
    assert about["schedule"]["schedule.pace"] == pace


def _train_with_lineage(ranks, folder):
    trainer, summary = train(folder, "population.lineage=true", "schedule.batch_size=2", ranks=ranks)
    progress = trainer.state.progress
    return trainer.state.table["id"].cpu(), progress.ledger, progress.milestones, summary["population"]


@pytest.mark.parametrize(("world_size", "device"), on_each_device(2))
def test_importance_passes_on_two_ranks_keep_the_lineage_consistent(tmp_path, world_size, device):
    pytest.importorskip("pyarrow")
    answers = run_ranks(_train_with_lineage, world_size, tmp_path, device=device)
    _, ledger, milestones, population = answers[0]
    assert answers[1][1:3] == (ledger, milestones)
    assert milestones["after_pass_1"] == int(0.7 * milestones["before_pass_1"])
    assert len(population["peak_memory_bytes"]) == 2
    ids = torch.cat([answer[0] for answer in answers])
    tables = read_lineage(tmp_path / run_files.LINEAGE)
    births, deaths = tables["births"]["id"], tables["deaths"]["id"]
    assert sorted(set(births) - set(deaths)) == sorted(ids.tolist())
    assert (ledger["births"], ledger["deaths"]) == (len(births), len(deaths))
    assert population["final"] == len(ids)


def stop_in_the_sweep_of(monkeypatch, time):
    """Have the process asked to stop while the pass at `time` surveys its second batch of views."""
    batches = importance.view_batches

    def interrupted(state):
        for number, batch in enumerate(batches(state)):
            if number == 1 and state.images_seen == time + 1:  # the end of its step
                os.kill(os.getpid(), signal.SIGTERM)
            yield batch

    monkeypatch.setattr(importance, "view_batches", interrupted)
    monkeypatch.setattr(importance, "LEAST_VIEWS", 2)


@pytest.mark.parametrize("time, left", [(40, ["pass_1"]), (80, ["pass_2", "checkpoint"])])
def test_a_pass_that_a_signal_cuts_short_happens_after_the_resume(tmp_path, monkeypatch, time, left):
    """The pass does not delay the stop, and the resumed run has the bits of the uninterrupted one."""
    options = ("schedule.checkpoint_every=80", "population.lineage=true", "view.cull=true")
    whole, _ = train(tmp_path / "whole", *options)
    stop_in_the_sweep_of(monkeypatch, time)
    cut, summary = train(tmp_path / "cut", *options)
    assert summary is None and cut.state.progress.step == time + 1
    assert [event[2] for event in cut.state.progress.events_left] == left
    assert (PHI in cut.state.table) == (time > 40)
    # The run stops at the same place once more.
    again, summary = train(tmp_path / "cut", *options, resume=True)
    assert summary is None
    # Nothing was added, and no time but that of the set-up.
    setup = again.state.progress.stages["setup"]
    assert setup > cut.state.progress.stages["setup"]
    expected = cut.state.progress.stages | {"setup": setup}
    assert again.state.progress == replace(cut.state.progress, stages=expected)
    monkeypatch.undo()
    resumed, _ = train(tmp_path / "cut", *options, resume=True)
    assert_same_table(resumed.state.table, whole.state.table)
    assert resumed.state.progress.milestones == whole.state.progress.milestones
    assert resumed.state.progress.events_left == []


@pytest.mark.parametrize(
    "options, named",
    [
        (
            ["population.pass1_keep=1e-4"],
            r"after 40 images kept none .*: raise population.pass1_keep \(0.0001\)$",
        ),
        (
            ["population.pass2_keep=1e-4"],
            r"after 80 images kept none .* population.pass2_keep \(0.0001\), or lower",
        ),
    ],
)
def test_a_pass_that_keeps_nothing_ends_the_run_before_it_is_saved(tmp_path, options, named):
    refused(ModelLostError, named, train, tmp_path, *options, "schedule.checkpoint_every=10")
    assert len(trained_model.open_model(tmp_path, Ranks()).table) > 0
