"""The parts of an LDCN/NMC servo axis that need no line: registers, homing control, motions, pins, drive state."""

from dataclasses import replace

import pytest

from ldcnd.drivers.driver import AnalogMotion, HomeCapture, Motion, PwmOutput, StopMode
from ldcnd.drivers.ldcn.controls import INPUTS, HomingControl, LimitPins, blocks_homing, with_modes
from ldcnd.drivers.ldcn.packet import AuxFlag, Status, StatusFlag
from ldcnd.drivers.ldcn.profiles import LS_173AP, LS_182AP, PIC_SERVO_SC, PIC_SERVO_V1, PIC_SERVO_V2, PIC_SERVO_V4
from ldcnd.drivers.ldcn.record import DriveState, RegisterBook
from ldcnd.drivers.ldcn.servo import home_methods, homing_control, opens_loop
from ldcnd.drivers.ldcn.trajectory import ProfileMode, Trajectory, quantised, trajectory_of
from ldcnd.errors import BadReply, NotSupported, ValueOutOfRange
from ldcnd.model.commands import HomeMethod, PinMode
from ldcnd.model.meta import Provenance

CLOSED = AuxFlag.SERVO_ON | AuxFlag.INDEX


def status(flags=StatusFlag.POWER_ON | StatusFlag.MOVE_DONE, aux=CLOSED, velocity=0, adc=None):
    return Status(flags, position=5, velocity=velocity, aux=aux, adc=adc)


# -- registers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("profile", "lacking"),
    [
        (LS_182AP, {"cl", "io_control"}),
        (PIC_SERVO_V1, {"deadband", "io_control"}),
        (PIC_SERVO_V4, set()),
        (PIC_SERVO_SC, {"io_control"}),
    ],
)
def test_a_book_has_the_registers_of_its_device(profile, lacking):
    full = {register.name for register in RegisterBook(PIC_SERVO_V4).all()}

    assert {register.name for register in RegisterBook(profile).all()} == full - lacking


def test_before_a_reset_nothing_is_known_and_after_it_what_the_manual_says():
    book = RegisterBook(PIC_SERVO_V4)
    assert {register.provenance for register in book.all()} == {Provenance.UNKNOWN}

    book.reset()

    assert {register.provenance for register in book.all()} == {Provenance.ASSUMED}
    assert (book.value("kp"), book.value("sr"), book.value("io_control")) == (0, 1, INPUTS)


def test_a_register_is_unknown_while_it_is_being_written():
    book = RegisterBook(LS_182AP)
    book.reset()

    book.invalidate(["kp"])
    assert (book.value("kp"), book.written("kp")) == (None, False)

    book.wrote({"kp": 350})
    assert (book.value("kp"), book.written("kp")) == (350, True)


def test_a_register_that_the_device_lacks_is_on_no_record():
    book = RegisterBook(LS_182AP)

    book.wrote({"cl": 5})
    book.invalidate(["cl"])

    assert "cl" not in {register.name for register in book.all()}
    assert (book.value("cl"), book.written("cl")) == (None, False)


def test_what_a_drive_was_taken_over_with_is_assumed_and_the_rest_is_unknown():
    book = RegisterBook(LS_182AP)
    book.wrote({"kp": 350, "position": 7})

    book.assume({"kp": 100})

    assert (book.value("kp"), book.written("kp"), book.value("position")) == (100, False, None)


# -- homing ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("profile", "methods"),
    [
        (LS_173AP, {HomeMethod.INDEX, HomeMethod.POSITION_ERROR}),
        (LS_182AP, set(HomeMethod) - {HomeMethod.CURRENT}),
        (PIC_SERVO_V1, set(HomeMethod)),
    ],
)
def test_each_device_has_its_home_captures(profile, methods):
    assert home_methods(profile) == methods


@pytest.mark.parametrize(
    ("profile", "method", "stop", "control"),
    [
        (LS_182AP, HomeMethod.INDEX, StopMode.ABRUPT, HomingControl.INDEX | HomingControl.STOP_ABRUPT),
        (LS_182AP, HomeMethod.REVERSE_LIMIT, StopMode.SMOOTH, HomingControl.LIMIT1 | HomingControl.STOP_SMOOTH),
        (LS_182AP, HomeMethod.FORWARD_LIMIT, StopMode.OFF, HomingControl.LIMIT2 | HomingControl.MOTOR_OFF),
        (LS_182AP, HomeMethod.POSITION_ERROR, StopMode.SMOOTH, HomingControl.POSITION_ERROR),
        (PIC_SERVO_V4, HomeMethod.CURRENT, StopMode.SMOOTH, HomingControl.CURRENT | HomingControl.STOP_SMOOTH),
        (PIC_SERVO_V2, HomeMethod.INDEX, StopMode.SMOOTH, HomingControl.INDEX),
    ],
)
def test_a_capture_is_armed_with_its_way_to_stop_where_the_drive_has_one(profile, method, stop, control):
    assert homing_control(profile, HomeCapture(method, stop)) == control


