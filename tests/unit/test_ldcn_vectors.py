"""Every frame of tests/vectors/ldcn-nmc.json and sc-io.json, both ways.

The first file has what the manuals print, right or wrong; the second PIC-SERVO SC, CMC and PIC-I/O.
"""

import json
from pathlib import Path

import pytest

from ldcnd.contract.errors import BadReply
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn import commands, pic_io
from ldcnd.drives.ldcn.commands import LeaderlessGroup, Node
from ldcnd.drives.ldcn.controls import IoOption, LimitPins
from ldcnd.drives.ldcn.packet import (
    CommandCode,
    StatusFlag,
    StatusItem,
    StatusPacket,
    decode_packet,
    decode_status,
    encode_packet,
    encode_status,
)
from ldcnd.drives.ldcn.profiles import PROFILES, DeviceKind
from ldcnd.drives.ldcn.received import (
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
    interpret_bytes,
)
from ldcnd.drives.ldcn.registers import BAUD_DIVISORS, BaudCodes, baud_divisor, module_baud
from ldcnd.drives.ldcn.trajectory import PathPoint, ProfileMode, Trajectory
from tests.support.ldcn_decoding import decode_command, decode_point

VECTORS = Path(__file__).parents[1] / "vectors"
ROWS = [row for name in ("ldcn-nmc.json", "sc-io.json") for row in json.loads((VECTORS / name).read_text())]
DIALECTS = {
    "ldcn-182": "ls-182ap",
    "ldcn-173": "ls-173ap",
    "nmc-sc": "pic-servo-sc",
    "nmc-cmc": "pic-servo-cmc",
    "nmc-io": "pic-io",
}

STOP_BITS = {
    "amp_enable": 0x01,
    "motor_off": 0x02,
    "stop_abrupt": 0x04,
    "stop_smooth": 0x08,
    "stop_here": 0x10,
    "advanced": 0x20,
}
OPTION_BITS = {
    "limit_off": 0x04,
    "limit_stop": 0x08,
    "three_phase": 0x10,
    "antiphase": 0x20,
    "fast_path": 0x40,
    "step_dir": 0x80,
}
PIN_BITS = {"limit1_is_input": 0x04, "limit2_is_input": 0x08, "fast_path": 0x40}
START_UP_BITS = {"save": 0x01, "restore_address": 0x02, "three_phase": 0x40, "antiphase": 0x80}
NEVER_SENT = (DefineStatus, ResetPosition, IoControl, HardReset)
"""Commands that other hosts send, in forms that ours has no use for: options of an SC, its EEPROM, another zero."""
NOT_BUILT = {"the same with the don't-care bits set", "14 bytes to an SC: step multiplier stays 1"}
"""Meanings of frames that other hosts send and ours does not."""
HOMING_BITS = {
    "on_limit1": 0x01,
    "on_limit2": 0x02,
    "motor_off": 0x04,
    "on_index": 0x08,
    "stop_abrupt": 0x10,
    "stop_smooth": 0x20,
}
ITEM_BITS = ("position", "ad", "velocity", "aux", "home", "id_version", "pos_error", "bit7")
IO_ITEM_BITS = ("inputs", "ad1", "ad2", "ad3", "timer", "id_version", "synch_inputs", "synch_timer")
HERTZ = {30: 64, 60: 32, 120: 16}
"""Nominal rates of path points, and the servo cycles that a point really takes."""


def rows(kind, *, ok):
    chosen = [row for row in ROWS if row["kind"] == kind and row["ok"] is ok]
    return pytest.mark.parametrize("row", chosen, ids=[f"{row['profile']} {row['hex']}" for row in chosen])


def profile_of(row):
    return PROFILES[DIALECTS[row["profile"]]]


def bits(names, table):
    return sum(table[name] for name in names)


def trajectory_of(decoded, profile=None):
    trapezoidal = decoded["servo"] and decoded["profile"] == "trapezoidal"
    relative = trapezoidal and decoded["reverse_or_relative"]
    return Trajectory(
        position=decoded.get("position"),
        velocity=decoded.get("velocity"),
        acceleration=decoded.get("acceleration"),
        pwm_or_target=decoded.get("pwm_or_atv"),
        servo=decoded["servo"],
        mode=ProfileMode(decoded["profile"]),
        reverse=decoded["reverse_or_relative"] and not relative,
        start_now=decoded["start_now"],
        relative=relative,
    )


def gains_of(decoded):
    registers = [decoded[name] for name in ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "db")]
    return Gains(*registers, decoded.get("sm", 1))


def expected(row):
    """Say with our types what the row says."""
    decoded = row["decoded"]
    own = expected_of_io(decoded) if row["profile"] == "nmc-io" else None
    return own or expected_of_servo(decoded)


