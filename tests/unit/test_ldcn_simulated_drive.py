"""Registers, sticky bits and modes of a simulated servo drive, as a host sees them."""

from dataclasses import replace

import pytest

from ldcnd.drives.ldcn.controls import LimitPins, StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag
from ldcnd.drives.ldcn.registers import encode_gains
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ModuleSettings, PositionErrorClearing
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, UTILITY_GAINS, SimulatedAxis
from tests.support.simulated_host import little


def test_position_error_bit_is_only_cleared_by_command_and_only_with_the_loop_closed():
    axis = SimulatedAxis(closed=False)
    axis.clear()
    open_loop = axis.status()

    axis.stop(ON | StopControl.ABRUPT)
    closed = axis.status()
    axis.clear()

    assert open_loop.flags & StatusFlag.POSITION_ERROR
    assert closed.flags & StatusFlag.POSITION_ERROR
    assert not axis.status().flags & StatusFlag.POSITION_ERROR


def test_closing_the_loop_clears_the_position_error_bit_in_the_other_variant():
    settings = ModuleSettings(version=20, position_error_clearing=PositionErrorClearing.BY_CLOSING)
    axis = SimulatedAxis(settings=settings, closed=False)

    axis.stop(ON | StopControl.ABRUPT)

    assert not axis.status().flags & StatusFlag.POSITION_ERROR


def test_stalled_motor_exceeds_the_error_limit_and_opens_the_loop():
    axis = SimulatedAxis("picservo-v4")
    axis.suffer(FaultCondition.STALLED)

    axis.move(8000)
    status = axis.wait_for(lambda status: status.flags & StatusFlag.POSITION_ERROR)

    assert not status.aux & AuxFlag.SERVO_ON
    assert status.position == 0
    assert axis.pwm() == 0


def test_stuck_encoder_runs_away_until_the_error_limit():
    axis = SimulatedAxis()
    axis.suffer(FaultCondition.ENCODER_STUCK)

    axis.move(8000)
    status = axis.wait_for(lambda status: status.flags & StatusFlag.POSITION_ERROR)

    assert status.position == 0
    assert axis.drive.shaft.position_counts > 3000


def test_position_counter_wraps_with_a_sticky_bit():
    axis = SimulatedAxis("picservo-sc")
    axis.send(1, CommandCode.RESET_POSITION, 2, *little(0x7FFF_FFFF - 500, 4))
    axis.jog(5 * ONE)
    axis.wait(1.0)

    status = axis.status()
    axis.clear()

    assert status.position < -0x7FFF_0000
    assert status.aux & AuxFlag.POSITION_WRAP
    assert status.aux & AuxFlag.SERVO_ON
    assert not axis.status().aux & AuxFlag.POSITION_WRAP


def test_reset_position_renames_the_place_without_moving():
    axis = SimulatedAxis()
    axis.move(1000)
    axis.finish()
    axis.wait(1.0)
    before = axis.drive.shaft.position_counts

    axis.send(1, CommandCode.RESET_POSITION)
    axis.wait(1.0)

    assert axis.status().position == pytest.approx(0, abs=1)
    assert axis.drive.shaft.position_counts == pytest.approx(before, abs=2)


def test_saved_home_can_be_read_and_sc_can_count_from_it():
    axis = SimulatedAxis("picservo-sc")
    axis.move(1000)
    axis.finish()
    axis.wait(1.0)
    axis.send(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME)
    home = axis.status().home
    axis.move(1500)
    axis.finish()
    axis.wait(1.0)

    axis.send(1, CommandCode.RESET_POSITION, 1)

    assert home == pytest.approx(1000, abs=1)
    assert axis.status().position == pytest.approx(500, abs=2)


def test_offset_is_added_in_mid_move_on_ls_182ap():
    axis = SimulatedAxis()
    axis.move(12_000)
    axis.wait(1.0)
    assert axis.status().aux & (AuxFlag.ACCEL_DONE | AuxFlag.SLEW_DONE) == AuxFlag.ACCEL_DONE

    axis.load(Trajectory(position=2000, start_now=True))
    axis.finish()
    axis.wait(1.0)

    assert abs(axis.status().position - 14_000) <= 1


