"""Data of the trace: words, the two memories of 500 points, the registers of a trace, units. Pure.

The figure of the memory word is lost from the manual, so the layout is an assumption and raw words stay with every
result. 1000 addresses hold 500 points, so an address holds a byte (INFERRED_HIGH). The printed formulas for command
pulse speed divide numerator and denominator one way and the other; the profile says which is taken (at gear 1/1 all
agree).
Source: manual 4, "Related addresses", settings 3 to 9, "Unit conversion" (twice), the flowchart note.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

from ldcnd.contract.errors import BadReply, ValueOutOfRange
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA, TRACE_2_AREA
from ldcnd.drives.smartstep.monitors import signed_word
from ldcnd.drives.smartstep.profiles import (
    ByteOrder,
    CommandPulseGear,
    SmartStepProfile,
    TraceWordLayout,
)

FULL_SCALE = 15_000
"""Torque and speed data reach this at MAXTRQC and OSVELCC."""


@dataclass(frozen=True, slots=True)
class TracePoint:
    """One decoded point.

    Attributes:
        value: in the units of the trace object, before scaling; 0 to FFFFH for the raw layout.
        io: the level of the I/O object; None where the layout does not tell.
    """

    value: int
    io: bool | None


def decode_word(word: int, layout: TraceWordLayout) -> TracePoint:
    """Decode one word, 0 to FFFFH; any word is possible in any layout."""
    match layout:
        case TraceWordLayout.MSB_IO:
            value = word & 0x7FFF
            return TracePoint(value - 0x8000 if value & 0x4000 else value, bool(word & 0x8000))
        case TraceWordLayout.LSB_IO_SHIFT:
            return TracePoint(signed_word(word) >> 1, bool(word & 1))
        case TraceWordLayout.LSB_IO_MASK:
            return TracePoint(signed_word(word & 0xFFFE), bool(word & 1))
        case TraceWordLayout.RAW:
            return TracePoint(word, None)


def encode_word(point: TracePoint, layout: TraceWordLayout) -> int:
    """Return the word of a point; a value beyond the layout's bits wraps, an odd one loses its bit under the mask."""
    io = bool(point.io)
    match layout:
        case TraceWordLayout.MSB_IO:
            return point.value & 0x7FFF | io << 15
        case TraceWordLayout.LSB_IO_SHIFT:
            return point.value << 1 & 0xFFFE | io
        case TraceWordLayout.LSB_IO_MASK:
            return point.value & 0xFFFE | io
        case TraceWordLayout.RAW:
            return point.value & 0xFFFF


def split_words(data: bytes, order: ByteOrder) -> tuple[int, ...]:
    """Return the words of a string of memory bytes.

    Raises:
        BadReply: an odd number of bytes.
    """
    if len(data) % 2:
        raise BadReply(f"{len(data)} bytes are no whole number of trace words")
    return tuple(int.from_bytes(data[at : at + 2], order.value) for at in range(0, len(data), 2))


def join_words(words: Sequence[int], order: ByteOrder) -> bytes:
    """Return words as memory bytes."""
    return b"".join(word.to_bytes(2, order.value) for word in words)


def is_beyond_full_scale(points: Sequence[TracePoint]) -> bool:
    """Tell whether torque or speed points are larger than the drive can mean: then the assumed layout is wrong."""
    return any(abs(point.value) > FULL_SCALE for point in points)


POINTS = 500
BYTES_PER_POINT = 2
HIGHEST_PRE_TRIGGER = POINTS - 1

PointT = TypeVar("PointT")


@dataclass(frozen=True, slots=True)
class Chunk:
    """One string reference of an upload."""

    address: int
    byte_count: int

    def halves(self) -> tuple["Chunk", "Chunk"] | None:
        """Return two smaller chunks for a drive that refused the number of bytes; None when it is one word."""
        first = self.byte_count // 2 // BYTES_PER_POINT * BYTES_PER_POINT
        if first == 0:
            return None
        return Chunk(self.address, first), Chunk(self.address + first, self.byte_count - first)


