"""Where an axis was between its readings: what they prove of an instant, in the daemon and in a recording alike. Pure.

Between two readings a shaft bends its path: the lines through the neighbouring readings and the chord enclose it as
long as it accelerates and brakes once. Where six readings in a row show an acceleration that hardly changes, the curve
through them is nearer than that. Beside it counts that a reading is true somewhere within its exchange, that a count is
no less than one, and that a loop overshoots a little.
"""

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple, Protocol

from ldcnd.contract.history import AxisInstant, Within
from ldcnd.contract.samples import InputLevels, Quality

COUNTS: Final = 1.75
"""Distance by which a closed loop hunts around its place, counts."""
BEND: Final = 0.45
"""Share by which an overshoot leaves what the neighbouring readings enclose."""
JERK: Final = 0.45
"""Share of the largest change of acceleration around an instant by which the curve through the readings may be off."""
FREE_COUNTS: Final = 3.0
"""What whole counts alone make of that change."""
BEND_OF_VELOCITY: Final = 1.0
"""Share by which a velocity leaves what the slopes around it enclose: it bends first."""
RIPPLE: Final = 0.2
"""Share of the velocity resolution by which the speed of a closed loop varies."""
LONGEST_GAP: Final = 2.5
"""Longest time between two readings, in poll periods, about which anything is concluded."""
SAME_ORIGIN_COUNTS: Final = 1e-3
"""Origins that differ by less are the same, written down in other units."""
QUALITIES: Final[tuple[Quality, ...]] = tuple(Quality)
_LEVELS: Final = {None: 0, False: 1, True: 2}
_SHOWN: Final = tuple(_LEVELS)
_ALL_LEVELS: Final[int] = len(_SHOWN) ** len(InputLevels.model_fields)


class Reading(NamedTuple):
    """What was read of an axis once."""

    t: int
    """When it was true, UTC in ns since 1970."""
    t_error_ns: int
    """How far off that can be."""
    counts: int
    """Position."""
    resolution: float
    """The smallest velocity that the drive can report, counts/s."""
    origin: float
    """Count of position 0."""
    rest: int
    """Inputs and quality, see `packed`."""


class Readings(Protocol):
    """Readings of an axis, each later than the one before."""

    def __len__(self) -> int: ...

    def __getitem__(self, number: int, /) -> Reading: ...


class Coordinates(NamedTuple):
    """How counts of an axis and its positions belong together."""

    unit: str
    counts_per_unit: float
    """Negative where forward is backward in counts."""


@lru_cache(maxsize=256)
def packed(levels: tuple[bool | None, ...], quality: Quality) -> int:
    """Return inputs, in the order of `InputLevels`, and quality as one number of 10 bits."""
    number = QUALITIES.index(quality)
    for level in reversed(levels):
        number = number * len(_SHOWN) + _LEVELS[level]
    return number


def longest_gap_ns(rate_hz: float) -> int:
    """Return the longest time between two readings about which anything is concluded, ns."""
    return round(LONGEST_GAP * 1e9 / max(rate_hz, 1e-3))


def instant_of(readings: Readings, t: int, gap_ns: int, coordinates: Coordinates) -> AxisInstant:
    """Return what readings prove of an instant.

    Args:
        readings: of the axis.
        t: the instant, UTC in ns since 1970.
        gap_ns: nothing is concluded where two of them are farther apart.
        coordinates: of the axis.
    """
    place = count_until(readings, t) - 1
    if not 1 <= place < len(readings) - 2:
        return _unknown(t, coordinates, "no readings around this instant")
    start, end = readings[place], readings[place + 1]
    apart_ns = (end.t - start.t) // 4  # a slope of what is nearer is noise
    earlier = _apart(readings, place, -1, apart_ns)
    later = _apart(readings, place + 1, 1, apart_ns)
    before, after = readings[earlier], readings[later]
    around = before, start, end, after
    if max(two.t - one.t for one, two in pairwise(around)) > gap_ns:
        return _unknown(t, coordinates, "readings are missing around this instant")
    if _quality(start) is Quality.BAD or _quality(end) is Quality.BAD:
        return _unknown(t, coordinates, "the drive did not answer then")
    if abs(start.origin - end.origin) > SAME_ORIGIN_COUNTS:
        return _unknown(t, coordinates, "the axis got other coordinates just then")
    first, last = _apart(readings, earlier, -1, apart_ns), _apart(readings, later, 1, apart_ns)
    outer = (readings[first], readings[last]) if first < earlier and later < last else None
    return _between(around, outer, t, coordinates)


