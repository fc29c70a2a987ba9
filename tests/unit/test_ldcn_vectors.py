"""Every printed frame of the manuals, right or wrong: tests/vectors/ldcn-nmc.json."""

import json
from pathlib import Path

import pytest

from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.commands import Group, Node
from ldcnd.drivers.ldcn.packet import Command, decode_packet, encode_packet
from ldcnd.drivers.ldcn.profiles import PROFILES
from ldcnd.drivers.ldcn.received import (
    AddPathPoints,
    DefineStatus,
    HardReset,
    IoControl,
    LoadTrajectory,
    PlainCommand,
    ReadStatus,
    ResetPosition,
    SetAddress,
    SetBaudRate,
    SetGain,
    SetHomingMode,
    StopMotor,
    decode_command,
    interpret_bytes,
)
from ldcnd.drivers.ldcn.registers import BaudCodes, Gains, baud_divisor
from ldcnd.drivers.ldcn.status import Status, StatusFlag, StatusItem, decode_status, encode_status
from ldcnd.drivers.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.errors import BadReply

ROWS = json.loads((Path(__file__).parents[1] / "vectors" / "ldcn-nmc.json").read_text())
DIALECTS = {"ldcn-182": "ls-182ap", "ldcn-173": "ls-173ap", "nmc-sc": "pic-servo-sc"}

STOP_BITS = {"amp_enable": 0x01, "motor_off": 0x02, "stop_abrupt": 0x04, "stop_smooth": 0x08, "stop_here": 0x10}
HOMING_BITS = {
    "on_limit1": 0x01,
    "on_limit2": 0x02,
    "motor_off": 0x04,
    "on_index": 0x08,
    "stop_abrupt": 0x10,
    "stop_smooth": 0x20,
}
ITEM_BITS = ("position", "ad", "velocity", "aux", "home", "id_version", "pos_error", "bit7")


def rows(kind, *, ok):
    chosen = [row for row in ROWS if row["kind"] == kind and row["ok"] is ok]
    return pytest.mark.parametrize("row", chosen, ids=[row["hex"] for row in chosen])


def profile_of(row):
    return PROFILES[DIALECTS[row["profile"]]]


def bits(names, table):
    return sum(table[name] for name in names)


def trajectory_of(decoded):
    return Trajectory(
        position=decoded.get("position"),
        velocity=decoded.get("velocity"),
        acceleration=decoded.get("acceleration"),
        pwm_or_target=decoded.get("pwm_or_atv"),
        servo=decoded["servo"],
        mode=ProfileMode(decoded["profile"]),
        reverse=decoded["reverse_or_relative"],
        start_now=decoded["start_now"],
    )


def gains_of(decoded):
    registers = [decoded[name] for name in ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "db")]
    return Gains(*registers, decoded.get("sm", 1))


def expected(decoded):  # noqa: PLR0911, PLR0912 - one branch per command
    """Say with our types what the row says."""
    match Command(decoded["cmd"]):
        case Command.RESET_POSITION:
            return ResetPosition(decoded.get("set_position", 0), decoded.get("relative_to_home", False))
        case Command.SET_ADDRESS:
            return SetAddress(decoded["individual"], decoded["group"], decoded["leader"])
        case Command.DEFINE_STATUS:
            return DefineStatus(StatusItem(decoded["mask"]))
        case Command.READ_STATUS:
            return ReadStatus(StatusItem(decoded["mask"]))
        case Command.LOAD_TRAJECTORY:
            return LoadTrajectory(trajectory_of(decoded))
        case Command.SET_GAIN:
            return SetGain(gains_of(decoded))
        case Command.STOP_MOTOR:
            return StopMotor(bits(decoded["bits"], STOP_BITS), decoded.get("position"))
        case Command.IO_CONTROL:
            return IoControl(decoded["control"])
        case Command.SET_HOMING_MODE:
            return SetHomingMode(bits(decoded["bits"], HOMING_BITS))
        case Command.SET_BAUD_RATE:
            return SetBaudRate(decoded["brd"])
        case Command.ADD_PATH_POINTS:
            return AddPathPoints(tuple(decoded["points_raw"]))
        case Command.HARD_RESET:
            return HardReset(decoded.get("control"))
        case plain:
            return PlainCommand(plain)


