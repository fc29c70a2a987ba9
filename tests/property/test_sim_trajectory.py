"""Properties of every trapezoidal move."""

from hypothesis import given, settings
from hypothesis import strategies as st

from ldcnd.sim.ldcn.trajectory import ProfileGenerator

ONE = 1 << 16


@settings(max_examples=150, deadline=None)
@given(
    counts=st.integers(-20_000, 20_000),
    speed=st.integers(ONE // 4, 60 * ONE),
    acceleration=st.integers(200, 8 * ONE),
)
def test_every_move_keeps_its_limits_and_ends_exactly_on_its_goal(counts, speed, acceleration):
    profiler = ProfileGenerator()
    profiler.go_to(counts, speed, acceleration)

    ticks, before = 0, 0
    while not profiler.done:
        profiler.step()
        ticks += 1
        assert abs(profiler.velocity) <= speed
        assert abs(profiler.velocity - before) <= acceleration
        before = profiler.velocity

    way = abs(counts) * ONE
    ideal = way / speed + speed / acceleration if way >= speed**2 / acceleration else 2 * (way / acceleration) ** 0.5
    assert profiler.position == counts * ONE
    assert profiler.at_rest
    assert ticks <= ideal + 4


@settings(max_examples=100, deadline=None)
@given(
    velocities=st.lists(st.integers(-30 * ONE, 30 * ONE), min_size=1, max_size=4), acceleration=st.integers(1, 10 * ONE)
)
def test_velocity_mode_integrates_its_velocity(velocities, acceleration):
    profiler = ProfileGenerator()

    travelled = 0
    for goal in velocities:
        profiler.run_at(goal, acceleration)
        for _ in range(50):
            before = profiler.velocity
            profiler.step()
            travelled += profiler.velocity
            assert abs(profiler.velocity - before) <= acceleration
            assert profiler.done == (profiler.velocity == goal)

    assert profiler.position == travelled


CHANGE = st.tuples(st.integers(-3000, 3000), st.integers(ONE // 4, 30 * ONE), st.integers(1, 300))
"""A goal, a velocity, and for how many ticks they are in force."""


@settings(max_examples=60, deadline=None)
@given(changes=st.lists(CHANGE, min_size=1, max_size=6), acceleration=st.integers(500, 4 * ONE))
def test_goal_and_velocity_may_change_at_any_time_and_the_limits_are_kept(changes, acceleration):
    """Every change begins with the velocity that is there; one above the new limit is only ever brought down."""
    profiler = ProfileGenerator()

    for counts, speed, ticks in changes:
        profiler.go_to(counts, speed, acceleration, from_velocity=True)
        for _ in range(ticks):
            before = profiler.velocity
            profiler.step()
            assert abs(profiler.velocity - before) <= acceleration
            assert abs(profiler.velocity) <= max(speed, abs(before) - min(acceleration, abs(before)))
    for _ in range(200_000):
        if profiler.done:
            break
        profiler.step()

    assert profiler.at_rest
    assert profiler.position == changes[-1][0] * ONE
