"""Lines of several drives: equal durations, limits kept, and how far from straight they are."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ldcnd.axis.straight import LineAxis, Trapezoid, deviation_of, straight_line
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.trajectory import quantised

CYCLE_S = 0.000512


def axis(target, velocity=20_000.0, acceleration=100_000.0, divisor=1, begin=0):
    profile = PROFILES["ls-182ap"]
    return LineAxis(
        begin, target, 1000.0, velocity, acceleration, lambda motion: quantised(motion, divisor, profile), CYCLE_S
    )


def durations(line, axes):
    return [
        Trapezoid(axes[name].way, motion.velocity_counts_per_s, motion.acceleration_counts_per_s2).duration_s
        for name, motion in line.motions.items()
        if axes[name].way
    ]


def test_two_axes_of_different_ways_last_equally_long():
    axes = {"x": axis(40_000), "y": axis(-10_000)}
    line = straight_line(axes)

    assert durations(line, axes) == pytest.approx([line.duration_s] * 2, rel=1e-4)
    assert line.motions["y"].target_counts == -10_000
    assert line.deviation < 0.03  # mm, of 41 mm at 20 mm/s


def test_an_axis_that_stays_keeps_its_place():
    line = straight_line({"x": axis(40_000), "y": axis(500, begin=500)})

    assert line.motions["y"].target_counts == 500
    assert line.deviation == pytest.approx(0.001)  # a count


def test_without_common_ramps_the_deviation_is_that_of_the_ramps():
    fast, slow = Trapezoid(40.0, 20.0, 100.0), Trapezoid(10.0, 5.0, 100.0)

    assert deviation_of([fast, slow]) > 0.1


@example([0, 0], 100.0, 1000.0, 2)  # axes that stay, with a limit between two values of their registers
@given(
    st.lists(st.integers(-500_000, 500_000), min_size=2, max_size=4),
    st.floats(100, 100_000),
    st.floats(1_000, 1_000_000),
    st.sampled_from([1, 2, 3]),
)
@pytest.mark.long
def test_limits_are_kept_and_the_longest_way_is_hardly_left(ways, velocity, acceleration, divisor):
    axes = {str(at): axis(way, velocity, acceleration, divisor) for at, way in enumerate(ways)}
    line = straight_line(axes)

    for name, motion in line.motions.items():
        step = 1 / 0.017179869184 / divisor**2
        assert motion.velocity_counts_per_s <= velocity * 1.001 + 1
        assert motion.acceleration_counts_per_s2 <= max(acceleration, step) * 1.001
        assert motion.target_counts == axes[name].target_counts
    assert line.deviation <= (math.hypot(*ways) + len(ways)) / 1000.0
