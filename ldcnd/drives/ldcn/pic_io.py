"""PIC-I/O: commands, status packets, and both directions of their bytes.

Twelve digital lines, three A/D inputs, two PWM outputs, one counter or timer of 32 bits. What is common to all modules
(addresses, status selection, rate, reset) is as for servos, but five of its own command codes mean something else
there: 0, 4, 6, 7 and 8. A packet is therefore built for an `IoNode`, never for an address alone.

Line n of the data sheet, 1 to 12, is bit n - 1 of every word here.
Source: PIC-I/O data sheet, 2.2, 3.1, 3.2.
"""

from dataclasses import dataclass, replace
from enum import IntFlag
from functools import partial

from typing_extensions import override

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.ldcn.commands import Destination
from ldcnd.drives.ldcn.packet import MOST_ADDRESS, CommandCode, Packet, check_status, encode_packet
from ldcnd.drives.ldcn.profiles import PIC_IO, Profile
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.line.exchange import Exchange, PacketEffect

LINES = 12
ALL_LINES = (1 << LINES) - 1
MOST_PWM = 0xFF
LOWEST_GROUP = 0x80
"""Addresses from here are of groups."""
TIMER_HZ = 5_000_000
"""The timer at prescale 1, with a 20 MHz crystal."""
COUNTER_LINE = 10
"""The counter counts rising edges of this line."""
PRESCALES = (1, 2, 4, 8)
CHECKSUM_ERROR = 0x02
"""The only bit of the status byte that is defined."""


class IoItem(IntFlag):
    """Bits of the Define Status and Read Status mask of a PIC-I/O; data follow in this order."""

    LEVELS = 0x01
    ADC1 = 0x02
    ADC2 = 0x04
    ADC3 = 0x08
    COUNTER = 0x10
    IDENTITY = 0x20
    CAPTURED_LEVELS = 0x40
    CAPTURED_COUNTER = 0x80


NO_ITEMS = IoItem(0)
ITEM_BYTES = (2, 1, 1, 1, 4, 2, 2, 4)


@dataclass(frozen=True, slots=True)
class IoStatus:
    """One status packet; None where the mask did not request the item.

    Attributes:
        rejected: the module found a wrong checksum and did not execute the command.
        levels: of the lines, 12 bits; the pins are read, outputs included.
        adc1: 0 to 255 for 0 to 5 V, as the next two.
        counter: counter or timer, unsigned 32 bit; it wraps silently.
        captured_levels: as the last Synch Input found them,
        captured_counter: and the counter.
    """

    rejected: bool = False
    levels: int | None = None
    adc1: int | None = None
    adc2: int | None = None
    adc3: int | None = None
    counter: int | None = None
    device_id: int | None = None
    version: int | None = None
    captured_levels: int | None = None
    captured_counter: int | None = None


@dataclass(frozen=True, slots=True)
class SetDirection:
    """Make lines inputs (bit set) or outputs."""

    inputs: int


@dataclass(frozen=True, slots=True)
class SetPwmOutputs:
    """Set both PWM outputs, 0 to 255 for 0 to 100 %."""

    pwm1: int
    pwm2: int


@dataclass(frozen=True, slots=True)
class SynchOutput:
    """Let the stored outputs and PWM values take effect; the byte is that of Start Motion."""


@dataclass(frozen=True, slots=True)
class SetOutput:
    """Set the levels of the lines that are outputs."""

    levels: int


@dataclass(frozen=True, slots=True)
class SetSynchOutput:
    """Store levels and PWM values for `SynchOutput`; all of them are replaced."""

    levels: int
    pwm1: int
    pwm2: int


@dataclass(frozen=True, slots=True)
class SetTimerMode:
    """Run the counter or timer.

    Attributes:
        prescale: 1, 2, 4 or 8 edges or clocks for each count.
    """

    enabled: bool
    counter: bool = False
    prescale: int = 1


@dataclass(frozen=True, slots=True)
class SynchInput:
    """Capture levels and counter; the byte is that of Save Current Position as Home."""


IoCommand = SetDirection | SetPwmOutputs | SynchOutput | SetOutput | SetSynchOutput | SetTimerMode | SynchInput
DATA_BYTES = {
    CommandCode.RESET_POSITION: 2,
    CommandCode.LOAD_TRAJECTORY: 2,
    CommandCode.START_MOTION: 0,
    CommandCode.SET_GAIN: 2,
    CommandCode.STOP_MOTOR: 4,
    CommandCode.IO_CONTROL: 1,
    CommandCode.SAVE_CURRENT_POSITION_AS_HOME: 0,
}
"""By the servo's name of the code."""


