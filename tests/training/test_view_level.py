# SPDX-License-Identifier: Apache-2.0
"""The LOD gate and the cull mask in a training, in evaluations and in rendering."""

import dataclasses

import numpy as np
import pytest
import torch

import blitzgs
from blitzgs.cli import main
from blitzgs.config.fields import ScheduleConfig
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.formats.ply import read_ply, write_ply
from blitzgs.frame.render import render_frame
from blitzgs.population.importance import is_culled
from blitzgs.runs import trained_model
from blitzgs.runs.evaluation import image_metrics
from blitzgs.runs.world import subject_of_file
from blitzgs.table.table import CULL, GaussianTable
from blitzgs.training import view_level
from blitzgs.training.events import evaluate
from blitzgs.training.step import Stepper
from blitzgs.view.gate import centres_of
from tests.distributed.rank_harness import on_each_device, run_ranks
from tests.helpers import other_defaults
from tests.training import tiny
from tests.training.tiny import (
    assert_same_table,
    events_of,
    lose_view,
    make_trainer,
    steps_of,
    stop_at,
    tiny_scene,
    trained_in_parts,
)

# The passes follow the density event at 40 and come at 70; the window ends at 60; the mask is cleared at 85.
FLAGS = (
    "view.lod=true", "view.cull=true", "population.importance=true", "schedule.densify_until=60",
    "schedule.t1=40", "schedule.t2=70",
)  # fmt: skip


def train(folder, *overrides, **how):
    return tiny.train(folder, *FLAGS, *overrides, **how)


def resume_without_a_view(folder, *overrides):
    """Return a trainer that goes on without a photograph that the run began with."""
    scene = tiny_scene()
    lose_view(*scene, 1)
    with pytest.warns(UserWarning, match="other views than the 6 of today: the cull mask is dropped"):
        flags = (*FLAGS, *overrides, "data.allow_missing=true")
        return make_trainer(folder, *flags, scene=scene, resume=True)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """Train; return the run and, for each step, (step, gate, views of each row, copy of the table)."""
    folder, steps = tmp_path_factory.mktemp("run"), {}
    forward = Stepper.forward

    def watched(self, step, options, batch, view_filter=None):
        frame, *rest = forward(self, step, options, batch, view_filter=view_filter)
        table = {name: self.table[name].clone() for name in self.table}
        steps[step] = (view_filter, frame.projected, batch.indices, table)
        return frame, *rest

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Stepper, "forward", watched)
        return folder, *train(folder), steps


def test_gate_and_mask_apply_in_the_scheduled_phases(whole_run):
    folder, trainer, _, steps = whole_run
    progress, column_of = trainer.state.progress, trainer.state.columns
    dropped = {"lod": 0, "cull": 0}
    active, compared = {record["t"]: record["active"] for record in steps_of(folder)}, 0
    for step, (gate, rows, (index,), table) in steps.items():
        t = step - 1  # steps of one image each
        has_lod, has_mask = t >= 60, 40 < t <= 85
        if gate is None:
            assert not has_mask and (not has_lod or "0" in progress.gated_views)
            continue
        assert has_lod or has_mask
        assert bool(gate.columns) == has_mask and (has_lod or gate.lod_views == 0)
        seen = torch.zeros(len(table["id"]), dtype=torch.bool)
        seen[rows.visible_ids.long()] = True
        everything = render_frame(
            GaussianTable(table), trainer.state.views.pick([index]), trainer.state.render_options
        ).projected
        allowed = torch.ones_like(seen)
        if gate.lod_views:
            centre = trainer.state.views.centres([index])
            distances = torch.cdist(table["means"].double(), centre)[:, 0]
            reach = torch.tensor(gate.reach, dtype=torch.float64)[table["level"].long()]
            allowed &= distances <= reach
        dropped["lod"] += int((~allowed).sum())
        if has_mask:
            culled = is_culled(table[CULL], column_of[index])
            dropped["cull"] += int(culled.sum())
            allowed &= ~culled
        without = torch.zeros_like(seen)
        without[everything.visible_ids.long()] = True
        assert torch.equal(seen, without & allowed)
        if step in active:
            assert int(seen.sum()) <= active[step] <= int(allowed.sum()) < len(table["id"])
            compared += 1
    assert min(dropped.values()) > 100 and compared > 0


