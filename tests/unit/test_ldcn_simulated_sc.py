"""What PIC-SERVO SC does beyond version 4: data sheet v10."""

from dataclasses import replace

import pytest

from ldcnd.drives.ldcn.controls import IoOption, StartUp, StopControl
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag
from ldcnd.drives.ldcn.registers import FRACTION, SERVO_CYCLE_S, encode_gains
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain, model
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import ExcludedOptions, RelativeTo, ResetInMotion, UnknownBaud
from ldcnd.sim.ldcn.simulation import SimulatedChainConfig
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_axis import ON, ONE, UTILITY_GAINS, SimulatedAxis
from tests.support.simulated_host import SimulatedHost, little

PHASES = AuxFlag.ACCEL_DONE | AuxFlag.SLEW_DONE


def sc(*, plant=None, **quirks):
    return SimulatedAxis("pic-servo-sc", plant=plant, settings=model("pic-servo-sc")[1].model_copy(update=quirks))


def profile(axis):
    """Return the profile generator as it is now."""
    axis.drive.catch_up(axis.now_s)
    return axis.drive.loop.trajectory


def commanded(axis):
    return profile(axis).position / FRACTION


# -- rates (5.2: the byte is looked up) -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "code", "baud"),
    [
        ("pic-servo-sc", 5, 230_400),
        ("pic-servo-sc", 10, 115_200),
        ("pic-servo-sc", 21, 57_600),
        ("pic-servo-sc", 20, 57_600),
        ("pic-servo-sc", 64, 19_200),
        ("pic-servo-sc", 127, 9600),
        ("pic-servo-sc", 129, 9600),
        ("pic-servo-v4", 5, 208_333),
        ("pic-servo-cmc", 5, 208_333),
        ("pic-io", 5, 208_333),
        ("ls-182ap", 20, 59_524),
    ],
)
def test_sc_looks_the_rate_up_and_the_others_divide(name, code, baud):
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec(name),))))
    host.address_all()

    host.send(0xFF, CommandCode.SET_BAUD_RATE, code)

    assert host.chain.modules[0].baud == pytest.approx(baud, rel=1e-4)


def test_a_host_talks_to_sc_at_230400():
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),) * 2)))
    host.address_all()

    host.send(0xFF, CommandCode.SET_BAUD_RATE, 5)
    host.chain.baud = 230_400

    assert [len(host.send(address, CommandCode.NO_OPERATION)) for address in (1, 2)] == [2, 2]


@pytest.mark.parametrize(("variant", "baud"), [(UnknownBaud.KEPT, 19_200), (UnknownBaud.DIVIDED, 178_571)])
def test_what_sc_makes_of_a_rate_that_it_does_not_know_is_a_switch(variant, baud):
    axis = sc(unknown_baud=variant)

    axis.send(1, CommandCode.SET_BAUD_RATE, 6)

    assert axis.drive.baud == pytest.approx(baud, rel=0.01)
    assert axis.drive.unknown_bauds == 1


# -- relative moves (5.2) ---------------------------------------------------------------------------------------------


def relative(position, **options):
    return Trajectory(position=position, velocity=5 * ONE, acceleration=200, relative=True, start_now=True, **options)


def test_a_relative_move_counts_from_the_command_position():
    axis = sc()
    axis.move(2000)
    axis.finish()

    axis.load(relative(500))
    axis.finish()
    axis.load(relative(-800))
    axis.finish()

    assert commanded(axis) == 1700


def test_an_older_drive_takes_the_same_bytes_for_an_absolute_goal():
    axis = SimulatedAxis("pic-servo-v4")
    axis.move(2000)
    axis.finish()

    axis.send(1, CommandCode.LOAD_TRAJECTORY, *bytes.fromhex("d7 f4010000 00000500 a00f0000"))
    axis.finish()

    assert commanded(axis) == 500


@pytest.mark.parametrize(("relative_to", "goal"), [(RelativeTo.START, 600), (RelativeTo.LOAD, 300)])
def test_what_a_relative_goal_that_waits_is_added_to_is_a_switch(relative_to, goal):
    axis = sc(relative_to=relative_to)

    axis.load(replace(relative(300), start_now=False))
    axis.stop(ON | StopControl.HERE, *little(300, 4))
    axis.wait(0.5)
    axis.send(1, CommandCode.START_MOTION)
    axis.finish()

    assert commanded(axis) == goal


def test_a_second_load_replaces_all_that_waited():
    axis = sc()
    axis.load(Trajectory(position=1000, velocity=5 * ONE, acceleration=200))
    axis.load(Trajectory(velocity=3 * ONE, acceleration=200))

    axis.send(1, CommandCode.START_MOTION)
    axis.wait(1.0)

    assert commanded(axis) == 0


