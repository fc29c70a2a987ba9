"""SmartStep packets: 14 characters each way, their checksum, their parity, and where one ends in a stream.

Handles characters only; the meaning of addresses and data is in addresses.py, commands.py. Where the manual prints a
format one or two letters short, its rule of 14 characters decides.
Source: "Serial communications with Smart Step servodriver" (OMRON Barcelona), 2.1 "Basic specifications", 2.2
"Communication mode".
"""

from binascii import unhexlify
from dataclasses import dataclass
from enum import IntEnum

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.line.flight_recorder import Parts, WireEvent, WireRecord

PACKET_CHARACTERS = 14
START = b"W"
END = b"\r"
UPPER_HEX = b"0123456789ABCDEF"
HIGHEST_UNIT = 0xF
HIGHEST_WORD = 0xFFFF


class Function(IntEnum):
    """The function of a command; its third character."""

    REFERENCE = 0
    SETTING = 1
    STRING_REFERENCE = 2


class ResponseStatus(IntEnum):
    """The third character of a reply: the function, plus 4 for a data error, plus 8 for an address error."""

    REFERENCE = 0x0
    SETTING = 0x1
    STRING_REFERENCE = 0x2
    REFERENCE_DATA_ERROR = 0x4
    SETTING_DATA_ERROR = 0x5
    BYTE_COUNT_ERROR = 0x6
    REFERENCE_ADDRESS_ERROR = 0x8
    SETTING_ADDRESS_ERROR = 0x9
    STRING_ADDRESS_ERROR = 0xA

    @property
    def function(self) -> Function:
        """The function of the command that this status answers."""
        return Function(self & 0x3)

    @property
    def normal(self) -> bool:
        """Whether the command was carried out."""
        return self < ResponseStatus.REFERENCE_DATA_ERROR


@dataclass(frozen=True, slots=True)
class CommandPacket:
    """A packet of the host.

    Attributes:
        unit: 0 to 15; 0 reaches only a drive in single-axis mode, there is no broadcast.
        address: 0 to FFFFH.
        data: 0 to FFFFH; 0 for a reference, the number of bytes for a string reference.

    Raises:
        ValueOutOfRange: a field does not fit.
    """

    unit: int
    function: Function
    address: int
    data: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.unit <= HIGHEST_UNIT:
            raise ValueOutOfRange(f"unit number {self.unit} is not 0 to 15", value=self.unit, limit=HIGHEST_UNIT)
        for name, value in (("address", self.address), ("data", self.data)):
            if not 0 <= value <= HIGHEST_WORD:
                raise ValueOutOfRange(
                    f"unit {self.unit}: {name} {value} does not fit four hexadecimal digits",
                    value=value,
                    limit=HIGHEST_WORD,
                )

    def encode(self) -> bytes:
        """Return the 14 characters, upper case as the manual prints them."""
        return _encode(self.unit, self.function, self.address, self.data)


@dataclass(frozen=True, slots=True)
class ReplyPacket:
    """A packet of a drive: every reply but that of a successful string reference."""

    unit: int
    status: ResponseStatus
    address: int
    data: int

    def encode(self) -> bytes:
        """Return the 14 characters."""
        return _encode(self.unit, self.status, self.address, self.data)


def is_upper_hex(characters: bytes) -> bool:
    """Tell whether all characters are hexadecimal digits in upper case; lower case is not documented."""
    return not characters.translate(None, UPPER_HEX)


def checksum(digits: bytes) -> int:
    """Return the byte that makes the sum of all digit pairs a multiple of 256 (manual 2.2 (4)).

    Args:
        digits: an even number of hexadecimal digits, without W, checksum and CR.
    """
    return -sum(unhexlify(digits)) & 0xFF


def sums_to_zero(digits: bytes) -> bool:
    """Tell whether hexadecimal digit pairs, their checksum among them, add up to a multiple of 256."""
    return sum(unhexlify(digits)) & 0xFF == 0


def decode_command(packet: bytes) -> CommandPacket | None:
    """Return the command, or None where a drive stays silent (manual 2.1): no error reply exists for a bad packet."""
    fields = _fields(packet)
    if fields is None or fields[1] > Function.STRING_REFERENCE:
        return None
    unit, function, address, data = fields
    return CommandPacket(unit, Function(function), address, data)