def expected_of_io(decoded):
    match decoded["name"]:
        case "Set Direction":
            return pic_io.SetDirection(decoded["directions"])
        case "Set PWM":
            return pic_io.SetPwmOutputs(decoded["pwm1"], decoded["pwm2"])
        case "Synch Output":
            return pic_io.SynchOutput()
        case "Set Output":
            return pic_io.SetOutput(decoded["outputs"])
        case "Set Synch Output":
            return pic_io.SetSynchOutput(decoded["outputs"], decoded["pwm1"], decoded["pwm2"])
        case "Set Timer Mode":
            return pic_io.SetTimerMode(decoded["enabled"], decoded["counter"], decoded["prescale"])
        case "Synch Input":
            return pic_io.SynchInput()
    return None


def expected_of_servo(decoded):  # noqa: PLR0911, PLR0912 - one branch per command
    match CommandCode(decoded["cmd"]):
        case CommandCode.RESET_POSITION:
            return ResetPosition(decoded.get("set_position", 0), decoded.get("relative_to_home", False))
        case CommandCode.SET_ADDRESS:
            return SetAddress(decoded["individual"], decoded["group"], decoded["leader"])
        case CommandCode.DEFINE_STATUS:
            return DefineStatus(StatusItem(decoded["mask"]))
        case CommandCode.READ_STATUS:
            return ReadStatus(StatusItem(decoded["mask"]))
        case CommandCode.LOAD_TRAJECTORY:
            return LoadTrajectory(trajectory_of(decoded))
        case CommandCode.SET_GAIN:
            return SetGain(gains_of(decoded))
        case CommandCode.STOP_MOTOR:
            return StopMotor(bits(decoded["bits"], STOP_BITS), decoded.get("position"))
        case CommandCode.IO_CONTROL:
            return IoControl(decoded["control"])
        case CommandCode.SET_HOMING_MODE:
            return SetHomingMode(bits(decoded["bits"], HOMING_BITS))
        case CommandCode.SET_BAUD_RATE:
            return SetBaudRate(decoded["brd"])
        case CommandCode.ADD_PATH_POINTS:
            return AddPathPoints(tuple(decoded["points_raw"]))
        case CommandCode.HARD_RESET:
            return HardReset(decoded.get("control"))
        case plain:
            return PlainCommand(plain)


def built(row, command):
    """Build the frame from the decoded command; None where the host has no use for it."""
    address, profile = row["decoded"]["addr"], profile_of(row)
    if profile.kind is not DeviceKind.IO:
        return built_for_servo(profile, address, command, row["decoded"])
    if isinstance(command, pic_io.IoCommand):
        return pic_io.send_io_command(pic_io.IoNode(address), command)
    if isinstance(command, DefineStatus):
        return None
    if isinstance(command, ReadStatus):
        return pic_io.read_io_status(pic_io.IoNode(address), pic_io.IoItem(command.items))
    return built_for_servo(profile, address, command, row["decoded"])


def built_for_servo(profile, address, command, decoded):  # noqa: PLR0911, PLR0912 - one branch per command
    to = Node(address, profile)
    match command:
        case ResetPosition(0, False):
            return commands.reset_position(to)
        case ResetPosition():
            return None
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
        case IoControl(control) if profile.sc_extensions:
            return None
        case IoControl(control):
            fast_path = bool(control & IoOption.FAST_PATH)
            return commands.io_control(to, LimitPins(control & ~IoOption.FAST_PATH), fast_path=fast_path)
        case SetHomingMode(control):
            return commands.set_homing(to, control)
        case SetBaudRate(code):
            codes = next(codes for codes in BaudCodes if BAUD_DIVISORS[codes].get(decoded["baud"]) == code)
            return commands.set_baud(LeaderlessGroup(address, profile), decoded["baud"], codes)
        case AddPathPoints(()):
            return commands.start_path(to)
        case AddPathPoints(words):
            fast_path = decoded.get("fast_path", False)
            points = [decode_point(word, fast_path=fast_path) for word in words]
            return commands.add_path_points(to, points, fast_path=fast_path)
        case PlainCommand(CommandCode.START_MOTION):
            return commands.start_motion(to)
        case PlainCommand(CommandCode.CLEAR_STICKY_BITS):
            return commands.clear_sticky_bits(to)
        case PlainCommand(CommandCode.SAVE_CURRENT_POSITION_AS_HOME):
            return commands.save_home(to)
        case PlainCommand(CommandCode.NO_OPERATION):
            return commands.no_operation(to)
        case HardReset(None):
            return commands.hard_reset(to)
    return None


@rows("command", ok=True)
@pytest.mark.sweep(2)
def test_a_correct_frame_is_decoded_and_framed_again(row):
    frame = bytes.fromhex(row["hex"])

    packet = decode_packet(frame)
    interpretation = decode_command(profile_of(row), frame)

    assert (packet.address, packet.command, len(packet.data)) == tuple(row["decoded"][k] for k in ("addr", "cmd", "n"))
    assert interpretation.address == row["decoded"]["addr"]
    assert interpretation.command == expected(row)
    assert encode_packet(packet) == frame


@rows("command", ok=True)
@pytest.mark.sweep(2)
def test_a_correct_frame_is_built_byte_by_byte(row):
    exchange = built(row, expected(row))

    if exchange is None:
        assert isinstance(expected(row), NEVER_SENT)
    elif row["meaning"] not in NOT_BUILT:
        assert exchange.request == bytes.fromhex(row["hex"])


