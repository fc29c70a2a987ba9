"""Polylines in points: what the axes are asked for, and what is said of the way they take."""

import random
from itertools import accumulate

import pytest

from ldcnd.axis.polyline import ROUNDING_COUNTS, PathAxis, walk
from ldcnd.contract.errors import ValueOutOfRange

PERIOD_S, CYCLE_S = 0.01, 0.0005
UNIT = 1000.0


def axis(*corners: float, velocity: float = 20_000.0, acceleration: float = 100_000.0) -> PathAxis:
    return PathAxis(corners, UNIT, velocity, acceleration)


def changes(steps: tuple[int, ...]) -> list[int]:
    """Return by how much the way in a period changes from one period to the next, at the ends from rest."""
    return [abs(after - before) for before, after in zip((0, *steps), (*steps, 0), strict=True)]


def test_a_straight_way_takes_as_long_as_a_trapezoid_at_the_share_of_the_acceleration_that_is_not_for_turning():
    planned = walk({"x": axis(0, 20_000)}, PERIOD_S, CYCLE_S)

    ramp_s = 20_000 / 50_000
    assert planned.duration_s == pytest.approx(20_000 / 20_000 + ramp_s, abs=PERIOD_S)
    assert sum(planned.steps["x"]) == 20_000
    assert max(changes(planned.steps["x"])) <= 50_000 * PERIOD_S**2 + ROUNDING_COUNTS


@pytest.mark.parametrize("short", [50, 200, 1000])
def test_a_short_leg_is_left_no_faster_than_its_length_allows(short):
    # along one line there is nothing to turn for: only the end of the short leg, and the acceleration, bound the speed
    there = walk({"x": axis(0, short, 20_000)}, PERIOD_S, CYCLE_S)
    back = walk({"x": axis(0, 20_000 - short, 20_000)}, PERIOD_S, CYCLE_S)
    whole = walk({"x": axis(0, 20_000)}, PERIOD_S, CYCLE_S)

    for planned in (there, back):
        assert planned.duration_s == pytest.approx(whole.duration_s, abs=2 * PERIOD_S)
        assert max(changes(planned.steps["x"])) <= 50_000 * PERIOD_S**2 + ROUNDING_COUNTS


def test_the_deviation_has_what_a_servo_cycle_between_the_starts_makes_and_the_rounding():
    planned = walk({"x": axis(0, 20_000)}, PERIOD_S, CYCLE_S)

    assert planned.deviation == pytest.approx(20_000 / UNIT * CYCLE_S + 0.5 / UNIT)


def test_a_corner_between_two_points_is_cut_by_what_is_said():
    corners = ((0, 0), (5003, 0), (5003, 4001))
    planned = walk({"x": axis(*(x for x, _ in corners)), "y": axis(*(y for _, y in corners))}, PERIOD_S, CYCLE_S)

    points = zip(*(accumulate(planned.steps[name]) for name in "xy"), strict=True)
    off = max(min(abs(y) if x <= 5003 else UNIT, abs(x - 5003) if y >= 0 else UNIT) for x, y in points)
    assert off / UNIT <= planned.deviation
    assert [sum(planned.steps[name]) for name in "xy"] == [5003, 4001]


def test_a_path_that_turns_at_every_point_is_refused_however_slowly_it_is_walked():
    dice = random.Random(1)
    ways = [(17 * (at % 2), 17 * at * dice.choice((0, 1))) for at in range(100)]
    sharp = {"velocity": 300_000.0, "acceleration": 300_000.0}

    with pytest.raises(ValueOutOfRange, match="turns too sharply") as refused:
        walk(
            {"x": axis(*(x for x, _ in ways), **sharp), "y": axis(*(y for _, y in ways), **sharp)},
            0.0169,
            CYCLE_S,
        )
    assert refused.value.value == len(ways)
