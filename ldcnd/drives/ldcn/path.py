"""Path points of PIC-SERVO SC and CMC: differences of position that are walked through at a fixed rate.

A point is 16 bits: the step in the upper ones, shifted by the number of cycles that it takes, bit 1 for the longer of
two periods, bit 0 for reverse. Without these two bits the word is the speed, in 1/256 count per servo cycle. A point
has no absolute position, so the host sums up what it has sent.
Source: PIC-SERVO SC data sheet, 4.4.5, 5.2; the cycles of a period from the scale factors of the vendor's library.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.ldcn.profiles import Profile

REVERSE = 0x0001
LONG_PERIOD = 0x0002
SPEED_MASK = 0xFFFC
WORD_BYTES = 2
MOST_POINTS_PER_PACKET = 7
_SPEED_FRACTION = 256


def point_cycles(word: int, *, fast_path: bool) -> int:
    """Return for how many servo cycles a point moves: 16, 32 or 64."""
    cycles = 64 if word & LONG_PERIOD else 32
    return cycles // 2 if fast_path else cycles


@dataclass(frozen=True, slots=True)
class PathPoint:
    """One step of a path.

    Attributes:
        counts: from the point before; at most 16383, 8191 or 4095 either way with 64, 32 or 16 cycles.
        cycles: servo cycles that it takes: 64 or 32, on the fast path 32 or 16.
    """

    counts: int
    cycles: int


def encode_point(point: PathPoint, *, fast_path: bool) -> int:
    """Return the word of a point.

    Args:
        point: to encode.
        fast_path: the option as last set by I/O Control.

    Raises:
        ValueOutOfRange: the step does not fit its period, or the period is none of the two.
    """
    periods = (32, 16) if fast_path else (64, 32)
    if point.cycles not in periods:
        allowed = f"{periods[0]} or {periods[1]}"
        raise ValueOutOfRange(f"a path point takes {allowed} cycles", value=point.cycles, limit=allowed)
    most = most_step(point.cycles)
    if abs(point.counts) > most:
        raise ValueOutOfRange(
            f"a path point of {point.cycles} cycles moves {most} counts at most, not {point.counts}",
            value=point.counts,
            limit=most,
            nearest=most if point.counts > 0 else -most,
        )
    word = abs(point.counts) * _SPEED_FRACTION // point.cycles
    if point.cycles == periods[0]:
        word |= LONG_PERIOD
    return word | REVERSE if point.counts < 0 else word


def decode_point(word: int, *, fast_path: bool) -> PathPoint:
    """Take a word as the module would; bits below the step count as a fraction of it and are cut off."""
    cycles = point_cycles(word, fast_path=fast_path)
    counts = (word & SPEED_MASK) * cycles // _SPEED_FRACTION
    return PathPoint(-counts if word & REVERSE else counts, cycles)


def encode_points(profile: Profile, points: Iterable[PathPoint], *, fast_path: bool) -> bytes:
    """Return the data of Add Path Points for 1 to 7 points.

    Raises:
        NotSupported: the device has no path mode.
        ValueOutOfRange: too many points, none, or one that does not fit.
    """
    if not profile.path_points:
        raise NotSupported(f"{profile.title} has no path mode")
    words = [encode_point(point, fast_path=fast_path) for point in points]
    if not 1 <= len(words) <= MOST_POINTS_PER_PACKET:
        raise ValueOutOfRange(
            f"{len(words)} path points, a packet takes 1 to {MOST_POINTS_PER_PACKET}",
            value=len(words),
            limit=MOST_POINTS_PER_PACKET,
        )
    return b"".join(word.to_bytes(WORD_BYTES, "little") for word in words)


def most_step(cycles: int) -> int:
    """Return the largest step whose speed still fits the word: below 256 counts per cycle."""
    return (1 << 16) * cycles // _SPEED_FRACTION - 1
