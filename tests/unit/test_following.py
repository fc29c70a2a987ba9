"""Whether an encoder counts while its profile goes on, by values alone: what friction explains, what it does not."""

import math
from dataclasses import replace

import pytest

from ldcnd.axis.following import PUSHES_S, Following, Leeway, Push, RunningProfile, Sighting
from ldcnd.drives.driver import AxisReading

TARGET = 10_000
CYCLE_S = 0.000512
PUSH = Push(kp=350, ki=400, most_sum=256 * 400, half=256 * 125, cycle_s=CYCLE_S)
LEEWAY = Leeway(least_counts=30.0, held_counts=15.0, sticks_counts=240.0, push=PUSH, faults=False, coasts=False)
READING = AxisReading(
    position_counts=TARGET, following_error_counts=None, velocity_counts_per_s=0.0,
    velocity_resolution_counts_per_s=1953.0, adc_counts=None, enabled=True, profile_done=True, homing=False, faults=(),
    reverse_limit=False, forward_limit=False,
)  # fmt: skip


def stands(short: int, leeway: Leeway = LEEWAY, *, tells_error: bool = False) -> Following:
    """Return a shaft that was seen to come to a place short of its target at instant 0."""
    seen = Sighting(0.0, 0.0, TARGET - short, TARGET - short, counted=True, error_counts=short if tells_error else None)
    return Following("c", RunningProfile(20_000.0, 200_000.0, 200_000.0, float(TARGET), -1.0), leeway, seen)


@pytest.mark.parametrize(
    ("short", "for_s", "parted"),
    [
        (5, 60.0, False),  # a loop hunts by as much
        (60, 0.05, False),  # it needs a moment to get going
        (60, 0.2, False),
        (60, 0.8, True),  # its integral has grown to half of the output
        (150, PUSHES_S, True),  # half of the output by the gain alone
        (250, PUSHES_S, True),
    ],
)
def test_a_shaft_has_parted_once_half_of_the_output_has_not_moved_it(short, for_s, parted):
    assert stands(short).has_parted(for_s, short) is parted


@pytest.mark.parametrize("leeway", [replace(LEEWAY, push=None, sticks_counts=math.inf)])
def test_what_may_be_stopped_by_what_it_meets_has_never_parted(leeway):
    assert not stands(5000, leeway).has_parted(60.0, 5000)


def test_without_gains_only_a_lag_of_many_windows_tells():
    leeway = replace(LEEWAY, push=None)

    assert not stands(239, leeway).has_parted(60.0, 239)
    assert stands(240, leeway).has_parted(60.0, 240)


@pytest.mark.parametrize(
    ("error", "told", "short"), [(80, True, 80), (0, True, 0), (None, True, None), (None, False, 80)]
)
def test_how_short_a_shaft_stands_is_what_place_and_drive_agree_on(error, told, short):
    """A drive that another program has stopped elsewhere tells no error there; most tell it in each second reading."""
    reading = replace(READING, position_counts=TARGET - 80, following_error_counts=error)

    assert stands(80, tells_error=told).short_counts(reading, TARGET) == short


@pytest.mark.parametrize(
    ("beyond", "velocity", "for_s", "swings"),
    [
        (100, 3000.0, 0.3, False),  # friction lets go
        (300, 3000.0, 0.3, True),
        (-10, 30_000.0, 0.3, True),
        (300, 30_000.0, 0.05, False),  # it has not stood
    ],
)
def test_a_shaft_that_stood_and_swings_farther_or_faster_than_friction_lets_it_makes_up_for_counts(
    beyond, velocity, for_s, swings
):
    reading = replace(READING, position_counts=TARGET + beyond, velocity_counts_per_s=velocity)

    assert stands(20).swings_past(reading, for_s, TARGET) is swings
