"""Every command as an exchange: what to send, how to recognise its answer, whether it may be sent again.

Bytes that do not pass the checks are not the answer: they are FOREIGN, and reading goes on until the deadline. An error
reply is an answer and becomes a `Refusal`. There is no way to set an arbitrary address: each kind of setting has its
function, and the operating mode is an enumeration.
Repeating: reading, RAM and trace registers always; EEPROM never (each write costs life: read back first); 2000H and
2001H never (read 2000H and decide by the mode).

String references: the checksum stands before the data and the manual does not say whether it covers them; nor does it
say what exactly the count counts. A reply is accepted if it fits a variant that the profile allows. Data that happen to
sum to zero fit several, so only a reply that leaves no choice says which variant a drive uses.
Source: manual 2.1, 2.2 with (3), (4) and (5) "Status", 3, 4 "Data setting limit".
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.smartstep.addresses import NEVER_VALID, OperatingMode, Register, TraceRegister, operating_mode
from ldcnd.drives.smartstep.monitors import Monitor
from ldcnd.drives.smartstep.packet import (
    END,
    PACKET_CHARACTERS,
    CommandPacket,
    Function,
    ReplyPacket,
    ResponseStatus,
    decode_reply,
    is_upper_hex,
    piece_bytes,
    sums_to_zero,
)
from ldcnd.drives.smartstep.parameters import Parameter
from ldcnd.drives.smartstep.profiles import RESPONSE_S, SMARTSTEP, CountUnit, SmartStepProfile, StringChecksum
from ldcnd.line.exchange import Exchange, PacketEffect, ReplyVerdict


class RefusalReason(StrEnum):
    """Why a drive did not do it."""

    ADDRESS = "address error"
    DATA = "data error"
    BYTE_COUNT = "error in number of bytes"
    TRACING = "busy in Data Trace Mode"


@dataclass(frozen=True, slots=True)
class Refusal(ReplyPacket):
    """An intact reply by which the drive declines; nothing was changed, and the same again will be declined again.

    Its data are as echoed: the value, or the requested number of bytes.
    """

    @property
    def reason(self) -> RefusalReason:
        """The reason by the manual's table, taken by itself."""
        if self.status & 0x8:
            return RefusalReason.ADDRESS
        if self.status.function is Function.STRING_REFERENCE:
            return RefusalReason.BYTE_COUNT
        return RefusalReason.DATA

    def reason_in(self, mode: OperatingMode | int) -> RefusalReason:
        """Return the reason for a drive in this operating mode: settings meet an address error while it traces."""
        if (
            mode == OperatingMode.DATA_TRACE
            and self.status is ResponseStatus.SETTING_ADDRESS_ERROR
            and self.address not in (Register.OPERATING_MODE, Register.OPERATION)
        ):
            return RefusalReason.TRACING
        return self.reason

    def __str__(self) -> str:
        verb = {
            Function.REFERENCE: "reading",
            Function.SETTING: f"setting to {self.data:04X}H",
            Function.STRING_REFERENCE: f"reading {self.data} counts from",
        }[self.status.function]
        return f"unit {self.unit}: {verb} {self.address:04X}H: {self.reason} (e={self.status:X})"


FLUSH = END
"""Ends whatever is in a drive's line buffer and, not being 14 characters, draws no reply."""
EXECUTE = 0x0001

ValueT = TypeVar("ValueT")


def reference(unit: int, address: int) -> Exchange[int | Refusal]:
    """Read one word, 0 to FFFFH; harmless at any address.

    Raises:
        ValueOutOfRange: unit or address does not fit.

    Source: manual 2.2, data reference command.
    """
    return _exchange(CommandPacket(unit, Function.REFERENCE, address), _word, repeatable=True)


def read_monitor(unit: int, monitor: Monitor) -> Exchange[int | Refusal]:
    """Read a status display in its own unit, with its sign.

    Source: manual 3.
    """
    return _exchange(
        CommandPacket(unit, Function.REFERENCE, monitor.address),
        lambda reply: monitor.value_of(reply.data),
        repeatable=True,
    )


def read_operating_mode(unit: int) -> Exchange[OperatingMode | int | Refusal]:
    """Read 2000H; the way to learn that a trace or a clear has finished.

    Source: manual 4, settings 1 and 2.
    """
    return _exchange(
        CommandPacket(unit, Function.REFERENCE, Register.OPERATING_MODE),
        lambda reply: operating_mode(reply.data),
        repeatable=True,
    )


