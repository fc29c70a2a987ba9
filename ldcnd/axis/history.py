"""Where an axis was: a ring of its readings, and what they prove of an instant between two of them.

Between two readings a shaft bends its path: the lines through the neighbouring readings and the chord enclose it as
long as it accelerates and brakes once. Beside it counts that a reading is true somewhere within its exchange, that a
count is no less than one, and that a loop overshoots a little. Memory is taken once, when the daemon starts.
"""

import struct
from typing import Final

from ldcnd.axis.scale import AxisScale
from ldcnd.contract.history import AxisInstant, Within
from ldcnd.contract.samples import InputLevels, Quality
from ldcnd.drives.driver import AxisReading

HISTORY_S: Final = 600.0
"""Time for which readings are kept at the rate of the polls, seconds."""
MOST_READINGS: Final = 60_000
"""Readings that are kept of an axis at most, 38 bytes each: 2.3 MB, 600 s of 100 polls a second."""
COUNTS: Final = 1.5
"""Distance by which a closed loop hunts around its place, counts."""
BEND: Final = 0.3
"""Share by which an overshoot leaves what the neighbouring readings enclose."""
BEND_OF_VELOCITY: Final = 0.7
"""The same for a velocity, which bends first."""
RIPPLE: Final = 0.2
"""Share of the velocity resolution by which the speed of a closed loop varies."""
LONGEST_GAP: Final = 2.5
"""Longest time between two readings, in poll periods, about which anything is concluded."""

_RECORD = struct.Struct("<qIqddH")
"""Instant and its error in ns, counts, velocity resolution, origin, inputs."""
_Record = tuple[int, int, int, float, float, int]
_LEVELS = {None: 0, False: 1, True: 2}
_SHOWN = (None, False, True)