def test_only_a_position_error_and_motor_off_open_the_loop_at_home():
    assert opens_loop(PIC_SERVO_V1, HomeCapture(HomeMethod.POSITION_ERROR))
    assert opens_loop(LS_182AP, HomeCapture(HomeMethod.INDEX, StopMode.OFF))
    assert not opens_loop(PIC_SERVO_V1, HomeCapture(HomeMethod.INDEX, StopMode.OFF))  # the host does it
    assert not opens_loop(LS_182AP, HomeCapture(HomeMethod.INDEX, StopMode.ABRUPT))


# -- motions -----------------------------------------------------------------------------------------------------------


def test_the_three_kinds_of_motion_are_three_trajectories():
    velocity, acceleration = 2000.0, 20_000.0

    assert trajectory_of(Motion(-500, velocity, acceleration), 1, LS_182AP) == Trajectory(
        position=-500, velocity=67_109, acceleration=344
    )
    assert trajectory_of(Motion(None, -velocity, acceleration), 1, LS_182AP) == Trajectory(
        velocity=67_109, acceleration=344, mode=ProfileMode.VELOCITY, reverse=True
    )
    assert trajectory_of(Motion(None, velocity, acceleration), 1, LS_182AP) == Trajectory(
        velocity=67_109, acceleration=344, mode=ProfileMode.VELOCITY
    )
    assert trajectory_of(AnalogMotion(356, velocity, acceleration), 1, LS_182AP) == Trajectory(
        velocity=67_109, acceleration=344, pwm_or_target=356, mode=ProfileMode.VELOCITY
    )
    assert trajectory_of(PwmOutput(-0.2, acceleration), 1, LS_182AP) == Trajectory(
        acceleration=344, pwm_or_target=51, servo=False, reverse=True
    )


@pytest.mark.parametrize(
    ("profile", "most"), [(PIC_SERVO_V4, 500_000), (LS_182AP, 2_000_000), (PIC_SERVO_SC, 2_500_000)]
)
def test_a_speed_at_which_the_encoder_would_lose_counts_is_refused(profile, most):
    assert quantised(Motion(None, float(most), 1e6), 1, profile).velocity_counts_per_s == pytest.approx(most)
    for refused in (Motion(0, most * 1.001, 1e6), Motion(None, -most * 1.001, 1e6)):
        with pytest.raises(ValueOutOfRange) as refusal:
            quantised(refused, 1, profile)
        assert abs(refusal.value.nearest) == most
        with pytest.raises(ValueOutOfRange):
            trajectory_of(refused, 1, profile)


def test_an_analog_motion_needs_absolute_positioning():
    with pytest.raises(NotSupported):
        trajectory_of(AnalogMotion(100, 1000.0, 1000.0), 1, PIC_SERVO_V4)


@pytest.mark.parametrize(
    ("profile", "target", "nearest"), [(LS_182AP, 7, 8), (LS_182AP, 1016, 1015), (LS_173AP, 1, 2), (LS_173AP, 254, 253)]
)
def test_an_analog_target_outside_the_sensor_range_is_refused(profile, target, nearest):
    with pytest.raises(ValueOutOfRange) as refusal:
        trajectory_of(AnalogMotion(target, 1000.0, 1000.0), 1, profile)

    assert refusal.value.nearest == nearest
    trajectory_of(AnalogMotion(nearest, 1000.0, 1000.0), 1, profile)


def test_quantising_keeps_the_sign_and_rounds_to_the_register():
    motion = quantised(Motion(None, -2000.0, 20_000.0), 1, LS_182AP)

    assert motion.velocity_counts_per_s == pytest.approx(-67_109 / 33.554432)
    assert motion.acceleration_counts_per_s2 == pytest.approx(344 / 0.017179869184)


# -- pins --------------------------------------------------------------------------------------------------------------