def decode_io_command(packet: Packet) -> IoCommand | None:
    """Take a packet as a PIC-I/O would, missing bytes as 0; None for codes that are common or undefined."""
    count = DATA_BYTES.get(packet.command)
    if count is None:
        return None
    data = packet.data[:count].ljust(count, b"\0")
    lines = int.from_bytes(data[:2], "little") & ALL_LINES
    match packet.command:
        case CommandCode.RESET_POSITION:
            return SetDirection(lines)
        case CommandCode.LOAD_TRAJECTORY:
            return SetPwmOutputs(data[0], data[1])
        case CommandCode.START_MOTION:
            return SynchOutput()
        case CommandCode.SET_GAIN:
            return SetOutput(lines)
        case CommandCode.STOP_MOTOR:
            return SetSynchOutput(lines, data[2], data[3])
        case CommandCode.IO_CONTROL:
            # bit 0 enables, bit 1 counts edges, bits 5 and 4 prescale (data sheet, 3.1)
            return SetTimerMode(bool(data[0] & 0x01), bool(data[0] & 0x02), PRESCALES[data[0] >> 4 & 0x03])
        case _:
            return SynchInput()


def encode_io_command(address: int, command: IoCommand) -> bytes:
    """Return the packet of a command.

    Raises:
        ValueOutOfRange: a line, a PWM value or a prescale that does not exist.
    """
    match command:
        case SetDirection(inputs):
            packet = Packet(address, CommandCode.RESET_POSITION, _lines(inputs))
        case SetPwmOutputs(pwm1, pwm2):
            packet = Packet(address, CommandCode.LOAD_TRAJECTORY, _pwm(pwm1, pwm2))
        case SynchOutput():
            packet = Packet(address, CommandCode.START_MOTION)
        case SetOutput(levels):
            packet = Packet(address, CommandCode.SET_GAIN, _lines(levels))
        case SetSynchOutput(levels, pwm1, pwm2):
            packet = Packet(address, CommandCode.STOP_MOTOR, _lines(levels) + _pwm(pwm1, pwm2))
        case SetTimerMode():
            packet = Packet(address, CommandCode.IO_CONTROL, bytes((timer_control(command),)))
        case SynchInput():
            packet = Packet(address, CommandCode.SAVE_CURRENT_POSITION_AS_HOME)
    return encode_packet(packet)


def io_status_bytes(items: IoItem) -> int:
    """Return the length of a whole status packet: status byte, items, checksum; 2 to 19."""
    return 2 + sum(width for bit, width in enumerate(ITEM_BYTES) if items & 1 << bit)


def encode_io_status(items: IoItem, status: IoStatus, *, undefined_bits: int = 0) -> bytes:
    """Build a status packet; absent values count as 0.

    Args:
        items: which data follow.
        status: their values.
        undefined_bits: of the status byte; hosts must not read anything from them.
    """
    identity = (status.device_id or 0) | (status.version or 0) << 8
    values = (
        status.levels,
        status.adc1,
        status.adc2,
        status.adc3,
        status.counter,
        identity,
        status.captured_levels,
        status.captured_counter,
    )
    body = bytearray((undefined_bits & ~CHECKSUM_ERROR | (CHECKSUM_ERROR if status.rejected else 0),))
    for bit, (width, value) in enumerate(zip(ITEM_BYTES, values, strict=True)):
        if items & 1 << bit:
            body += (value or 0).to_bytes(width, "little")
    body.append(sum(body) & 0xFF)
    return bytes(body)


def decode_io_status(items: IoItem, data: bytes) -> IoStatus:
    """Decode a status packet; the undefined bits of the status byte and of the levels are dropped.

    Raises:
        BadReply: the length does not fit the mask, or the checksum is wrong.
    """
    if len(data) != io_status_bytes(items):
        raise BadReply(f"{PIC_IO.title}: {len(data)} status bytes, mask {items:02X} makes {io_status_bytes(items)}")
    if sum(data[:-1]) & 0xFF != data[-1]:
        raise BadReply(f"{PIC_IO.title}: status checksum {data[-1]:02X}, computed {sum(data[:-1]) & 0xFF:02X}")
    values: list[int | None] = []
    at = 1
    for bit, width in enumerate(ITEM_BYTES):
        if not items & 1 << bit:
            values.append(None)
            continue
        values.append(int.from_bytes(data[at : at + width], "little"))
        at += width
    levels, adc1, adc2, adc3, counter, identity, captured, captured_counter = values
    return IoStatus(
        rejected=bool(data[0] & CHECKSUM_ERROR),
        levels=None if levels is None else levels & ALL_LINES,
        adc1=adc1,
        adc2=adc2,
        adc3=adc3,
        counter=counter,
        device_id=None if identity is None else identity & 0xFF,
        version=None if identity is None else identity >> 8,
        captured_levels=None if captured is None else captured & ALL_LINES,
        captured_counter=captured_counter,
    )


