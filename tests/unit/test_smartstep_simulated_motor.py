import pytest

from ldcnd.drivers.smartstep.simulated_motor import SimulatedMotor

RATE_AT_3000_RPM = 100_000.0


def turning(rate: float = RATE_AT_3000_RPM, to_s: float = 2.0) -> SimulatedMotor:
    motor = SimulatedMotor(servo_on=True, pulse_rate=rate)
    motor.advance(to_s)
    return motor


def test_pulse_train_makes_speed_and_following_deviation():
    motor = turning()

    assert motor.rpm(motor.speed) == pytest.approx(3000)
    assert motor.deviation == pytest.approx(400_000 / 40)
    assert motor.position == pytest.approx(400_000 * 2.0 - motor.deviation)


def test_counts_commanded_are_travelled_or_still_in_the_deviation():
    motor = turning()
    motor.pulse_rate = 0.0
    motor.advance(5.0)

    assert motor.position == pytest.approx(motor.command_units * motor.gear)
    assert motor.speed == pytest.approx(0, abs=1e-6)


def test_servo_off_coasts_and_clears_the_deviation():
    motor = turning()
    before = motor.position
    motor.servo_on = False
    motor.advance(4.0)

    assert motor.position == pytest.approx(before + 400_000 * 0.05)
    assert motor.deviation == 0.0
    assert motor.command_units == pytest.approx(400_000)


def test_jammed_shaft_stands_while_deviation_and_torque_grow():
    motor = SimulatedMotor(servo_on=True, pulse_rate=100.0, jammed=True)
    motor.advance(1.0)

    assert (motor.position, motor.speed) == (0.0, 0.0)
    assert motor.deviation == pytest.approx(400)
    assert motor.torque_percent == pytest.approx(200)


def test_acceleration_takes_torque():
    starting = SimulatedMotor(servo_on=True, pulse_rate=RATE_AT_3000_RPM)
    starting.advance(0.001)

    assert starting.torque_percent > turning().torque_percent + 100


def test_earlier_time_changes_nothing():
    motor = turning()
    before = motor.position

    motor.advance(1.0)

    assert (motor.position, motor.at_s) == (before, 2.0)


def test_trembling_feedback_has_two_values():
    motor = SimulatedMotor(servo_on=True, tremble=-1)
    seen = set()
    for step in range(50):
        motor.advance(step * 0.003)
        seen.add(motor.feedback)

    assert seen == {0, -1}
