"""LDCN/NMC command packets: header, address, command byte, data, checksum; and the fields that data consist of.

Handles bytes only; the meaning of the data is in commands.py and received.py. Replies have no such frame: status.py.
Sources: LS-182AP manual, "Serial Command Interface", "Command Description"; PIC-SERVO manual, 4.1, 5.2.
"""

from dataclasses import dataclass
from enum import IntEnum

from ldcnd.errors import BadReply, ValueOutOfRange

HEADER = 0xAA
MOST_DATA_BYTES = 15
"""The upper nibble of the command byte counts them."""
MOST_ADDRESS = 0xFF
FRAME_BYTES = 4
"""Header, address, command byte and checksum."""


class Command(IntEnum):
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
    command: Command
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
    count = len(packet.data)
    if count > MOST_DATA_BYTES:
        raise ValueOutOfRange(
            f"{count} data bytes, a packet holds at most {MOST_DATA_BYTES}",
            value=count,
            limit=MOST_DATA_BYTES,
            nearest=MOST_DATA_BYTES,
        )
    body = bytes((packet.address, count << 4 | packet.command)) + packet.data
    return bytes((HEADER,)) + body + bytes((sum(body) & 0xFF,))


def decode_packet(data: bytes) -> Packet:
    """Take exactly one intact packet apart.

    Raises:
        BadReply: no header, another length than the command byte says, or a wrong checksum.
    """
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
    return Packet(data[1], Command(data[2] & 0x0F), data[3:-1])


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
        packet = Packet(body[0], Command(body[1] & 0x0F), body[2:-1])
        return ReceivedPacket(packet, checksum_ok=sum(body[:-1]) & 0xFF == body[-1])


@dataclass(frozen=True, slots=True)
class Field:
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
        """Return the value of up to `width` bytes, in range or not; missing ones count as 0, as in the firmware."""
        return int.from_bytes(data[: self.width].ljust(self.width, b"\0"), "little", signed=self.least < 0)


ADDRESS = Field("individual address", 1, 0x01, 0x7F)
"""PIC-SERVO takes 0 to 255 [manual, 5.2], but above 127 an individual address could be taken for a group's."""
GROUP_ADDRESS = Field("group address", 1, 0x80, 0xFF)
GROUP_MEMBER = 0x80
"""This bit of the group address, cleared in the data of Set Address, makes the module the leader of its group."""
POSITION = Field("position", 4, -0x7FFF_FFFF, 0x7FFF_FFFF)
"""Both manuals leave out the most negative 32-bit value."""