@dataclass(frozen=True, slots=True)
class IoNode(Destination[IoStatus]):
    """One PIC-I/O, or a group that it leads.

    Attributes:
        address: 0 to 255.
        items: what it adds to every reply, that is, the mask of the last Define Status.
    """

    address: int
    items: IoItem = NO_ITEMS
    profile: Profile = PIC_IO

    def __post_init__(self) -> None:
        """Refuse an address that does not fit its byte."""
        if not 0 <= self.address <= MOST_ADDRESS:
            raise ValueOutOfRange(
                f"node address {self.address} is outside 0 to {MOST_ADDRESS}", value=self.address, limit=MOST_ADDRESS
            )

    @override
    def exchange(
        self, request: bytes, items: int | None, *, repeatable: bool, effect: PacketEffect = PacketEffect.CHANGES
    ) -> Exchange[IoStatus]:
        asked = self.items if items is None else IoItem(items)
        reply_bytes, rejected_bytes = io_status_bytes(asked), io_status_bytes(self.items)
        return Exchange(
            node=self.address,
            request=request,
            reply_bytes=reply_bytes,
            check=check_status,
            decode=partial(decode_io_status, asked),
            response_s=SERVO_CYCLE_S,
            repeatable=repeatable,
            total_bytes=None if asked == self.items else partial(_total_bytes, rejected_bytes, reply_bytes),
            effect=effect,
        )


def send_io_command(to: IoNode, command: IoCommand) -> Exchange[IoStatus]:
    """Return the exchange of a command; all but `SynchInput`, and `SynchOutput` to a group, may be repeated.

    Raises:
        ValueOutOfRange: see `encode_io_command`.
    """
    # a second one would start servos of the group once more, or capture a later instant; a module alone only sets once
    # more what it was set to
    started = isinstance(command, SynchOutput) and to.address >= LOWEST_GROUP
    repeatable = not (started or isinstance(command, SynchInput))
    exchange = to.exchange(encode_io_command(to.address, command), None, repeatable=repeatable)
    # what its lines read is not what it was told: an output shows the level of its pin, and a direction nothing
    return replace(exchange, unseen=True)


def read_io_status(to: IoNode, items: IoItem) -> Exchange[IoStatus]:
    """Request these items once instead of the default ones."""
    request = encode_packet(Packet(to.address, CommandCode.READ_STATUS, bytes((items,))))
    return to.exchange(request, items, repeatable=True, effect=PacketEffect.READS)


def _total_bytes(rejected_bytes: int, reply_bytes: int, data: bytes) -> int:
    """A module that rejects a packet answers with the items of its default."""
    return rejected_bytes if data[0] & CHECKSUM_ERROR else reply_bytes


def _lines(levels: int) -> bytes:
    if not 0 <= levels <= ALL_LINES:
        raise ValueOutOfRange(f"lines {levels:X} are not 12 bits", value=levels, limit=ALL_LINES, nearest=ALL_LINES)
    return levels.to_bytes(2, "little")


def _pwm(*values: int) -> bytes:
    for value in values:
        if not 0 <= value <= MOST_PWM:
            nearest = min(max(value, 0), MOST_PWM)
            raise ValueOutOfRange(
                f"PWM {value} is outside 0 to {MOST_PWM}", value=value, limit=nearest, nearest=nearest
            )
    return bytes(values)


def timer_control(mode: SetTimerMode) -> int:
    """Return the byte of Set Timer Mode.

    Raises:
        ValueOutOfRange: the prescale does not exist.
    """
    if mode.prescale not in PRESCALES:
        raise ValueOutOfRange(f"prescale {mode.prescale} is not one of 1, 2, 4, 8", value=mode.prescale, limit=8)
    return mode.enabled | mode.counter << 1 | PRESCALES.index(mode.prescale) << 4