# -- changes in mid-move (4.4.4) --------------------------------------------------------------------------------------


def test_a_trapezoid_reloaded_every_25_ms_reaches_its_speed():
    axis = sc(plant=MotorPlant(forward_limit_counts=1_000_000))
    speed = round(30_000 * SERVO_CYCLE_S * ONE)
    for _ in range(40):
        axis.load(Trajectory(position=500_000, velocity=speed, acceleration=4000, start_now=True))
        axis.wait(0.025)

    assert axis.status().velocity == pytest.approx(30_000 * SERVO_CYCLE_S, abs=1.5)


def test_a_goal_too_near_is_overshot_within_the_limits_and_come_back_to():
    axis = sc()
    acceleration, speed = 400, 10 * ONE
    axis.move(50_000, velocity=speed, acceleration=acceleration)
    axis.wait(2.0)
    goal = round(commanded(axis)) + 10
    axis.move(goal, velocity=speed, acceleration=acceleration)

    trajectory = profile(axis)
    before, highest = trajectory.velocity, 0.0
    while not trajectory.done:
        axis.drive.loop.run(1)
        assert abs(trajectory.velocity - before) <= acceleration
        assert abs(trajectory.velocity) <= speed
        before = trajectory.velocity
        highest = max(highest, trajectory.position / FRACTION - goal)

    assert trajectory.position == goal * FRACTION
    assert highest == pytest.approx(10**2 / (2 * acceleration / ONE), rel=0.1)


def test_a_lower_velocity_in_mid_move_is_ramped_down_to():
    axis = sc()
    axis.move(50_000, velocity=10 * ONE, acceleration=400)
    axis.wait(1.0)

    axis.load(Trajectory(velocity=4 * ONE, start_now=True))
    axis.wait(1.0)

    assert profile(axis).velocity == 4 * ONE
    assert not axis.status().flags & StatusFlag.MOVE_DONE


def test_a_trapezoid_may_begin_in_velocity_mode():
    axis = sc()
    axis.jog(8 * ONE, acceleration=400)
    axis.wait(2.0)
    before = profile(axis).velocity

    axis.load(Trajectory(position=0, velocity=8 * ONE, acceleration=400, start_now=True))
    after = profile(axis).velocity

    assert before == 8 * ONE
    assert 0 < after < before
    axis.finish()
    assert commanded(axis) == 0


def test_the_divisor_does_not_slow_the_profile():
    axis = sc()
    axis.send(1, CommandCode.SET_GAIN, *bytes.fromhex("5e01 5802 0000 0000 fa 00 a00f 05 00"))

    axis.jog(5 * ONE, acceleration=2000)
    axis.wait(1.0)

    assert axis.status().velocity == pytest.approx(5, abs=1)


# -- auxiliary bits (5.3) ---------------------------------------------------------------------------------------------


def test_auxiliary_bits_tell_what_the_profile_does_now():
    axis = sc()
    axis.move(20_000, velocity=10 * ONE, acceleration=400)
    seen = []
    for _ in range(200):
        aux = axis.status().aux & (PHASES | AuxFlag.SERVO_ON)
        if not seen or seen[-1] != aux:
            seen.append(int(aux))

    assert seen == [0x0C, 0x14, 0x04, 0x14]


def test_the_index_bit_is_the_level_on_sc_and_its_complement_on_version_4():
    plant = MotorPlant(index_at_counts=0)
    levels = {
        name: SimulatedAxis(name, plant=plant).status().aux & AuxFlag.INDEX for name in ("pic-servo-sc", "pic-servo-v4")
    }

    assert levels == {"pic-servo-sc": AuxFlag.INDEX, "pic-servo-v4": AuxFlag(0)}


@pytest.mark.parametrize("shown", [True, False])
def test_whether_the_slew_bit_is_set_after_a_reset_is_a_switch(shown):
    settings = model("pic-servo-sc")[1].model_copy(update={"aux_after_reset": shown})
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-sc", settings=settings),))))
    host.address_all()

    aux = host.read(1, host.chain.modules[0].profile, 0x08).aux

    assert aux == (AuxFlag.SLEW_DONE if shown else AuxFlag(0))


# -- limit protection (4.7) -------------------------------------------------------------------------------------------

PLANT = MotorPlant(forward_limit_counts=2000, reverse_limit_counts=-2000)


