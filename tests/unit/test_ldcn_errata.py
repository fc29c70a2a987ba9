"""The misprints of the manuals: what is printed is refused, what is meant is built (LS-182AP unless said otherwise)."""

import pytest

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import StatusItem, item_bytes
from ldcnd.drives.ldcn.profiles import LS_173AP, LS_182AP, HomingControl
from ldcnd.drives.ldcn.received import SetGain
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory, TrajectoryControl
from tests.support.ldcn_decoding import decode_command

DRIVE = Node(1, LS_182AP)
INITIAL = Trajectory(position=0, velocity=0, acceleration=1, pwm_or_target=0, start_now=True)


def refused(frame, reason):
    with pytest.raises(BadReply, match=reason):
        decode_command(LS_182AP, bytes.fromhex(frame))


def test_the_printed_set_address_has_a_wrong_checksum():
    refused("AA 01 21 07 FF 21", "checksum 21")

    assert commands.set_address(DRIVE, 7, 0xFF).request == bytes.fromhex("AA 01 21 07 FF 28")


@pytest.mark.parametrize(
    ("address", "printed", "meant"),
    [
        (1, "AA 01 E4 9F 0000000000000000 01000000 00 85", "AA 01 F4 9F 0000000000000000 01000000 0000 95"),
        (2, "AA 02 E4 9F 0000000000000000 01000000 00 86", "AA 02 F4 9F 0000000000000000 01000000 0000 96"),
    ],
)
def test_the_printed_initial_trajectory_has_the_pwm_field_of_ls_173ap(address, printed, meant):
    refused(printed, "14 data bytes, control byte 9F implies 15")

    assert commands.load_trajectory(Node(address, LS_173AP), INITIAL).request == bytes.fromhex(printed)
    assert commands.load_trajectory(Node(address, LS_182AP), INITIAL).request == bytes.fromhex(meant)


@pytest.mark.parametrize(("address", "checksum"), [(1, "79"), (2, "7A")])
def test_the_printed_acceleration_of_6400h_is_64h_on_the_wire(address, checksum):
    printed = f"AA {address:02X} E4 9F 00000000 00800100 64000000 00 {0x68 + address:02X}"
    refused(printed, "14 data bytes, control byte 9F implies 15")

    trajectory = Trajectory(position=0, velocity=0x18000, acceleration=0x64, pwm_or_target=0, start_now=True)
    meant = f"AA {address:02X} F4 9F 00000000 00800100 64000000 0000 {checksum}"
    assert commands.load_trajectory(Node(address, LS_182AP), trajectory).request == bytes.fromhex(meant)


def test_the_printed_set_trajectory_parameters_counts_one_byte_too_few():
    refused("AA 01 E4 9F 0000000000000000 00 01 00 00 00 00 85", "says 14 data bytes")

    assert len(commands.load_trajectory(DRIVE, INITIAL).request) == 4 + 15


def test_the_printed_homing_trajectory_announces_a_position_that_it_lacks():
    refused("AA 01 94 37 25060100 58010000 51", "9 data bytes, control byte 37 implies 13")

    trajectory = Trajectory(velocity=67_109, acceleration=344, mode=ProfileMode.VELOCITY)
    meant = bytes.fromhex("AA 01 94 36 25060100 58010000 50")
    assert commands.load_trajectory(DRIVE, trajectory).request == meant


def test_the_printed_analog_target_counts_one_byte_too_few():
    refused("AA 01 A4 3E 25060100 58010000 6401 CD", "says 10 data bytes")

    trajectory = Trajectory(velocity=67_109, acceleration=344, pwm_or_target=0x164, mode=ProfileMode.VELOCITY)
    meant = bytes.fromhex("AA 01 B4 3E 25060100 58010000 6401 DD")
    assert commands.load_trajectory(DRIVE, trajectory).request == meant


def test_the_first_ki_of_the_gain_comment_is_kd():
    frame = bytes.fromhex("AA 01 E6 6400 0004 0000 0000 FF 00 0008 01 00 57")

    command = decode_command(LS_182AP, frame).command

    assert isinstance(command, SetGain)
    assert (command.gains.kp, command.gains.kd, command.gains.ki) == (0x64, 0x400, 0)


def test_bit_5_chooses_between_trapezoid_and_velocity():
    assert Trajectory(velocity=1, mode=ProfileMode.VELOCITY).control & ~TrajectoryControl.LOAD_VELOCITY == 0x30
    assert Trajectory(velocity=1, servo=False, pwm_or_target=1).control & TrajectoryControl.SERVO == 0


def test_stop_motor_has_one_or_five_data_bytes():
    smooth = commands.stop_motor(DRIVE, StopControl.AMP_ENABLE | StopControl.SMOOTH)
    here = commands.stop_motor(DRIVE, StopControl.AMP_ENABLE | StopControl.HERE, 0x2800)

    assert smooth.request == bytes.fromhex("AA 01 17 09 21")
    assert here.request == bytes.fromhex("AA 01 57 11 00280000 91")


def test_a_full_status_of_ls_182ap_has_17_optional_bytes():
    assert item_bytes(LS_182AP, StatusItem(0xFF)) == 17


def test_the_printed_homing_procedure_is_index_with_an_abrupt_stop():
    control = HomingControl.INDEX | HomingControl.STOP_ABRUPT

    assert commands.set_homing(DRIVE, control).request == bytes.fromhex("AA 01 19 18 32")
