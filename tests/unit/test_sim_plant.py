"""The machine on a simulated shaft."""

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
