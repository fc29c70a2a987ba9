"""The machine on a simulated shaft."""

from itertools import pairwise

import pytest

from ldcnd.sim.plant import MotorPlant, Shaft

STEP_S = 0.000512


def shaft_of(**constants):
    return Shaft(MotorPlant(**constants), STEP_S)


def run(shaft, duty, steps):
    for _ in range(steps):
        shaft.step(duty)


def test_default_motor_reaches_its_rated_speed():
    shaft = shaft_of(forward_limit_counts=10**9)

    run(shaft, 1.0, 2000)

    revolutions_per_min = shaft.velocity_counts / STEP_S / 2000 * 60
    assert revolutions_per_min == pytest.approx(3000, rel=0.05)


def test_speed_is_proportional_to_duty_but_for_friction():
    full, half = shaft_of(friction_nm=0.0), shaft_of(friction_nm=0.0)

    run(full, 1.0, 500)
    run(half, 0.5, 500)

    assert half.velocity_counts == pytest.approx(full.velocity_counts / 2)


def test_friction_holds_against_a_small_duty():
    shaft = shaft_of(friction_nm=0.015)

    run(shaft, 2 / 255, 1000)

    assert shaft.position_counts == 0.0


def test_open_windings_coast_longer_than_a_driven_stop():
    coasting, braked = shaft_of(), shaft_of()
    run(coasting, 1.0, 500)
    run(braked, 1.0, 500)

    run(coasting, None, 50)
    run(braked, 0.0, 50)

    assert coasting.velocity_counts > 2 * braked.velocity_counts


def test_motor_without_voltage_comes_to_a_complete_stop():
    shaft = shaft_of()
    run(shaft, 0.3, 200)

    run(shaft, None, 20_000)

    assert shaft.velocity_counts == 0.0


def test_hard_stop_is_behind_the_limit_switch():
    shaft = shaft_of(forward_limit_counts=3000, stop_margin_counts=500)

    run(shaft, 1.0, 2000)

    assert shaft.position_counts == 3500
    assert shaft.on_forward_limit
    assert not shaft.on_reverse_limit


def test_shaft_leaves_a_hard_stop_again():
    shaft = shaft_of(reverse_limit_counts=-3000, stop_margin_counts=500)
    run(shaft, -1.0, 2000)
    assert shaft.on_reverse_limit

    run(shaft, 0.5, 500)

    assert not shaft.on_reverse_limit


def test_index_pulse_comes_once_per_revolution():
    shaft = shaft_of(counts_per_rev=100, index_at_counts=30, index_width_counts=4)

    seen = []
    for counts in range(-200, 200):
        shaft.position_counts = float(counts)
        if shaft.on_index:
            seen.append(counts)

    assert seen == [first + at for first in (-170, -70, 30, 130) for at in range(4)]


def test_stalled_motor_does_not_move_and_draws_its_stall_current():
    shaft = shaft_of()
    shaft.stalled = True

    run(shaft, 1.0, 100)

    assert shaft.position_counts == 0.0
    assert shaft.current_a(1.0) == pytest.approx(24.0 / 1.2)


def test_current_falls_as_the_motor_speeds_up():
    shaft = shaft_of()
    at_start_a = shaft.current_a(1.0)

    run(shaft, 1.0, 500)

    assert 0 < shaft.current_a(1.0) < 0.1 * at_start_a
    assert shaft.current_a(None) == 0.0


def test_potentiometer_spans_its_range_and_ends_there():
    shaft = shaft_of(pot_span_counts=(-1000, 1000))

    readings = []
    for shaft.position_counts in (-2000.0, -1000.0, 0.0, 500.0, 3000.0):
        readings.append(shaft.potentiometer())

    assert readings == [0.0, 0.0, 0.5, 0.75, 1.0]


def test_potentiometer_noise_is_seeded():
    def readings(seed):
        shaft = shaft_of(pot_noise=0.01, seed=seed)
        return [shaft.potentiometer() for _ in range(20)]

    assert readings(1) == readings(1)
    assert readings(1) != readings(2)
    assert len(set(readings(1))) > 10


def test_a_hanging_load_pulls_a_motor_that_friction_does_not_hold():
    held, falling = shaft_of(load_nm=-0.003), shaft_of(load_nm=-0.01)

    run(held, None, 200)
    run(falling, None, 200)

    assert held.position_counts == 0.0
    assert falling.position_counts < -50


def test_a_dead_time_shifts_what_the_motor_does_and_changes_nothing_else():
    late, prompt = shaft_of(delay_s=3 * STEP_S), shaft_of()

    for shaft, steps in ((late, 103), (prompt, 100)):
        run(shaft, 0.5, steps)

    assert late.position_counts == pytest.approx(prompt.position_counts)


def test_half_a_step_of_dead_time_lies_between_none_and_one():
    none, half, one = (shaft_of(delay_s=share * STEP_S) for share in (0.0, 0.5, 1.0))

    for shaft in (none, half, one):
        run(shaft, 0.5, 50)

    assert one.position_counts < half.position_counts < none.position_counts


def test_with_backlash_the_load_stands_until_the_motor_has_turned_through_it():
    loose, tight = shaft_of(backlash_counts=30.0), shaft_of()

    for shaft in (loose, tight):
        run(shaft, 0.5, 100)
    gone = loose.position_counts
    for shaft in (loose, tight):
        run(shaft, -0.5, 100)

    assert tight.position_counts - loose.position_counts == pytest.approx(0.0, abs=1e-6)
    assert gone > 100


def test_swapped_leads_turn_the_motor_the_other_way():
    swapped, right = shaft_of(motor_reversed=True), shaft_of()

    for shaft in (swapped, right):
        run(shaft, 0.5, 100)

    assert swapped.position_counts == pytest.approx(-right.position_counts)
    assert swapped.current_a(0.5) == pytest.approx(-right.current_a(0.5))


def test_without_one_phase_the_torque_is_missing_in_two_thirds_of_a_turn_twice_per_electrical_turn():
    shaft, right = shaft_of(phase_lost=True, pole_pairs=4), shaft_of()
    currents = []
    for place in range(2000):
        shaft.position_counts = place + 0.5
        currents.append(shaft.current_a(0.5))
    spans = sum(before == 0.0 != now for before, now in pairwise([*currents, currents[0]]))

    assert set(currents) == {0.0, right.current_a(0.5)}
    assert currents.count(0.0) / 2000 == pytest.approx(2 / 3, abs=0.005)
    assert spans == 2 * 4


def test_without_one_phase_a_motor_coasts_through_a_dead_span_or_stands_in_it():
    standing, moving, driven = (shaft_of(phase_lost=True, pole_pairs=1, friction_nm=0.0) for _ in range(3))
    moving.velocity_counts = 1.0
    driven.position_counts = 800.0  # of 2000: a sixth of a turn with torque begins at 667

    for shaft in (standing, moving, driven):
        run(shaft, 0.5, 10)

    assert standing.position_counts == 0.0
    assert moving.velocity_counts == pytest.approx(1.0, rel=0.01)
    assert driven.velocity_counts > 0.0
