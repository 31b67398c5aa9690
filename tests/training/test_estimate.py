# SPDX-License-Identifier: Apache-2.0
"""What `--check` says of memory and time."""

import dataclasses

import pytest

from blitzgs.capture.capture import load_capture
from blitzgs.config.fields import Config
from blitzgs.config.files import load_config
from blitzgs.config.recipes import recipe_path
from blitzgs.config.schedule import Schedule
from blitzgs.training.estimate import _grown, estimate
from tests.training.tiny import HEIGHT, WIDTH, write_tiny_capture

VIEWS = 7  # of the tiny capture, without the one that is held out


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_tiny_capture(folder)
    return load_capture(folder)


def config_of(*overrides):
    return load_config(None, [f"{text}" for text in overrides])


def test_the_memory_of_a_known_population(capture):
    found = estimate(config_of("population.max_gaussians=400", "schedule.batch_size=2"), capture, True, 2)
    row = 3 * 59 * 4 + 42 + 180 + 500  # 59 parameters with two moments, and the widest column once more
    assert found.gaussians == 400
    assert found.device_bytes == 400 * row + 2 * WIDTH * HEIGHT * 100
    assert found.host_bytes == 2_000_000_000 + 3 * VIEWS * WIDTH * HEIGHT
    on_cpu = estimate(config_of("population.max_gaussians=400", "schedule.batch_size=2"), capture, False, 2)
    assert on_cpu.device_bytes == 0
    assert on_cpu.host_bytes == 400_000_000 + 3 * VIEWS * WIDTH * HEIGHT + found.device_bytes


def test_a_lower_degree_takes_less(capture):
    few, many = (
        estimate(config_of("population.max_gaussians=400", f"model.sh_degree={degree}"), capture, True, 2)
        for degree in (0, 3)
    )
    assert many.device_bytes - few.device_bytes == 400 * (3 * 45 * 4 + 180 - 12)


def test_minutes_are_those_that_were_asked_for(capture):
    assert estimate(config_of("schedule.minutes=7"), capture, False, 2).minutes == 7
    one, four = (estimate(config_of(), capture, False, cores).minutes for cores in (1, 4))
    assert one == pytest.approx(4 * four)


def test_growth_ends_at_the_limit_and_its_mean_is_over_images():
    times = {"iterations": 100, "densify_from": 10, "densify_until": 40, "densify_every": 10, "scale": 1.0}
    schedule = Schedule(dataclasses.replace(Config().schedule, **times, batch_size=1))
    assert [e.time for e in schedule.events(0, 100) if e.kind == "densify"] == [10, 20, 30]
    most, mean = _grown(100, 130, 0.2, schedule)
    assert (most, mean) == (130, pytest.approx((10 * 100 + 10 * 120 + 80 * 130) / 100))
    assert _grown(100, 10**6, 0.2, schedule)[0] == 172


def test_the_recipes_limit_the_population(capture):
    found = estimate(load_config(recipe_path("smoke"), []), capture, False, 2)
    assert len(capture.points) <= found.gaussians <= 100_000
