# SPDX-License-Identifier: Apache-2.0
import math
import re

import pytest
import torch

from blitzgs.config.fields import OptimiserConfig, ScheduleConfig
from blitzgs.config.files import ConfigError, load_config
from blitzgs.config.schedule import Schedule, stretched


def all_events(config):
    schedule = Schedule(config)
    steps = [
        schedule.events(step * schedule.batch_size, (step + 1) * schedule.batch_size)
        for step in range(schedule.steps)
    ]
    return schedule, steps


def test_paper_schedule_densifies_thirty_times_and_last_at_31000():
    config = ScheduleConfig(
        iterations=90_000, batch_size=4, densify_from=2_000, densify_until=32_000, densify_every=1_000
    )
    schedule, steps = all_events(config)
    times = [event.time for step in steps for event in step if event.kind == "densify"]
    assert times == list(range(2_000, 32_000, 1_000))
    assert schedule.steps == 22_500
    for step, events in enumerate(steps):
        assert all(4 * step <= event.time < 4 * step + 4 for event in events)


@pytest.mark.parametrize("scale", [0.1, 0.25, 1 / 3, 2.0])
def test_one_field_scales_every_time(scale):
    config = ScheduleConfig(
        iterations=3_000, densify_from=50, densify_until=1_500, densify_every=10, scale=scale
    )
    schedule, steps = all_events(config)
    times = [event.time for step in steps for event in step if event.kind == "densify"]
    expected = sorted({math.floor(t * scale + 1e-6) for t in range(50, 1_500, 10)})
    assert times == expected
    assert schedule.steps == math.floor(3_000 * scale + 1e-6)


@pytest.mark.parametrize("scale", [0.1, 1.0, 2.0])
def test_the_resolution_rises_at_its_times(scale):
    config = ScheduleConfig(iterations=3_000, batch_size=4, resolution=((4, 100), (2, 902)), scale=scale)
    schedule = Schedule(config)
    for begin in range(0, schedule.iterations, 4):
        expected = 4 if begin < 100 * scale else 2 if begin < math.floor(902 * scale + 1e-6) else 1
        assert schedule.reduction(begin) == expected
    assert Schedule(ScheduleConfig()).reduction(0) == 1


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[[3, 100]]", "factors must be 8, 4 or 2 and decrease, got [3]"),
        ("[[2, 100], [4, 200]]", "factors must be 8, 4 or 2 and decrease, got [2, 4]"),
        ("[[4, 200], [2, 200]]", "times must increase, got [200, 200]"),
        ("[[2, 0]]", "must be in [1, 1,000,000,000], got ((2, 0),)"),
        ("[2, 100]", "[0]: must be a list of 2 values, got 2"),
    ],
)
def test_a_resolution_that_cannot_be_is_refused(value, message):
    with pytest.raises(ConfigError, match=r"schedule\.resolution.*" + re.escape(message)):
        load_config(None, [f"schedule.resolution={value}"])


@pytest.mark.parametrize(
    ("views", "minutes", "factor"), [(10, 0.0, 1.0), (45, 0.0, 3.0), (1_000, 0.0, 4.0), (45, 5.0, 1.0)]
)
def test_a_capture_of_many_views_gets_a_longer_schedule(views, minutes, factor):
    config = ScheduleConfig(iterations=3_000, images_per_view=200.0, minutes=minutes)
    longer = stretched(config, views)
    assert Schedule(longer).iterations == 3_000 * factor
    assert Schedule(stretched(ScheduleConfig(iterations=3_000), views)).iterations == 3_000
    # The run's own configuration holds the result: a resumed run is not stretched again.
    assert stretched(longer, views) == longer


def test_events_do_not_depend_on_how_the_run_is_cut():
    config = ScheduleConfig(
        iterations=400, densify_from=20, densify_until=300, densify_every=7, evaluate_every=50
    )
    schedule = Schedule(config)
    whole = schedule.events(0, 400)
    pieces = [event for begin in range(0, 400, 3) for event in schedule.events(begin, min(begin + 3, 400))]
    assert pieces == whole
    assert [event.kind for event in whole if event.time == 50] == ["evaluate"]


@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_importance_passes_scale_and_follow_density_control(scale):
    config = ScheduleConfig(
        iterations=3_000,
        densify_from=500,
        densify_until=1_500,
        densify_every=100,
        t1=1_000,
        t2=1_600,
        scale=scale,
    )
    _, steps = all_events(config)
    events = [(event.kind, event.time) for step in steps for event in step]
    assert (
        events.count(("pass_1", round(1_000 * scale))) == events.count(("pass_2", round(1_600 * scale))) == 1
    )
    assert [kind for kind, _ in events].count("pass_1") == [kind for kind, _ in events].count("pass_2") == 1
    at = events.index(("pass_1", round(1_000 * scale)))
    assert events[at - 1] == ("densify", round(1_000 * scale))
    none = ScheduleConfig(iterations=3_000, t1=0, t2=0, densify_from=4_000)
    assert not any(step for step in all_events(none)[1])


def test_sh_degree_grows_in_the_step_that_contains_the_event():
    schedule = Schedule(ScheduleConfig(batch_size=4, sh_every=10))
    assert [schedule.sh_degree(begin, 3) for begin in (0, 4, 8, 12, 16, 20, 28, 40)] == [
        0,
        0,
        1,
        1,
        1,
        2,
        3,
        3,
    ]
    # Where the degree practically never grows, the share of the first step is lost to rounding.
    assert Schedule(ScheduleConfig(sh_every=10**9)).sh_degree(0, 3) == 0


def test_size_pruning_starts_after_its_time():
    schedule = Schedule(ScheduleConfig(size_prune_after=3_000, scale=0.5))
    assert not schedule.prunes_by_size(1_500)
    assert schedule.prunes_by_size(1_501)


def test_learning_rates():
    config = OptimiserConfig(final=0.1)
    times = ScheduleConfig(iterations=1_000, batch_size=4, densify_until=100, position_decay=500)
    schedule = Schedule(times)
    table = schedule.learning_rates(config, extent=2.0).double()
    assert table.shape == (251, 6)
    assert not table[0].any()
    for step in (1, 2, 77, 126, 250):
        fraction = min((step - 1) * 4 / 500, 1.0)
        position = 2.0 * math.exp(
            (1 - fraction) * math.log(config.position) + fraction * math.log(config.position_final)
        )
        share = 0.1 ** min(max((step - 1) * 4 - 100, 0) / 400, 1.0)
        colors = [config.sh_dc * share, config.sh_rest * share]
        others = [config.rotation * share, config.scale * share, config.opacity, *colors]
        expected = torch.tensor([position, *others]).double()
        torch.testing.assert_close(table[step], 2.0 * expected, rtol=1e-6, atol=0.0)


def test_positions_can_stand_still():
    schedule = Schedule(ScheduleConfig(iterations=100))
    table = schedule.learning_rates(OptimiserConfig(position=0.0), extent=2.0)
    assert not table[:, 0].any() and table[1:, 1:].all()


def test_opacities_are_reset_while_densifying_and_after_the_density_event_of_the_same_image():
    config = ScheduleConfig(
        iterations=3_000, densify_from=100, densify_until=1_500, densify_every=100, reset_every=500
    )
    _, steps = all_events(config)
    events = [(event.time, event.kind) for step in steps for event in step]
    assert [time for time, kind in events if kind == "reset_opacities"] == [500, 1_000]
    assert events.index((500, "densify")) + 1 == events.index((500, "reset_opacities"))
    schedule = Schedule(config)
    assert schedule.gathers_statistics(1_499) and not schedule.gathers_statistics(1_500)
