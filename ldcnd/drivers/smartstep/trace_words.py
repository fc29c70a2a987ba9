"""Trace memory words: one I/O bit and one value in 16 bits, in whichever layout is assumed.

The manual's figure of the word is lost. Raw words stay with every result, so that they can be decoded again when a
bench has settled the layout.
Source: manual 4, settings 3; the flowchart note (trc1Data, trc1I/O).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ldcnd.drivers.smartstep.profiles import ByteOrder, TraceWordLayout
from ldcnd.drivers.smartstep.status import signed_word
from ldcnd.errors import BadReply

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
    """Tell whether torque or speed points are larger than the drive can mean: the assumed layout is doubtful."""
    return any(abs(point.value) > FULL_SCALE for point in points)
