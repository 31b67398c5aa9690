# SPDX-License-Identifier: Apache-2.0
"""The spawn gate: trees equal XGBoost's, the veto equals sorting, and a fit predicts predictable lives."""

import dataclasses
import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.population.importance import sample_by_score
from blitzgs.spawn.candidates import FEATURES, Candidates
from blitzgs.spawn.fit import Spawns, auc, best_feature, fit, judge
from blitzgs.spawn.gate import (
    GateError,
    SpawnGate,
    gate_file,
    info_path,
    random_veto,
    rank_veto,
    sampled_veto,
    veto_lowest,
)
from tests.distributed.rank_harness import run_ranks
from tests.helpers import refused

xgboost = pytest.importorskip("xgboost")
SCHEDULE = {"schedule.iterations": 100}


def spawns(scene, count=4000, seed=0, schedule=SCHEDULE):
    """Lives that depend on two features together and on chance; neither feature alone predicts them."""
    g = np.random.default_rng(seed)
    features = g.random((count, len(FEATURES)), dtype=np.float32)
    features[:, 7] = features[:, 7] > 0.5
    features[::50, 0] = np.nan
    hidden = (features[:, 1] > 0.5) ^ (features[:, 5] > 0.4)
    survived = np.where(g.random(count) < 0.85, hidden, g.random(count) < 0.5)
    parents = g.integers(0, 1 << 62, count)
    return Spawns(scene, scene, schedule, features, survived, parents, g.random((count, 3), dtype=np.float32))


@pytest.fixture(scope="module")
def gate(tmp_path_factory):
    path = tmp_path_factory.mktemp("gate") / "gate.json"
    return path, fit([spawns("a", seed=1), spawns("b", seed=2), spawns("c", seed=3)], path)


def candidates(count=1000, seed=5, device="cpu"):
    run = spawns("d", count, seed)
    features = torch.from_numpy(run.features).to(device)
    return Candidates(torch.from_numpy(run.parents).to(device), features[:, 7] > 0.5, features, 100)


def test_a_gate_transfers_to_scenes_it_has_not_seen(gate):
    path, figures = gate
    assert figures["protocol"] == "leave one scene out"
    for entry in figures["held_out"]:
        assert entry["auc"] > 0.88 > 0.65 > entry["best_feature_auc"]
        assert entry["spawns"] == 4000
    info = json.loads(info_path(path).read_text())
    assert info["features"] == list(FEATURES) and info["scenes"] == {"a": "a", "b": "b", "c": "c"}
    assert info["auc"] == figures and info["schedule"] == SCHEDULE


def test_trees_are_those_of_xgboost(gate, device):
    path, _ = gate
    booster = xgboost.Booster(model_file=str(path))
    some = candidates(20_000)
    some.features[::7, 3] = float("nan")
    scores = SpawnGate(path).scores(some.features.to(device)).cpu().double() / 2**32
    data = xgboost.DMatrix(some.features.numpy(), feature_names=list(FEATURES))
    margins = torch.from_numpy(booster.predict(data, output_margin=True)).double()
    assert (scores - scores.mean() - margins + margins.mean()).abs().max() < 1e-4
    assert SpawnGate(path).scores(some.features[:0]).shape == (0,)


def test_spawns_from_the_onset_on_are_also_judged_alone():
    run = spawns("a", 400)
    run.features[:, 6] = np.arange(400)  # time
    scores = np.where(run.times < 300, 0.0, run.survived)  # knows the late ones only
    figures = judge(run, scores, gate_from=300)
    assert figures["spawns"] == 400 and figures["auc"] < 0.8
    assert figures["judged"]["spawns"] == 100 and figures["judged"]["auc"] == 1
    assert "judged" not in figures["judged"]
    assert "judged" not in judge(run, scores, gate_from=0)  # that would be all of them
    assert "judged" not in judge(run, scores, gate_from=400)  # none


