"""Moving and stopping a simulated servo drive, as a host sees it."""

import pytest

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag
from ldcnd.drives.ldcn.trajectory import Trajectory
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, SOFT_GAINS, UTILITY_GAINS, SimulatedAxis
from tests.support.simulated_host import little

SERVOS = ["ls182ap", "ls173ap", "picservo-v1", "picservo-v2", "picservo-v3", "picservo-v4", "picservo-sc"]


@pytest.mark.parametrize("name", SERVOS)
@pytest.mark.parametrize("gains", [UTILITY_GAINS, SOFT_GAINS], ids=["utility", "soft"])
@pytest.mark.sweep(2)
def test_move_ends_within_one_count(name, gains):
    axis = SimulatedAxis(name, gains=gains)

    axis.move(5000)
    moving = axis.status()
    axis.finish()
    axis.wait(1.0)
    status = axis.status()

    assert not moving.flags & StatusFlag.MOVE_DONE
    assert abs(status.position - 5000) <= 1
    accelerated = AuxFlag(0) if name == "picservo-sc" else AuxFlag.ACCEL_DONE
    assert status.aux & (AuxFlag.SERVO_ON | AuxFlag.ACCEL_DONE | AuxFlag.SLEW_DONE) == 0x14 | accelerated
    assert not status.flags & StatusFlag.POSITION_ERROR


def test_motor_follows_the_profile_within_a_few_counts():
    axis = SimulatedAxis()
    axis.move(20_000, velocity=8 * ONE, acceleration=400)

    worst = 0
    while not axis.drive.loop.trajectory.done:
        axis.drive.loop.run(1)
        worst = max(worst, abs(axis.drive.loop.following_error))

    assert worst <= 8


def test_velocity_is_sent_negative_when_moving_forward():
    axis = SimulatedAxis()
    axis.jog(10 * ONE)
    axis.wait(1.0)

    raw = axis.send(1, CommandCode.READ_STATUS, 0x04)

    assert int.from_bytes(raw[1:3], "little", signed=True) == pytest.approx(-10, abs=1)


def test_sc_sends_the_velocity_positive_when_moving_forward():
    axis = SimulatedAxis("picservo-sc")
    axis.jog(10 * ONE)
    axis.wait(1.0)

    raw = axis.send(1, CommandCode.READ_STATUS, 0x04)

    assert int.from_bytes(raw[1:3], "little", signed=True) == pytest.approx(10, abs=1)


def test_limit1_is_the_forward_switch_of_sc_and_the_reverse_one_of_the_others():
    flags = {}
    for name in ("picservo-sc", "picservo-v4", "ls182ap"):
        axis = SimulatedAxis(name, plant=MotorPlant(forward_limit_counts=1000))
        axis.move(1500)
        axis.finish()
        flags[name] = axis.status().flags & (StatusFlag.LIMIT1 | StatusFlag.LIMIT2)

    assert flags == {
        "picservo-sc": StatusFlag.LIMIT1,
        "picservo-v4": StatusFlag.LIMIT2,
        "ls182ap": StatusFlag.LIMIT2,
    }


def test_velocity_mode_reports_done_at_the_goal_velocity_and_runs_on():
    axis = SimulatedAxis()

    axis.jog(4 * ONE, acceleration=200)
    accelerating = axis.status()
    axis.finish()
    first = axis.status().position
    axis.wait(0.512)

    assert not accelerating.flags & StatusFlag.MOVE_DONE
    assert axis.status().position - first == pytest.approx(4 * (0.512 + 0.03) / 0.000512, rel=0.02)


def test_start_motion_executes_what_was_loaded_in_parts():
    axis = SimulatedAxis()
    axis.load(Trajectory(velocity=5 * ONE, acceleration=200))
    axis.load(Trajectory(position=2000))
    axis.wait(0.5)
    assert axis.status().position == 0

    axis.send(1, CommandCode.START_MOTION)
    axis.finish()
    axis.wait(1.0)

    assert abs(axis.status().position - 2000) <= 1


def test_initialising_trajectory_of_the_manual_moves_nothing():
    axis = SimulatedAxis(closed=False)

    axis.load(Trajectory(position=0, velocity=0, acceleration=1, pwm_or_target=0, start_now=True))

    status = axis.status()
    assert status.flags & StatusFlag.MOVE_DONE
    assert not status.aux & AuxFlag.SERVO_ON


def test_printed_frame_with_a_one_byte_pwm_field_is_executed():
    axis = SimulatedAxis()

    axis.chain.write(axis.now_s, bytes.fromhex("aa 01 e4 9f 00 00 00 00 00 80 01 00 64 00 00 00 00 69"))
    reply = axis.wait(0.03)

    assert len(reply) == 2
    assert not reply[0] & StatusFlag.CHECKSUM_ERROR


def test_servo_rate_divisor_slows_the_profile_but_not_on_sc():
    positions = {}
    for name in ("ls182ap", "picservo-sc"):
        gains = Gains(kp=350, kd=1000, ki=0, il=0, ol=250, cl=0, el=4000, sr=3)
        axis = SimulatedAxis(name, gains=gains)
        axis.jog(3 * ONE, acceleration=ONE)
        axis.wait(0.512)
        positions[name] = axis.status().position

    assert positions["picservo-sc"] == pytest.approx(3 * positions["ls182ap"], rel=0.1)


def test_zero_gains_leave_the_motor_limp_and_trip_at_the_first_error():
    axis = SimulatedAxis(gains=Gains(kp=0, kd=0, ki=0, il=0, ol=0, cl=0, el=0, sr=1))

    axis.move(100)
    axis.wait(0.5)

    status = axis.status()
    assert status.flags & StatusFlag.POSITION_ERROR
    assert not status.aux & AuxFlag.SERVO_ON


