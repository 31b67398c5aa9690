# SPDX-License-Identifier: Apache-2.0
import dataclasses
import json
import shutil
import warnings
from functools import partial

import cv2
import numpy as np
import pytest
import torch

from blitzgs.cli import main
from blitzgs.config.files import ConfigError, load_config, to_dict
from blitzgs.distributed.group import Ranks
from blitzgs.runs import run_files, trained_model
from blitzgs.runs.folder import open_run
from blitzgs.runs.guard import NonFiniteError
from blitzgs.training.events import densify
from blitzgs.training.trainer import Trainer
from blitzgs.training.understood import small_batch_hint
from tests.helpers import refused
from tests.training.tiny import (
    HEIGHT,
    WIDTH,
    assert_same_table,
    events_of,
    make_trainer,
    sorted_rows,
    steps_of,
    stop_at,
    tiny_scene,
    train,
    trained_in_parts,
)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, *train(folder)


def test_training_improves_the_images(whole_run, tmp_path):
    _, trainer, summary = whole_run
    _, start = train(tmp_path, "schedule.iterations=1")
    assert summary["psnr"] > start["psnr"] + 3
    assert summary["ssim"] > start["ssim"]


def test_what_a_run_leaves_behind(whole_run):
    folder, trainer, summary = whole_run
    assert trainer.state.progress.sh_degree == 3 and trainer.state.table["birth"].max() > 0
    assert json.loads((folder / "summary.json").read_text()) == summary
    figures = ("psnr", "ssim", "seconds", "images_per_second", "peak_memory_bytes", "config_hash", "versions")
    assert all(summary[name] for name in figures)
    assert summary["peak_gaussians"] >= summary["gaussians"]
    assert [r["t"] for r in steps_of(folder)] == [20, 40, 60, 80, 100]
    assert [r["t"] for r in events_of(folder, "densify")] == [20, 40, 60, 80]
    assert load_config(folder / "config.yaml") == trainer.state.config
    metrics = json.loads((folder / "evaluation" / "000100" / "metrics.json").read_text())
    assert list(metrics["views"]) == ["03.png"]
    assert (folder / "evaluation" / "000100" / "03.jpg").stat().st_size > 0
    model = trained_model.open_model(folder, Ranks())
    assert_same_table(model.table, trainer.state.table)


def _of_an_earlier_version(config):
    """Return `to_dict` of a configuration, with fields of earlier versions."""
    values = to_dict(config)
    values["data"]["threads"], values["ranks"]["max_imbalance"], values["view"]["most_kept"] = 6, 1.3, 0.8
    values["population"] |= {"relocate": False, "opacity_decay": 0.0, "reset_opacity": 0.01}
    return values


def test_resume_is_exact(whole_run, tmp_path, monkeypatch):
    """50 steps, SIGTERM, resume and 50 more steps give the bits of the uninterrupted run.

    The first 50 are those of an earlier version, whose configuration has fields that are gone.
    """
    _, whole, _ = whole_run
    for module in ("blitzgs.config.files", "blitzgs.runs.trained_model"):
        monkeypatch.setattr(f"{module}.to_dict", _of_an_earlier_version)
    stop_at(monkeypatch, 50)
    first, summary = train(tmp_path)
    assert summary is None and first.state.progress.step == 50
    monkeypatch.undo()
    written = tmp_path / "config.yaml"
    assert "max_imbalance: 1.3" in written.read_text()
    assert load_config(written) == first.state.config
    second, summary = train(tmp_path, resume=True)
    assert summary is not None
    assert_same_table(second.state.table, whole.state.table)
    assert second.state.progress.peak_gaussians == whole.state.progress.peak_gaussians


@pytest.mark.parametrize(
    ("asked", "other", "field"),
    [
        # A schedule that the views made longer, and an opacity term that follows the views.
        (("schedule.images_per_view=20", "schedule.iterations=40"), "19", "schedule.scale"),
        (("loss.opacity_total=0.2",), "0.3", "loss.opacity"),
    ],
)
def test_a_run_is_resumed_with_either_configuration(tmp_path, monkeypatch, asked, other, field):
    stop_at(monkeypatch, 50)
    first, summary = train(tmp_path, *asked)
    views = len(first.state.capture.train)
    assert summary is None
    monkeypatch.undo()
    own = load_config(tmp_path / "config.yaml")
    if field == "schedule.scale":
        assert first.state.schedule.iterations == 20 * views > 50
        assert own.schedule.images_per_view == 0 and own.schedule.scale == views / 2
    else:
        assert first.state.config.loss.opacity == 0.2 / views
        assert own.loss.opacity_total == 0 and own.loss.opacity == 0.2 / views
    with pytest.raises(ConfigError, match=f"{field}: the checkpoint was trained with"):
        train(tmp_path, asked[0].partition("=")[0] + "=" + other, *asked[1:], resume=True)
    Trainer(own, *tiny_scene(), tmp_path, Ranks(), resume=True).close()
    second, summary = train(tmp_path, *asked, resume=True)
    assert summary is not None and second.state.schedule.iterations == first.state.schedule.iterations


