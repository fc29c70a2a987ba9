"""LDCN/NMC commands as a module takes them: from a packet to a value.

For the simulator and the wire log. A module believes the count in the command byte: surplus data bytes are ignored, and
missing ones are those that an earlier packet has left in its receive buffer (seen on real hardware: Define Status
without its byte takes the first one of the Set Address before). `interpret` does the same and says what was odd.
Sources: LS-182AP manual, "Command Description"; PIC-SERVO manual, 5.2; for PIC-SERVO SC later vendor data sheets.
"""

from dataclasses import dataclass, field, replace

from ldcnd.contract.errors import BadReply
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.commands import COMMON_COMMANDS
from ldcnd.drives.ldcn.controls import PositionReset, StopControl
from ldcnd.drives.ldcn.packet import (
    GROUP_MEMBER,
    POSITION,
    CommandCode,
    Packet,
    PacketReader,
    ReceivedPacket,
    StatusItem,
)
from ldcnd.drives.ldcn.pic_io import DATA_BYTES, IoCommand, decode_io_command
from ldcnd.drives.ldcn.profiles import DeviceKind, HomingControl, Profile, Support
from ldcnd.drives.ldcn.registers import decode_gains
from ldcnd.drives.ldcn.trajectory import Trajectory, TrajectoryControl, decode_trajectory, trajectory_bytes

POSITION_BYTES = POSITION.width
OLDEST_GAIN_BYTES = 13
"""Length of Set Gain's data for PIC-SERVO versions 1 to 3, bytes."""


@dataclass(frozen=True, slots=True)
class PlainCommand:
    """A command without data: Start Motion, Clear Sticky Bits, Save Current Position as Home, No Operation."""

    command: CommandCode


@dataclass(frozen=True, slots=True)
class UndefinedCommand:
    """A command that this device does not define; it answers and does nothing."""

    command: CommandCode
    data: bytes


@dataclass(frozen=True, slots=True)
class UndescribedCommand:
    """A command of a device that ldcnd only identifies: what its data mean is not known."""

    command: CommandCode
    data: bytes


@dataclass(frozen=True, slots=True)
class ResetPosition:
    """Set the position counter, to 0 on everything but PIC-SERVO SC.

    Attributes:
        position: the new value of the counter, in counts.
        relative_to_home: the captured home position becomes 0 instead.
    """

    position: int = 0
    relative_to_home: bool = False


@dataclass(frozen=True, slots=True)
class SetAddress:
    """Take these addresses; `group` has bit 7 set whether the module leads it or not."""

    address: int
    group: int
    leader: bool


@dataclass(frozen=True, slots=True)
class DefineStatus:
    """Add these items to this reply and to all that follow."""

    items: StatusItem


@dataclass(frozen=True, slots=True)
class ReadStatus:
    """Send these items in this reply."""

    items: StatusItem


@dataclass(frozen=True, slots=True)
class LoadTrajectory:
    """Load motion registers, and start if the trajectory says so."""

    trajectory: Trajectory


@dataclass(frozen=True, slots=True)
class SetGain:
    """Load the position loop's registers; in range or not.

    Attributes:
        without_multiplier: the step multiplier that the device has was not sent.
    """

    gains: Gains
    without_multiplier: bool = field(default=False, repr=False, compare=False)


@dataclass(frozen=True, slots=True)
class StopMotor:
    """Stop, or switch the amplifier; `position` exactly with the bit for stopping here."""

    control: StopControl
    position: int | None


@dataclass(frozen=True, slots=True)
class IoControl:
    """Limit pins on PIC-SERVO version 4 and CMC, `IoOption` on PIC-SERVO SC."""

    control: int


@dataclass(frozen=True, slots=True)
class SetHomingMode:
    """Arm the home capture, or disarm it with 0."""

    control: HomingControl


@dataclass(frozen=True, slots=True)
class SetBaudRate:
    """Change the rate to `registers.module_baud` of this code."""

    code: int


@dataclass(frozen=True, slots=True)
class AddPathPoints:
    """Append to the path buffer; without any data, start the path. Points are raw 16-bit words.

    Attributes:
        half: a byte that was left behind the last point.
    """

    points: tuple[int, ...]
    half: int | None = None