def test_the_default_gate_loads_and_ranks_candidates():
    gate = SpawnGate(gate_file("default"))
    assert gate.info.schedule["schedule.iterations"] == 30_000 and len(gate.info.scenes) >= 2
    held_out = gate.info.auc["held_out"]
    assert {entry["run"] for entry in held_out} == set(gate.info.scenes)
    assert all(entry["auc"] > 0.6 for entry in held_out)
    # Usual values; the two features that predict survival best on each capture vary in their usual range.
    usual = {"gradient": 2e-4, "parent_opacity": 0.75, "parent_age": 2000, "views": 23, "time": 4000}
    for varied, low, high in (("parent_color_gradient", 1e-8, 1e-6), ("parent_scale", 3e-4, 5e-3)):
        row = {"parent_scale": 2e-3, "parent_flatness": 0.27, "parent_color_gradient": 1e-7, **usual}
        features = torch.tensor([[row.get(name, 0.0) for name in FEATURES]]).repeat(1000, 1)
        features[:, FEATURES.index(varied)] = torch.logspace(math.log10(low), math.log10(high), 1000)
        scores = gate.scores(features).double()
        assert scores[-100:].mean() > scores[:100].mean(), varied  # large values weigh more
    assert gate_file("gates/mine.json") == Path("gates/mine.json")


def test_vetoes_the_lowest_of_clones_and_of_splits():
    some = candidates(101)
    scores = torch.randn(101, generator=torch.Generator().manual_seed(2))
    scores[:30] = -3.0  # ties
    for rate in (0.0, 0.3, 0.6, 1.0):
        vetoed = veto_lowest(scores, some, rate, Ranks())
        for group in (some.is_split, ~some.is_split):
            rows = sorted(
                group.nonzero().squeeze(1).tolist(), key=lambda i: (float(scores[i]), int(some.parents[i]))
            )
            k = -int(-len(rows) * round(rate * 10) // 10)
            assert vetoed[rows[:k]].all() and not vetoed[rows[k:]].any()


def _veto(ranks, path):
    some = candidates()
    mine = torch.arange(1000) % 5 % ranks.world_size == ranks.rank
    own = Candidates(some.parents[mine], some.is_split[mine], some.features[mine], some.time)
    known = SpawnGate(path)
    vetoes = (
        partial(rank_veto, known, 0.6),
        partial(random_veto, 0.6, 4),
        partial(sampled_veto, known, 0.6, 4),
    )
    return [own.parents[veto(own, ranks)].tolist() for veto in vetoes]


def test_vetoes_do_not_depend_on_the_world_size(gate):
    alone = _veto(Ranks(), gate[0])
    answers = run_ranks(_veto, 3, gate[0])
    for k, want in enumerate(alone):
        assert sorted(i for answer in answers for i in answer[k]) == sorted(want)
        assert 600 <= len(want) <= 602
    assert len({frozenset(vetoed) for vetoed in alone}) == len(alone)


def test_a_sampled_veto_keeps_candidates_in_proportion_to_their_odds(gate):
    """The share of kept candidates per score, against numpy's draws without replacement by the same odds."""
    known, some, events = SpawnGate(gate[0]), candidates(60), 1000
    odds = np.exp(known.scores(some.features).numpy() * 2.0**-32)
    kept = np.zeros(60)
    for event in range(events):
        at = dataclasses.replace(some, time=event)
        kept += ~sampled_veto(known, 0.6, 1, at, Ranks()).numpy()
    g, expected = np.random.default_rng(0), np.zeros(60)
    for split in (False, True):
        rows = np.flatnonzero(some.is_split.numpy() == split)
        count = len(rows) - math.ceil(0.6 * len(rows))
        for _ in range(events):
            expected[g.choice(rows, count, replace=False, p=odds[rows] / odds[rows].sum())] += 1
    assert len(set(odds.round(6))) > 5
    # Each difference of two counts has a variance of at most events / 2.
    assert np.abs(kept - expected).max() < 4.5 * math.sqrt(events / 2)
    assert kept.std() > 3 * math.sqrt(events / 4)


class Known:
    """A gate whose scores are known: the first feature is the log odds."""

    def scores(self, features):
        return (features[:, 0].double() * 2.0**32).long()


def with_odds(log_odds):
    features = torch.zeros(len(log_odds), len(FEATURES))
    features[:, 0] = torch.tensor(log_odds)
    # The parents of high ids have the best odds, so that ties by id would be wrong.
    return Candidates(torch.arange(len(log_odds)), torch.zeros(len(log_odds)).bool(), features, 0)


@pytest.mark.parametrize("low", [-4000.0, 1000.0])
def test_a_sampled_veto_compares_odds_beyond_the_range_of_numbers(low):
    """e^-4000 is rounded to 0 and e^1000 to infinity, but the order of such odds still decides."""
    some = with_odds([low] * 50 + [low + 1000] * 50)
    kept = []
    for time in range(2):
        vetoed = sampled_veto(Known(), 0.6, 1, dataclasses.replace(some, time=time), Ranks())
        assert vetoed[:50].all() and vetoed[50:].sum() == 10
        kept.append(vetoed)
    assert not torch.equal(*kept)  # among equal odds, chance decides


@pytest.mark.parametrize(
    "veto", [partial(random_veto, 0.5, 7), partial(sampled_veto, Known(), 0.5, 7)], ids=["random", "sample"]
)
def test_vetoes_are_independent_of_the_draw_of_a_pass_at_the_same_time(veto):
    """The first importance pass draws among the same Gaussians by the same seed and time."""
    some = with_odds([0.0] * 2000)
    vetoed = veto(some, Ranks())
    kept = sample_by_score(torch.ones(2000), some.parents, 0.5, 7, some.time, Ranks())
    assert 400 < int((vetoed & kept).sum()) < 600  # 500 are expected, with a standard deviation of 11


def test_auc_is_the_chance_to_rank_right():
    g = np.random.default_rng(0)
    scores, positive = g.integers(0, 20, 300), g.random(300) < 0.3
    pairs = scores[positive][:, None] - scores[~positive][None]
    assert auc(scores, positive) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean(), abs=1e-12)
    run = spawns("a")
    name, value = best_feature(run)
    assert name in FEATURES and 0.5 <= value < 0.65
    assert judge(run, run.survived.astype(float))["auc"] == 1