def test_a_checkpoint_has_all_events_of_its_step(tmp_path):
    """In a batch, a checkpoint may be due an image before a density event of the same step."""
    times = ("schedule.densify_from=22", "schedule.checkpoint_every=20")
    options = ("schedule.batch_size=4", "schedule.iterations=60", "log.keep_checkpoints=10", *times)
    whole, _ = train(tmp_path, *options)
    checkpoints = sorted((tmp_path / run_files.CHECKPOINTS).iterdir())
    for later in checkpoints[1:]:
        shutil.rmtree(later)
    resumed, _ = train(tmp_path, *options, resume=True)
    assert "after 6 steps" in resumed.state.origin
    assert (whole.state.table["birth"] == 22).any()
    assert_same_table(resumed.state.table, whole.state.table)


@pytest.mark.parametrize("power", [-7, 10])
def test_a_world_scaled_by_a_power_of_two_trains_to_the_same_bits(whole_run, tmp_path, power):
    _, whole, expected = whole_run
    scaled, summary = train(tmp_path, scene=tiny_scene(2.0**power))
    assert_same_table(scaled.state.table, whole.state.table)
    assert scaled.state.space.unit == whole.state.space.unit * 2.0**power
    assert summary["psnr"] == expected["psnr"]


def test_batches_masks_and_background(tmp_path):
    _, images = scene = tiny_scene()
    images.masks = [torch.ones(32, 48, dtype=torch.uint8) for _ in images.images]
    for image, mask in zip(images.images, images.masks, strict=True):
        mask[:, :24] = 0
        image[:, :24] = 255
    images.masks[0] = None
    options = ("schedule.batch_size=4", "schedule.iterations=120", "population.max_gaussians=420")
    trainer, summary = train(tmp_path, *options, "model.background=[0.2, 0.2, 0.2]", scene=scene)
    assert summary["images"] == 120 and trainer.state.progress.step == 30
    assert summary["psnr"] > 15
    assert trainer.state.progress.peak_gaussians <= 420


def test_random_backgrounds_make_gaussians_cover_what_photographs_show(tmp_path):
    """Photographs of the background's colour need no Gaussian otherwise; with alpha that is what they say."""
    capture, images = tiny_scene()
    images.images = [torch.full_like(image, 51) for image in images.images]

    def covered(random, alpha=None):
        folder = tmp_path / f"{random} {alpha}"
        scene = dataclasses.replace(capture, has_alpha=alpha is not None)
        if alpha is not None:
            photograph = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
            photograph[0, 0, 3] = alpha
            capture.cameras[capture.train[-1]].image_path = tmp_path / f"{alpha}.png"
            cv2.imwrite(str(tmp_path / f"{alpha}.png"), photograph)
        options = (
            "model.background=[0.2, 0.2, 0.2]", "loss.opacity=0.3", "optimiser.opacity=0.1",
            "schedule.densify_from=90", f"model.random_background={random}",
        )  # fmt: skip
        train(folder, *options, scene=(scene, images))
        return open_run(folder).model().render(capture.cameras[0], alpha=True)[..., 3].mean()

    least = covered("false")
    assert covered("true") > least + 0.2 and covered("true", alpha=255) > least + 0.2
    assert covered("true", alpha=254) == least