def chunk_plan(trace: int, chunk_bytes: int) -> tuple[Chunk, ...]:
    """Return the string references that fetch a whole trace memory in order.

    Args:
        trace: 1 or 2.
        chunk_bytes: 2 to 1000, even; the last chunk may be shorter.

    Raises:
        ValueOutOfRange: there is no such trace, or chunks of that size are impossible.
    """
    areas = {1: TRACE_1_AREA, 2: TRACE_2_AREA}
    if trace not in areas:
        raise ValueOutOfRange(f"trace {trace} is not 1 or 2", value=trace)
    area = areas[trace]
    if chunk_bytes % BYTES_PER_POINT or not BYTES_PER_POINT <= chunk_bytes <= len(area):
        raise ValueOutOfRange(
            f"chunks of {chunk_bytes} bytes are not an even number from {BYTES_PER_POINT} to {len(area)}",
            value=chunk_bytes,
            limit=len(area),
        )
    return tuple(Chunk(address, min(chunk_bytes, area.stop - address)) for address in area[::chunk_bytes])


def first_point(trigger_address: int, pre_trigger: int) -> int:
    """Return the ring index of the oldest point of a triggered trace.

    The manual's index rules are right modulo 500 only; with no pre-trigger points the first point is the trigger.

    Args:
        trigger_address: TRGADR, 0 to 499, as the drive reports it.
        pre_trigger: PTRGNO, 0 to 499.

    Raises:
        BadReply: the trigger address is outside the ring.
        ValueOutOfRange: this number of pre-trigger points leaves nothing for the trigger.
    """
    if trigger_address >= POINTS:
        raise BadReply(f"trigger address {trigger_address} is outside the {POINTS} points")
    return (trigger_address - require_pre_trigger(pre_trigger)) % POINTS


def require_pre_trigger(points: int) -> int:
    """Return the number of pre-trigger points.

    Raises:
        ValueOutOfRange: it is not 0 to 499.
    """
    if not 0 <= points <= HIGHEST_PRE_TRIGGER:
        raise ValueOutOfRange(
            f"{points} pre-trigger points are not 0 to {HIGHEST_PRE_TRIGGER}", value=points, limit=HIGHEST_PRE_TRIGGER
        )
    return points


def unwrap(ring: Sequence[PointT], first: int) -> tuple[PointT, ...]:
    """Return the points of a ring from its oldest on; `first` is 0 for an untriggered trace (INFERRED_HIGH)."""
    return (*ring[first:], *ring[:first])


NO_TRIGGER = 0x0000
"""Both edges disabled under any layout with positive enable bits (INFERRED_HIGH)."""
SHORTEST_INTERVAL = 2
"""The drive does not refuse 0 and 1, so ldcnd does."""
LONGEST_INTERVAL = 0xFFFF


class DataObject(IntEnum):
    """The value of a trace point. 02H, speed command on related drives, is not listed."""

    TORQUE_REFERENCE = 0x00
    SPEED_FEEDBACK = 0x01
    COMMAND_PULSE_SPEED = 0x03
    POSITION_DEVIATION = 0x04


class IoObject(IntEnum):
    """The I/O bit of a trace point; function codes, not the bit numbers of 8005H and 8006H."""

    RUN = 0x00
    RESET = 0x06
    ALM = 0x80
    INP = 0x81
    BKIR = 0x87


def object_word(data: DataObject, io: IoObject) -> int:
    """Return the word of 5000H or 5001H: I/O code in the left byte, data code in the right one."""
    return io << 8 | data


