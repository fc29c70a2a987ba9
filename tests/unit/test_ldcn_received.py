"""Commands as a module takes them: it believes the count in the command byte (PIC-SERVO manual, section 3 and 5.2)."""

import pytest

from ldcnd.contract.errors import BadReply
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.received import (
    HardReset,
    Interpretation,
    IoControl,
    LoadTrajectory,
    PlainCommand,
    ResetPosition,
    SetAddress,
    SetGain,
    StopMotor,
    UndefinedCommand,
    interpret,
    interpret_bytes,
)
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from tests.support.ldcn_decoding import decode_command

LS_182AP = PROFILES["ls-182ap"]
V3, V4 = PROFILES["pic-servo-v3"], PROFILES["pic-servo-v4"]
SC = PROFILES["pic-servo-sc"]
THIRTEEN = bytes.fromhex("64 00 00 04 00 00 00 00 ff 00 00 08 01")


def taken(profile, command, data):
    return interpret(profile, Packet(1, command, bytes.fromhex(data)))


def test_surplus_data_bytes_are_ignored_and_reported():
    interpretation = taken(V4, CommandCode.START_MOTION, "01 02")

    assert interpretation.command == PlainCommand(CommandCode.START_MOTION)
    assert interpretation.oddities == ("2 data bytes, START_MOTION takes 0: the surplus is ignored",)


@pytest.mark.parametrize(("buffered", "acceleration"), [("", 0), ("ff " * 9 + "64 00 00 00 05 06", 100)])
def test_missing_data_bytes_are_those_of_the_receive_buffer_and_are_reported(buffered, acceleration):
    packet = Packet(1, CommandCode.LOAD_TRAJECTORY, bytes.fromhex("37 25 06 01 00 58 01 00 00"))

    interpretation = interpret(V4, packet, bytes.fromhex(buffered))

    trajectory = Trajectory(position=67_109, velocity=344, acceleration=acceleration, mode=ProfileMode.VELOCITY)
    assert interpretation.command == LoadTrajectory(trajectory)
    (oddity,) = interpretation.oddities
    assert oddity.startswith("9 data bytes, control byte 37 implies 13: ")
    assert "receive buffer" in oddity


def test_a_control_byte_out_of_the_receive_buffer_says_how_many_more_come_from_there():
    interpretation = interpret(V4, Packet(1, CommandCode.LOAD_TRAJECTORY, b""), bytes.fromhex("91 05 00 00 00 07 08"))

    assert interpretation.command == LoadTrajectory(Trajectory(position=5, start_now=True))


def test_a_half_present_field_keeps_its_low_bytes():
    interpretation = taken(LS_182AP, CommandCode.LOAD_TRAJECTORY, "08 07")

    assert interpretation.command.trajectory.pwm_or_target == 7


def test_version_4_takes_thirteen_gain_bytes_without_deadband_compensation():
    interpretation = interpret(V4, Packet(1, CommandCode.SET_GAIN, THIRTEEN), bytes([9] * 15))

    assert interpretation.command == SetGain(Gains(100, 1024, 0, 0, 255, 0, 2048, 1, deadband=0))
    assert not interpretation.oddities


def test_version_3_ignores_the_fourteenth_gain_byte():
    interpretation = interpret(V3, Packet(1, CommandCode.SET_GAIN, THIRTEEN + b"\x05"))

    assert interpretation.command.gains.deadband == 0


def test_a_missing_step_multiplier_is_one():
    interpretation = interpret(SC, Packet(1, CommandCode.SET_GAIN, THIRTEEN + b"\x05"))

    assert (interpretation.command.gains.deadband, interpretation.command.gains.step_multiplier) == (5, 1)


def test_gains_out_of_range_are_taken_as_they_are():
    interpretation = taken(V4, CommandCode.SET_GAIN, "ff " * 12 + "00 00")

    assert (interpretation.command.gains.kp, interpretation.command.gains.sr) == (0xFFFF, 0)


def test_undefined_commands_are_kept_with_their_data():
    assert taken(LS_182AP, CommandCode.IO_CONTROL, "05").command == UndefinedCommand(CommandCode.IO_CONTROL, b"\x05")
    assert taken(V4, CommandCode.ADD_PATH_POINTS, "").command == UndefinedCommand(CommandCode.ADD_PATH_POINTS, b"")
    assert taken(V4, CommandCode.IO_CONTROL, "05").command == IoControl(5)


def test_reset_position_means_more_on_sc():
    assert taken(SC, CommandCode.RESET_POSITION, "02 fe ff ff ff").command == ResetPosition(position=-2)
    assert taken(SC, CommandCode.RESET_POSITION, "01").command == ResetPosition(relative_to_home=True)
    assert taken(V4, CommandCode.RESET_POSITION, "01").command == ResetPosition()


def test_hard_reset_takes_a_control_byte_on_sc_only():
    assert taken(SC, CommandCode.HARD_RESET, "5f").command == HardReset(0x5F)
    assert taken(V4, CommandCode.HARD_RESET, "5f").command == HardReset()


def test_the_leader_bit_is_not_part_of_the_group_address():
    assert taken(V4, CommandCode.SET_ADDRESS, "05 01").command == SetAddress(5, 0x81, leader=True)
    assert taken(V4, CommandCode.SET_ADDRESS, "05 81").command == SetAddress(5, 0x81, leader=False)


def test_a_stop_position_counts_only_with_its_bit():
    assert taken(V4, CommandCode.STOP_MOTOR, "11 64 00 00 00").command == StopMotor(StopControl(0x11), 100)
    assert taken(V4, CommandCode.STOP_MOTOR, "09 64 00 00 00").command == StopMotor(StopControl(0x09), None)


def test_bytes_of_a_line_are_explained_with_their_wrong_checksum():
    interpretation = interpret_bytes(LS_182AP, bytes.fromhex("00 00 aa 01 21 07 ff 21"))

    assert interpretation == Interpretation(
        1,
        SetAddress(7, 0xFF, leader=False),
        ("packet checksum 21, computed 28: not executed",),
        checksum_ok=False,
    )


@pytest.mark.parametrize("data", [b"", b"\x00\x55", b"\xaa\x01\x13\x01"])
def test_bytes_without_a_packet_cannot_be_explained(data):
    with pytest.raises(BadReply, match="no complete packet"):
        interpret_bytes(LS_182AP, data)


@pytest.mark.parametrize(
    ("profile", "packet", "reason"),
    [
        (V4, Packet(1, CommandCode.START_MOTION, b"\x00"), "surplus"),
        (LS_182AP, Packet(1, CommandCode.SET_GAIN, THIRTEEN), "13 data bytes, SET_GAIN takes 14: .* receive buffer"),
        (LS_182AP, Packet(1, CommandCode.IO_CONTROL, b"\x00"), "does not define command 8"),
        (SC, Packet(1, CommandCode.ADD_PATH_POINTS, b"\x00"), "surplus"),
    ],
)
def test_strict_decoding_refuses_what_a_module_would_tolerate(profile, packet, reason):
    with pytest.raises(BadReply, match=reason):
        decode_command(profile, encode_packet(packet))