def test_a_run_decides_on_its_background_once(tmp_path):
    """It is the mean colour of the photographs with random backgrounds, and black without."""
    capture, images = scene = tiny_scene()
    images.images = [torch.full_like(image, 51) for image in images.images]
    options = ("model.random_background=true", "schedule.iterations=20")
    train(tmp_path / "random", *options, scene=scene)
    assert open_run(tmp_path / "random").config().model.background == (0.2, 0.2, 0.2)
    images.images = [torch.full_like(image, 102) for image in images.images]
    train(tmp_path / "random", *options, scene=scene, resume=True)
    model = open_run(tmp_path / "random").model()
    assert model.config.model.background == (0.2, 0.2, 0.2)
    camera = dataclasses.replace(capture.cameras[0], world_to_camera=np.diag([1.0, -1.0, -1.0, 1.0]))
    camera.world_to_camera[2, 3] = -100.0  # looks away from the scene
    torch.testing.assert_close(model.render(camera), torch.full((HEIGHT, WIDTH, 3), 0.2))
    capture.has_alpha = True
    for name, given in {"alpha": options, "black": options[1:]}.items():
        train(tmp_path / name, *given, scene=scene)
        assert open_run(tmp_path / name).config().model.background == (0.0, 0.0, 0.0)
        capture.has_alpha = False


@pytest.mark.parametrize("share", [0.0, 0.01])
@pytest.mark.parametrize("strategy", ["relocation", "density"])
def test_with_random_backgrounds_axes_are_limited(tmp_path, strategy, share):
    options = (f"population.strategy={strategy}", f"population.prune_world_scale={share}")
    trainer, _ = train(tmp_path, *options, "model.random_background=true")
    table, extent = trainer.state.table, trainer.state.space.extent
    limits = 0.01 * table["means"].norm(dim=1).clamp(min=extent)
    excess = (table["scales"].exp().amax(dim=1) / limits).max()
    # Steps that a row owes when it is seen for the last time may still move it a little.
    assert excess < 1.01 if share else excess > 1.5


def test_a_run_that_starts_from_a_file_says_what_it_makes_smaller(tmp_path):
    trainer, _ = train(tmp_path / "first", "schedule.iterations=20")
    assert main(["export", str(tmp_path / "first"), "--ply", str(tmp_path / "model.ply")]) == 0
    start, share = f"model.start={tmp_path / 'model.ply'}", "population.prune_world_scale"
    table, extent = trainer.state.table, trainer.state.space.extent
    larger = int((table["scales"].exp().amax(1) > 0.01 * table["means"].norm(dim=1).clamp(min=extent)).sum())
    assert larger > 0
    with pytest.warns(UserWarning, match=f"{larger} of the {len(table)} Gaussians of .*{share}=0 keeps"):
        make_trainer(tmp_path / "second", start, f"{share}=0.01", "model.random_background=true")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = make_trainer(tmp_path / "third", start, f"{share}=0", "model.random_background=true")
    scales, others = (t["scales"][t["means"][:, 0].argsort()] for t in (table, again.state.table))
    torch.testing.assert_close(scales, others)


@pytest.mark.parametrize("white", [0, 1], ids=["black", "inverted"])
def test_training_views_that_are_masked_almost_as_a_whole_are_counted(tmp_path, white):
    """Masks whose meaning is inverted exclude all or almost all of a view; the run says so, once."""
    capture, images = scene = tiny_scene()
    images.masks = [torch.zeros(32, 48, dtype=torch.uint8) for _ in images.images]
    for mask in images.masks:
        mask[:8, :8] = white  # 4 % of the pixels
    images.masks[capture.test[0]] = None
    with pytest.warns(UserWarning, match="7 of the first 7 training views are masked by more than") as found:
        train(tmp_path, "schedule.iterations=40", scene=scene)
    assert len(found) == 1 and "95%: black excludes a pixel and white counts" in str(found[0].message)
    # A step without a pixel that counts has no PSNR.
    assert ["psnr" in record for record in steps_of(tmp_path)] == [bool(white)] * 2


def test_a_short_run_and_only_some_masks(tmp_path):
    capture, images = scene = tiny_scene()
    images.masks = [None] * 8
    images.masks[capture.train[0]] = torch.zeros(32, 48, dtype=torch.uint8)
    images.masks[capture.train[1]] = torch.ones(32, 48, dtype=torch.uint8)
    with pytest.warns(UserWarning, match="1 of the first 7 training views are masked"):
        train(tmp_path, "schedule.iterations=10", "log.every=100", scene=scene)


def test_the_start_line_names_the_size_of_downscaled_images(tmp_path, capsys):
    for factor, name in ((1, "whole"), (4, "quarter")):
        train(tmp_path / name, f"data.downscale={factor}", "schedule.iterations=1")
        printed = capsys.readouterr().out
        assert ("; images of 48 x 32 (data.downscale=4)" in printed) == (factor == 4)
        assert not events_of(tmp_path / name, "hint")  # one rank needs no larger batch
    capture, images = scene = tiny_scene()
    capture.cameras[0].width, images.images[0] = 40, images.images[0][:, :40]
    train(tmp_path / "sizes", "data.downscale=2", "schedule.iterations=1", scene=scene)
    assert "; images of at most 48 x 32 (data.downscale=2)" in capsys.readouterr().out