def write_ram(unit: int, parameter: Parameter, value: int) -> Exchange[int | Refusal]:
    """Change a parameter until power-off; the drive itself refuses a value out of the parameter's range.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 2.2, note; 3.
    """
    return _exchange(CommandPacket(unit, Function.SETTING, parameter.ram_address, value), _word, repeatable=True)


def write_eeprom(unit: int, parameter: Parameter, value: int) -> Exchange[int | Refusal]:
    """Change a parameter permanently; costs one of 10,000 writes even when the value stays the same.

    Read first and skip if equal; when the reply is lost, read back before sending again. Whether the value in use
    changes too is not known: read both addresses afterwards.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 2.2, note.
    """
    return _exchange(CommandPacket(unit, Function.SETTING, parameter.eeprom_address, value), _word, repeatable=False)


def write_trace_register(unit: int, register: TraceRegister, value: int) -> Exchange[int | Refusal]:
    """Set up the trace; refused with an address error while the drive is in Data Trace Mode.

    Raises:
        ValueOutOfRange: the value does not fit 16 bits.

    Source: manual 4, "Data setting limit" and settings 3 to 8.
    """
    return _exchange(CommandPacket(unit, Function.SETTING, register, value), _word, repeatable=True)


def set_operating_mode(unit: int, mode: OperatingMode) -> Exchange[int | Refusal]:
    """Enter a mode, or leave the present one without executing it (`NORMAL`).

    Source: manual 4, settings 1; 5 (2); 6 (2).
    """
    # Membership, not the type: an IntEnum parameter accepts a bare number at run time.
    command = CommandPacket(unit, Function.SETTING, Register.OPERATING_MODE, OperatingMode(mode))
    return _exchange(command, _word, repeatable=False)


def execute(unit: int) -> Exchange[int | Refusal]:
    """Start the operation of the operating mode; read 2000H, not 2001H, to see when it has finished.

    Source: manual 4, settings 2; 5 (2); 6 (2).
    """
    return _exchange(CommandPacket(unit, Function.SETTING, Register.OPERATION, EXECUTE), _word, repeatable=False)


def probe(unit: int) -> Exchange[None]:
    """Request an address that never exists: the error reply proves that the unit is alive and the line in step.

    Safe on any wiring: a drive that receives an error reply does not take it for a command. No other command's reply
    carries this address, so none can pass for it. `decode` raises `BadReply` for any other answer.

    Source: manual 2.2, example 3.
    """
    command = CommandPacket(unit, Function.REFERENCE, NEVER_VALID)
    known = ReplyPacket(unit, ResponseStatus.REFERENCE_ADDRESS_ERROR, NEVER_VALID, 0).encode()

    def decode(packet: bytes) -> None:
        if packet != known:
            raise BadReply(f"unit {unit}: {packet!r} is not the known answer {known!r}")

    return Exchange(
        unit,
        command.encode(),
        PACKET_CHARACTERS,
        _checker(command),
        decode,
        RESPONSE_S,
        repeatable=True,
        total_bytes=_packet_total,
        effect=PacketEffect.READS,
    )


def with_response_time(exchange: Exchange[ValueT], profile: SmartStepProfile) -> Exchange[ValueT]:
    """Return the exchange with the response time of a profile instead of the manual's."""
    return replace(exchange, response_s=profile.unit.first_character_s)


def is_self_hearing(unit: int, stray: bytes) -> bool:
    """Tell whether bytes that follow a good reply show a drive that took its own reply for a command.

    On two wires a non-zero word sent by a drive is, to itself, a reference with data: it answers with a data error. A
    zero word, or a setting, would make it answer itself without end, so nothing may be written on such a line.
    """
    try:
        reply = decode_reply(stray)
    except BadReply:
        return False
    return reply.unit == unit and reply.status is ResponseStatus.REFERENCE_DATA_ERROR


def _word(reply: ReplyPacket) -> int:
    return reply.data


def _packet_total(data: bytes) -> int | None:
    return piece_bytes(data, PACKET_CHARACTERS)


def _exchange(
    command: CommandPacket, value_of: Callable[[ReplyPacket], ValueT], *, repeatable: bool
) -> Exchange[ValueT | Refusal]:
    check = _checker(command)

    def decode(packet: bytes) -> ValueT | Refusal:
        if check(packet) is not ReplyVerdict.INTACT:
            raise BadReply(f"unit {command.unit}: {packet!r} does not answer {command.encode()!r}")
        reply = decode_reply(packet)
        if reply.status.normal:
            return value_of(reply)
        return Refusal(reply.unit, reply.status, reply.address, reply.data)

    return Exchange(
        command.unit,
        command.encode(),
        PACKET_CHARACTERS,
        check,
        decode,
        RESPONSE_S,
        repeatable,
        total_bytes=_packet_total,
        effect=_effect(command),
    )


