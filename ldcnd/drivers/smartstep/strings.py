"""String references: many words in one reply, in whichever of the ways the manual leaves open.

The checksum stands before the data and the manual does not say whether it covers them; nor does it say what exactly the
count counts. A reply is accepted if it fits a variant that the profile allows. Data that happen to sum to zero fit
several, so only a reply that leaves no choice says which variant a drive uses.
Source: manual 2.2, data string reference command; (3) and (4).
"""

from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.drivers.smartstep.packet import (
    END,
    PACKET_CHARACTERS,
    Command,
    Function,
    ResponseStatus,
    decode_reply,
    is_upper_hex,
    sums_to_zero,
)
from ldcnd.drivers.smartstep.profiles import SMARTSTEP, CountUnit, SmartStepProfile, StringChecksum
from ldcnd.drivers.smartstep.refusals import Refusal
from ldcnd.drivers.smartstep.reply_reader import piece_bytes
from ldcnd.errors import BadReply, ValueOutOfRange
from ldcnd.exchange import Exchange, ReplyVerdict

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
    command = Command(unit, Function.STRING_REFERENCE, address, _count(byte_count, profile.string_count_unit))
    allowed = _VARIANTS if profile.string_checksum is StringChecksum.AUTO else (profile.string_checksum,)
    longest = PACKET_CHARACTERS + 4 * command.data + TRAILER_CHARACTERS
    expected = PACKET_CHARACTERS + 2 * byte_count
    if StringChecksum.TRAILER in allowed:
        expected += TRAILER_CHARACTERS
    return Exchange(
        unit,
        command.encode(),
        expected,
        _checker(command, allowed),
        _decoder(command, allowed, byte_count),
        profile.first_character_s,
        repeatable=True,
        total_bytes=lambda data: piece_bytes(data, longest),
    )


def _count(byte_count: int, unit: CountUnit) -> int:
    match unit:
        case CountUnit.BYTES:
            return byte_count
        case CountUnit.WORDS:
            return byte_count // 2
        case CountUnit.CHARS:
            return byte_count * 2


def _is_refusal(command: Command, packet: bytes) -> bool:
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


def _checker(command: Command, allowed: tuple[StringChecksum, ...]) -> Callable[[bytes], ReplyVerdict]:
    start = command.encode()[:11]

    def check(packet: bytes) -> ReplyVerdict:
        if packet[:11] != start or packet[-1:] != END:
            return ReplyVerdict.INTACT if _is_refusal(command, packet) else ReplyVerdict.FOREIGN
        # This is the answer: if it fits no variant, it is damaged and nothing better will follow.
        plausible = _count_unit(command, len(packet) - PACKET_CHARACTERS) and _fitting(packet, allowed, None)
        return ReplyVerdict.INTACT if plausible else ReplyVerdict.CORRUPT

    return check


def _fitting(packet: bytes, allowed: tuple[StringChecksum, ...], byte_count: int | None) -> dict[StringChecksum, bytes]:
    """Return the data digits by variant; with `byte_count`, only variants that make the data so long."""
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


def _decoder(
    command: Command, allowed: tuple[StringChecksum, ...], byte_count: int
) -> Callable[[bytes], StringReply | Refusal]:
    check = _checker(command, allowed)

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


def _count_unit(command: Command, digits: int) -> CountUnit | None:
    """Return what the drive must have counted to send so many data characters; None when nothing explains them."""
    for extra in (0, TRAILER_CHARACTERS):
        for unit, length in (
            (CountUnit.BYTES, 2 * command.data),
            (CountUnit.WORDS, 4 * command.data),
            (CountUnit.CHARS, command.data),
        ):
            if digits == length + extra:
                return unit
    return None


def _wrong_length(command: Command, digits: int, byte_count: int) -> str:
    return (
        f"unit {command.unit}: {digits} data characters came for {byte_count} bytes:"
        f" the count unit seems to be {_count_unit(command, digits)}"
    )
