"""LDCN/NMC packets: commands with their data to a module, status packets from it.

A command packet is header, address, command byte, data, checksum; the meaning of the data is in commands.py and
received.py. A status packet has no header, no address and no length: its layout follows from the profile and the item
mask of the request, never from its length (two devices answer 19 bytes to mask FF with different layouts).
Sources: LS-182AP manual, "Serial Command Interface", "Command Description", "Define Status", "Status byte and auxiliary
status byte definitions"; PIC-SERVO manual, 4.1, 5.2, 5.3.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cache
from operator import itemgetter
from struct import Struct
from typing import Any

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.line.exchange import ReplyVerdict

HEADER = 0xAA
MOST_DATA_BYTES = 15
"""The upper nibble of the command byte counts them."""
MOST_ADDRESS = 0xFF
FRAME_BYTES = 4
"""Header, address, command byte and checksum."""


class CommandCode(IntEnum):
    """The lower nibble of the command byte (manuals, "List of Commands")."""

    RESET_POSITION = 0x0
    SET_ADDRESS = 0x1
    DEFINE_STATUS = 0x2
    READ_STATUS = 0x3
    LOAD_TRAJECTORY = 0x4
    START_MOTION = 0x5
    SET_GAIN = 0x6
    STOP_MOTOR = 0x7
    IO_CONTROL = 0x8  # unused on LS-182AP
    SET_HOMING_MODE = 0x9
    SET_BAUD_RATE = 0xA
    CLEAR_STICKY_BITS = 0xB
    SAVE_CURRENT_POSITION_AS_HOME = 0xC
    ADD_PATH_POINTS = 0xD  # reserved on everything but PIC-SERVO SC
    NO_OPERATION = 0xE
    HARD_RESET = 0xF


@dataclass(frozen=True, slots=True)
class Packet:
    """One command packet without its frame.

    Attributes:
        address: individual (0 to 127) or group (128 to 255).
        command: what to do.
        data: 0 to 15 bytes.
    """

    address: int
    command: CommandCode
    data: bytes = b""


def encode_packet(packet: Packet) -> bytes:
    """Frame a packet for the wire.

    Raises:
        ValueOutOfRange: the address does not fit a byte, or there are more than 15 data bytes.
    """
    if not 0 <= packet.address <= MOST_ADDRESS:
        nearest = 0 if packet.address < 0 else MOST_ADDRESS
        raise ValueOutOfRange(
            f"address {packet.address} is outside 0 to {MOST_ADDRESS}",
            value=packet.address,
            limit=nearest,
            nearest=nearest,
        )
    # "the upper nibble contains the number of additional data bytes required for that command" (PIC-SERVO manual, 4.1)
    count = len(packet.data)
    if count > MOST_DATA_BYTES:
        raise ValueOutOfRange(
            f"{count} data bytes, a packet holds at most {MOST_DATA_BYTES}",
            value=count,
            limit=MOST_DATA_BYTES,
            nearest=MOST_DATA_BYTES,
        )
    # "8-bit sum of the Module Address byte thru the last additional data byte": the header is not in it
    body = bytes((packet.address, count << 4 | packet.command)) + packet.data
    return bytes((HEADER,)) + body + bytes((sum(body) & 0xFF,))


def decode_packet(data: bytes) -> Packet:
    """Take exactly one intact packet apart.

    Raises:
        BadReply: no header, another length than the command byte says, or a wrong checksum.
    """
    # a module would skip to the next header; here the bytes are one packet or none
    if not data or data[0] != HEADER:
        raise BadReply(f"a packet begins with the header AA, not with {data[:1].hex() or 'nothing'}")
    if len(data) < FRAME_BYTES:
        raise BadReply(f"{len(data)} bytes are too few for a packet")
    count = data[2] >> 4
    if len(data) != FRAME_BYTES + count:
        raise BadReply(f"command byte {data[2]:02X} says {count} data bytes, the frame has {len(data) - FRAME_BYTES}")
    computed = sum(data[1:-1]) & 0xFF
    if data[-1] != computed:
        raise BadReply(f"packet checksum {data[-1]:02X}, computed {computed:02X}")
    return Packet(data[1], CommandCode(data[2] & 0x0F), data[3:-1])


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """A packet as a module received it; a module answers a wrong checksum but does not execute the command."""

    packet: Packet
    checksum_ok: bool


class PacketReader:
    """The receiver of a module: finds packets in the bytes of the line, for any address.

    Outside a packet everything but the header is skipped; inside, the count in the command byte rules, so that 16 nulls
    complete any half-received packet (PIC-SERVO manual, 4.1).
    """

    __slots__ = ("_body", "_missing")

    def __init__(self) -> None:
        self._body = bytearray()
        self._missing = 0  # body bytes still to come; 0 outside a packet

    @property
    def in_packet(self) -> bool:
        """Whether a header has come whose packet is not complete yet."""
        return self._missing > 0

    def begins(self, byte: int) -> bool:
        """Tell whether this byte would begin a packet."""
        return byte == HEADER and not self._missing

    def reset(self) -> None:
        """Discard a half-received packet."""
        self._body.clear()
        self._missing = 0

    def feed(self, byte: int) -> ReceivedPacket | None:
        """Take the next byte of the line, 0 to 255; return the packet that it completes."""
        # "when waiting for a new command, each module will ignore any incoming data until it sees a header byte"
        if not self._missing:
            if byte == HEADER:
                self._missing = FRAME_BYTES - 1
            return None
        self._body.append(byte)
        self._missing -= 1
        if len(self._body) == 2:  # noqa: PLR2004 - the command byte is the second of the body
            self._missing += byte >> 4
        if self._missing:
            return None
        body = bytes(self._body)
        self._body.clear()
        packet = Packet(body[0], CommandCode(body[1] & 0x0F), body[2:-1])
        # "the command will not be executed, but a status packet will still be returned" (PIC-SERVO manual, 4.1)
        return ReceivedPacket(packet, checksum_ok=sum(body[:-1]) & 0xFF == body[-1])


@dataclass(frozen=True, slots=True)
class RegisterField:
    """One register as it travels.

    Attributes:
        name: as in the manuals.
        width: bytes.
        least: the lower end of the documented range; a field that may be negative is two's complement.
        most: the upper end.
    """

    name: str
    width: int
    least: int
    most: int

    def check(self, value: int) -> None:
        """Refuse what the register does not take.

        Raises:
            ValueOutOfRange: with the limit that the value breaks.
        """
        if not self.least <= value <= self.most:
            nearest = self.least if value < self.least else self.most
            raise ValueOutOfRange(
                f"{self.name} {value} is outside {self.least} to {self.most}",
                value=value,
                limit=nearest,
                nearest=nearest,
            )

    def encode(self, value: int) -> bytes:
        """Return the field's bytes.

        Raises:
            ValueOutOfRange: see `check`.
        """
        self.check(value)
        return value.to_bytes(self.width, "little", signed=self.least < 0)

    def decode(self, data: bytes) -> int:
        """Return the value of up to `width` bytes, in range or not; missing ones count as 0."""
        return int.from_bytes(data[: self.width].ljust(self.width, b"\0"), "little", signed=self.least < 0)


ADDRESS = RegisterField("individual address", 1, 0x01, 0x7F)
"""PIC-SERVO takes 0 to 255 [manual, 5.2], but above 127 an individual address could be taken for a group's."""
GROUP_ADDRESS = RegisterField("group address", 1, 0x80, 0xFF)
GROUP_MEMBER = 0x80
"""This bit of the group address, cleared in the data of Set Address, makes the module the leader of its group."""
POSITION = RegisterField("position", 4, -0x7FFF_FFFF, 0x7FFF_FFFF)
"""Both manuals leave out the most negative 32-bit value."""