@pytest.mark.parametrize("row", [row for row in ROWS if row["decoded"].get("points")], ids=lambda row: row["hex"])
def test_path_points_are_taken_apart(row):
    decoded = row["decoded"]

    points = [decode_point(word, fast_path=decoded["fast_path"]) for word in decoded["points_raw"]]

    assert points == [PathPoint(point["counts"], HERTZ[point["hz"]]) for point in decoded["points"]]


@rows("command", ok=False)
def test_a_wrong_frame_is_refused_for_the_reason_noted(row):
    note, frame = row["note"], bytes.fromhex(row["hex"])
    if "odd count" in note:
        reason = "3 data bytes, ADD_PATH_POINTS takes 2"
    elif "not executed" in note:
        reason = f"packet checksum {frame[-1]:02X}"
    elif note.startswith("checksum"):
        reason = note
    elif note.startswith("control byte"):
        control, implied = note.split()[2], note.split()[4]
        reason = f"{row['decoded']['n']} data bytes, control byte {control} implies {implied}"
    else:
        nibble = note.split()[1]
        reason = f"says {nibble} data bytes, the frame has {row['decoded']['n']}"

    with pytest.raises(BadReply, match=reason):
        decode_command(profile_of(row), frame)


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
    elif "odd count" in row["note"]:
        assert interpretation.command == AddPathPoints((402,), half=0)
    elif "not executed" in row["note"]:
        assert not interpretation.checksum_ok
    elif row["note"].startswith("checksum"):
        assert not interpretation.checksum_ok
        assert interpretation.command == expected(row)
    else:  # what is missing counts as 0
        trajectory = interpretation.command.trajectory
        given = trajectory_of(row["decoded"])
        assert interpretation.checksum_ok
        for name in ("position", "velocity", "acceleration", "pwm_or_target"):
            assert getattr(trajectory, name) in {getattr(given, name), 0}
        assert (trajectory.servo, trajectory.mode, trajectory.start_now) == (given.servo, given.mode, given.start_now)


def status_of(decoded, profile):
    raw = decoded.get("velocity_raw")
    return StatusPacket(
        StatusFlag(decoded["status"]),
        position=decoded.get("position"),
        adc=decoded.get("ad"),
        velocity=None if raw is None else profile.velocity_sign * raw,
        aux=decoded.get("aux"),
        home=decoded.get("home"),
        device_id=decoded.get("device_id"),
        version=decoded.get("version"),
        position_error=decoded.get("pos_error"),
        bit7=decoded.get("path_points"),
    )


def io_status_of(decoded):
    return pic_io.IoStatus(
        rejected=bool(decoded["status"] & 2),
        levels=decoded.get("inputs"),
        adc1=decoded.get("ad1"),
        adc2=decoded.get("ad2"),
        adc3=decoded.get("ad3"),
        counter=decoded.get("timer"),
        device_id=decoded.get("device_id"),
        version=decoded.get("version"),
        captured_levels=decoded.get("synch_inputs"),
        captured_counter=decoded.get("synch_timer"),
    )


@rows("status", ok=True)
def test_a_status_packet_goes_both_ways(row):
    frame, profile = bytes.fromhex(row["hex"]), profile_of(row)

    if profile.kind is DeviceKind.IO:
        items = pic_io.IoItem(row["mask"])
        io_status = pic_io.decode_io_status(items, frame)
        assert io_status == io_status_of(row["decoded"])
        assert pic_io.encode_io_status(items, io_status) == frame
    else:
        items = StatusItem(row["mask"])
        status = decode_status(profile, items, frame)
        assert status == status_of(row["decoded"], profile)
        assert encode_status(profile, items, status) == frame


def test_masks_name_their_items():
    for row in ROWS:
        if "items" in row["decoded"]:
            names = IO_ITEM_BITS if row["profile"] == "nmc-io" else ITEM_BITS
            assert row["decoded"]["mask"] == sum(1 << names.index(item) for item in row["decoded"]["items"])


def test_baud_codes_agree_with_the_table():
    for row in ROWS:
        if "brd" in row["decoded"]:
            baud, code = row["decoded"]["baud"], row["decoded"]["brd"]
            assert module_baud(profile_of(row), code) == pytest.approx(baud, rel=0.035)
            assert code in {baud_divisor(baud, codes) for codes in BaudCodes}


def test_control_bytes_name_their_bits():
    tables = {7: STOP_BITS, 9: HOMING_BITS, 15: START_UP_BITS}
    for row in ROWS:
        decoded = row["decoded"]
        if "bits" in decoded and "control" in decoded:
            pins = PIN_BITS if row["profile"] == "nmc-cmc" else OPTION_BITS
            assert decoded["control"] == bits(decoded["bits"], tables.get(decoded["cmd"], pins))


def test_every_row_is_tested():
    kinds = {(row["kind"], row["ok"]) for row in ROWS}

    assert kinds == {("command", True), ("command", False), ("status", True)}
    assert {row["profile"] for row in ROWS} == set(DIALECTS)