def _effect(command: CommandPacket) -> PacketEffect:
    if command.function is Function.REFERENCE:
        return PacketEffect.READS
    # "set the operating mode to Normal Mode" ends what is under way (manual 4, setting 1)
    if (command.address, command.data) == (Register.OPERATING_MODE, OperatingMode.NORMAL):
        return PacketEffect.RELIEVES  # it leaves a mode and does nothing else
    return PacketEffect.CHANGES


def _checker(command: CommandPacket) -> Callable[[bytes], ReplyVerdict]:
    """Return the judge of 14-character replies to a command: everything that is not an answer is foreign."""
    request = command.encode()
    start, address = request[:2], request[3:7]
    # A setting's reply repeats the data, good or bad (manual, examples 2, 4 and 6).
    data = request[7:11] if command.function is Function.SETTING else b""
    statuses = b"".join(b"%X" % status for status in ResponseStatus if status.function is command.function)

    def check(packet: bytes) -> ReplyVerdict:
        if (
            len(packet) == PACKET_CHARACTERS
            and packet[:2] == start
            and packet[2] in statuses
            and packet[3:7] == address
            and packet[7 : 7 + len(data)] == data
            and packet[13:] == END
            and is_upper_hex(packet[1:13])
            and sums_to_zero(packet[1:13])
        ):
            return ReplyVerdict.INTACT
        return ReplyVerdict.FOREIGN

    return check


LONGEST_STRING_BYTES = 1000
"""One whole trace area; a longer one is not documented."""
HEADER_CHARACTERS = PACKET_CHARACTERS - 1
TRAILER_CHARACTERS = 2
AGREEING_REPLIES = 3
_VARIANTS = (StringChecksum.HEADER, StringChecksum.ALL, StringChecksum.TRAILER)


@dataclass(frozen=True, slots=True)
class StringReply:
    """The answer to a string reference.

    Attributes:
        data: memory bytes in the order of the wire.
        fits: the checksum variants that this reply fits, at least one.
    """

    data: bytes
    fits: frozenset[StringChecksum]


class ChecksumPin:
    """Learns which checksum variant a drive uses, from replies that leave no choice.

    Attributes:
        pinned: AUTO until three replies in a row fitted one and the same variant only.
    """

    def __init__(self) -> None:
        self.pinned = StringChecksum.AUTO
        self._candidate = StringChecksum.AUTO
        self._agreeing = 0

    def take(self, reply: StringReply) -> None:
        """Learn from a reply; one that fits several variants says nothing."""
        if len(reply.fits) != 1 or self.pinned is not StringChecksum.AUTO:
            return
        (variant,) = reply.fits
        self._agreeing = self._agreeing + 1 if variant is self._candidate else 1
        self._candidate = variant
        if self._agreeing == AGREEING_REPLIES:
            self.pinned = variant


def string_reference(
    unit: int, address: int, byte_count: int, profile: SmartStepProfile = SMARTSTEP
) -> Exchange[StringReply | Refusal]:
    """Read consecutive memory; 14 + 2 x `byte_count` characters come back.

    A refusal has 14 characters, so replies end at their CR and not at a known length. Address and count are even: what
    a drive does with odd ones is not known.

    Raises:
        ValueOutOfRange: an odd or impossible number.

    Source: manual 2.2, data string reference command.
    """
    if byte_count % 2 or not 2 <= byte_count <= LONGEST_STRING_BYTES:  # noqa: PLR2004 - one word
        raise ValueOutOfRange(
            f"unit {unit}: a string of {byte_count} bytes is not an even number from 2 to {LONGEST_STRING_BYTES}",
            value=byte_count,
            limit=LONGEST_STRING_BYTES,
        )
    if address % 2:
        raise ValueOutOfRange(f"unit {unit}: string address {address:04X}H is odd", value=address)
    command = CommandPacket(
        unit, Function.STRING_REFERENCE, address, _string_count(byte_count, profile.unit.trace.string_count_unit)
    )
    checksum = profile.unit.trace.string_checksum
    allowed = _VARIANTS if checksum is StringChecksum.AUTO else (checksum,)
    # as if the count were one of words, whatever the profile says: a wrong unit is to be named, not to time out
    longest = PACKET_CHARACTERS + 4 * command.data + TRAILER_CHARACTERS
    expected = PACKET_CHARACTERS + 2 * byte_count
    if StringChecksum.TRAILER in allowed:
        # for the time that it takes only: where it ends, its CR tells
        expected += TRAILER_CHARACTERS
    return Exchange(
        unit,
        command.encode(),
        expected,
        _string_checker(command, allowed),
        _string_decoder(command, allowed, byte_count),
        profile.unit.first_character_s,
        repeatable=True,
        total_bytes=lambda data: piece_bytes(data, longest),
        effect=PacketEffect.READS,
    )