def test_output_limit_bounds_the_pwm_but_not_in_pwm_mode():
    axis = SimulatedAxis(gains=Gains(kp=350, kd=3000, ki=0, il=0, ol=20, cl=0, el=16_000, sr=1))
    axis.move(10_000, velocity=100 * ONE, acceleration=ONE)
    axis.wait(0.1)
    assert axis.pwm() == 20

    axis.drive_pwm(120)
    axis.wait(0.1)

    assert axis.pwm() == 120


@pytest.mark.parametrize(("name", "pwm"), [("ls182ap", 20), ("picservo-v4", 25), ("picservo-sc", 20)])
def test_deadband_compensation_lifts_the_output_above_its_limit_on_version_4_only(name, pwm):
    gains = Gains(kp=256, kd=0, ki=0, il=0, ol=20, cl=0, el=16_000, sr=1, deadband=5)
    axis = SimulatedAxis(name, gains=gains)
    axis.suffer(FaultCondition.STALLED)

    axis.stop(ON | StopControl.HERE, *little(1000, 4))
    axis.wait(0.1)

    assert axis.pwm() == pwm


def test_deadband_is_added_to_the_output():
    axis = SimulatedAxis(gains=Gains(kp=256, kd=0, ki=0, il=0, ol=250, cl=0, el=16_000, sr=1, deadband=5))

    axis.stop(ON | StopControl.HERE, *little(10, 4))
    axis.drive.loop.run(1)

    assert axis.drive.loop.pwm == 15


def test_integral_is_bounded_by_256_times_il():
    axis = SimulatedAxis(gains=Gains(kp=0, kd=0, ki=256, il=3, ol=250, cl=0, el=16_000, sr=1))
    axis.suffer(FaultCondition.STALLED)

    axis.stop(ON | StopControl.HERE, *little(100, 4))
    axis.wait(1.0)

    assert axis.pwm() == 3


def test_smooth_stop_decelerates_at_the_loaded_acceleration():
    axis = SimulatedAxis()
    axis.jog(8 * ONE, acceleration=400)
    axis.wait(1.5)
    start = axis.status().position

    axis.stop(ON | StopControl.SMOOTH)
    braking = axis.status()
    axis.finish()
    axis.wait(0.5)

    assert not braking.flags & StatusFlag.MOVE_DONE
    distance = 8**2 / (2 * 400 / ONE)
    assert axis.status().position - start == pytest.approx(distance, rel=0.2)


def test_abrupt_stop_holds_the_command_position_at_once():
    axis = SimulatedAxis()
    axis.jog(8 * ONE)
    axis.wait(0.5)

    axis.stop(ON | StopControl.ABRUPT)
    status = axis.status()
    axis.wait(0.5)

    assert status.flags & StatusFlag.MOVE_DONE
    assert status.aux & AuxFlag.SERVO_ON
    assert axis.status().velocity == 0


def test_motor_off_opens_the_loop_and_lets_the_motor_coast():
    axis = SimulatedAxis("picservo-v4")
    axis.jog(8 * ONE)
    axis.wait(0.5)
    before = axis.status().position

    axis.stop(StopControl.MOTOR_OFF)
    status = axis.status()
    axis.wait(5.0)

    assert not status.aux & AuxFlag.SERVO_ON
    assert status.flags & StatusFlag.POSITION_ERROR
    assert status.flags & StatusFlag.MOVE_DONE
    assert axis.status().position > before + 100


def test_stop_here_goes_to_a_position_without_a_profile():
    axis = SimulatedAxis()

    axis.stop(ON | StopControl.HERE, *little(-300, 4))
    status = axis.status()
    axis.wait(1.5)

    assert status.flags & StatusFlag.MOVE_DONE
    assert abs(axis.status().position + 300) <= 1


def test_stop_here_too_far_away_makes_a_position_error():
    axis = SimulatedAxis()

    axis.stop(ON | StopControl.HERE, *little(4100, 4))
    axis.wait(0.01)

    assert axis.status().flags & StatusFlag.POSITION_ERROR


def test_version_1_knows_no_stop_here():
    axis = SimulatedAxis("picservo-v1")

    axis.stop(ON | StopControl.HERE, *little(300, 4))
    axis.wait(1.0)

    assert axis.status().position == 0


def test_stop_with_the_enable_bit_only_changes_nothing_else():
    axis = SimulatedAxis()
    axis.jog(4 * ONE)
    axis.wait(0.5)

    axis.stop(ON)

    status = axis.status()
    assert status.aux & AuxFlag.SERVO_ON
    assert status.velocity == pytest.approx(4, abs=1)


def test_power_driver_off_opens_the_loop_of_a_logosol_drive_only():
    logosol, pic = SimulatedAxis("ls182ap"), SimulatedAxis("picservo-v4")

    logosol.stop(StopControl(0))
    pic.stop(StopControl(0))

    assert not logosol.status().aux & AuxFlag.SERVO_ON
    assert pic.status().aux & AuxFlag.SERVO_ON


def test_loop_cannot_be_closed_without_the_power_driver():
    axis = SimulatedAxis(closed=False)

    axis.stop(StopControl.ABRUPT)

    assert not axis.status().aux & AuxFlag.SERVO_ON


def test_closing_the_loop_on_a_moving_motor_takes_its_velocity_over():
    axis = SimulatedAxis(closed=False)
    axis.stop(ON | StopControl.MOTOR_OFF)
    axis.load(Trajectory(pwm_or_target=60, acceleration=500, servo=False, start_now=True))
    axis.wait(0.5)
    running = axis.status().velocity

    axis.stop(ON | StopControl.SMOOTH)
    status = axis.status()

    assert running > 8
    assert 0 < status.velocity <= running
    assert not status.flags & StatusFlag.MOVE_DONE
