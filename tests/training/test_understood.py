# SPDX-License-Identifier: Apache-2.0
"""What `train` says of a capture, memory and time before it trains, and what it refuses."""

import dataclasses
import warnings
from types import SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch

from blitzgs.capture import colmap
from blitzgs.capture.cameras import rectify
from blitzgs.capture.capture import load_capture
from blitzgs.capture.lens import Lens
from blitzgs.cli import main
from blitzgs.config.fields import Config
from blitzgs.config.files import load_config
from blitzgs.config.schedule import Schedule
from blitzgs.distributed.group import Ranks
from blitzgs.training import inputs
from blitzgs.training.understood import (
    HopelessCaptureError,
    _exposure,
    _grown,
    _look,
    _warn_of_pictures,
    check_worlds,
    estimate,
    large_images_hint,
    undistortion_note,
)
from tests.capture.helpers import smooth_image
from tests.helpers import refused
from tests.training.tiny import (
    HEIGHT,
    OVERRIDES,
    WIDTH,
    Camera,
    Capture,
    as_flags,
    tiny_config,
    write_tiny_capture,
)

FLAGS = as_flags("config=defaults", *OVERRIDES, "schedule.iterations=10")


@pytest.fixture(scope="module")
def loaded(capture):
    return load_capture(capture)


@pytest.fixture
def data(tmp_path):
    write_tiny_capture(tmp_path / "data")
    return tmp_path / "data"


def check(data, capsys, *flags):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        status = main(["train", "--data", str(data), "--check", *FLAGS, *flags])
    printed = capsys.readouterr()
    lines = dict(line.split(":", 1) for line in printed.out.splitlines() if ":" in line)
    return status, {key: value.strip() for key, value in lines.items()}, printed.err, [
        str(w.message) for w in caught
    ]  # fmt: skip


def edit(data, change):
    folder = next((data / "sparse").glob("*")) if (data / "sparse" / "0").is_dir() else data / "sparse"
    model = colmap.read_model(folder)
    change(model)
    colmap.write_model(folder, model)


def test_check_prints_a_block_and_stops(data, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "_lazy_init", lambda: pytest.fail("a GPU was touched"))
    before = {path for path in tmp_path.rglob("*")}
    status, lines, _, said = check(data, capsys)
    assert status == 0 and not said and before == {path for path in tmp_path.rglob("*")}
    names = ["capture", "photographs", "held out", "stray cameras", "sizes", "masks", "alpha", "points"]
    assert list(lines) == [*names, "exposure", "extent", "training"]
    assert lines["photographs"] == "8 used: 7 to train, 1 held out"
    assert lines["held out"].startswith("every 8th view by name: 00.png")
    assert lines["sizes"] == f"{WIDTH} x {HEIGHT} pixels" and lines["masks"] == lines["alpha"] == "none"
    assert lines["points"].startswith("400 of ") and "near plane" in lines["extent"]
    assert "Gaussians at most" in lines["training"] and "minutes" in lines["training"]