# -- status packets ----------------------------------------------------------------------------------------------------


class StatusItem(IntFlag):
    """Bits of the Define Status and Read Status mask; data follow in this order."""

    POSITION = 0x01
    ADC = 0x02
    VELOCITY = 0x04
    AUX = 0x08
    HOME = 0x10
    IDENTITY = 0x20
    POSITION_ERROR = 0x40
    BIT7 = 0x80


STATUS_BYTE_ONLY = StatusItem(0)
"""The status items that every module sends after power-up."""


class StatusFlag(IntFlag):
    """The status byte, by PIC-SERVO names; with `pic_ae_diagnostics` bits 3 to 6 mean more, see faults.py."""

    # "set otherwise, including while the position servo is disabled" (PIC-SERVO manual, 5.3)
    MOVE_DONE = 0x01
    CHECKSUM_ERROR = 0x02  # the node rejected *our* packet
    OVERCURRENT = 0x04  # reserved on LS-182AP
    # "set if motor power is greater than 12v" (ibid.)
    POWER_ON = 0x08
    # "also set whenever the position servo is disabled. Must be cleared by user" (ibid.)
    POSITION_ERROR = 0x10
    LIMIT1 = 0x20  # LS-182AP: reverse limit, or diagnostic bit
    LIMIT2 = 0x40  # LS-182AP: forward limit, or diagnostic bit
    # "reset to zero once the home position has been captured" (ibid.)
    HOME_IN_PROGRESS = 0x80