def instants_of(readings: Readings, t: int, until: int, gap_ns: int, coordinates: Coordinates) -> Iterator[AxisInstant]:
    """Yield what is known of the first instant of a range, of each reading in it, and of its last instant."""
    yield instant_of(readings, t, gap_ns, coordinates)
    while (number := count_until(readings, t)) < len(readings) and (reading := readings[number]).t < until:
        t = reading.t
        yield instant_of(readings, t, gap_ns, coordinates)
    yield instant_of(readings, until, gap_ns, coordinates)


def count_until(readings: Readings, t: int) -> int:
    """Return how many readings are not behind an instant."""
    low, high = 0, len(readings)
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if readings[middle].t <= t else (low, middle)
    return low


def _apart(readings: Readings, place: int, step: int, apart_ns: int) -> int:
    """Return the number of the next reading in a direction that is far enough away, or of the last there is."""
    here, found = readings[place], place
    while 0 <= found + step < len(readings):
        found += step
        if abs(readings[found].t - here.t) >= apart_ns:
            break
    return found


def _unknown(t: int, coordinates: Coordinates, reason: str) -> AxisInstant:
    return AxisInstant(t=t, unit=coordinates.unit, quality=Quality.BAD, reason=reason)


def _slope(one: Reading, two: Reading) -> float:
    return (two.counts - one.counts) / ((two.t - one.t) / 1e9)


def _between(
    around: tuple[Reading, Reading, Reading, Reading],
    outer: tuple[Reading, Reading] | None,
    t: int,
    coordinates: Coordinates,
) -> AxisInstant:
    before, start, end, after = around
    length_s = (end.t - start.t) / 1e9
    share = (t - start.t) / (end.t - start.t)
    earlier, slope, later = (_slope(one, two) for one, two in pairwise(around))
    bend, bend_later = (slope - earlier) * length_s, (later - slope) * length_s
    chord = start.counts + share * (end.counts - start.counts)
    rising, falling = bend * share, bend_later * (1 - share)
    if rising * falling >= 0:
        depth = min(rising, falling, key=abs)
        low, high = chord - max(depth, 0.0), chord - min(depth, 0.0)
    else:
        low, high = chord - max(rising, falling), chord - min(rising, falling)
    parts = (
        bend / (1 + (start.t - before.t) / (end.t - start.t)),
        bend_later / (1 + (after.t - end.t) / (end.t - start.t)),
    )
    value = chord - share * (1 - share) * sum(parts) / 2
    fastest, still = max(abs(slope), abs(earlier), abs(later)), not (slope or earlier or later)
    error = fastest * ((1 - share) * start.t_error_ns + share * end.t_error_ns) / 1e9 + (1.0 if still else COUNTS)
    curve, amid = max(abs(bend), abs(bend_later)), min(1.0, 4 * share * (1 - share) + 0.1)
    spare, off = error + BEND * max(0.0, curve - 2 * error) * amid, math.inf
    if outer:
        bends = (
            (earlier - _slope(outer[0], before)) * length_s,
            bend,
            bend_later,
            (_slope(after, outer[1]) - later) * length_s,
        )
        off = error + JERK * max(0.0, max(abs(two - one) for one, two in pairwise(bends)) - FREE_COUNTS) * amid
    bounds = max(min(low - spare, value - error), value - off), min(max(high + spare, value + error), value + off)
    speed = slope + (2 * share - 1) * ((1 - share) * parts[0] + share * parts[1]) / length_s
    ripple = (BEND_OF_VELOCITY * curve + 2 * error) / length_s + RIPPLE * start.resolution
    speeds = min(slope, earlier, later) - ripple, max(slope, earlier, later) + ripple
    return AxisInstant(
        t=t,
        unit=coordinates.unit,
        quality=max(_quality(start), _quality(end), key=QUALITIES.index),
        position=_within(value, bounds, start.origin, coordinates),
        velocity=_within(speed, speeds, 0.0, coordinates),
        inputs=_inputs(start.rest) if start.rest % _ALL_LEVELS == end.rest % _ALL_LEVELS else None,
    )


def _within(value: float, bounds: tuple[float, float], origin: float, coordinates: Coordinates) -> Within:
    placed, *ends = ((each - origin) / coordinates.counts_per_unit for each in (value, *bounds))
    return Within(value=placed, lower=min(ends), upper=max(ends))


def _quality(reading: Reading) -> Quality:
    return QUALITIES[reading.rest // _ALL_LEVELS]


def _inputs(number: int) -> InputLevels:
    shown = {}
    for name in InputLevels.model_fields:
        number, level = divmod(number, len(_SHOWN))
        shown[name] = _SHOWN[level]
    return InputLevels(**shown)
