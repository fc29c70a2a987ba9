"""Diagnostics: LS-182AP manual, "Diagnostic bits", row by row; PIC-SERVO manual, 4.5 and 5.3."""

import pytest

from ldcnd.drives.ldcn.faults import WARNINGS, FaultCode, Knowledge, LdcnFault, diagnose
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import PROFILES

LS_182AP = PROFILES["ls-182ap"]
LS_173AP = PROFILES["ls-173ap"]
V4 = PROFILES["pic-servo-v4"]


def logosol(row, *, adc=None):
    """Build a status from the first six columns of the table."""
    limit2, limit1, pos_error, power_on, servo_on, index = (bit == "1" for bit in row.split())
    flags = (
        StatusFlag.LIMIT2 * limit2
        | StatusFlag.LIMIT1 * limit1
        | StatusFlag.POSITION_ERROR * pos_error
        | StatusFlag.POWER_ON * power_on
    )
    return StatusPacket(StatusFlag(flags), adc=adc, aux=AuxFlag(AuxFlag.SERVO_ON * servo_on | AuxFlag.INDEX * index))


def found(profile, status, *, pic_ae, absolute_mode=False, **known):
    known = {"nothing_latched": pic_ae is False, "closed": bool(pic_ae)} | known
    return diagnose(profile, status, Knowledge(pic_ae=pic_ae, absolute=absolute_mode, **known))


@pytest.mark.parametrize("pos_error", "01")
def test_switched_off_and_healthy_is_no_fault(pos_error):
    assert found(LS_182AP, logosol(f"1 1 {pos_error} 1 0 1"), pic_ae=False) == ()


@pytest.mark.parametrize("row", ["0 0 0 1 1 0", "1 0 0 1 1 1", "0 1 0 1 0 1", "1 1 0 1 0 0"])
def test_switched_on_the_limit_bits_are_limit_switches(row):
    assert found(LS_182AP, logosol(row), pic_ae=True) == ()


@pytest.mark.parametrize(
    ("row", "codes"),
    [
        ("0 1 0 1 0 1", [FaultCode.OVERHEAT]),
        ("0 1 1 1 0 1", [FaultCode.OVERHEAT]),
        ("1 0 0 1 0 1", [FaultCode.STOP_INPUT]),
        ("1 0 1 1 0 1", [FaultCode.STOP_INPUT]),
        ("0 0 1 1 0 1", [FaultCode.STOP_INPUT, FaultCode.OVERHEAT]),
        ("1 1 0 0 0 1", [FaultCode.OVERVOLTAGE]),
        ("1 1 1 0 0 1", [FaultCode.OVERVOLTAGE]),
        ("1 0 1 0 0 1", [FaultCode.LATCHED_FAULT]),  # the chapter on the stop input has it clear bit 3, too
    ],
)
def test_switched_off_the_bits_say_what_is_wrong_at_present(row, codes):
    assert found(LS_182AP, logosol(row), pic_ae=False) == tuple(LdcnFault(code, latched=False) for code in codes)


@pytest.mark.parametrize(
    ("row", "code"),
    [
        ("1 0 1 0 0 1", FaultCode.STOP_INPUT),
        ("0 1 1 0 0 1", FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE),
        ("1 1 1 0 0 1", FaultCode.OVERHEAT),
        ("0 0 1 0 0 1", FaultCode.OVERCURRENT),
        ("1 0 1 0 0 0", FaultCode.ENCODER_OR_HALL),
        ("1 1 1 1 0 0", FaultCode.POSITION_ERROR),
        ("0 0 1 1 0 1", FaultCode.POSITION_ERROR),
    ],
)
def test_switched_on_the_bits_say_what_switched_the_driver_off(row, code):
    loses = code is FaultCode.ENCODER_OR_HALL
    assert found(LS_182AP, logosol(row), pic_ae=True) == (LdcnFault(code, latched=True, loses_position=loses),)


@pytest.mark.parametrize("row", ["1 1 1 0 0 1", "0 0 1 0 0 1", "1 0 1 0 0 0"])
@pytest.mark.parametrize("pic_ae", [False, None])
def test_what_bit_3_stands_for_is_not_readable_while_a_cause_may_be_latched(row, pic_ae):
    fault = LdcnFault(FaultCode.LATCHED_FAULT, latched=True, loses_position=True)

    assert found(LS_182AP, logosol(row), pic_ae=pic_ae, nothing_latched=False) == (fault,)


@pytest.mark.parametrize("row", ["1 1 1 0 0 1", "0 0 1 0 0 1"])
@pytest.mark.parametrize("pic_ae", [False, None])
def test_a_cause_that_was_seen_keeps_its_name_while_bit_3_is_clear(row, pic_ae):
    cause = LdcnFault(FaultCode.OVERCURRENT, latched=True)

    assert found(LS_182AP, logosol(row), pic_ae=pic_ae, nothing_latched=False, latched=cause) == (cause,)


def test_a_cause_of_the_power_driver_is_gone_once_bit_3_is_set_again():
    cause = LdcnFault(FaultCode.OVERCURRENT, latched=True)

    assert found(LS_182AP, logosol("1 1 1 1 0 1"), pic_ae=False, latched=cause) == ()


@pytest.mark.parametrize(
    ("row", "codes"), [("1 1 1 1 0 1", []), ("0 0 0 1 0 1", []), ("0 1 1 1 0 1", [FaultCode.LATCHED_FAULT])]
)
def test_with_pic_ae_not_known_only_what_both_readings_call_a_fault_is_one(row, codes):
    assert [fault.code for fault in found(LS_182AP, logosol(row), pic_ae=None)] == codes