def decode_reply(packet: bytes) -> ReplyPacket:
    """Decode the 14 characters of a reply.

    Raises:
        BadReply: wrong length, start, end, digit, checksum or response status.
    """
    fields = _fields(packet)
    if fields is None:
        raise BadReply(f"{packet!r} is not a packet of {PACKET_CHARACTERS} characters with a correct checksum")
    unit, code, address, data = fields
    try:
        status = ResponseStatus(code)
    except ValueError:
        raise BadReply(f"{packet!r} carries response status {code:X}, which the manual does not list") from None
    return ReplyPacket(unit, status, address, data)


def _encode(unit: int, code: int, address: int, data: int) -> bytes:
    digits = b"%X%X%04X%04X" % (unit, code, address, data)
    return b"W%b%02X\r" % (digits, checksum(digits))


def _fields(packet: bytes) -> tuple[int, int, int, int] | None:
    digits = packet[1:13]
    if (
        len(packet) != PACKET_CHARACTERS
        or packet[:1] != START
        or packet[13:] != END
        or not is_upper_hex(digits)
        or not sums_to_zero(digits)
    ):
        return None
    return int(digits[:1], 16), int(digits[1:2], 16), int(digits[2:6], 16), int(digits[6:10], 16)


DAMAGED = 0x7F
"""Stands for a character with wrong parity: it keeps its place and can belong to no packet."""

# even parity: seven bits and this one, sent as eight, are on the wire what 7E1 makes of them
_ENCODED = bytes((code & 0x7F) | ((code & 0x7F).bit_count() & 1) << 7 for code in range(256))
_DECODED = bytes(code & 0x7F if code.bit_count() % 2 == 0 else DAMAGED for code in range(256))


def add_parity(characters: bytes) -> bytes:
    """Return the 8N1 bytes of seven-bit characters."""
    return characters.translate(_ENCODED)


def strip_parity(data: bytes) -> bytes:
    """Return the seven-bit characters of 8N1 bytes, `DAMAGED` in the place of each with wrong parity."""
    return data.translate(_DECODED)


def piece_bytes(data: bytes, longest: int) -> int | None:
    """Return the length of the first piece of the stream, or None while its end has not come.

    A second W, or more than `longest` bytes without CR, ends what was no packet.

    Args:
        data: what has arrived, from the end of the last piece on.
        longest: no packet is longer than this.
    """
    if not data:
        return None
    if data[:1] != START:
        start = data.find(START)
        return len(data) if start < 0 else start
    end = data.find(END) + 1
    restart = data.find(START, 1)
    # its CR was lost: what begins here is a packet of its own
    if restart > 0 and (end == 0 or restart < end):
        end = restart
    if end == 0:
        return longest if len(data) >= longest else None
    return min(end, longest)


class ReplyReader:
    """Cuts a stream into packet candidates; the cuts do not depend on how the stream arrives.

    Attributes:
        skipped: number of bytes that belonged to no candidate.
    """

    def __init__(self, longest: int) -> None:
        self.skipped = 0
        self._longest = longest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take further bytes and return the candidates, W to CR, that they complete."""
        self._buffer += data
        candidates = []
        while (length := piece_bytes(bytes(self._buffer), self._longest)) is not None:
            piece = bytes(self._buffer[:length])
            del self._buffer[:length]
            if piece[:1] == START and piece[-1:] == END:
                candidates.append(piece)
            else:
                self.skipped += length
        return candidates


CHARACTER = 0x7F
"""The eighth bit is the parity, where the host makes it."""


class CommandCutter:
    """Cuts what a host sends: W begins a packet, CR ends it."""

    def begins(self, byte: int) -> bool:
        """Tell whether this byte would begin a packet."""
        return byte & CHARACTER == START[0]

    def feed(self, byte: int) -> bool:
        """Take a byte; tell whether it completes a packet."""
        return byte & CHARACTER == END[0]


class SmartStepTranscript:
    """Reads the records of one SmartStep line, oldest first."""

    def __init__(self) -> None:
        self._parts = Parts()

    def describe(self, record: WireRecord) -> str:
        """Return the record's packet in words; empty when there is none."""
        data = self._parts.whole(record)
        if record.event is WireEvent.SENT:
            command = decode_command(data)
            if command is None:
                return ""
            return f"unit {command.unit}: {command.function.name} {command.address:04X}H, {command.data:04X}H"
        if record.event is not WireEvent.RECEIVED:
            return ""
        try:
            reply = decode_reply(data)
        except BadReply as error:
            return error.message
        return f"unit {reply.unit}: {reply.status.name} {reply.address:04X}H, {reply.data:04X}H"
