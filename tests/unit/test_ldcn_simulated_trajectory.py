"""The profile generator, tick by tick, in 16.16 arithmetic."""

import pytest

from ldcnd.sim.ldcn.trajectory import ProfileGenerator

ONE = 1 << 16


def moved(counts, speed, acceleration, *, most_ticks=100_000):
    """Run a trapezoidal move; return the velocity of every tick."""
    profiler = ProfileGenerator()
    profiler.go_to(counts, speed, acceleration)
    velocities = []
    while not profiler.done:
        profiler.step()
        velocities.append(profiler.velocity)
        assert len(velocities) <= most_ticks
    assert profiler.position == counts * ONE
    return velocities


def test_trapezoid_accelerates_slews_and_decelerates_exactly():
    velocities = moved(100, 2 * ONE, ONE // 4)  # 8 ticks up, slew, 8 ticks down

    up = [ONE // 4 * tick for tick in range(1, 8)]
    assert velocities[:7] == up
    assert velocities[-8:] == [*reversed(up), 0]
    assert set(velocities[7:-8]) == {2 * ONE}


def test_command_position_while_accelerating_is_the_sum_of_the_velocities():
    profiler = ProfileGenerator()
    profiler.go_to(10_000, 67_109 * 4, 137)

    for tick in range(1, 500):
        profiler.step()
        assert profiler.position == 137 * tick * (tick + 1) // 2


def test_negative_move_mirrors_the_positive_one():
    assert moved(-1234, 50_000, 137) == [-velocity for velocity in moved(1234, 50_000, 137)]


def test_short_move_is_triangular():
    velocities = moved(100, 1000 * ONE, ONE // 4)

    peak = max(velocities)
    assert peak < 1000 * ONE
    assert velocities.index(peak) == pytest.approx(len(velocities) / 2, abs=3)


def test_very_large_velocity_and_acceleration_jump_in_one_tick():
    velocities = moved(1000, 0x7FFF_FFFF, 0x7FFF_FFFF)

    assert velocities == [1000 * ONE, 0]


def test_flags_follow_the_phases():
    profiler = ProfileGenerator()
    profiler.go_to(100, 2 * ONE, ONE // 4)
    seen = []
    while not profiler.done:
        profiler.step()
        flags = (profiler.accel_done, profiler.slew_done)
        if not seen or seen[-1] != flags:
            seen.append(flags)

    assert seen == [(False, False), (True, False), (True, True)]


def test_move_to_the_present_position_is_done_at_once():
    profiler = ProfileGenerator()

    profiler.go_to(0, 0, 1)

    assert profiler.done


def test_move_without_velocity_never_ends():
    profiler = ProfileGenerator()
    profiler.go_to(10, 0, ONE)

    for _ in range(1000):
        profiler.step()

    assert profiler.position == 0
    assert not profiler.done


def test_trapezoid_starts_from_standstill_even_in_motion():
    profiler = ProfileGenerator()
    profiler.run_at(5 * ONE, ONE)
    for _ in range(10):
        profiler.step()

    profiler.go_to(1000, 5 * ONE, ONE // 2)
    profiler.step()

    assert profiler.velocity == ONE // 2


def test_velocity_mode_ramps_up_and_down_at_the_acceleration():
    profiler = ProfileGenerator()
    profiler.run_at(10 * ONE, 3 * ONE)
    velocities = []
    for _ in range(5):
        profiler.step()
        velocities.append(profiler.velocity // ONE)
    profiler.run_at(-2 * ONE, 5 * ONE)
    for _ in range(4):
        profiler.step()
        velocities.append(profiler.velocity // ONE)

    assert velocities == [3, 6, 9, 10, 10, 5, 0, -2, -2]
    assert profiler.done


def test_smooth_stop_leaves_a_trapezoid_at_the_acceleration_in_force():
    profiler = ProfileGenerator()
    profiler.go_to(100_000, 4 * ONE, ONE)
    for _ in range(10):
        profiler.step()

    profiler.stop_smoothly()
    velocities = []
    while not profiler.done:
        profiler.step()
        velocities.append(profiler.velocity // ONE)

    assert velocities == [3, 2, 1, 0]


def test_offset_while_slewing_moves_the_goal_without_a_jolt():
    profiler = ProfileGenerator()
    profiler.go_to(1000, 4 * ONE, ONE)
    for _ in range(50):
        profiler.step()
    before = profiler.velocity

    profiler.add_offset(500)
    profiler.step()
    jolt = abs(profiler.velocity - before)
    while not profiler.done:
        profiler.step()

    assert jolt == 0
    assert profiler.position == 1500 * ONE


def test_offset_while_accelerating_makes_the_command_position_jump():
    profiler = ProfileGenerator()
    profiler.go_to(100_000, 4 * ONE, ONE // 100)
    profiler.step()

    profiler.add_offset(500)

    assert profiler.position == 500 * ONE + ONE // 100


def test_offset_back_behind_the_motor_makes_it_return():
    profiler = ProfileGenerator()
    profiler.go_to(1000, 4 * ONE, ONE // 4)
    for _ in range(100):
        profiler.step()

    profiler.add_offset(-900)
    for _ in range(2000):
        profiler.step()

    assert profiler.done
    assert profiler.position == 100 * ONE
