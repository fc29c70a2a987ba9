"""The parts of an LDCN/NMC servo axis that need no line: registers, homing control, motions, pins, drive state."""

import math
from contextlib import suppress
from dataclasses import replace

import pytest

from ldcnd.contract.commands import HomeMethod, PinMode
from ldcnd.contract.errors import BadReply, NotSupported, ReplyTimeout, ValueOutOfRange
from ldcnd.contract.meta import Provenance
from ldcnd.drives.driver import AnalogMotion, Ceiling, CountsMotion, Gains, HomeCapture, PwmOutput, StopMode
from ldcnd.drives.ldcn.controls import LimitPins, pin_bits
from ldcnd.drives.ldcn.homing import home_methods, homing_control, opens_loop
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import (
    LS_173AP,
    LS_182AP,
    PIC_SERVO_SC,
    PIC_SERVO_V1,
    PIC_SERVO_V2,
    PIC_SERVO_V4,
    PROFILES,
    HomingControl,
)
from ldcnd.drives.ldcn.record import DriveState
from ldcnd.drives.ldcn.registers import REPLY_LOST, TAKEN_OVER, Assumed, Known, ServoRegisters, Unknown
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory, quantised, quantised_output, trajectory_of

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1)
CLOSED = AuxFlag.SERVO_ON | AuxFlag.INDEX


def status(flags=StatusFlag.POWER_ON | StatusFlag.MOVE_DONE, aux=CLOSED, velocity=0, adc=None):
    return StatusPacket(flags, position=5, velocity=velocity, aux=aux, adc=adc)


# -- registers ---------------------------------------------------------------------------------------------------------


def book_of(profile, gains=GAINS):
    return ServoRegisters(profile, gains, lambda: 7.0)


def write_in_vain(book, values, *, sent=True):
    """Fail to write values: the reply to a packet is lost, or it never went."""
    with suppress(ReplyTimeout), book.writing(values) as about_to_send:
        if sent:
            about_to_send()
        raise ReplyTimeout("no reply")


def state_of(profile):
    registers = book_of(profile)
    registers.reset()
    return DriveState("x", profile, registers)


@pytest.mark.parametrize(
    ("profile", "lacking"),
    [
        (LS_182AP, {"cl", "limit1_pin", "limit2_pin", "step_multiplier", "fast_path"}),
        (PIC_SERVO_V1, {"deadband", "limit1_pin", "limit2_pin", "step_multiplier", "fast_path"}),
        (PIC_SERVO_V4, {"step_multiplier", "fast_path"}),
        (PIC_SERVO_SC, {"limit1_pin", "limit2_pin"}),
    ],
)
def test_a_book_has_the_registers_of_its_device(profile, lacking):
    full = {register.name for each in PROFILES.values() for register in book_of(each).published()}

    assert {register.name for register in book_of(profile).published()} == full - lacking


def test_before_a_reset_nothing_is_known_and_after_it_what_the_manual_says():
    book = book_of(PIC_SERVO_V4)
    assert {register.provenance for register in book.published()} == {Provenance.UNKNOWN}

    book.reset()

    assert {register.provenance for register in book.published()} == {Provenance.RESET}
    assert (book.known("kp"), book.known("sr"), book.known("limit2_pin")) == (0, 1, LimitPins.LIMIT2_INPUT)


def test_a_register_is_unknown_once_its_packet_is_sent_unless_it_holds_the_value_already():
    book = book_of(LS_182AP)
    book.reset()

    with book.writing({"kp": 350, "kd": 0}) as sent:
        assert (book.known("kp"), book.known("kd")) == (0, 0)
        sent()
        assert (book["kp"], book.known("kd")) == (Unknown(REPLY_LOST, (0, 350), others=False), 0)

    assert book["kp"] == Known(350, 7.0, Provenance.WRITTEN_AND_ACKNOWLEDGED)


def test_a_register_whose_write_was_not_acknowledged_holds_one_of_its_values():
    book = book_of(LS_182AP)
    book.reset()
    for value, sent in ((350, True), (400, True), (450, False)):
        write_in_vain(book, {"kp": value}, sent=sent)

    assert book["kp"] == Unknown(REPLY_LOST, (0, 350, 400), others=False)


def test_a_register_that_the_device_lacks_is_in_no_book():
    book = book_of(LS_182AP)

    with book.writing({"cl": 5}):
        pass

    assert "cl" not in {register.name for register in book.published()}
    assert book.known("cl") is None


def test_what_a_drive_was_taken_over_with_is_assumed_and_the_rest_is_unknown():
    book = book_of(LS_182AP)
    book.reset()

    book.taken_over()

    assert isinstance(book["kp"], Assumed)
    assert (book["kp"].value, book.known("kp"), book.loaded, book.known("position")) == (350, None, False, None)