def test_new_target_in_mid_move_is_erratic_on_pic_servo():
    axis = SimulatedAxis("picservo-v4")
    axis.move(8000)
    axis.wait(0.9)

    axis.load(Trajectory(position=2000, start_now=True))

    assert axis.drive.loop.trajectory.velocity < ONE


def test_pwm_mode_drives_the_motor_both_ways_with_the_loop_open():
    axis = SimulatedAxis()

    axis.drive_pwm(40)
    axis.wait(0.5)
    forward = axis.status()
    axis.drive_pwm(-40)
    axis.wait(0.5)

    assert forward.velocity > 5
    assert not forward.aux & AuxFlag.SERVO_ON
    assert axis.status().velocity < -5


def test_command_position_follows_the_motor_while_the_loop_is_open():
    axis = SimulatedAxis()
    axis.drive_pwm(40)
    axis.wait(0.5)
    axis.drive_pwm(0)
    axis.wait(1.0)

    axis.stop(ON | StopControl.ABRUPT)
    axis.wait(0.1)

    assert abs(axis.status().position_error) <= 1


@pytest.mark.parametrize(("name", "target"), [("ls182ap", 600), ("ls182ap", 356), ("ls173ap", 150)])
def test_absolute_positioning_ends_near_the_analog_target(name, target):
    axis = SimulatedAxis(name, plant=MotorPlant(pot_span_counts=(-20_000, 20_000)))

    axis.load(
        Trajectory(velocity=8 * ONE, acceleration=5000, pwm_or_target=target, mode=ProfileMode.VELOCITY, start_now=True)
    )
    axis.wait(0.05)
    running = axis.status()
    axis.finish()

    counts_per_step = 40_000 / (1 << axis.profile.adc_bits)
    assert not running.flags & StatusFlag.MOVE_DONE
    assert abs(running.velocity) == pytest.approx(8, abs=1)
    assert axis.status().adc == pytest.approx(target, abs=1 + 8**2 / (2 * 5000 / ONE) / counts_per_step)


def test_lost_sensor_stops_absolute_positioning_and_nothing_else():
    axis = SimulatedAxis()
    axis.suffer(FaultCondition.SENSOR_LOST)
    axis.move(1000)
    axis.finish()
    plain = axis.status()

    axis.load(
        Trajectory(velocity=8 * ONE, acceleration=5000, pwm_or_target=600, mode=ProfileMode.VELOCITY, start_now=True)
    )
    axis.wait(0.1)
    status = axis.status()

    assert plain.aux & AuxFlag.SERVO_ON
    assert not status.aux & AuxFlag.SERVO_ON
    assert status.adc < 8
    assert status.flags & 0x78 == 0x78


def test_limit_pins_of_version_4_can_be_outputs():
    axis = SimulatedAxis("picservo-v4")

    axis.send(1, CommandCode.IO_CONTROL, LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_INPUT)

    assert axis.status().flags & (StatusFlag.LIMIT1 | StatusFlag.LIMIT2) == StatusFlag.LIMIT1


def test_loss_of_motor_power_opens_the_loop_of_pic_servo_for_good():
    axis = SimulatedAxis("picservo-v4")
    axis.jog(4 * ONE)

    axis.suffer(FaultCondition.MOTOR_POWER_OFF)
    lost = axis.status()
    axis.stop(ON | StopControl.ABRUPT)
    refused = axis.status()
    axis.recover(FaultCondition.MOTOR_POWER_OFF)
    back = axis.status()

    assert not lost.flags & StatusFlag.POWER_ON
    assert lost.flags & StatusFlag.POSITION_ERROR
    assert not refused.aux & AuxFlag.SERVO_ON
    assert back.flags & StatusFlag.POWER_ON
    assert not back.aux & AuxFlag.SERVO_ON


@pytest.mark.parametrize(("name", "off"), [("picservo-v4", 0), ("picservo-sc", 0), ("picservo-sc", 255)])
def test_current_limiting_that_is_switched_off_gives_the_output_back(name, off):
    gains = replace(UTILITY_GAINS, ol=200, cl=21)
    axis = SimulatedAxis(name, gains=gains)
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *little(1000, 4))
    axis.wait(0.5)
    limited = axis.pwm()

    axis.send(1, CommandCode.SET_GAIN, *encode_gains(axis.profile, replace(gains, cl=off)))
    axis.wait(0.5)

    assert limited < 100
    assert axis.pwm() == 200