def test_what_the_run_says_and_saves(whole_run):
    folder, trainer, _, _ = whole_run
    progress = trainer.state.progress
    opened, again = events_of(folder, "lod_gate")  # at the end of the window, and after the second pass
    assert opened["t"] == 60 and again["t"] == 71
    assert progress.finest_level == progress.level_count - 1 >= 1
    assert progress.reference_distance > 0
    assert len(progress.gated_views) == 7 and "1" in progress.gated_views
    assert again["gated_views"] == progress.gated_views.count("1") and again["kept"] < 0.95
    assert events_of(folder, "clear_cull")[0]["t"] == 85 and CULL not in trainer.state.table
    saved = trained_model.open_model(folder, Ranks())
    # What comes after the checkpoint takes time, too.
    assert saved.progress == dataclasses.replace(progress, stages=saved.progress.stages)
    gate = saved.progress.model_gate(saved.config, saved.table, Ranks())
    assert gate.gate == progress.model_gate(trainer.state.config, trainer.state.table, Ranks()).gate


def test_evaluation_has_the_gate_and_no_mask(tmp_path, monkeypatch):
    """The following holds while the mask is used."""
    stop_at(monkeypatch, 80)
    trainer, _ = train(tmp_path)
    state = trainer.state
    assert CULL in state.table
    found = evaluate.measure(state, [3], None)
    view, camera = state.views.pick([3]), state.capture.cameras[3]
    distances = torch.cdist(state.table["means"].double(), centres_of(view.viewmats))[:, 0]
    gate = state.progress.model_gate(state.config, state.table, Ranks()).gate
    reach = torch.tensor(gate.reach(), dtype=torch.float64)[state.table["level"].long()]
    assert (distances <= reach).double().mean() < 0.95
    small = GaussianTable({name: state.table[name] for name in state.table})
    small.keep(distances <= reach)
    image = render_frame(small, view, state.render_options).renders[0]
    assert found["psnr"] == image_metrics(image, tiny_scene()[1].get(3), None)["psnr"]
    assert not torch.equal(image, render_frame(state.table, view, state.render_options).renders[0])
    shown = blitzgs.open_run(tmp_path).model().render(camera)
    torch.testing.assert_close(shown, image, rtol=0, atol=1e-5)


@pytest.mark.parametrize("last", [50, 65, 80])
def test_resume_is_exact(whole_run, tmp_path, last):
    """The run stops with the mask alone, with gate and first mask, and with gate and second mask."""
    _, whole, _, _ = whole_run
    second = trained_in_parts(train, tmp_path, last)
    assert_same_table(second.state.table, whole.state.table)
    assert second.state.progress.gated_views == whole.state.progress.gated_views


def test_levels_that_follow_footprints_leave_out_what_is_small_in_the_view(tmp_path, monkeypatch):
    followed, follow = [], view_level.follow_footprints

    def watched(state):
        before = state.table["level"].clone()
        follow(state)
        gate, table = model_gate_of(state), state.table
        distances = torch.cdist(table["means"].double(), state.views.centres(state.capture.train))
        _, middle, largest = table["scales"].double().exp().sort(1).values.unbind(1)
        size = table["opacities"].double().sigmoid() * (middle * largest).sqrt()
        footprints = size[:, None] * float(state.capture.cameras[0].K[0, 0]) / distances
        reach = torch.tensor(gate.reach(), dtype=torch.float64)[table["level"].long()]
        left_out = distances > reach[:, None]
        assert footprints[left_out].max() < 0.5 and left_out[footprints < 0.5 / 2**0.25].all()
        followed.append((state.images_seen, not torch.equal(table["level"], before)))

    def model_gate_of(state):
        return dataclasses.replace(state.progress, finest_level=31, gated_views="").lod_gate(state.config)

    monkeypatch.setattr(view_level, "follow_footprints", watched)
    flags = (
        "view.footprint=0.5", "population.importance=false", "view.cull=false", "schedule.densify_every=2",
    )  # fmt: skip
    whole, summary = train(tmp_path / "whole", *flags)
    assert followed == [(60, True), (80, True)] and summary is not None
    progress = whole.state.progress
    assert "1" in progress.gated_views and blitzgs.open_run(tmp_path / "whole").model().lod is not None
    resumed = trained_in_parts(train, tmp_path / "stopped", 75, *flags)
    assert_same_table(resumed.state.table, whole.state.table)


