# SPDX-License-Identifier: Apache-2.0
"""Schedules, and those whose pace changes during a run."""

import math
import random
from dataclasses import replace

import pytest
import torch

from blitzgs.config.fields import OptimiserConfig, ScheduleConfig
from blitzgs.config.schedule import Pace, Schedule, stretched
from blitzgs.optim.table_adam import TableAdam
from tests.training.tiny import assert_same_table, random_gaussians


def events_of(schedule):
    """Return kind and time of all events."""
    return [(event.kind, event.time) for event in schedule.events(0, schedule.iterations)]


def density_events(schedule):
    """Return the times of all density events."""
    return [time for kind, time in events_of(schedule) if kind == "densify"]


@pytest.mark.parametrize("scale", [0.1, 0.25, 1 / 3, 1.0, 2.0])
def test_one_field_scales_every_time(scale):
    config = ScheduleConfig(
        iterations=3_000,
        densify_from=50,
        densify_until=1_500,
        densify_every=10,
        size_prune_after=30,
        scale=scale,
    )
    schedule = Schedule(config)
    assert density_events(schedule) == sorted({math.floor(t * scale + 1e-6) for t in range(50, 1_500, 10)})
    assert schedule.steps == math.floor(3_000 * scale + 1e-6)
    pruned = math.floor(30 * scale + 1e-6)
    assert not schedule.prunes_by_size(pruned) and schedule.prunes_by_size(pruned + 1)


@pytest.mark.parametrize("scale", [0.1, 1.0, 2.0])
def test_the_resolution_rises_at_its_times(scale):
    config = ScheduleConfig(iterations=3_000, batch_size=4, resolution=((4, 100), (2, 902)), scale=scale)
    schedule = Schedule(config)
    for begin in range(0, schedule.iterations, 4):
        expected = 4 if begin < 100 * scale else 2 if begin < math.floor(902 * scale + 1e-6) else 1
        assert schedule.reduction(begin) == expected
    assert Schedule(ScheduleConfig()).reduction(0) == 1


@pytest.mark.parametrize(
    ("views", "minutes", "factor"), [(10, 0.0, 1.0), (45, 0.0, 3.0), (1_000, 0.0, 10.0), (45, 5.0, 1.0)]
)
def test_a_capture_of_many_views_gets_a_longer_schedule(views, minutes, factor):
    config = ScheduleConfig(iterations=3_000, images_per_view=200.0, minutes=minutes)
    longer = stretched(config, views)
    assert Schedule(longer).iterations == 3_000 * factor
    assert Schedule(stretched(ScheduleConfig(iterations=3_000), views)).iterations == 3_000
    # The run's own configuration holds the result: a resumed run is not stretched again.
    assert stretched(longer, views) == longer


@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_importance_passes_scale_and_follow_density_control(scale):
    config = ScheduleConfig(
        iterations=3_000, densify_from=500, densify_until=1_500, densify_every=100, t1=1_000, t2=1_600,
        scale=scale,
    )  # fmt: skip
    events, first = events_of(Schedule(config)), round(1_000 * scale)
    passes = [event for event in events if event[0].startswith("pass")]
    assert passes == [("pass_1", first), ("pass_2", round(1_600 * scale))]
    assert events[events.index(("pass_1", first)) - 1] == ("densify", first)
    assert not events_of(Schedule(ScheduleConfig(iterations=3_000, t1=0, t2=0, densify_from=4_000)))


def test_sh_degree_grows_in_the_step_that_contains_the_event():
    schedule = Schedule(ScheduleConfig(batch_size=4, sh_every=10))
    assert [schedule.sh_degree(begin, 3) for begin in (0, 4, 8, 12, 16, 20, 28, 40)] == [
        0, 0, 1, 1, 1, 2, 3, 3,
    ]  # fmt: skip
    # Where the degree practically never grows, the share of the first step is lost to rounding.
    assert Schedule(ScheduleConfig(sh_every=10**9)).sh_degree(0, 3) == 0