def test_an_output_that_was_limited_is_given_back_while_the_loop_is_open():
    axis = SimulatedAxis("picservo-v4", gains=replace(UTILITY_GAINS, ol=200, cl=21))
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *little(1000, 4))
    axis.wait(0.5)

    axis.stop(ON | StopControl.MOTOR_OFF)
    axis.wait(0.5)
    axis.recover(FaultCondition.STALLED)
    axis.send(1, CommandCode.SET_GAIN, *encode_gains(axis.profile, replace(UTILITY_GAINS, ol=200)))
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *little(1000, 4))

    assert axis.pwm() == 200


@pytest.mark.parametrize("name", ["ls182ap", "picservo-v4", "picservo-sc"])
@pytest.mark.parametrize("event", ["motor_off", "amplifier_off", "position_error", "power"])
def test_the_pwm_value_is_reset_by_whatever_disables_the_servo(name, event):
    axis = SimulatedAxis(name)
    axis.load(Trajectory(pwm_or_target=120, servo=False, reverse=False))
    if name == "picservo-sc":  # its loads replace each other, so the value has to be in use
        axis.drive_pwm(120)
        axis.stop(ON | StopControl.ABRUPT)
    match event:
        case "motor_off":
            axis.stop(ON | StopControl.MOTOR_OFF)
        case "amplifier_off":
            axis.stop(StopControl.MOTOR_OFF)
        case "position_error":
            axis.stop(ON | StopControl.HERE, *little(20_000, 4))
        case _:
            lost = FaultCondition.STOP_INPUT if name == "ls182ap" else FaultCondition.MOTOR_POWER_OFF
            axis.suffer(lost)
            axis.wait(0.01)
            axis.recover(lost)
    axis.stop(StopControl.MOTOR_OFF)
    axis.clear()
    axis.stop(ON)

    axis.load(Trajectory(servo=False, start_now=True))

    assert axis.pwm() == 0


def test_both_limit_switches_may_be_actuated_at_once_wherever_the_shaft_is():
    axis = SimulatedAxis()
    both = StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    before = axis.status().flags & both

    axis.suffer(FaultCondition.LIMITS_ACTUATED)
    actuated = axis.status().flags & both
    axis.recover(FaultCondition.LIMITS_ACTUATED)

    assert (before, actuated, axis.status().flags & both) == (0, both, 0)


def test_shaft_stays_where_it_is_when_the_drive_is_switched_off_and_on():
    axis = SimulatedAxis()
    axis.move(1000)
    axis.finish()
    axis.wait(1.0)

    axis.drive.power(on=False, at_s=axis.now_s)
    axis.wait(1.0)
    axis.drive.power(on=True, at_s=axis.now_s)
    axis.wait(0.002)
    axis.address_all()

    assert axis.status().position == 0
    assert axis.drive.shaft.position_counts == pytest.approx(1000, abs=2)


def test_stop_may_clear_the_velocity_register():
    axis = SimulatedAxis(settings=ModuleSettings(version=20, stop_clears_velocity=True))
    axis.move(1000)
    axis.finish()
    axis.stop(ON | StopControl.SMOOTH)

    axis.load(Trajectory(position=2000, start_now=True))
    axis.wait(1.0)

    assert axis.status().position == pytest.approx(1000, abs=2)


def test_settled_loop_skips_ahead():
    axis = SimulatedAxis()
    axis.move(5000)
    axis.finish()
    axis.wait(3.0)
    axis.status()
    cycles = []
    one_cycle = axis.drive.loop._cycle
    axis.drive.loop._cycle = lambda: cycles.append(1) or one_cycle()

    axis.wait(3600.0)
    status = axis.status()

    assert abs(status.position - 5000) <= 1
    assert len(cycles) < 100


def test_skipping_ahead_changes_nothing():
    ticking, skipping = SimulatedAxis(), SimulatedAxis()
    for axis in (ticking, skipping):
        axis.move(3000)
        axis.finish()
    for _ in range(2000):
        ticking.drive.loop.run(1)  # too few cycles at once to skip any
    skipping.drive.loop.run(2000)

    assert skipping.drive.loop.position == ticking.drive.loop.position
    assert skipping.drive.shaft.position_counts == ticking.drive.shaft.position_counts
    assert skipping.drive.loop.pwm == ticking.drive.loop.pwm