def test_a_doubtful_write_stays_in_doubt_behind_a_gap_of_the_line_and_what_was_assumed_is_not_called_written():
    book = book_of(LS_182AP)
    book.reset()
    with book.writing({"kd": 600}):
        pass
    write_in_vain(book, {"kp": 61})

    book.taken_over(known=True)
    kept = book["kd"]
    book.taken_over(known=True)

    assert book["kp"] == Unknown(TAKEN_OVER, (0, 61))
    assert book["kd"] == kept == Assumed(600, f"{TAKEN_OVER}; this host has written it before")


def test_velocity_is_shown_in_the_shortest_tick_that_is_possible():
    book = book_of(LS_182AP)
    book.reset()
    with book.writing({"sr": 10}):
        pass
    assert book.shown_tick == (pytest.approx(0.00512), False)

    write_in_vain(book, {"sr": 4})
    assert book.shown_tick == (pytest.approx(0.002048), True)

    book.forget("it is another drive")
    assert book.shown_tick == (pytest.approx(0.000512), True)

    book.wanted_gains = replace(GAINS, sr=10)
    book.taken_over()  # what is assumed is no bound: the host before may have set another
    assert book.shown_tick == (pytest.approx(0.000512), True)


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

    assert trajectory_of(CountsMotion(-500, velocity, acceleration), 1, LS_182AP) == Trajectory(
        position=-500, velocity=67_109, acceleration=344
    )
    assert trajectory_of(CountsMotion(None, -velocity, acceleration), 1, LS_182AP) == Trajectory(
        velocity=67_109, acceleration=344, mode=ProfileMode.VELOCITY, reverse=True
    )
    assert trajectory_of(CountsMotion(None, velocity, acceleration), 1, LS_182AP) == Trajectory(
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
    assert quantised(CountsMotion(None, float(most), 1e6), 1, profile).velocity_counts_per_s == pytest.approx(most)
    for refused in (CountsMotion(0, most * 1.001, 1e6), CountsMotion(None, -most * 1.001, 1e6)):
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
    motion = quantised(CountsMotion(None, -2000.0, 20_000.0), 1, LS_182AP)

    assert motion.velocity_counts_per_s == pytest.approx(-67_109 / 33.554432)
    assert motion.acceleration_counts_per_s2 == pytest.approx(344 / 0.017179869184)


def test_a_value_at_its_limit_is_rounded_down_where_the_nearest_register_is_above_it():
    step = 1 / 0.017179869184
    free = quantised(CountsMotion(0, 1000.0, 3.6 * step), 1, LS_182AP)
    held = quantised(CountsMotion(0, 1000.0, 3.6 * step), 1, LS_182AP, Ceiling(1000.0, 3.6 * step))

    assert free.acceleration_counts_per_s2 == pytest.approx(4 * step)
    assert free.velocity_counts_per_s == pytest.approx(1000.0, abs=0.02)
    assert held.acceleration_counts_per_s2 == pytest.approx(3 * step)
    assert 999.97 < held.velocity_counts_per_s <= 1000.0


def test_a_limit_that_is_a_register_value_is_reached():
    held = quantised(CountsMotion(0, 1000.0, 344 / 0.017179869184), 1, LS_182AP)

    again = quantised(held, 1, LS_182AP, Ceiling(held.velocity_counts_per_s, held.acceleration_counts_per_s2))

    assert again == held


@pytest.mark.parametrize("ceiling", [1.9, 2.0, 3.6])
def test_what_is_far_above_its_limit_is_brought_down_to_it(ceiling):
    step = 1 / 0.017179869184
    held = quantised(CountsMotion(0, 1000.0, 1000 * step), 1, LS_182AP, Ceiling(500.0, ceiling * step))

    assert held.acceleration_counts_per_s2 == pytest.approx(int(ceiling) * step)
    assert 499.97 < held.velocity_counts_per_s <= 500.0


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
@pytest.mark.parametrize(("limit", "register"), [(0.1, 25), (0.305, 77), (0.5, 127), (1.0, 255), (3 / 255, 3)])
def test_a_duty_at_its_limit_is_not_rounded_beyond_it(profile, limit, register):
    held = quantised_output(PwmOutput(-limit, 20_000.0), 1, profile, Ceiling(duty=limit))

    assert held.duty == pytest.approx(-register / 255)
    assert trajectory_of(held, 1, profile).pwm_or_target == register


@pytest.mark.parametrize("duty", [0.0015, -0.0015])
def test_a_duty_that_would_open_the_loop_without_voltage_is_refused(duty):
    with pytest.raises(ValueOutOfRange) as refusal:
        quantised_output(PwmOutput(duty, 20_000.0), 1, LS_182AP)
    assert refusal.value.nearest == pytest.approx(math.copysign(1 / 255, duty))

    with pytest.raises(ValueOutOfRange, match=r"the limit is 0\.003"):
        quantised_output(PwmOutput(2 * duty, 20_000.0), 1, LS_182AP, Ceiling(duty=0.003))


def test_a_limit_below_one_step_of_the_register_is_refused_and_the_step_is_named():
    with pytest.raises(ValueOutOfRange, match="the limit is 30") as refusal:
        quantised(CountsMotion(0, 1000.0, 30.0), 1, LS_182AP, Ceiling(1000.0, 30.0))

    assert refusal.value.limit == pytest.approx(58.2, abs=0.01)
    assert refusal.value.nearest is None
    assert (
        quantised(CountsMotion(0, 1000.0, 30.0), 2, LS_182AP, Ceiling(1000.0, 30.0)).acceleration_counts_per_s2 < 30.0
    )


# -- pins --------------------------------------------------------------------------------------------------------------


def test_the_bits_of_a_pin_say_what_it_is_used_as():
    bits = (LimitPins.LIMIT1_INPUT, LimitPins.LIMIT1_HIGH)

    assert [int(pin_bits(mode, *bits)) for mode in (PinMode.INPUT, PinMode.HIGH, PinMode.LOW)] == [4, 1, 0]


# -- drive state -------------------------------------------------------------------------------------------------------


def test_a_closed_loop_proves_that_the_power_driver_is_on():
    state = state_of(LS_182AP)

    reading = state.reading(status(flags=StatusFlag.POWER_ON | StatusFlag.LIMIT1))

    assert state.known.pic_ae
    assert (reading.faults, reading.reverse_limit, reading.forward_limit) == ((), True, False)


def test_limit_switches_are_out_of_sight_while_the_power_driver_is_off():
    state = state_of(LS_182AP)

    reading = state.reading(
        status(flags=StatusFlag.POWER_ON | StatusFlag.LIMIT1 | StatusFlag.LIMIT2, aux=AuxFlag.INDEX)
    )

    assert (reading.enabled, reading.reverse_limit, reading.forward_limit, reading.faults) == (False, None, None, ())


def test_an_open_loop_on_purpose_is_no_position_error():
    state = state_of(PIC_SERVO_V4)
    state.switched(pic_ae=True, closed=True)
    tripped = status(flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag.INDEX)
    searching = status(
        flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR | StatusFlag.HOME_IN_PROGRESS, aux=AuxFlag.INDEX
    )
    assert [fault.code for fault in state.faults(tripped)] == ["position_error"]

    state.switched(pic_ae=True, closed=True)
    state.known = replace(state.known, latched=None)
    state.loaded(absolute=False, runs_open=False, opens_at_home=True)

    assert state.faults(tripped) == ()
    assert [fault.code for fault in state.faults(searching)] == ["position_error"]

    state.known = replace(state.known, latched=None)
    state.loaded(absolute=False, runs_open=True, opens_at_home=False)  # a limit switch is to end a raw duty
    assert state.faults(searching) == ()


def test_a_loop_that_was_closed_again_is_not_open_on_purpose():
    state = state_of(PIC_SERVO_V4)
    state.loaded(absolute=False, runs_open=False, opens_at_home=True)
    state.switched(pic_ae=True, closed=True)
    tripped = status(flags=StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag.INDEX)

    assert [fault.code for fault in state.faults(tripped)] == ["position_error"]


def test_velocity_counts_in_the_ticks_of_the_servo_rate_divisor_but_not_on_sc():
    v4, sc = state_of(PIC_SERVO_V4), state_of(PIC_SERVO_SC)
    for state in (v4, sc):
        with state._registers.writing({"sr": 4}):
            pass

    assert v4.reading(status(velocity=8)).velocity_counts_per_s == pytest.approx(8 / 0.002048)
    assert sc.reading(status(velocity=8)).velocity_counts_per_s == pytest.approx(8 / 0.000512)


def test_a_search_is_armed_until_the_drive_says_that_it_is_over():
    state = state_of(LS_182AP)
    state.homing_armed, state.awaited, state.guard = True, True, (HomeMethod.FORWARD_LIMIT,)

    state.reading(status(flags=StatusFlag.POWER_ON | StatusFlag.HOME_IN_PROGRESS))
    assert (state.homing_armed, state.guard_hit) == (True, False)

    assert state.reading(status()).captured
    assert (state.homing_armed, state.guard_hit) == (False, True)


def test_a_flag_that_went_down_out_of_sight_tells_of_no_capture():
    state = state_of(LS_182AP)
    state.homing_armed, state.awaited, state.guard = True, True, (HomeMethod.FORWARD_LIMIT,)

    state.unseen()

    assert not state.reading(status()).captured
    assert not state.guard_hit


def test_a_servo_overrun_is_a_warning():
    state = state_of(LS_182AP)

    (fault,) = state.reading(status(aux=CLOSED | AuxFlag.SERVO_OVERRUN)).faults

    assert (fault.code, fault.stops) == ("servo_overrun", False)


def test_the_motion_lock_is_seen_where_there_is_one():
    locked = status(aux=CLOSED | AuxFlag.MOTION_LOCKED)
    logosol, pic_servo = state_of(LS_182AP), state_of(PIC_SERVO_V4)

    logosol.reading(locked)
    pic_servo.reading(locked)

    assert (logosol.motion_locked, pic_servo.motion_locked) == (True, False)


def test_a_status_without_position_is_no_reading():
    with pytest.raises(BadReply):
        state_of(LS_182AP).reading(StatusPacket(StatusFlag(0)))