def test_runs_of_different_schedules_are_refused_by_the_fields_that_differ(tmp_path):
    other = SCHEDULE | {"schedule.scale": 0.5}
    message = r"^a and b were .* different schedules, .* each: schedule.scale \(None and 0.5\)$"
    refused(ValueError, message, fit, [spawns("a"), spawns("b", schedule=other)], tmp_path / "h.json")


def test_scenes_of_the_same_name_are_told_apart(tmp_path):
    path = tmp_path / "g.json"
    runs = [dataclasses.replace(spawns(scene, seed=k), name="capture") for k, scene in enumerate("ab")]
    assert [entry["run"] for entry in fit(runs, path)["held_out"]] == ["capture", "capture_2"]
    assert SpawnGate(path).info.scenes == {"capture": "a", "capture_2": "b"}


def test_too_few_spawns_to_hold_some_out_are_refused(tmp_path):
    run = spawns("a")
    with pytest.raises(ValueError, match=r"^a, of which a part is held out: 1 of 1 spawns survived"):
        fit([run.only(run.parents == run.parents[0])], tmp_path / "g.json")
    assert not list(tmp_path.iterdir())


def test_a_fit_replaces_only_a_gate(tmp_path):
    path = tmp_path / "package.json"
    geojson = '{"type": "FeatureCollection", "features": []}'
    others = ("{}", "[" * 100_000, geojson)
    for file, text in ((path, "the user's"), *((info_path(path), text) for text in others)):
        file.write_text(text)
        with pytest.raises(FileExistsError, match=f"{file} exists and does not belong to a gate: choose"):
            fit([spawns("a")], path)
        assert file.read_text() == text
        file.unlink()
    (tmp_path / "target.json").symlink_to(path)
    refused(OSError, "a symbolic link, .* not overwritten", fit, [spawns("a")], tmp_path / "target.json")
    (entry,) = fit([spawns("a")], path)["held_out"]  # of one scene, a quarter of the parents
    assert 800 < entry["spawns"] < 1200 and entry["auc"] > 0.85
    fit([spawns("b", seed=1)], path)
    assert SpawnGate(path).info.scenes == {"b": "b"}


