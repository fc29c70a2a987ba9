"""The last readings of an axis, in memory that is taken when the daemon starts; see contract/instants.py."""

import struct
from collections.abc import Iterator
from typing import Final

from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import AxisStatus
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.instants import (
    Coordinates,
    Course,
    Gap,
    Past,
    Reading,
    count_until,
    course,
    instant_of,
    instants_of,
    longest_gap_ns,
    packed,
)
from ldcnd.contract.samples import Quality
from ldcnd.drives.driver import AxisReading

HISTORY_S: Final = 600.0
"""Time for which readings are kept at the rate of the polls, seconds."""
MOST_READINGS: Final = 60_000
"""Readings that are kept of an axis at most, 38 bytes each: 2.3 MB, 600 s of 100 polls a second."""
MOST_COURSES: Final = 8192
"""Changes of what it does that are kept of an axis at most."""
MOST_RATES: Final = 256
"""Changes of the rate of its polls that are kept of an axis at most."""
LONGEST_ERROR_NS: Final = 0xFFFF_FFFF

_RECORD = struct.Struct("<qIqddH")
"""As `Reading` has it."""


class ReadingRing:
    """The last readings of one axis, numbered from the earliest on.

    Args:
        rate_hz: how often its position is polled; extra readings shorten the time that the ring spans.
        counts_per_unit: by which they are counted.

    Attributes:
        rate_hz: as polled now.
        counts_per_unit: as given.
    """

    def __init__(self, rate_hz: float, counts_per_unit: float) -> None:
        self.rate_hz = rate_hz
        self.counts_per_unit = counts_per_unit
        self._most = _most_at(rate_hz)
        self._gaps = [Gap(0, longest_gap_ns(rate_hz))]
        self._ring = bytearray(self._most * _RECORD.size)
        self._count = 0
        self._last_ns = 0
        self._status: AxisStatus | None = None
        self._levels: tuple[bool | None, ...] = ()
        self._origin = 0.0
        self._packed = 0
        self._stretch = 0
        self._courses = [Course(0, altered=False, winding=False)]

    def repoll(self, rate_hz: float, t: int) -> None:
        """Keep what there is, and take readings at another rate from an instant on, UTC in ns since 1970."""
        self.rate_hz = rate_hz
        self._gaps.append(Gap(max(t, self._gaps[-1].t), longest_gap_ns(rate_hz)))
        del self._gaps[:-MOST_RATES]
        most = max(_most_at(rate_hz), len(self))
        if most != self._most:
            size, oldest = _RECORD.size, max(0, self._count - self._most) % self._most * _RECORD.size
            kept = (self._ring[oldest:] + self._ring[:oldest])[: len(self) * size]
            self._count, self._most = len(self), most
            self._ring = kept + bytearray(most * size - len(kept))

    def take(self, reading: AxisReading, status: AxisStatus, t: int, t_error_ns: int) -> None:
        """Keep a reading; in every poll, so what seldom changes is compared and not computed."""
        levels = (
            reading.reverse_limit,
            reading.forward_limit,
            reading.index,
            reading.stop_input,
            reading.amplifier_enable,
        )
        uncertain = reading.position_uncertain
        if status is not self._status or levels != self._levels or uncertain:
            self._status, self._levels = None if uncertain else status, levels
            self._origin, quality = status.scale.origin_counts, status.quality
            self._packed = packed(
                levels,
                Quality.UNCERTAIN if uncertain and quality is Quality.GOOD else quality,
                referenced=status.referenced,
                lost=status.reference_lost,
                stretch=self._stretch,
            )
        if t <= self._last_ns:
            self._count = 0  # the clock was set back: which instants these were is not known
            self._courses = [Course(t, altered=True, winding=False)]
        self._last_ns = t
        _RECORD.pack_into(
            self._ring,
            self._count % self._most * _RECORD.size,
            t,
            t_error_ns if t_error_ns < LONGEST_ERROR_NS else LONGEST_ERROR_NS,  # noqa: FURB136 - no call in a poll
            reading.position_counts,
            reading.velocity_resolution_counts_per_s,
            self._origin,
            self._packed,
        )
        self._count += 1

    def forget(self) -> None:
        """Conclude nothing across now: the drive was out of reach, or its counter was set."""
        self._stretch += 1
        self._status = None

    def alter(self, t: int, status: AxisStatus, *, approaches: bool) -> None:
        """Keep what the axis does from an instant on, UTC in ns since 1970; see `course`."""
        if len(self._courses) >= MOST_COURSES:
            del self._courses[: MOST_COURSES // 2]
        verb = status.command.verb if status.command else None
        self._courses.append(course(max(t, self._courses[-1].t), status.state, verb, approaches=approaches))

    def at(self, t: int, scale: AxisScale, fastest: float | None) -> AxisInstant:
        """Return what is proven of an instant.

        Args:
            t: the instant, UTC in ns since 1970.
            scale: of the axis.
            fastest: its limit of velocity in units a second, None without one.
        """
        return instant_of(self._past(scale, fastest), t)

    def between(self, t: int, until: int, scale: AxisScale, fastest: float | None) -> Iterator[AxisInstant]:
        """Yield the same of the first instant of a range, of each reading in it, and of its last instant."""
        return instants_of(self._past(scale, fastest), t, until)

    def count(self, t: int, until: int) -> int:
        """Return how many readings lie in a range."""
        return count_until(self, until) - count_until(self, t)

    def _past(self, scale: AxisScale, fastest: float | None) -> Past:
        coordinates = Coordinates.of(scale.unit, scale.counts_per_unit, fastest)
        return Past(self, self._courses, self._gaps, coordinates)

    def __len__(self) -> int:
        return min(self._count, self._most)

    def __getitem__(self, number: int) -> Reading:
        place = (max(0, self._count - self._most) + number) % self._most
        return Reading._make(_RECORD.unpack_from(self._ring, place * _RECORD.size))


def _most_at(rate_hz: float) -> int:
    return min(MOST_READINGS, max(8, int(HISTORY_S * rate_hz)))