def test_pins_change_one_by_one():
    pins = with_modes(INPUTS, PinMode.HIGH, None)
    assert pins == LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_INPUT

    pins = with_modes(pins, None, PinMode.LOW)
    assert pins == LimitPins.LIMIT1_HIGH

    assert with_modes(pins, PinMode.INPUT, PinMode.INPUT) == INPUTS


def test_a_pin_that_is_an_output_blocks_homing_on_it_only():
    pins = with_modes(INPUTS, PinMode.LOW, None)

    assert blocks_homing(pins, HomeMethod.REVERSE_LIMIT)
    assert not blocks_homing(pins, HomeMethod.FORWARD_LIMIT)
    assert not blocks_homing(pins, HomeMethod.INDEX)


# -- drive state -------------------------------------------------------------------------------------------------------


def test_a_closed_loop_proves_that_the_power_driver_is_on():
    state = DriveState("x", LS_182AP)

    reading = state.reading(status(flags=StatusFlag.POWER_ON | StatusFlag.LIMIT1))

    assert state.known.pic_ae
    assert (reading.faults, reading.reverse_limit, reading.forward_limit) == ((), True, False)


def test_limit_switches_are_out_of_sight_while_the_power_driver_is_off():
    state = DriveState("x", LS_182AP)

    reading = state.reading(
        status(flags=StatusFlag.POWER_ON | StatusFlag.LIMIT1 | StatusFlag.LIMIT2, aux=AuxFlag.INDEX)
    )

    assert (reading.enabled, reading.reverse_limit, reading.forward_limit, reading.faults) == (False, None, None, ())


def test_an_open_loop_on_purpose_is_no_position_error():
    state = DriveState("x", PIC_SERVO_V4)
    state.switched(pic_ae=True, closed=True)
    tripped = status(flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag.INDEX)
    searching = status(
        flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR | StatusFlag.HOME_IN_PROGRESS, aux=AuxFlag.INDEX
    )
    assert [fault.code for fault in state.faults(tripped)] == ["position_error"]

    state.switched(pic_ae=True, closed=True)
    state.known = replace(state.known, latched=None)
    state.loaded(absolute=False, opens_loop=True)

    assert state.faults(tripped) == ()
    assert [fault.code for fault in state.faults(searching)] == ["position_error"]


def test_a_loop_that_was_closed_again_is_not_open_on_purpose():
    state = DriveState("x", PIC_SERVO_V4)
    state.loaded(absolute=False, opens_loop=True)
    state.switched(pic_ae=True, closed=True)
    tripped = status(flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag.INDEX)

    assert [fault.code for fault in state.faults(tripped)] == ["position_error"]


def test_velocity_counts_in_the_ticks_of_the_servo_rate_divisor_but_not_on_sc():
    v4, sc = DriveState("x", PIC_SERVO_V4), DriveState("x", PIC_SERVO_SC)
    v4.servo_divisor = sc.servo_divisor = 4

    assert v4.reading(status(velocity=8)).velocity_counts_per_s == pytest.approx(8 / 0.002048)
    assert sc.reading(status(velocity=8)).velocity_counts_per_s == pytest.approx(8 / 0.000512)


def test_a_search_is_armed_until_the_drive_says_that_it_is_over():
    state = DriveState("x", LS_182AP)
    state.homing_armed, state.guard = True, "forward limit"

    state.reading(status(flags=StatusFlag.POWER_ON | StatusFlag.HOME_IN_PROGRESS))
    assert (state.homing_armed, state.guard_hit) == (True, False)

    state.reading(status())
    assert (state.homing_armed, state.guard_hit) == (False, True)


def test_a_servo_overrun_is_a_warning():
    state = DriveState("x", LS_182AP)

    (fault,) = state.reading(status(aux=CLOSED | AuxFlag.SERVO_OVERRUN)).faults

    assert (fault.code, fault.stops) == ("servo_overrun", False)


def test_the_motion_lock_is_seen_where_there_is_one():
    locked = status(aux=CLOSED | AuxFlag.MOTION_LOCKED)
    logosol, pic_servo = DriveState("x", LS_182AP), DriveState("x", PIC_SERVO_V4)

    logosol.reading(locked)
    pic_servo.reading(locked)

    assert (logosol.motion_locked, pic_servo.motion_locked) == (True, False)


def test_a_status_without_position_is_no_reading():
    with pytest.raises(BadReply):
        DriveState("x", LS_182AP).reading(Status(StatusFlag(0)))