class AuxFlag(IntFlag):
    """The auxiliary status byte."""

    INDEX = 0x01  # complement of the index input (its level with `live_aux`), or diagnostic bit
    # sticky, as is the overrun below: "cleared with the Clear Sticky Bits command" (ibid.)
    POSITION_WRAP = 0x02
    SERVO_ON = 0x04
    # this one and the next: "cleared when the next move is started" (ibid.)
    ACCEL_DONE = 0x08  # with `live_aux`: accelerating now
    SLEW_DONE = 0x10  # with `live_aux`: at constant velocity, or standing
    # "typically not serious, only periodically introducing a small fraction of a millisecond delay" (ibid.)
    SERVO_OVERRUN = 0x20
    PATH_MODE = 0x40  # a path runs
    MOTION_LOCKED = 0x80  # LS-182AP from version 22 on


@dataclass(frozen=True, slots=True)
class StatusPacket:
    """One decoded status packet; None where the mask did not request the item.

    Attributes:
        position: counts, signed 32 bit.
        adc: counts, 0 to 255 or 0 to 1023 as the profile says.
        velocity: counts per servo tick, **positive forward** (most devices send the opposite).
        home: counts, signed 32 bit.
        position_error: counts, commanded minus actual, signed 16 bit.
        bit7: the byte of status item 7 (PIC-SERVO SC: path points left).
    """

    flags: StatusFlag
    position: int | None = None
    adc: int | None = None
    velocity: int | None = None
    aux: AuxFlag | None = None
    home: int | None = None
    device_id: int | None = None
    version: int | None = None
    position_error: int | None = None
    bit7: int | None = None


_STATUS_FLAGS = tuple(map(StatusFlag, range(256)))
_AUX_FLAGS = tuple(map(AuxFlag, range(256)))
"""By the byte: to make a flag costs as much as to decode all other items."""

_POSITION, _ADC, _VELOCITY, _AUX, _HOME, _IDENTITY, _POSITION_ERROR, _BIT7 = map(int, StatusItem)
"""As numbers: arithmetic with flags costs ten times as much, and every reply needs it."""


def item_bytes(profile: Profile, items: StatusItem) -> int:
    """Return how many data bytes a status packet of this device carries for these items, 0 to 17."""
    mask = int(items)
    return (
        # "the status data will always be sent in the order listed" (PIC-SERVO manual, 5.2, "Define Status")
        (4 if mask & _POSITION else 0)
        + (profile.adc_bytes if mask & _ADC else 0)
        + (2 if mask & _VELOCITY else 0)
        + (1 if mask & _AUX else 0)
        + (4 if mask & _HOME else 0)
        + (2 if mask & _IDENTITY else 0)
        + (profile.position_error_bytes if mask & _POSITION_ERROR else 0)
        + (profile.bit7_bytes if mask & _BIT7 else 0)
    )


def status_bytes(profile: Profile, items: StatusItem) -> int:
    """Return the length of a whole status packet: status byte, items, checksum; 2 to 19."""
    return 2 + item_bytes(profile, items)