def test_what_was_left_out_is_in_the_block(data, capsys):
    cv2.imwrite(str(data / "images" / "x.png"), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    (data / "images" / "02.png").unlink()

    def move(model):
        model.images.translations[5] += [400.0, 0, 0]

    edit(data, move)
    status, lines, _, _ = check(data, capsys, "--data.allow_missing=true")
    assert status == 0 and lines["photographs"].startswith(
        "6 used: 5 to train, 1 held out; 1 without a camera"
    )
    assert "1 not on disk" in lines["photographs"] and lines["stray cameras"].startswith(
        "1 left out: 05.png at"
    )
    status, lines, _, _ = check(data, capsys, "--data.allow_missing=true", "--data.stray_cameras=keep")
    assert lines["stray cameras"].startswith("1 kept: 05.png at")


def test_masks_and_their_share(data, capsys):
    half = np.full((HEIGHT, WIDTH), 255, np.uint8)
    half[:, : WIDTH // 2] = 0
    (data / "masks").mkdir()
    for i in range(4):
        cv2.imwrite(str(data / "masks" / f"{i:02}.png"), half)
    _, lines, _, _ = check(data, capsys)
    assert lines["masks"] == "4 of 8 photographs have one; mean share excluded 50.0% of 3 looked at"


def test_a_damaged_photograph_is_counted_once():
    """The check of all files has found one, and reading any photograph raises its error from then on."""

    def get(index):
        if index > 3:
            raise ValueError("07.png: truncated")
        return torch.full((2, 2, 3), 90, dtype=torch.uint8)

    images = SimpleNamespace(prefetch=list, get=get, mask=lambda index: None)
    cameras = [Camera(f"{i:02d}.png", 4, 4, np.eye(3), np.eye(4)) for i in range(8)]
    nothing = np.zeros((0, 3))
    capture = SimpleNamespace(train=list(range(8)), cameras=cameras, points=nothing, colors=nothing)
    said = _exposure(_look(capture, images))
    assert said == "means of 4 photographs 90 to 90 of 255 (0.0 stops); 1 cannot be read: 07.png: truncated"


@pytest.mark.parametrize(("value", "what"), [(0, "black"), (255, "saturated")])
def test_a_black_or_saturated_picture_is_predicted(data, capsys, value, what):
    edit(data, lambda model: model.points.colors.fill(value))
    _, _, _, said = check(data, capsys)
    assert [text for text in said if f"the points' colours are {what}" in text]
    for path in (data / "images").glob("*.png"):
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), value, np.uint8))
    _, _, _, said = check(data, capsys)
    assert [text for text in said if f"photographs that were looked at are {what}" in text]


def test_twelve_bits_in_files_of_sixteen_are_named(data, capsys):
    for path in (data / "images").glob("*.png"):
        pixels = cv2.imread(str(path)).astype(np.uint16)
        cv2.imwrite(str(path), pixels * 257 // 16)
    _, _, _, said = check(data, capsys)
    assert [text for text in said if "are black, and so will" in text and "do 16 bits hold 12 or 10?" in text]


def said_of_colours(change="turned", wrong=(), points_like=None, behind=0):
    """Return the warnings; six cameras look straight down on a map, and a pixel is a unit of length."""
    random = np.random.default_rng(0)
    ground, k = smooth_image(150, 200, 5), np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1.0]])
    points = np.concatenate([random.uniform(0, [200, 150], (3000, 2)), np.zeros((3000, 1))], axis=1)
    colors = ground[points[:, 1].astype(int), points[:, 0].astype(int)] // 2 + 20  # another exposure
    if points_like is not None:
        colors[:] = points_like
    hidden = np.concatenate([random.uniform(0, [200, 150], (behind, 2)), np.full((behind, 1), 20)], axis=1)
    points = np.concatenate([points, hidden])
    colors = np.concatenate([colors, random.integers(0, 255, (behind, 3), dtype=np.uint8)])
    cameras, shown = [], []
    for i in range(6):
        left, top = 22 * i, 16 * i
        pose = np.eye(4)
        pose[:3, 3] = [-left - 32, -top - 24, 60]
        cameras.append(Camera(f"{i}.png", 64, 48, k, pose))
        image = ground[top : top + 48, left : left + 64]
        if i in wrong:
            image = {
                "another": ground[top : top + 48, left + 25 - 50 * (i > 4) :][:, :64],
                "turned": image[::-1, ::-1],
                "mirrored": image[:, ::-1],
                "cropped": cv2.resize(image[10:-10, 13:-13], (64, 48)),
            }[change]
        shown.append(torch.from_numpy(image.copy()))
    capture = Capture(cameras, points, colors, list(range(6)), [], 1.0)
    images = SimpleNamespace(prefetch=list, get=shown.__getitem__, mask=lambda index: None)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _warn_of_pictures(capture, _look(capture, images), 0.01)
    return [str(w.message) for w in caught if "other colours than the points" in str(w.message)]


@pytest.mark.parametrize("wrong", [(), (3,), range(6)])
@pytest.mark.parametrize("change", ["another", "turned", "mirrored", "cropped"])
def test_photographs_that_do_not_show_the_points_are_named(change, wrong):
    said = said_of_colours(change, wrong)
    assert len(said) == bool(wrong)
    if len(wrong) == 1:
        assert said[0].startswith("1 of 6 photographs") and "(first: 3.png)" in said[0]


def test_hidden_points_and_points_of_one_colour_make_no_photograph_wrong():
    assert not said_of_colours(points_like=(127, 127, 128))
    assert not said_of_colours(behind=12000)