def sampling_interval(period_s: float, cyclec_us: int) -> int:
    """Return SMPTMS, the sampling interval in units of CYCLEC, nearest to a wanted period.

    Args:
        period_s: of one point.
        cyclec_us: 8700H of this drive, microseconds; read for each trace.

    Raises:
        ValueOutOfRange: the drive reports no time unit, or the interval is not 2 to FFFFH units.
    """
    if cyclec_us <= 0:
        raise ValueOutOfRange(f"a sampling time unit of {cyclec_us} us is impossible", value=cyclec_us)
    unit_s = cyclec_us * 1e-6
    shortest_s, longest_s = SHORTEST_INTERVAL * unit_s, LONGEST_INTERVAL * unit_s
    # what rounds to an interval that the drive has is meant by it
    if not SHORTEST_INTERVAL - 0.5 <= period_s / unit_s < LONGEST_INTERVAL + 0.5:
        raise ValueOutOfRange(
            f"a sampling period of {period_s} s is not {shortest_s} to {longest_s} s",
            value=period_s,
            nearest=min(max(period_s, shortest_s), longest_s),
        )
    return min(max(round(period_s / unit_s), SHORTEST_INTERVAL), LONGEST_INTERVAL)


def period_s(smptms: int, cyclec_us: int) -> float:
    """Return the time between two points."""
    return smptms * cyclec_us * 1e-6


_US_PER_MINUTE = 60_000_000


@dataclass(frozen=True, slots=True)
class TraceConstants:
    """The scale of a trace; read from the drive for each one.

    Attributes:
        cyclec_us: 8700H.
        maxtrqc: 8701H, torque in % at data 15,000.
        osvelcc: 8702H, speed in r/min at data 15,000.
        gear_numerator: RATB, Pn202.
        gear_denominator: RATA, Pn203.

    Raises:
        BadReply: a constant is zero, which no scaling survives.
    """

    cyclec_us: int
    maxtrqc: int
    osvelcc: int
    gear_numerator: int = 1
    gear_denominator: int = 1

    def __post_init__(self) -> None:
        if not all((self.cyclec_us, self.maxtrqc, self.osvelcc, self.gear_numerator, self.gear_denominator)):
            raise BadReply(f"trace constants cannot be zero: {self}")


def unit_of(data: DataObject) -> str:
    """Return the unit of scaled data."""
    match data:
        case DataObject.TORQUE_REFERENCE:
            return "%"
        case DataObject.SPEED_FEEDBACK | DataObject.COMMAND_PULSE_SPEED:
            return "r/min"
        case DataObject.POSITION_DEVIATION:
            return "command units"


def scale(profile: SmartStepProfile, constants: TraceConstants, data: DataObject) -> float:
    """Return what one count of trace data is worth in `unit_of(data)`."""
    match data:
        case DataObject.TORQUE_REFERENCE:
            return constants.maxtrqc / FULL_SCALE
        case DataObject.SPEED_FEEDBACK:
            return constants.osvelcc / FULL_SCALE
        case DataObject.COMMAND_PULSE_SPEED:
            per_minute = _US_PER_MINUTE / (2 * constants.cyclec_us)
            return _gear(profile, constants) * per_minute / profile.unit.encoder_counts_per_rev
        case DataObject.POSITION_DEVIATION:
            return 1.0


def trigger_level(profile: SmartStepProfile, constants: TraceConstants, data: DataObject, level: float) -> int:
    """Return the word of 5005H for a level in `unit_of(data)`.

    Raises:
        ValueOutOfRange: the level does not fit 16 bits with sign.
    """
    unit = scale(profile, constants, data)
    count = round(level / unit)
    if not -0x8000 <= count <= 0x7FFF:  # noqa: PLR2004 - 16 bits with sign
        raise ValueOutOfRange(
            f"trigger level {level} {unit_of(data)} is {count} in trace data, beyond 16 bits",
            value=level,
            limit=0x7FFF * unit,
        )
    return count & 0xFFFF


def _gear(profile: SmartStepProfile, constants: TraceConstants) -> float:
    match profile.unit.trace.command_pulse_gear:
        case CommandPulseGear.NUM_DEN:
            return constants.gear_numerator / constants.gear_denominator
        case CommandPulseGear.DEN_NUM:
            return constants.gear_denominator / constants.gear_numerator
        case CommandPulseGear.NONE:
            return 1.0