@pytest.mark.parametrize(("option", "holds"), [(IoOption.LIMIT_STOP, True), (IoOption.LIMIT_OFF, False)])
@pytest.mark.parametrize("direction", [1, -1])
def test_limit_protection_ends_a_motion_into_a_limit(option, holds, direction):
    axis = sc(plant=PLANT)
    axis.send(1, CommandCode.IO_CONTROL, option)

    axis.jog(direction * 5 * ONE)
    axis.wait(3.0)
    status = axis.status()

    assert bool(status.aux & AuxFlag.SERVO_ON) is holds
    assert 2000 <= direction * status.position <= 2200 + (0 if holds else 1800)
    assert status.velocity == 0


def test_without_limit_protection_the_motor_reaches_the_hard_stop():
    axis = sc(plant=PLANT)

    axis.jog(5 * ONE)
    axis.wait(5.0)
    axis.drive.catch_up(axis.now_s)

    assert axis.drive.shaft.position_counts == 4000


def test_commands_into_the_limit_are_ignored_and_the_way_back_is_free():
    axis = sc(plant=PLANT)
    axis.send(1, CommandCode.IO_CONTROL, IoOption.LIMIT_STOP)
    axis.jog(5 * ONE)
    axis.wait(3.0)
    stopped = commanded(axis)

    axis.move(3500)
    axis.jog(ONE)
    axis.wait(0.2)
    ignored = commanded(axis)
    axis.move(0)
    axis.finish()

    assert ignored == stopped
    assert commanded(axis) == 0


def test_with_the_servo_off_limit_protection_takes_the_pwm_value_into_the_limit():
    axis = sc(plant=PLANT)
    axis.send(1, CommandCode.IO_CONTROL, IoOption.LIMIT_OFF)

    axis.drive_pwm(60)
    axis.wait(2.0)
    reached = axis.pwm()
    axis.drive_pwm(60)
    forward = axis.pwm()
    axis.drive_pwm(-60)

    assert (reached, forward, axis.pwm()) == (0, 0, -60)


def test_pwm_mode_without_a_value_keeps_the_present_output_on_sc():
    outputs = {}
    for name in ("pic-servo-sc", "pic-servo-v4"):
        axis = SimulatedAxis(name)
        axis.suffer(FaultCondition.STALLED)
        axis.stop(ON | StopControl.HERE, *little(40, 4))
        axis.wait(0.3)
        axis.load(Trajectory(servo=False, start_now=True))
        outputs[name] = axis.pwm()

    assert outputs["pic-servo-sc"] > 20
    assert outputs["pic-servo-v4"] == 0


# -- supply (4.7) -----------------------------------------------------------------------------------------------------


def test_a_supply_too_low_opens_the_loop_and_one_too_high_only_disables_the_amplifier():
    low, high = sc(), sc()
    for axis, condition in ((low, FaultCondition.MOTOR_POWER_OFF), (high, FaultCondition.OVERVOLTAGE)):
        axis.jog(5 * ONE)
        axis.suffer(condition)
        assert not axis.status().flags & StatusFlag.POWER_ON
        assert not axis.drive.stage.drives
        axis.recover(condition)

    assert not low.status().aux & AuxFlag.SERVO_ON
    assert high.status().aux & AuxFlag.SERVO_ON
    assert low.drive.stage.drives
    assert high.drive.stage.drives


# -- Reset Position (5.2) ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shifts", [True, False])
def test_whether_the_home_register_moves_with_the_position_is_a_switch(shifts):
    axis = sc(home_shifts=shifts)
    axis.move(1000)
    axis.finish()
    axis.wait(0.5)
    axis.send(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME)
    home = axis.status().home

    axis.send(1, CommandCode.RESET_POSITION, 2, *little(5000, 4))
    status = axis.status()

    assert status.position == 5000
    assert status.home == (5000 if shifts else home)