@pytest.mark.parametrize("pace", [(), ((100, 0.5), (200, 4.0))])
def test_learning_rates(pace):
    config = OptimiserConfig(final=0.1)
    times = ScheduleConfig(iterations=1_000, batch_size=4, densify_until=100, position_decay=500, pace=pace)
    schedule = Schedule(times)
    # With changes, 100 images more are the next 200 of the configuration, and 4 are one of the rest.
    assert schedule.iterations == (200 + 700 * 4 if pace else 1_000)
    table = schedule.learning_rates(config, extent=2.0).double()
    assert table.shape == (schedule.steps + 1, 6)
    assert not table[0].any()
    for step in (1, 2, 20, 38, 77, 126, 250):
        image = (step - 1) * 4
        time = image
        if pace and image > 100:
            time = 2 * image - 100 if image < 200 else 300 + (image - 200) / 4
        position = 2.0 * config.position * 0.01 ** min(time / 500, 1.0)
        share = 0.1 ** min(max(time - 100, 0) / 400, 1.0)
        colors = [config.sh_dc * share, config.sh_dc / 20 * share]
        others = [config.rotation * share, config.scale * share, config.opacity, *colors]
        expected = torch.tensor([position, *others]).double()
        torch.testing.assert_close(table[step], 2.0 * expected, rtol=1e-6, atol=0.0)


def test_opacities_are_reset_while_densifying_and_after_the_density_event_of_the_same_image():
    config = ScheduleConfig(
        iterations=3_000, densify_from=100, densify_until=1_500, densify_every=100, reset_every=500
    )
    schedule = Schedule(config)
    events = events_of(schedule)
    assert [time for kind, time in events if kind == "reset_opacities"] == [500, 1_000]
    assert events.index(("densify", 500)) + 1 == events.index(("reset_opacities", 500))
    assert schedule.gathers_statistics(1_499) and not schedule.gathers_statistics(1_500)


@pytest.mark.parametrize("scale", [0.37, 1.0, 3.3])
@pytest.mark.parametrize("until", [1_499, 1_500, 1_501])
def test_the_last_density_event_is_known(scale, until):
    config = ScheduleConfig(scale=scale, iterations=3_000, densify_until=until, densify_every=100)
    schedule = Schedule(config)
    times = density_events(schedule)
    assert [schedule.is_last_density_event(time) for time in times] == [*[False] * (len(times) - 1), True]


CHANGES = ((40, 0.5), (120, 2.5), (128, 0.01), (131, 3.0))


@pytest.mark.parametrize("scale", [1.0, 0.3, 4.0])
def test_times_and_images_are_those_of_a_walk_image_by_image(scale):
    pace, time = Pace(scale, CHANGES), 0.0
    for image in range(400):
        assert pace.time(image) == pytest.approx(time, rel=1e-12)
        assert pace.image(pace.time(image)) == pytest.approx(image, rel=1e-12)
        factor = ([1.0] + [f for begin, f in CHANGES if begin <= image])[-1]
        time += 1 / (scale * factor)
    images = torch.arange(400, dtype=torch.float64)
    expected = torch.tensor([pace.time(image) for image in range(400)], dtype=torch.float64)
    assert torch.equal(pace.times(images), expected)
    assert pace.image(math.inf) == math.inf and pace.scale == scale * 3.0


def phases_of(schedule, begin):
    """Return all properties of the step that begins with an image, except for events and rates."""
    return (
        schedule.sh_degree(begin, 3), schedule.reduction(begin), schedule.gathers_statistics(begin),
        schedule.has_spawn_gate(begin), schedule.prunes_by_size(begin),
    )  # fmt: skip