def check_status(data: bytes) -> ReplyVerdict:
    """Judge a complete status packet by its checksum and its checksum-error bit."""
    if (sum(data) - data[-1]) & 0xFF != data[-1]:
        return ReplyVerdict.CORRUPT
    if data[0] & 0x02:  # StatusFlag.CHECKSUM_ERROR, as a number: this runs between two packets
        return ReplyVerdict.REJECTED
    return ReplyVerdict.INTACT


def encode_status(profile: Profile, items: StatusItem, status: StatusPacket) -> bytes:
    """Build the packet that a device with this profile sends; absent values count as zero.

    Raises:
        OverflowError: a value does not fit its field.
    """
    mask = int(items)
    body = bytearray([status.flags])
    if mask & _POSITION:
        body += (status.position or 0).to_bytes(4, "little", signed=True)
    if mask & _ADC:
        body += (status.adc or 0).to_bytes(profile.adc_bytes, "little")
    if mask & _VELOCITY:
        # "the signed 16 bit integer returned is the negative of the velocity in units of counts per servo tick" (ibid.)
        body += (profile.velocity_sign * (status.velocity or 0)).to_bytes(2, "little", signed=True)
    if mask & _AUX:
        body.append(status.aux or 0)
    if mask & _HOME:
        body += (status.home or 0).to_bytes(4, "little", signed=True)
    if mask & _IDENTITY:
        body += bytes([status.device_id or 0, status.version or 0])
    if mask & _POSITION_ERROR and profile.position_error_bytes:
        body += (status.position_error or 0).to_bytes(2, "little", signed=True)
    if mask & _BIT7 and profile.bit7_bytes:
        body.append(status.bit7 or 0)
    body.append(sum(body) & 0xFF)
    return bytes(body)


def decode_status(profile: Profile, items: StatusItem, data: bytes) -> StatusPacket:
    """Decode a status packet of this device for these items; unknown flag bits are kept.

    Raises:
        BadReply: the length does not fit the mask, or the checksum is wrong.
    """
    return status_decoder(profile, items)(data)


def status_decoder(profile: Profile, items: StatusItem) -> Callable[[bytes], StatusPacket]:
    """Return `decode_status` for many packets of one kind."""
    mask, expected, sign = int(items), status_bytes(profile, items), profile.velocity_sign
    layout, pick = _layout(mask, profile.adc_bytes, profile.position_error_bytes, profile.bit7_bytes)
    unpack = layout.unpack

    def decode(data: bytes) -> StatusPacket:
        # no length travels with it: two devices send different layouts of one length, so only the mask tells
        if len(data) != expected:
            raise BadReply(f"{profile.title}: {len(data)} status bytes, mask {mask:02X} makes {expected}")
        if (sum(data) - data[-1]) & 0xFF != data[-1]:
            raise BadReply(f"{profile.title}: status checksum {data[-1]:02X}, computed {sum(data[:-1]) & 0xFF:02X}")
        fields = pick((None, *unpack(data)))
        flags, position, adc, velocity, aux, home, device_id, version, position_error, bit7 = fields
        return StatusPacket(
            _STATUS_FLAGS[flags],
            position,
            adc,
            None if velocity is None else sign * velocity,
            None if aux is None else _AUX_FLAGS[aux],
            home,
            device_id,
            version,
            position_error,
            bit7,
        )

    return decode


@cache
def _layout(
    mask: int, adc_bytes: int, position_error_bytes: int, bit7_bytes: int
) -> tuple[Struct, Callable[[tuple[Any, ...]], tuple[Any, ...]]]:
    """Return how the bytes are read, and what picks the fields of a `StatusPacket` from None and what was read."""
    formats = (
        (_POSITION, "i"),
        (_ADC, "B" if adc_bytes == 1 else "H"),
        (_VELOCITY, "h"),
        (_AUX, "B"),
        (_HOME, "i"),
        (_IDENTITY, "B"),
        (_IDENTITY, "B"),
        (_POSITION_ERROR if position_error_bytes else 0, "h"),
        (_BIT7 if bit7_bytes else 0, "B"),
    )
    order = [1]
    layout = "<B"
    for bit, code in formats:
        present = bool(mask & bit)
        order.append(len(layout) if present else 0)
        layout += code if present else ""
    # x: the checksum, judged before
    return Struct(f"{layout}x"), itemgetter(*order)