@pytest.mark.parametrize(
    ("rule", "position", "goal"),
    [(ResetInMotion.GOAL_KEPT, 0, 2000), (ResetInMotion.GOAL_SHIFTED, 0, 1000), (ResetInMotion.IGNORED, 1000, 2000)],
)
def test_what_reset_position_does_to_a_move_under_way_is_a_switch(rule, position, goal):
    axis = sc(reset_in_motion=rule)
    axis.move(2000, velocity=ONE // 2)
    while axis.status().position < 1000:
        axis.wait(0.001)

    axis.send(1, CommandCode.RESET_POSITION)
    after = axis.status().position
    axis.finish()

    assert after == pytest.approx(position, abs=100)
    assert commanded(axis) == pytest.approx(goal, abs=100)


# -- I/O Control, step and direction inputs (4.4.6, 5.2) --------------------------------------------------------------


@pytest.mark.parametrize(
    ("variant", "protection"),
    [
        (ExcludedOptions.OBEYED, IoOption.LIMIT_OFF | IoOption.LIMIT_STOP),
        (ExcludedOptions.CLEARED, IoOption(0)),
        (ExcludedOptions.IGNORED, IoOption.LIMIT_STOP),
    ],
)
def test_what_options_do_that_exclude_each_other_is_a_switch(variant, protection):
    axis = sc(excluded_options=variant)
    axis.send(1, CommandCode.IO_CONTROL, IoOption.LIMIT_STOP)

    axis.send(1, CommandCode.IO_CONTROL, 0x0C)

    assert axis.drive.loop.protection == protection


@pytest.mark.parametrize("steps_hz", [2000.0, -2000.0])
def test_pulses_at_the_step_input_move_the_command_position_by_the_multiplier(steps_hz):
    axis = sc(steps_hz=steps_hz)
    axis.send(1, CommandCode.SET_GAIN, *encode_gains(axis.profile, replace(UTILITY_GAINS, step_multiplier=3)))
    axis.wait(0.5)
    before = commanded(axis)

    axis.send(1, CommandCode.IO_CONTROL, IoOption.STEP_DIRECTION)
    axis.wait(0.5)

    assert before == 0
    assert commanded(axis) == pytest.approx(3 * steps_hz * 0.5, rel=0.08)
    assert not axis.status().aux & AuxFlag.SERVO_OVERRUN


def test_steps_that_come_too_fast_make_the_servo_late():
    axis = sc(steps_hz=200_000.0)

    axis.send(1, CommandCode.IO_CONTROL, IoOption.STEP_DIRECTION)
    axis.wait(0.01)

    assert axis.status().aux & AuxFlag.SERVO_OVERRUN


@pytest.mark.parametrize(("kept", "multiplier"), [(False, 1), (True, 5)])
def test_whether_set_gain_without_a_multiplier_restores_it_is_a_switch(kept, multiplier):
    axis = sc(gains_keep_multiplier=kept)
    whole = encode_gains(axis.profile, replace(UTILITY_GAINS, step_multiplier=5))
    axis.send(1, CommandCode.SET_GAIN, *whole)

    axis.send(1, CommandCode.SET_GAIN, *whole[:14])

    assert axis.drive.loop.gains.step_multiplier == multiplier


@pytest.mark.parametrize("latched", [True, False])
def test_whether_a_module_behind_a_fault_with_step_inputs_still_hears_is_a_switch(latched):
    settings = model("pic-servo-sc")[1].model_copy(update={"steps_hz": 100_000.0, "address_in_latched": latched})
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-sc", settings=settings),) * 2)))
    host.address_all()
    host.send(1, CommandCode.SET_GAIN, *encode_gains(host.chain.modules[0].profile, replace(UTILITY_GAINS, el=100)))
    host.send(1, CommandCode.STOP_MOTOR, 0x05)
    host.send(1, CommandCode.IO_CONTROL, IoOption.STEP_DIRECTION)
    host.wait(0.5)  # the motor cannot follow
    host.send(1, CommandCode.NO_OPERATION)

    assert not host.chain.modules[0].loop.servo_on
    assert bool(host.send(2, CommandCode.NO_OPERATION)) is latched

    host.send(1, CommandCode.IO_CONTROL, 0)
    host.send(1, CommandCode.NO_OPERATION)
    assert host.send(2, CommandCode.NO_OPERATION)


# -- EEPROM (4.6, 5.2) ------------------------------------------------------------------------------------------------


def save(axis, *options):
    control = StartUp(0)
    for option in options:
        control |= option
    axis.send(1, CommandCode.HARD_RESET, control)


def power_cycle(axis):
    axis.drive.power(on=False, at_s=axis.now_s)
    axis.wait(0.1)
    axis.drive.power(on=True, at_s=axis.now_s)
    axis.wait(0.002)


def test_hard_reset_with_data_saves_and_only_a_power_cycle_restores():
    axis = sc()
    axis.load(Trajectory(velocity=5 * ONE, acceleration=200, position=0, start_now=True))
    gains = axis.drive.loop.gains

    save(axis, StartUp.SAVE)
    after_reset = axis.drive.loop.gains
    power_cycle(axis)
    axis.address_all()

    assert after_reset.kp == 0
    assert axis.drive.loop.gains == gains
    assert not axis.drive.loop.servo_on
    axis.stop(ON | StopControl.ABRUPT)
    axis.load(Trajectory(position=500, start_now=True))
    axis.finish()
    assert commanded(axis) == 500


def test_a_saved_servo_comes_on_when_the_module_is_given_its_address():
    axis = sc()
    save(axis, StartUp.SAVE, StartUp.AMPLIFIER_ON, StartUp.SERVO_ON)
    power_cycle(axis)
    axis.wait(0.1)
    before = (axis.drive.stage.enabled, axis.drive.loop.servo_on)

    axis.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)

    assert before == (False, False)
    assert (axis.drive.stage.enabled, axis.drive.loop.servo_on) == (True, True)