def test_a_change_of_pace_does_not_change_past_events():
    """A run that changes its pace at random has the events and rates of its last schedule."""
    chance = random.Random(3)
    for batch_size in (1, 4):
        config = ScheduleConfig(
            iterations=3_000, batch_size=batch_size, densify_from=50, densify_until=1_500, densify_every=40,
            reset_every=300, resolution=((4, 310), (2, 877)), t1=700, t2=1_600, sh_every=100, gate_from=900,
            size_prune_after=400, position_decay=2_500, evaluate_every=333,
        )  # fmt: skip
        optimiser = OptimiserConfig(final=0.1)
        schedule, happened, phases, step = Schedule(config), [], [], 0
        rates = schedule.learning_rates(optimiser, 2.0)
        while step < schedule.steps:
            begin, step = step * batch_size, step + 1
            phases.append(phases_of(schedule, begin))
            happened += schedule.events(begin, begin + batch_size)
            if step < schedule.steps and chance.random() < 0.05:
                pace = (*config.pace, (step * batch_size, math.exp(chance.uniform(-1.5, 1.0))))
                config = ScheduleConfig(**{**vars(config), "pace": pace})
                schedule = Schedule(config)
                before, rates = rates, schedule.learning_rates(optimiser, 2.0)
                assert torch.equal(rates[: step + 1], before[: step + 1])
                assert schedule.pace.image(schedule.pace.time(step * batch_size)) == step * batch_size
        assert len(config.pace) > 10
        assert happened == schedule.events(0, schedule.iterations)
        assert phases == [phases_of(schedule, i * batch_size) for i in range(schedule.steps)]
        assert len(set(phases)) > 5
        kinds = [event.kind for event in happened]
        assert kinds.count("pass_1") == kinds.count("pass_2") == 1
        # Two events at one image become one; no other event is lost.
        wanted = {math.floor(schedule.pace.image(time) + 1e-6) for time in range(50, 1_500, 40)}
        assert density_events(schedule) == sorted(wanted)


@pytest.mark.parametrize("factor", [0.1, 5.0])
def test_pending_steps_are_the_same_after_a_change_of_pace(factor):
    """They have the bits of an optimiser that knew the change from the beginning."""
    config, before = OptimiserConfig(), ScheduleConfig(iterations=200, position_decay=100)
    after = replace(before, pace=((60, factor),))
    tables, rates = [], []
    for known in (before, after):
        table, g = random_gaussians(200), torch.Generator().manual_seed(0)
        for first, second in zip(table.exp_avgs, table.exp_avg_sqs, strict=True):
            first.copy_(torch.randn(first.shape, generator=g))
            second.copy_(torch.rand(second.shape, generator=g) + 0.1)
        for name in ("last_step", "moment_step"):
            table[name].copy_(torch.arange(200) % 50 + 1)
        optimiser = TableAdam(config, Schedule(known), 3.0, "cpu")
        rates.append(optimiser.position_rate(70))
        # Some rows are caught up in between, the others are not.
        optimiser.catch_up(table, torch.arange(0, 200, 3, dtype=torch.int32), 55)
        optimiser.follow(Schedule(after))
        optimiser.catch_up(table, None, 70)
        assert optimiser.position_rate(70) == Schedule(after).learning_rates(config, 3.0)[70, 0].item()
        tables.append(table)
    assert rates[0] != rates[1]
    assert_same_table(*tables)


@pytest.mark.parametrize("pace", [(), ((300, 0.1), (700, 4.0))])
def test_every_phase_begins_at_its_own_time(pace):
    config = ScheduleConfig(sh_every=100, densify_until=600, gate_from=500, size_prune_after=450, pace=pace)
    schedule = Schedule(config)
    plain = Schedule(replace(config, pace=()))
    for time in range(10, 4_000, 10):
        image = schedule.pace.image(time)
        # Avoid the image at which rounding decides.
        for shift in (-2, 2):
            assert (
                phases_of(schedule, round(image) + shift)[1:]
                == phases_of(plain, schedule.pace.time(round(image) + shift))[1:]
            )