def spoil_tree(path, field, value, at="root", tree=3):
    model = json.loads(path.read_text())
    tree = model["learner"]["gradient_booster"]["model"]["trees"][tree]
    if at == "all":
        tree[field] = value
    else:
        tree[field][0 if at == "root" else tree["left_children"].index(-1)] = value
    path.write_text(json.dumps(model))


def spoil_info(path, **fields):
    info_path(path).write_text(json.dumps(json.loads(info_path(path).read_text()) | fields))


def without_trees(path):
    model = json.loads(path.read_text())
    model["learner"]["gradient_booster"]["model"]["trees"] = []
    path.write_text(json.dumps(model))


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda path: info_path(path).unlink(), "is missing: a gate is a model and its metadata"),
        (lambda path: info_path(path).write_text("{}"), "is not the metadata of a gate"),
        (lambda path: path.unlink(), "gate.json cannot be read: No such file"),
        (lambda path: path.write_text("no"), "is not a binary classifier in XGBoost's JSON"),
        (
            lambda path: info_path(path).write_text(
                info_path(path).read_text().replace("parent_age", "parent_name")
            ),
            "was fitted on the features",
        ),
        (
            lambda path: path.write_text(path.read_text().replace("binary:logistic", "reg:squarederror")),
            "objective reg:squarederror",
        ),
        (lambda path: spoil_tree(path, "left_children", 0), "the nodes of a tree do not form one"),
        (lambda path: spoil_tree(path, "left_children", math.nan), "is not a binary classifier"),
        (lambda path: spoil_tree(path, "right_children", 1 << 20), "the nodes of a tree do not form one"),
        (lambda path: spoil_tree(path, "split_indices", 99), "a split of feature 99"),
        (lambda path: spoil_tree(path, "split_indices", 1.5), "a split of feature 1.5"),
        (lambda path: spoil_tree(path, "split_conditions", math.nan), "without a threshold"),
        (lambda path: spoil_tree(path, "categories_nodes", [0], at="all"), "without a threshold"),
        (
            # In a leaf's place, `split_conditions` has its value.
            lambda path: spoil_tree(path, "split_conditions", math.inf, at="leaf"),
            "convert float infinity to integer",
        ),
        (
            # One leaf fits into 64 bits in units of 2^-32, but not the sum over the trees.
            lambda path: [spoil_tree(path, "split_conditions", 1.5e9, "leaf", tree) for tree in (0, 1)],
            "the leaves of its trees may add up to 2.31 or more",
        ),
        (without_trees, "no trees"),
        (lambda path: path.write_text("[" * 100_000), "is not a binary classifier in XGBoost's JSON"),
        (lambda path: info_path(path).write_text("null"), "is not the metadata of a gate"),
        (lambda path: info_path(path).write_text("[" * 100_000), "is not the metadata of a gate"),
        (lambda path: info_path(path).write_text('{"format": ' + "9" * 5000 + "}"), "is not the metadata"),
        (lambda path: spoil_info(path, scenes=["a"]), "schedule, scenes and auc must be objects"),
        (lambda path: spoil_info(path, format=7), "format 7, this version reads 1"),
    ],
)
def test_bad_files_are_named(gate, tmp_path, break_it, message):
    path = tmp_path / "gate.json"
    path.write_text(gate[0].read_text())
    info_path(path).write_text(info_path(gate[0]).read_text())
    SpawnGate(path)
    break_it(path)
    refused(GateError, message, SpawnGate, path)


def test_a_gate_in_ubjson_is_refused_with_how_to_convert_it(gate, tmp_path):
    path = tmp_path / "gate.ubj"
    info_path(path).write_text(info_path(gate[0]).read_text())
    with pytest.raises(
        GateError, match=r"gate\.ubj: only XGBoost's JSON is read: .*save_model\('gate.json'\)"
    ):
        SpawnGate(path)
    refused(GateError, r"^\.: no such gate", SpawnGate, gate_file(""))
