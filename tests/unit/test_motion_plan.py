import pytest

from ldcnd.axis.motion import profile_duration_s


def test_a_long_move_is_a_trapezoid():
    assert profile_duration_s(100, 10, 20) == pytest.approx(100 / 10 + 10 / 20)


def test_a_short_move_is_a_triangle():
    assert profile_duration_s(1, 10, 4) == pytest.approx(2 * (1 / 4) ** 0.5)


def test_the_two_meet_where_the_velocity_is_just_reached():
    distance = 10 * 10 / 20

    assert profile_duration_s(distance, 10, 20) == pytest.approx(2 * (distance / 20) ** 0.5)


def test_no_distance_takes_no_time():
    assert profile_duration_s(0, 10, 20) == 0