def test_a_command_reset_before_set_address_keeps_the_saved_servo_off():
    axis = sc()
    save(axis, StartUp.SAVE, StartUp.AMPLIFIER_ON, StartUp.SERVO_ON)
    power_cycle(axis)

    axis.send(0, CommandCode.HARD_RESET)
    axis.send(0, CommandCode.SET_ADDRESS, 1, 0xFF)

    assert (axis.drive.stage.enabled, axis.drive.loop.servo_on) == (False, False)


def test_saved_addresses_answer_at_once_and_let_the_next_module_hear():
    host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),) * 2)))
    host.address_all()
    host.send(1, CommandCode.SET_ADDRESS, 5, 0x81)
    host.send(5, CommandCode.HARD_RESET, StartUp.SAVE | StartUp.ADDRESSES)
    assert host.send(2, CommandCode.NO_OPERATION) == b""

    first = host.chain.modules[0]
    first.power(on=False, at_s=host.now_s)
    first.power(on=True, at_s=host.now_s)
    host.wait(0.002)

    assert len(host.send(5, CommandCode.NO_OPERATION)) == 2
    assert len(host.send(2, CommandCode.NO_OPERATION)) == 2
    assert (first.group, first.leader) == (0x81, False)


def test_erasing_forgets_and_older_drives_just_reset():
    axis = sc()
    save(axis, StartUp.SAVE)
    axis.address_all()
    axis.send(1, CommandCode.HARD_RESET, 0)
    old = SimulatedAxis("pic-servo-v4")
    old.send(1, CommandCode.HARD_RESET, StartUp.SAVE | StartUp.THREE_PHASE)

    assert axis.drive.saved is None
    assert old.drive.saved is None
    assert old.drive.address == 0


def test_velocity_mode_needs_no_other_bits_than_before():
    axis = sc()

    axis.load(Trajectory(velocity=ONE, acceleration=400, mode=ProfileMode.VELOCITY, reverse=True, start_now=True))
    axis.wait(1.0)

    assert axis.status().velocity == -1


@pytest.mark.parametrize("sign", [1, -1])
def test_the_sign_of_the_velocity_on_the_wire_is_a_switch(sign):
    axis = sc(velocity_sign=sign)
    axis.jog(10 * ONE)
    axis.wait(1.0)

    raw = axis.send(1, CommandCode.READ_STATUS, 0x04)

    assert int.from_bytes(raw[1:3], "little", signed=True) == pytest.approx(10 * sign, abs=1)


@pytest.mark.parametrize("scaled", [True, False])
def test_whether_the_integral_limit_counts_256_times_is_a_switch(scaled):
    axis = sc(il_times_256=scaled)
    axis.send(1, CommandCode.SET_GAIN, *bytes.fromhex("0000 0000 0001 0300 fa 00 803e 01 00 01"))
    axis.suffer(FaultCondition.STALLED)

    axis.stop(ON | StopControl.HERE, *little(100, 4))
    axis.wait(1.0)

    assert axis.pwm() == (3 if scaled else 0)


@pytest.mark.parametrize("added", [True, False])
def test_whether_deadband_compensation_applies_at_zero_is_a_switch(added):
    axis = sc(deadband_at_zero=added)
    axis.send(1, CommandCode.SET_GAIN, *bytes.fromhex("0001 0000 0000 0000 fa 00 803e 01 05 01"))
    axis.suffer(FaultCondition.STALLED)
    axis.stop(ON | StopControl.HERE, *little(axis.status().position, 4))

    assert abs(axis.pwm()) == (5 if added else 0)


def test_a_module_may_come_with_a_start_up_that_energises_it_when_it_is_addressed():
    config = SimulatedChainConfig.model_validate({"module": [{"model": "pic-servo-sc", "start_up": 0x0D}]})
    host = SimulatedHost(build_chain(config.spec()))
    drive = host.chain.modules[0]
    before = drive.loop.servo_on

    host.address_all()

    assert (before, drive.stage.enabled, drive.loop.servo_on) == (False, True, True)


def test_only_sc_has_an_eeprom():
    with pytest.raises(ValueError, match="start_up: a ls-182ap has no EEPROM"):
        SimulatedChainConfig.model_validate({"module": [{"model": "ls-182ap", "start_up": 1}]})
