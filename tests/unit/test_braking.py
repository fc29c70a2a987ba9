"""Whether a drive carries out a stop that it has confirmed, from readings."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from ldcnd.axis.course import Braking, Pace
from ldcnd.axis.rest import Comparison
from ldcnd.drives.driver import AxisReading, StopMode
from tests.support.axis_bench import AT_REST

RESOLUTION = 2000.0
"""A count per servo cycle: what a status packet shows of a velocity is a multiple of it."""
EVERY_S = 0.05
WITHIN_S = 120.0


def shown(counts: float, speed: float) -> AxisReading:
    return replace(
        AT_REST,
        enabled=True,
        position_counts=round(counts),
        velocity_counts_per_s=speed // RESOLUTION * RESOLUTION,
        velocity_resolution_counts_per_s=RESOLUTION,
    )


def verdict(braking: Braking, shaft: Callable[[float], tuple[float, float]]) -> tuple[bool, float]:
    """Return how a stop ends on a shaft, whose place and speed are a function of the time, and when."""
    at_s = EVERY_S
    while at_s < WITHIN_S:
        seen = braking.observe(shown(*shaft(at_s)), at_s)
        if isinstance(seen, Comparison):
            return seen, at_s
        braking, at_s = seen, at_s + EVERY_S
    raise AssertionError(braking)


def slowing(speed: float, deceleration: float, lag_s: float = 0.02) -> Callable[[float], tuple[float, float]]:
    """Return a shaft that brakes, behind its profile by a lag."""

    def shaft(at_s: float) -> tuple[float, float]:
        at_s = min(max(at_s - lag_s, 0.0), speed / deceleration)
        return speed * at_s - deceleration * at_s**2 / 2, speed - deceleration * at_s

    return shaft


@pytest.mark.parametrize("braking_s", [0.1, 1.0, 10.0, 60.0])
@pytest.mark.parametrize("speed", [300.0, 10_000.0, 200_000.0])
def test_a_shaft_that_brakes_has_heard_however_long_it_takes(speed: float, braking_s: float):
    deceleration = speed / braking_s

    seen, at_s = verdict(Braking(StopMode.SMOOTH, 0.0, deceleration), slowing(speed, deceleration))

    assert seen is Comparison.AS_TOLD
    assert at_s < braking_s + 1


@pytest.mark.parametrize("braking_s", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("speed", [3000.0, 10_000.0, 200_000.0])
def test_a_shaft_that_runs_on_has_not_heard_about_when_it_should_stand(speed: float, braking_s: float):
    seen, at_s = verdict(Braking(StopMode.SMOOTH, 0.0, speed / braking_s), lambda at_s: (speed * at_s, speed))

    assert seen is Comparison.NOT_AS_TOLD
    assert at_s < 1.2 * braking_s + 1.5


@pytest.mark.parametrize("mode", [StopMode.SMOOTH, StopMode.ABRUPT])
def test_a_shaft_that_creeps_on_below_what_a_velocity_can_show_has_not_heard(mode: StopMode):
    seen, _ = verdict(Braking(mode, 0.0, 40_000.0), lambda at_s: (100 * at_s, 100))

    assert seen is Comparison.NOT_AS_TOLD


def test_a_shaft_whose_deceleration_is_not_known_has_a_second():
    seen, at_s = verdict(Braking(StopMode.SMOOTH, 0.0), lambda at_s: (10_000 * at_s, 10_000))

    assert seen is Comparison.NOT_AS_TOLD
    assert 1 < at_s < 2


def test_an_abrupt_stop_is_not_given_the_way_of_a_smooth_one():
    seen, at_s = verdict(Braking(StopMode.ABRUPT, 0.0, 5000.0), lambda at_s: (50_000 * at_s, 50_000))

    assert seen is Comparison.NOT_AS_TOLD
    assert at_s < 0.3


def test_a_motor_that_is_off_coasts_as_long_as_it_likes():
    off = replace(shown(0, 90_000), enabled=False)

    assert Braking(StopMode.OFF, 0.0).observe(off, 1.0) is Comparison.AS_TOLD
    assert Braking(StopMode.SMOOTH, 0.0, 1000.0).observe(off, 1.0) is Comparison.AS_TOLD


def test_a_loop_that_is_still_closed_was_not_switched_off():
    assert Braking(StopMode.OFF, 0.0).observe(shown(0, 0), 0.01) is Comparison.NOT_AS_TOLD


def test_a_reading_from_before_the_stop_says_nothing():
    braking = Braking(StopMode.OFF, 5.0)

    assert braking.observe(shown(0, 0), 4.99) is braking


TOLD, FAST = Comparison.AS_TOLD, Comparison.NOT_AS_TOLD
PACES = [
    ("as slow as it was told", [(1.0, 0.0), (1.1, 0.0), (1.22, 0.0)], 1000.0, [None, None, TOLD]),
    ("twice as fast", [(1.0, 0.0), (1.1, 0.0), (1.22, 0.0)], 2000.0, [None, None, FAST]),
    ("the second request waits behind its instant", [(1.0, 0.0), (1.3, 3.0), (4.4, 0.0)], 1000.0, [None, None, TOLD]),
    ("the first one does", [(1.0, 3.0), (4.1, 0.0), (4.3, 0.0), (9.0, 0.0)], 2000.0, [None, None, None, FAST]),
]


@pytest.mark.parametrize(("_what", "asked", "speed", "found"), PACES, ids=[each[0] for each in PACES])
def test_a_shaft_counts_as_too_fast_only_if_it_is_so_at_whatever_instant_it_was_read(_what, asked, speed, found):
    """Each reading is requested at an instant, and is of some seconds later where the machine stood still."""
    pace, shown_of = Pace(1000.0, from_s=0.5), []
    for at_s, waits_s in asked:
        true_s = at_s + waits_s
        seen = pace.observe(shown(speed * true_s, speed), at_s, true_s + 0.005)
        shown_of.append(seen if isinstance(seen, Comparison) else None)
        pace = seen if isinstance(seen, Pace) else pace

    assert shown_of == found
