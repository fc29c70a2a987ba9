"""The two trace memories: 500 points each in a ring, how to fetch them and how to put them in order.

1000 addresses hold 500 points, so an address holds a byte (INFERRED_HIGH). The trigger address counts points, not
addresses, and fetching a whole memory makes the difference harmless.
Source: manual 4, "Related addresses" and settings 9.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from ldcnd.drivers.smartstep.addresses import TRACE_1_AREA, TRACE_2_AREA
from ldcnd.errors import BadReply, ValueOutOfRange

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
        ValueOutOfRange: so many pre-trigger points leave nothing for the trigger.
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