@pytest.mark.parametrize(("batch", "ranks", "enough"), [(1, 4, 16), (7, 2, 8), (8, 2, None), (1, 1, None)])
def test_a_batch_that_is_small_for_its_ranks_gets_a_hint(batch, ranks, enough):
    hint = small_batch_hint(batch, ranks)
    if enough is None:
        assert hint is None
    else:
        views = "1 view" if batch == 1 else f"{batch} views"
        assert hint.startswith(f"a step of {views} may be no faster on {ranks} ranks than on one: ")
        assert f"try --schedule.batch_size={enough}," in hint


def test_views_that_see_nothing(tmp_path):
    capture, images = tiny_scene()
    for camera in capture.cameras:
        camera.world_to_camera = np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera.world_to_camera
    trainer = make_trainer(tmp_path, "schedule.iterations=40", scene=(capture, images))
    before = trainer.state.table["means"].clone()
    trainer.train()
    assert torch.equal(trainer.state.table["means"], before)


def test_non_finite_values_stop_the_run_by_name(tmp_path, device):
    trainer = make_trainer(tmp_path, ranks=Ranks(device=torch.device(device)))
    trainer.state.table["scales"][trainer.state.table["id"] == 7, 1] = float("nan")
    refused(NonFiniteError, r"step 20: column 'scales' is not finite in 1 Gaussians \(ids 7\)", trainer.train)


def test_a_non_finite_loss_names_step_and_view(tmp_path, monkeypatch):
    from blitzgs.training import step as module

    original = module.loss_terms

    def broken(*args):
        terms = original(*args)
        return terms._replace(parts=terms.parts * torch.tensor([1.0, float("inf")]))

    monkeypatch.setattr(module, "loss_terms", broken)
    message = r"step 1: the loss of view '0\d.png' is not finite; .* op photometric"
    refused(NonFiniteError, message, train, tmp_path)


def test_a_run_is_not_overwritten_nor_resumed_with_another_configuration(whole_run):
    folder, *_ = whole_run
    written = (folder / "config.yaml").read_bytes()
    refused(FileExistsError, "add --resume", train, folder)
    differs = r"loss.ssim: the checkpoint was trained with 0.2, now 0.3; leave out --config"
    refused(ConfigError, differs, train, folder, "loss.ssim=0.3", resume=True)
    assert (folder / "config.yaml").read_bytes() == written
    train(folder, "log.every=50", "schedule.evaluate_every=7", "schedule.checkpoint_every=9", resume=True)


@pytest.mark.cuda
def test_cuda_trains_like_the_cpu_and_resumes_exactly(whole_run, tmp_path):
    ranks = Ranks(device=torch.device("cuda"))
    on_gpu = partial(train, ranks=ranks)
    whole, summary = on_gpu(tmp_path / "whole", "model.deterministic=true")
    assert summary["psnr"] == pytest.approx(whole_run[2]["psnr"], abs=1.0)
    resumed = trained_in_parts(on_gpu, tmp_path / "cut", 50, "model.deterministic=true")
    assert_same_table(resumed.state.table, whole.state.table)


@pytest.mark.parametrize("strategy", ["density", "relocation"])
def test_a_table_is_sorted_rarely_and_a_run_is_the_same_if_it_is_sorted_often(
    tmp_path, monkeypatch, strategy
):
    options = (f"population.strategy={strategy}", "population.growth=0.2", "population.max_gaussians=700",
               "schedule.densify_from=10", "schedule.densify_every=8", "schedule.densify_until=40",
               "schedule.iterations=44", "model.deterministic=true")  # fmt: skip
    tables = []
    for name, sorts in (("rarely", [True, False, False, True]), ("often", [True] * 4)):
        if all(sorts):
            monkeypatch.setattr(densify, "MOST_SPREAD", 0.0)
        trainer, _ = train(tmp_path / name, *options)
        assert [event.get("sorted", 0) == 1 for event in events_of(tmp_path / name, "densify")] == sorts
        tables.append(sorted_rows(trainer.state.table))
    assert len(tables[0]["id"]) > 450
    assert_same_table(*tables)