def _string_count(byte_count: int, unit: CountUnit) -> int:
    match unit:
        case CountUnit.BYTES:
            return byte_count
        case CountUnit.WORDS:
            return byte_count // 2
        case CountUnit.CHARS:
            return byte_count * 2


def _is_refusal(command: CommandPacket, packet: bytes) -> bool:
    try:
        reply = decode_reply(packet)
    except BadReply:
        return False
    return (
        reply.unit == command.unit
        and reply.status in (ResponseStatus.STRING_ADDRESS_ERROR, ResponseStatus.BYTE_COUNT_ERROR)
        and reply.address == command.address
        and reply.data == command.data
    )


def _string_checker(command: CommandPacket, allowed: tuple[StringChecksum, ...]) -> Callable[[bytes], ReplyVerdict]:
    start = command.encode()[:11]

    def check(packet: bytes) -> ReplyVerdict:
        if packet[:11] != start or packet[-1:] != END:
            return ReplyVerdict.INTACT if _is_refusal(command, packet) else ReplyVerdict.FOREIGN
        # This is the answer: if it fits no variant, it is damaged and nothing better will follow.
        plausible = _count_unit(command, len(packet) - PACKET_CHARACTERS) and _fitting(packet, allowed, None)
        return ReplyVerdict.INTACT if plausible else ReplyVerdict.CORRUPT

    return check


def _fitting(packet: bytes, allowed: tuple[StringChecksum, ...], byte_count: int | None) -> dict[StringChecksum, bytes]:
    """Return the data digits by variant; with `byte_count`, only variants that give the data this length."""
    header, body = packet[1:HEADER_CHARACTERS], packet[HEADER_CHARACTERS:-1]
    if len(body) % 2 or not is_upper_hex(header) or not is_upper_hex(body) or not body:
        return {}
    header_fits = sums_to_zero(header)
    fits = {
        StringChecksum.HEADER: header_fits,
        StringChecksum.ALL: sums_to_zero(header + body),
        StringChecksum.TRAILER: header_fits and len(body) > TRAILER_CHARACTERS and sums_to_zero(body),
    }
    digits = {variant: body for variant in allowed if fits[variant]}
    if StringChecksum.TRAILER in digits:
        digits[StringChecksum.TRAILER] = body[:-TRAILER_CHARACTERS]
    if byte_count is None:
        return digits
    return {variant: data for variant, data in digits.items() if len(data) == 2 * byte_count}


def _string_decoder(
    command: CommandPacket, allowed: tuple[StringChecksum, ...], byte_count: int
) -> Callable[[bytes], StringReply | Refusal]:
    check = _string_checker(command, allowed)

    def decode(packet: bytes) -> StringReply | Refusal:
        if check(packet) is not ReplyVerdict.INTACT:
            raise BadReply(f"unit {command.unit}: {packet[:40]!r} does not answer {command.encode()!r}")
        if _is_refusal(command, packet):
            reply = decode_reply(packet)
            return Refusal(reply.unit, reply.status, reply.address, reply.data)
        fits = _fitting(packet, allowed, byte_count)
        if not fits:
            raise BadReply(_wrong_length(command, len(packet) - PACKET_CHARACTERS, byte_count))
        digits = next(iter(fits.values()))
        return StringReply(bytes.fromhex(digits.decode("ascii")), frozenset(fits))

    return decode


def _count_unit(command: CommandPacket, digits: int) -> CountUnit | None:
    """Return the unit of the count that explains this number of data characters; None when nothing explains it."""
    for extra in (0, TRAILER_CHARACTERS):
        for unit, length in (
            (CountUnit.BYTES, 2 * command.data),
            (CountUnit.WORDS, 4 * command.data),
            (CountUnit.CHARS, command.data),
        ):
            if digits == length + extra:
                return unit
    return None


def _wrong_length(command: CommandPacket, digits: int, byte_count: int) -> str:
    return (
        f"unit {command.unit}: {digits} data characters came for {byte_count} bytes:"
        f" the count unit seems to be {_count_unit(command, digits)}"
    )