def _train_on(ranks, folder):
    trainer, summary = train(folder, ranks=ranks)
    return summary["psnr"], trainer.state.progress.gated_views, CULL in trainer.state.table


@pytest.mark.parametrize(("world_size", "device"), on_each_device(2))
def test_a_run_on_two_ranks_opens_the_gate_and_clears_the_mask(whole_run, tmp_path, world_size, device):
    _, whole, summary, _ = whole_run
    answers = run_ranks(_train_on, world_size, tmp_path, device=device)
    for psnr, gated_views, has_mask in answers:
        assert gated_views == whole.state.progress.gated_views and not has_mask
        assert psnr == pytest.approx(summary["psnr"], abs=0.5)


def test_render_honours_the_gate(whole_run, tmp_path):
    folder, *_ = whole_run
    assert main(["render", str(folder), "--out", str(tmp_path), "--raw", "--device", "cpu"]) == 0
    model = blitzgs.open_run(folder).model()
    assert model.lod is not None
    image = model.render(3)
    np.testing.assert_allclose(np.load(tmp_path / "03.npy"), image.numpy(), rtol=0, atol=1e-5)
    with other_defaults():  # of a program that opens the run
        again = blitzgs.open_run(folder).model()
        assert torch.equal(again.render(3), image)
    assert again in [model, again] and again != model


def test_a_gate_that_no_training_view_has_is_not_applied_elsewhere(tmp_path, monkeypatch):
    """Coarse levels that no training view shows alone are not shown alone by any other view."""
    monkeypatch.setattr("blitzgs.runs.trained_model.MOST_KEPT", 0.0)
    trainer, _ = train(tmp_path)
    progress = trainer.state.progress
    assert progress.finest_level is not None and set(progress.gated_views) == {"0"}
    assert [event["gated_views"] for event in events_of(tmp_path, "lod_gate")][-1] == 0
    assert blitzgs.open_run(tmp_path).model().lod is None


def test_a_view_from_farther_away_than_training_views_has_no_gate(whole_run):
    folder, trainer, _, _ = whole_run
    gate, state = blitzgs.open_run(folder).model().lod, trainer.state
    kept = gate.kept(state.views.centres(state.capture.train))
    assert [gate.applies(share) for share in kept] == [flag == "1" for flag in state.progress.gated_views]
    (far,) = gate.kept(torch.tensor([[0.0, 0.0, 1e3 * state.progress.reference_distance]]).double())
    assert far < gate.least_kept < min(kept) and not gate.applies(far)


def test_the_export_carries_the_levels(whole_run, tmp_path):
    folder, trainer, _, _ = whole_run
    path = tmp_path / "model.ply"
    assert main(["export", str(folder), "--ply", str(path)]) == 0
    found, table, state = read_ply(path), trainer.state.table, trainer.state
    assert torch.equal(found.levels, table["level"].float())
    assert torch.equal(found.quats, table["quats"]) and torch.equal(found.opacities, table["opacities"])
    (line,) = [text for text in found.comments if text.startswith("comment lod ")]
    words = line.split()
    distance = state.progress.reference_distance * state.space.unit
    assert float(words[words.index("reference_distance") + 1]) == distance
    assert words[-6:-1] == ["levels", str(state.progress.level_count), "finest", "1", "least"]
    # The views of the file have the gate that those of the run have.
    lod = subject_of_file(found, state.config, state.space, Ranks()).lod
    centres = torch.cat([state.views.centres(state.capture.train), torch.tensor([[0.0, 0.0, 1e5]]).double()])
    gated = [flag == "1" for flag in state.progress.gated_views]
    assert [lod.applies(share) for share in lod.kept(centres)] == [*gated, False]
    with pytest.raises(ValueError, match="levels has the shape"):
        write_ply(path, means=found.means, quats=found.quats, scales=found.scales,
                  opacities=found.opacities, sh=found.sh, levels=found.levels[1:])  # fmt: skip