@dataclass(frozen=True, slots=True)
class HardReset:
    """Restart; PIC-SERVO SC takes a control byte that saves or clears its configuration."""

    control: int | None = None


ReceivedCommand = (
    PlainCommand
    | UndefinedCommand
    | UndescribedCommand
    | IoCommand
    | ResetPosition
    | SetAddress
    | DefineStatus
    | ReadStatus
    | LoadTrajectory
    | SetGain
    | StopMotor
    | IoControl
    | SetHomingMode
    | SetBaudRate
    | AddPathPoints
    | HardReset
)


@dataclass(frozen=True, slots=True)
class Interpretation:
    """A module's interpretation of a packet, and what is odd about it.

    Attributes:
        address: who is meant.
        command: what the module executes, unless the checksum is wrong.
        oddities: sentences; empty for a packet as the manual wants it.
        checksum_ok: a module answers a wrong checksum but does not execute the command.
    """

    address: int
    command: ReceivedCommand
    oddities: tuple[str, ...]
    checksum_ok: bool = True


def interpret(profile: Profile, packet: Packet, buffered: bytes = b"") -> Interpretation:
    """Take an intact packet as this device would; `buffered` as in `received_command`."""
    command, expected = _complete(profile, packet, buffered)
    return Interpretation(packet.address, command, _oddities(profile, packet, command, expected))


def received_command(profile: Profile, packet: Packet, buffered: bytes = b"") -> ReceivedCommand:
    """Return what an intact packet commands this device to do.

    Args:
        profile: the dialect.
        packet: what came.
        buffered: data bytes in the receive buffer; those behind the packet's own are left from earlier packets. Bytes
            that are not given count as 0.
    """
    return _complete(profile, packet, buffered)[0]


def _complete(profile: Profile, packet: Packet, buffered: bytes) -> tuple[ReceivedCommand, int]:
    """Return the command with what the buffer adds, and how many data bytes it should have had."""
    command, expected = _decode(profile, packet)
    while len(packet.data) < min(expected, len(buffered)):  # the first byte may tell that there are more
        packet = replace(packet, data=packet.data + buffered[len(packet.data) : expected])
        command, expected = _decode(profile, packet)
    return command, expected


def interpret_bytes(profile: Profile, data: bytes, buffered: bytes = b"") -> Interpretation:
    """Take the first packet in the bytes of a line as this device would, wrong checksum included.

    Raises:
        BadReply: there is no complete packet.
    """
    reader = PacketReader()
    for at, byte in enumerate(data):
        received = reader.feed(byte)
        if received:
            return _with_frame(profile, received, buffered, checksum=byte, left=len(data) - at - 1)
    raise BadReply(f"no complete packet in {len(data)} bytes")


def _with_frame(
    profile: Profile, received: ReceivedPacket, buffered: bytes, *, checksum: int, left: int
) -> Interpretation:
    packet = received.packet
    plain = interpret(profile, packet, buffered)
    oddities = plain.oddities
    if not received.checksum_ok:
        computed = (packet.address + (len(packet.data) << 4 | packet.command) + sum(packet.data)) & 0xFF
        oddities += (f"packet checksum {checksum:02X}, computed {computed:02X}: not executed",)
    if left:
        oddities += (f"{left} byte(s) follow the {len(packet.data)} data bytes and the checksum",)
    return Interpretation(packet.address, plain.command, oddities, received.checksum_ok)


def _oddities(profile: Profile, packet: Packet, command: ReceivedCommand, expected: int) -> tuple[str, ...]:
    if isinstance(command, UndefinedCommand):
        return (f"{profile.title} does not define command {packet.command:X}",)
    if isinstance(command, UndescribedCommand):
        return ()
    count = len(packet.data)
    if count == expected:
        return ()
    what = f"{count} data bytes, {packet.command.name} takes {expected}"
    if packet.command is CommandCode.LOAD_TRAJECTORY and packet.data:
        what = f"{count} data bytes, control byte {packet.data[0]:02X} implies {expected}"
    if count > expected:
        return (f"{what}: the surplus is ignored",)
    return (f"{what}: the rest is what an earlier packet has left in the receive buffer",)


