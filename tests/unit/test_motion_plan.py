import pytest

from ldcnd.axis.trapezoid import braking_way, duration_from_s, profile_duration_s


def test_a_long_move_is_a_trapezoid():
    assert profile_duration_s(100, 10, 20) == pytest.approx(100 / 10 + 10 / 20)


def test_a_short_move_is_a_triangle():
    assert profile_duration_s(1, 10, 4) == pytest.approx(2 * (1 / 4) ** 0.5)


def test_the_two_meet_where_the_velocity_is_just_reached():
    distance = 10 * 10 / 20

    assert profile_duration_s(distance, 10, 20) == pytest.approx(2 * (distance / 20) ** 0.5)


def test_no_distance_takes_no_time():
    assert profile_duration_s(0, 10, 20) == 0


@pytest.mark.parametrize("before", [0.0, 3.0, 10.0, 25.0, -4.0])
@pytest.mark.parametrize("way", [0.5, 20.0, 200.0])
def test_a_profile_from_a_velocity_takes_as_long_as_its_parts(before, way):
    """Walked through in small steps, as a drive does: it slows down where the rest of its way needs that."""
    place, velocity, passed_s, step_s = 0.0, before, 0.0, 1e-3
    while abs(way - place) > 0.02 or abs(velocity) > 0.2:
        left = way - place
        brakes = velocity * left > 0 and braking_way(velocity, 20.0) >= abs(left)
        wanted = 0.0 if brakes or velocity * left < 0 else 10.0 if left > 0 else -10.0
        change = max(-20.0 * step_s, min(20.0 * step_s, wanted - velocity))
        velocity += change
        place += velocity * step_s
        passed_s += step_s
        assert passed_s < 60

    assert duration_from_s(way, before, 10.0, 20.0) == pytest.approx(passed_s, abs=0.15)