def built(profile, address, command):  # noqa: PLR0911, PLR0912 - one branch per command
    """Build the frame from the decoded command; None where the host has no use for it."""
    to = Node(address, profile)
    match command:
        case ResetPosition(0, False):
            return commands.reset_position(to)
        case ResetPosition(_, True):
            return commands.reset_position_relative_to_home(to)
        case ResetPosition(position):
            return commands.set_position(to, position)
        case SetAddress(individual, group, leader):
            return commands.set_address(to, individual, group, leader=leader)
        case DefineStatus(items):
            return commands.define_status(to, items)
        case ReadStatus(items):
            return commands.read_status(to, items)
        case LoadTrajectory(trajectory):
            return commands.load_trajectory(to, trajectory)
        case SetGain(gains):
            return commands.set_gain(to, gains)
        case StopMotor(control, position):
            return commands.stop_motor(to, control, position)
        case IoControl(control):
            return commands.set_output_mode(to, control)
        case SetHomingMode(control):
            return commands.set_homing(to, control)
        case SetBaudRate():
            return commands.set_baud(Group(address, profile), 115_200, BaudCodes.MANUAL)
        case PlainCommand(Command.START_MOTION):
            return commands.start_motion(to)
        case PlainCommand(Command.CLEAR_STICKY_BITS):
            return commands.clear_sticky_bits(to)
        case PlainCommand(Command.SAVE_CURRENT_POSITION_AS_HOME):
            return commands.save_home(to)
        case PlainCommand(Command.NO_OPERATION):
            return commands.no_operation(to)
        case HardReset(None):
            return commands.hard_reset(to)
    return None


@rows("command", ok=True)
def test_a_correct_frame_is_decoded_and_framed_again(row):
    frame = bytes.fromhex(row["hex"])

    packet = decode_packet(frame)
    interpretation = decode_command(profile_of(row), frame)

    assert (packet.address, packet.command, len(packet.data)) == tuple(row["decoded"][k] for k in ("addr", "cmd", "n"))
    assert interpretation.address == row["decoded"]["addr"]
    assert interpretation.command == expected(row["decoded"])
    assert encode_packet(packet) == frame


@rows("command", ok=True)
def test_a_correct_frame_is_built_byte_by_byte(row):
    command = expected(row["decoded"])

    exchange = built(profile_of(row), row["decoded"]["addr"], command)

    if exchange is None:
        assert isinstance(command, AddPathPoints | HardReset)
    else:
        assert exchange.request == bytes.fromhex(row["hex"])


@rows("command", ok=False)
def test_a_wrong_frame_is_refused_for_the_reason_noted(row):
    note = row["note"]
    if note.startswith("checksum"):
        reason = note
    elif note.startswith("control byte"):
        control, implied = note.split()[2], note.split()[4]
        reason = f"{row['decoded']['n']} data bytes, control byte {control} implies {implied}"
    else:
        nibble = note.split()[1]
        reason = f"says {nibble} data bytes, the frame has {row['decoded']['n']}"

    with pytest.raises(BadReply, match=reason):
        decode_command(profile_of(row), bytes.fromhex(row["hex"]))


@rows("command", ok=False)
def test_a_wrong_frame_is_taken_as_the_firmware_would(row):
    frame = bytes.fromhex(row["hex"])
    nibble_is_short = frame[2] >> 4 != row["decoded"]["n"]

    interpretation = interpret_bytes(profile_of(row), frame)

    assert interpretation.oddities
    assert interpretation.address == row["decoded"]["addr"]
    if nibble_is_short:  # the last data byte is taken for the checksum: nothing is executed
        assert not interpretation.checksum_ok
        assert any("follow" in oddity for oddity in interpretation.oddities)
    elif row["note"].startswith("checksum"):
        assert not interpretation.checksum_ok
        assert interpretation.command == expected(row["decoded"])
    else:  # what is missing counts as 0
        trajectory = interpretation.command.trajectory
        given = trajectory_of(row["decoded"])
        assert interpretation.checksum_ok
        for name in ("position", "velocity", "acceleration", "pwm_or_target"):
            assert getattr(trajectory, name) in {getattr(given, name), 0}
        assert (trajectory.servo, trajectory.mode, trajectory.start_now) == (given.servo, given.mode, given.start_now)


@rows("status", ok=True)
def test_a_status_packet_goes_both_ways(row):
    frame = bytes.fromhex(row["hex"])
    items = StatusItem(row["mask"])
    decoded = row["decoded"]

    status = decode_status(profile_of(row), items, frame)

    assert status == Status(StatusFlag(decoded["status"]), position=decoded.get("position"))
    assert encode_status(profile_of(row), items, status) == frame


def test_masks_name_their_items():
    for row in ROWS:
        if "items" in row["decoded"]:
            assert row["decoded"]["mask"] == sum(1 << ITEM_BITS.index(item) for item in row["decoded"]["items"])


def test_baud_codes_agree_with_the_table():
    for row in ROWS:
        if "brd" in row["decoded"]:
            assert baud_divisor(row["decoded"]["baud"]) == row["decoded"]["brd"]


def test_every_row_is_tested():
    kinds = {(row["kind"], row["ok"]) for row in ROWS}

    assert kinds == {("command", True), ("command", False), ("status", True)}
    assert {row["profile"] for row in ROWS} == set(DIALECTS)