class ReadingRing:
    """The last readings of one axis.

    Args:
        rate_hz: how often its position is polled; extra readings shorten the time that the ring spans.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._most = min(MOST_READINGS, max(8, int(HISTORY_S * rate_hz)))
        self._gap_ns = round(LONGEST_GAP * 1e9 / max(rate_hz, 1e-3))
        self._ring = bytearray(self._most * _RECORD.size)
        self._count = 0
        self._last_ns = 0
        self._levels: tuple[bool | None, ...] = ()
        self._packed = 0

    def take(self, reading: AxisReading, origin_counts: float, t: int, t_error_ns: int) -> None:
        """Keep a reading; in every poll, so what seldom changes is compared and not computed."""
        levels = (
            reading.reverse_limit,
            reading.forward_limit,
            reading.index,
            reading.stop_input,
            reading.amplifier_enable,
        )
        if levels != self._levels:
            self._levels, self._packed = levels, sum(_LEVELS[each] * 3**at for at, each in enumerate(levels))
        if t <= self._last_ns:
            self._count = 0  # the clock was set back: which instants these were is not known
        self._last_ns = t
        _RECORD.pack_into(
            self._ring,
            self._count % self._most * _RECORD.size,
            t,
            min(t_error_ns, 0xFFFF_FFFF),
            reading.position_counts,
            reading.velocity_resolution_counts_per_s,
            origin_counts,
            self._packed,
        )
        self._count += 1

    def forget(self) -> None:
        """Conclude nothing across now: the drive was out of reach, or its counter was set."""
        self._count = 0

    def at(self, t: int, scale: AxisScale, quality: Quality) -> AxisInstant:
        """Return what the readings prove of an instant, UTC in ns since 1970."""
        place = self._find(t)
        if place is None:
            return _unknown(t, scale, "no readings around this instant")
        start, end = self._at(place), self._at(place + 1)
        apart_ns, first, last = (end[0] - start[0]) // 4, max(0, self._count - self._most), self._count - 1
        earlier, later = place - 1, place + 2
        while earlier > first and start[0] - self._at(earlier)[0] < apart_ns:  # a slope of what is too near is noise
            earlier -= 1
        while later < last and self._at(later)[0] - end[0] < apart_ns:
            later += 1
        before, after = self._at(earlier), self._at(later)
        if max(start[0] - before[0], end[0] - start[0], after[0] - end[0]) > self._gap_ns:
            return _unknown(t, scale, "readings are missing around this instant")
        if start[4] != end[4]:
            return _unknown(t, scale, "the axis got other coordinates just then")
        return _between(before, start, end, after, t, scale, quality)

    def _find(self, t: int) -> int | None:
        """Return the number of the last reading not behind an instant that has one before and two behind it."""
        low, high = max(0, self._count - self._most) + 1, self._count - 3
        if high < low or not self._at(low)[0] <= t < self._at(high + 1)[0]:
            return None
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if self._at(middle)[0] <= t else (low, middle - 1)
        return low

    def _at(self, number: int) -> _Record:
        return _RECORD.unpack_from(self._ring, number % self._most * _RECORD.size)


def _unknown(t: int, scale: AxisScale, reason: str) -> AxisInstant:
    return AxisInstant(t=t, unit=scale.unit, quality=Quality.BAD, reason=reason)


def _between(
    before: _Record, start: _Record, end: _Record, after: _Record, t: int, scale: AxisScale, quality: Quality
) -> AxisInstant:
    length_s, early_s, late_s = (end[0] - start[0]) / 1e9, (start[0] - before[0]) / 1e9, (after[0] - end[0]) / 1e9
    share = (t - start[0]) / (end[0] - start[0])
    slope, earlier, later = (
        (end[2] - start[2]) / length_s,
        (start[2] - before[2]) / early_s,
        (after[2] - end[2]) / late_s,
    )
    bend, bend_later = (slope - earlier) * length_s, (later - slope) * length_s
    chord = start[2] + share * (end[2] - start[2])
    rising, falling = bend * share, bend_later * (1 - share)
    if rising * falling >= 0:
        depth = min(rising, falling, key=abs)
        low, high = chord - max(depth, 0.0), chord - min(depth, 0.0)
    else:
        low, high = chord - max(rising, falling), chord - min(rising, falling)
    parts = bend / (1 + early_s / length_s), bend_later / (1 + late_s / length_s)
    value = chord - share * (1 - share) * sum(parts) / 2
    fastest, still = max(abs(slope), abs(earlier), abs(later)), not (slope or earlier or later)
    error = fastest * ((1 - share) * start[1] + share * end[1]) / 1e9 + (1.0 if still else COUNTS)
    curve = max(abs(bend), abs(bend_later))
    spare = error + BEND * max(0.0, curve - 2 * error) * min(1.0, 4 * share * (1 - share) + 0.1)
    placed = AxisScale(scale.units, scale.counts_per_unit, None, start[4])
    ends = sorted(placed.position(each) for each in (min(low - spare, value - error), max(high + spare, value + error)))
    speed = slope + (2 * share - 1) * ((1 - share) * parts[0] + share * parts[1]) / length_s
    ripple = (BEND_OF_VELOCITY * curve + 2 * error) / length_s + RIPPLE * start[3]
    speeds = min(slope, earlier, later) - ripple, max(slope, earlier, later) + ripple
    low_speed, high_speed = sorted(each / scale.counts_per_unit for each in speeds)
    return AxisInstant(
        t=t,
        unit=scale.unit,
        quality=quality,
        position=Within(value=placed.position(value), lower=ends[0], upper=ends[1]),
        velocity=Within(value=speed / scale.counts_per_unit, lower=low_speed, upper=high_speed),
        inputs=_inputs(start[5]) if start[5] == end[5] else None,
    )


def _inputs(levels: int) -> InputLevels:
    shown = []
    for _ in InputLevels.model_fields:
        levels, level = divmod(levels, 3)
        shown.append(_SHOWN[level])
    return InputLevels(**dict(zip(InputLevels.model_fields, shown, strict=True)))