def test_masks_stay_with_their_views_when_a_photograph_is_lost(tmp_path, monkeypatch):
    """The columns of the cull matrix and the gated views are those of the checkpoint's training views."""
    stop_at(monkeypatch, 75)
    before, _ = train(tmp_path)
    assert CULL in before.state.table and len(before.state.progress.gated_views) == 7
    stop_at(monkeypatch, 78)
    fewer = resume_without_a_view(tmp_path)
    assert CULL not in fewer.state.table
    assert fewer.train() is None
    assert len(fewer.state.progress.gated_views) == 6
    monkeypatch.undo()
    again, summary = train(tmp_path, resume=True)
    assert summary is not None and len(again.state.progress.gated_views) == 7


def test_a_photograph_that_is_lost_changes_neither_length_nor_opacity_term_of_a_run(tmp_path, monkeypatch):
    """This also holds if the number of views decided on both and the configuration is unchanged."""
    longer = ("schedule.images_per_view=20", "loss.opacity_total=0.2")
    stop_at(monkeypatch, 75)
    before, _ = train(tmp_path, *longer)
    monkeypatch.undo()
    fewer = resume_without_a_view(tmp_path, *longer)
    fewer.close()
    assert fewer.state.progress.step == 75
    assert fewer.state.schedule.iterations == before.state.schedule.iterations > 6 * 20
    assert fewer.state.config.loss == before.state.config.loss


def test_a_run_with_smooth_levels_is_shown_as_it_was_trained(tmp_path):
    resumed = trained_in_parts(train, tmp_path / "stopped", 65, "view.lod=smooth")
    trainer, _ = train(tmp_path / "whole", "view.lod=smooth")
    state = trainer.state
    assert_same_table(resumed.state.table, state.table)
    assert set(state.progress.gated_views) == {"1"}  # for any share that the views keep
    gate = state.progress.model_gate(state.config, state.table, Ranks())
    view, camera = state.views.pick([3]), state.capture.cameras[3]
    weights = gate.gate.weights(state.table["means"], state.table["level"], centres_of(view.viewmats)[0])
    assert ((weights > 0) & (weights < 1)).sum() > 10
    faded = GaussianTable({name: state.table[name].clone() for name in state.table})
    faded["opacities"] = (faded["opacities"].double().sigmoid() * weights).logit().float()
    options = dataclasses.replace(state.render_options, fade=())
    image = render_frame(faded, view, options).renders[0]
    found = render_frame(state.table, view, state.render_options).renders[0]
    torch.testing.assert_close(found, image, rtol=0, atol=1e-5)
    psnr = image_metrics(image, tiny_scene()[1].get(3), None)["psnr"]
    assert evaluate.measure(state, [3], None)["psnr"] == pytest.approx(psnr, abs=1e-3)
    shown = blitzgs.open_run(tmp_path / "whole").model().render(camera)
    torch.testing.assert_close(shown, image, rtol=0, atol=1e-5)
    path = tmp_path / "model.ply"
    assert main(["export", str(tmp_path / "whole"), "--ply", str(path)]) == 0
    assert any(text.endswith(" finest 1 smooth") for text in read_ply(path).comments)


def test_the_mask_is_cleared_halfway_after_the_last_pass():
    def cleared(**fields):
        schedule = Schedule(ScheduleConfig(iterations=90_000, densify_until=0, **fields))
        events = schedule.events(0, schedule.iterations)
        return [event.time for event in events if event.kind == "clear_cull"]

    assert cleared(t1=16_000, t2=34_000) == [62_000]
    assert cleared(t1=16_000, t2=0) == [53_000]
    assert cleared(t1=16_000, t2=100_000) == [53_000]  # the run ends before the second pass
    assert cleared(t1=0, t2=0) == []
    assert cleared(t1=16_000, t2=34_000, scale=0.5) == [31_000]