def test_a_closed_loop_is_read_as_the_power_driver_being_on():
    assert found(LS_182AP, logosol("0 0 0 1 1 1"), pic_ae=None) == ()


def test_an_analog_move_that_may_have_been_under_way_leaves_the_cause_open():
    status = logosol("1 1 1 1 0 1", adc=0)

    (fault,) = diagnose(LS_182AP, status, Knowledge(pic_ae=True, absolute=None))

    assert fault.code is FaultCode.LATCHED_FAULT


@pytest.mark.parametrize("adc", [0, 7, 1016, 1023])
def test_a_lost_sensor_is_reported_in_absolute_positioning_mode_only(adc):
    status = logosol("1 1 1 1 0 1", adc=adc)

    assert found(LS_182AP, status, pic_ae=True, absolute_mode=True) == (
        LdcnFault(FaultCode.SENSOR_FAULT, latched=True),
    )
    assert found(LS_182AP, status, pic_ae=True) == (LdcnFault(FaultCode.POSITION_ERROR, latched=True),)


@pytest.mark.parametrize("adc", [None, 8, 500, 1015])
def test_a_connected_sensor_is_not_blamed(adc):
    status = logosol("1 1 1 1 0 1", adc=adc)

    (fault,) = found(LS_182AP, status, pic_ae=True, absolute_mode=True)

    assert fault.code is FaultCode.POSITION_ERROR


@pytest.mark.parametrize(("adc", "code"), [(1, "sensor_fault"), (2, "position_error"), (254, "sensor_fault")])
def test_the_sensor_range_scales_with_the_converter(adc, code):
    status = logosol("1 1 1 1 0 1", adc=adc)

    assert [fault.code for fault in found(LS_173AP, status, pic_ae=True, absolute_mode=True)] == [code]


def test_an_old_position_error_in_a_closed_loop_is_no_fault():
    assert found(LS_182AP, logosol("1 1 1 1 1 1"), pic_ae=True) == ()


def test_without_the_auxiliary_byte_a_stop_input_and_a_lost_encoder_look_alike():
    status = StatusPacket(StatusFlag.LIMIT2 | StatusFlag.POSITION_ERROR)

    fault = LdcnFault(FaultCode.LATCHED_FAULT, latched=True, loses_position=True)
    assert found(LS_182AP, status, pic_ae=True) == (fault,)


def test_pic_servo_at_rest_with_everything_off_is_healthy():
    status = StatusPacket(StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag(0))

    assert found(V4, status, pic_ae=False) == ()


def test_pic_servo_tells_a_position_error_from_lost_power():
    tripped = StatusPacket(StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag(0))
    unpowered = StatusPacket(StatusFlag.POSITION_ERROR, aux=AuxFlag(0))

    assert found(V4, tripped, pic_ae=True) == (LdcnFault(FaultCode.POSITION_ERROR, latched=True),)
    assert found(V4, unpowered, pic_ae=True) == (LdcnFault(FaultCode.POWER_LOST, latched=True),)
    assert found(V4, unpowered, pic_ae=False) == (LdcnFault(FaultCode.POWER_LOST, latched=False),)


def test_missing_motor_power_stops_nothing_while_the_loop_is_open():
    assert not LdcnFault(FaultCode.POWER_LOST, latched=False).stops
    assert LdcnFault(FaultCode.POWER_LOST, latched=True).stops


def test_pic_servo_that_tripped_out_of_sight_does_not_say_why():
    tripped = StatusPacket(StatusFlag.POWER_ON | StatusFlag.POSITION_ERROR, aux=AuxFlag(0))

    assert found(V4, tripped, pic_ae=True, seen=False) == (LdcnFault(FaultCode.LATCHED_FAULT, latched=True),)


def test_pic_servo_limit_switches_are_no_faults():
    status = StatusPacket(StatusFlag.POWER_ON, aux=AuxFlag.SERVO_ON)

    assert found(V4, status, pic_ae=True) == ()


def test_current_limiting_is_known_on_pic_servo_only():
    flags = StatusFlag.POWER_ON | StatusFlag.OVERCURRENT | StatusFlag.LIMIT1 | StatusFlag.LIMIT2
    status = StatusPacket(flags, aux=AuxFlag.SERVO_ON)

    assert found(V4, status, pic_ae=True) == (LdcnFault(FaultCode.CURRENT_LIMIT, latched=True),)
    assert found(LS_182AP, status, pic_ae=True) == ()


@pytest.mark.parametrize("profile", [LS_182AP, V4])
def test_warnings_come_from_the_auxiliary_byte(profile):
    aux = AuxFlag.SERVO_ON | AuxFlag.POSITION_WRAP | AuxFlag.SERVO_OVERRUN
    status = StatusPacket(StatusFlag.POWER_ON | StatusFlag.LIMIT1 | StatusFlag.LIMIT2, aux=aux)

    codes = [fault.code for fault in found(profile, status, pic_ae=True)]

    assert codes == [FaultCode.POSITION_WRAP, FaultCode.SERVO_OVERRUN]
    assert WARNINGS.issuperset(codes)


def test_every_fault_says_what_to_do():
    remedies = {code.remedy for code in FaultCode}

    assert len(remedies) == len(FaultCode)
    assert all(": " in remedy for remedy in remedies)