def test_a_near_plane_beyond_the_points_is_predicted(data, capsys):
    _, _, _, said = check(data, capsys, "--model.near=3")
    assert any("views have all their points in front of the near plane" in text for text in said)


def test_points_of_another_world_stop_the_run(data, capsys, tmp_path):
    def move(model):
        model.points.positions += [1e5, 2e5, 3e5]

    edit(data, move)
    for flags in (["--check"], ["--out", str(tmp_path / "run")]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert main(["train", "--data", str(data), *flags, *FLAGS]) == 1
        shown = " ".join(capsys.readouterr().err.split())
        assert "8 of 8 views see none of the 400 points, so there is nothing to train" in shown
    assert not (tmp_path / "run").exists()


def test_views_that_see_no_random_point_ask_for_points():
    """As in a flight that looks straight down: parallel views do not meet anywhere."""
    about = SimpleNamespace(blind=3, random_points=True)
    capture = SimpleNamespace(cameras=[None] * 3, about=about, root="site")
    refused(HopelessCaptureError, "site has no points, .* put the points of the rec", check_worlds, capture)


def test_train_prints_the_block_before_it_trains_and_keeps_its_near_plane(data, capsys, tmp_path):
    assert main(["train", "--data", str(data), "--out", str(tmp_path / "run"), *FLAGS]) == 0
    shown = capsys.readouterr().out
    assert shown.index("photographs:") < shown.index("extent:") < shown.index("new run")
    assert 0 < load_config(tmp_path / "run" / "config.yaml").model.near <= 0.01


@pytest.mark.parametrize(("cache_bytes", "budget"), [(800_000, 250_000), (300_000, 150_000)])
def test_ranks_share_at_most_half_of_the_memory(capture, monkeypatch, cache_bytes, budget):
    monkeypatch.setattr(inputs, "host_bytes", lambda: 1_000_000)
    config = tiny_config(f"data.path={capture}", f"data.cache_bytes={cache_bytes}")
    _, images = inputs.open_capture(config, Ranks(local_world_size=2))
    assert images.compressed.budget == budget and images.decoded.budget == budget // 4 + budget


def test_ranks_whose_photographs_do_not_fit_get_a_hint(loaded, monkeypatch):
    size = inputs.size_of(inputs.decoded_shapes(loaded))
    monkeypatch.setattr(inputs, "host_bytes", lambda: 4 * size)
    assert inputs.sharing_hint(loaded, 2 * size, 2) is None
    assert inputs.sharing_hint(loaded, 2 * size - 2, 1) is None
    hint = inputs.sharing_hint(loaded, 2 * size - 2, 2)
    assert "each rank decodes the photographs for itself" in hint
    assert "--data.cache_bytes=1_000_000_000," in hint  # rounded up to whole gigabytes
    monkeypatch.setattr(inputs, "host_bytes", lambda: 4 * size - 4)
    assert inputs.sharing_hint(loaded, 2 * size - 2, 2) is None


def test_the_ranks_of_a_host_divide_the_search_for_damage(tmp_path):
    """Two hosts of two ranks: one rank of each host reads a file, and all ranks know what is wrong."""
    files = [(tmp_path / f"{index}.png", None) for index in range(5)]
    for index, (path, _) in enumerate(files):
        path.write_bytes(
            b"damaged" if index in (1, 4) else cv2.imencode(".png", np.ones((8, 8)))[1].tobytes()
        )

    class Rank(Ranks):
        found: ClassVar = []

        def all_gather_object(self, value):
            self.found.append(value)
            return self.found

    results = [
        inputs._damaged_of_share(Rank(rank=rank, world_size=4, local_world_size=2), files)
        for rank in range(4)
    ]
    assert [list(found) for found in Rank.found] == [[4], [1], [4], [1]]
    assert list(results[-1]) == [1, 4] and "1.png" in results[-1][1]


def capture_of(*cameras):
    return SimpleNamespace(cameras=list(cameras), train=list(range(len(cameras))))


@pytest.mark.parametrize(
    ("size", "downscale", "device", "flag"),
    [
        ((1600, 1200), 1, "cpu", None),
        ((5472, 3648), 1, "cpu", "--data.downscale=5"),
        ((2736, 1824), 2, "cpu", "--data.downscale=6"),
        ((4000, 3000), 1, "cuda", None),
        ((5472, 3648), 1, "cuda", "--data.downscale=3"),
    ],
)
def test_large_photographs_get_the_flag(size, downscale, device, flag):
    capture = capture_of(SimpleNamespace(width=size[0], height=size[1]))
    hint = large_images_hint(capture, downscale, device)
    assert hint is None if flag is None else flag in hint and f"{size[0]} x {size[1]}" in hint


@pytest.mark.parametrize(
    ("k1", "policy", "says"),
    [(0.0, "crop", None), (-0.3, "crop", "(data.undistort=mask keeps all"), (-0.3, "mask", "lenses are und")],
)
def test_undistortion_says_the_sizes(k1, policy, says):
    lens = Lens("SIMPLE_RADIAL", 400, 300, (250.0, 200.0, 150.0, k1))
    form = rectify(lens, policy)
    halved = SimpleNamespace(width=form.width // 2, height=form.height // 2, rectification=form)
    note = undistortion_note(capture_of(halved))
    if says is None:
        assert note is None
        return
    assert f"1 photographs from 400 x 300 to {form.width} x {form.height}" in note
    assert (says in note) or form.width * form.height >= 0.9 * 400 * 300


VIEWS = 7  # of the tiny capture, without the one that is held out


def config_of(*overrides):
    return load_config(None, overrides)


def test_the_memory_of_a_known_population_and_the_minutes(loaded):
    found = estimate(config_of("population.max_gaussians=400", "schedule.batch_size=2"), loaded, True, 2)
    row = 3 * 59 * 4 + 42 + 180 + 500  # 59 parameters with two moments, and the widest column once more
    assert found.gaussians == 400
    assert found.device_bytes == 400 * row + 2 * WIDTH * HEIGHT * 100
    assert found.host_bytes == 2_000_000_000 + 3 * VIEWS * WIDTH * HEIGHT
    flat = "population.max_gaussians=400", "schedule.batch_size=2", "model.sh_degree=0"
    fewer = found.device_bytes - estimate(config_of(*flat), loaded, True, 2).device_bytes
    assert fewer == 400 * (3 * 45 * 4 + 180 - 12)  # of the rest of SH, and a widest column of 3 values
    on_cpu = estimate(config_of("population.max_gaussians=400", "schedule.batch_size=2"), loaded, False, 2)
    assert on_cpu.device_bytes == 0
    assert on_cpu.host_bytes == 400_000_000 + 3 * VIEWS * WIDTH * HEIGHT + found.device_bytes
    minutes = [estimate(config_of(), loaded, False, cores).minutes for cores in (1, 4)]
    assert minutes[0] == pytest.approx(4 * minutes[1])
    assert estimate(config_of("schedule.minutes=7"), loaded, False, 2).minutes == 7


def test_growth_ends_at_the_limit_and_its_mean_is_over_images():
    times = {"iterations": 100, "densify_from": 10, "densify_until": 40, "densify_every": 10, "scale": 1.0}
    schedule = Schedule(dataclasses.replace(Config().schedule, **times, batch_size=1))
    assert [e.time for e in schedule.events(0, 100) if e.kind == "densify"] == [10, 20, 30]
    most, mean = _grown(100, 130, 0.2, 1.0, schedule)
    assert (most, mean) == (130, pytest.approx((10 * 100 + 10 * 120 + 80 * 130) / 100))
    assert _grown(100, 10**6, 0.2, 1.0, schedule)[0] == 172
    with_pass = Schedule(dataclasses.replace(Config().schedule, **times, batch_size=1, t1=0, t2=40))
    most, mean = _grown(100, 130, 0.2, 0.5, with_pass)
    assert (most, mean) == (130, pytest.approx((10 * 100 + 10 * 120 + 20 * 130 + 60 * 65) / 100))


@pytest.mark.parametrize(
    ("views", "said"), [(VIEWS, "400 Gaussians at most (200 in the end), "), (50, "400 Gaussians at most, ")]
)
def test_what_a_pass_keeps_is_said(loaded, views, said):
    passes = "population.importance=true", "population.pass2_keep=0.5", f"population.pass2_views={views}"
    assert said in str(estimate(config_of("population.max_gaussians=400", *passes), loaded, False, 2))