def _decode(profile: Profile, packet: Packet) -> tuple[ReceivedCommand, int]:
    """Return the command and how many data bytes it should have had."""
    data = packet.data
    first = data[0] if data else 0
    if packet.command not in COMMON_COMMANDS:
        if profile.kind is DeviceKind.IO:
            own = decode_io_command(packet)
            return (own, DATA_BYTES[packet.command]) if own else (UndefinedCommand(packet.command, data), 0)
        if profile.support is Support.IDENTIFY:
            return UndescribedCommand(packet.command, data), 0
    match packet.command:
        case CommandCode.RESET_POSITION | CommandCode.IO_CONTROL | CommandCode.ADD_PATH_POINTS | CommandCode.HARD_RESET:
            return _decode_by_dialect(profile, packet, first)
        case CommandCode.SET_ADDRESS | CommandCode.DEFINE_STATUS | CommandCode.READ_STATUS | CommandCode.SET_BAUD_RATE:
            return _decode_network(packet, first)
        case CommandCode.LOAD_TRAJECTORY:
            return LoadTrajectory(decode_trajectory(profile, data)), trajectory_bytes(profile, TrajectoryControl(first))
        case CommandCode.SET_GAIN:
            # whether a load without it sets the multiplier back to 1 is not in the data sheet: both are simulated
            short = profile.sc_extensions and len(data) < profile.gain_bytes
            return SetGain(decode_gains(profile, data), short), _gain_bytes(profile, len(data))
        case CommandCode.STOP_MOTOR:
            if first & StopControl.HERE:
                return StopMotor(StopControl(first), POSITION.decode(data[1:])), 1 + POSITION_BYTES
            return StopMotor(StopControl(first), None), 1
        case CommandCode.SET_HOMING_MODE:
            return SetHomingMode(HomingControl(first)), 1
    return PlainCommand(packet.command), 0


def _gain_bytes(profile: Profile, count: int) -> int:
    """Return how many bytes Set Gain should have had: PIC-SERVO takes those of every older version.

    "If the command 0xD6 is used (and only 13 data bytes are sent, version 4 will use a default value of zero for the
    deadband compensation" (PIC-SERVO manual, 5.2); the manual of LS-182AP has 14 bytes only.
    """
    accepted = range(OLDEST_GAIN_BYTES, profile.gain_bytes)
    return count if not profile.pic_ae_diagnostics and count in accepted else profile.gain_bytes


def _decode_network(packet: Packet, first: int) -> tuple[ReceivedCommand, int]:
    match packet.command:
        case CommandCode.SET_ADDRESS:
            group = packet.data[1] if len(packet.data) > 1 else 0
            return SetAddress(first, group | GROUP_MEMBER, leader=not group & GROUP_MEMBER), 2
        case CommandCode.DEFINE_STATUS:
            return DefineStatus(StatusItem(first)), 1
        case CommandCode.READ_STATUS:
            return ReadStatus(StatusItem(first)), 1
    return SetBaudRate(first), 1


def _decode_by_dialect(profile: Profile, packet: Packet, first: int) -> tuple[ReceivedCommand, int]:
    data = packet.data
    match packet.command:
        case CommandCode.RESET_POSITION if data and profile.sc_extensions:
            return _decode_sc_reset_position(data)
        case CommandCode.RESET_POSITION:
            return ResetPosition(), 0
        case CommandCode.IO_CONTROL if profile.limit_outputs or profile.sc_extensions:
            return IoControl(first), 1
        case CommandCode.ADD_PATH_POINTS if profile.path_points:
            points = tuple(int.from_bytes(data[at : at + 2], "little") for at in range(0, len(data) - 1, 2))
            # what becomes of half a point is not in the data sheet
            return AddPathPoints(points, data[-1] if len(data) % 2 else None), 2 * len(points)
        case CommandCode.HARD_RESET if data and profile.sc_extensions:
            return HardReset(first), 1
        case CommandCode.HARD_RESET:
            return HardReset(), 0
    return UndefinedCommand(packet.command, data), 0


def _decode_sc_reset_position(data: bytes) -> tuple[ReceivedCommand, int]:
    control = data[0]
    if control == PositionReset.SET_POSITION:
        return ResetPosition(position=POSITION.decode(data[1:])), 1 + POSITION_BYTES
    return ResetPosition(relative_to_home=control == PositionReset.RELATIVE_TO_HOME), 1
