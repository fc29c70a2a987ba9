"""Where an axis was between its readings: what they prove of an instant, in the daemon and in a recording alike. Pure.

Between two readings a shaft bends its path: the lines through the neighbouring readings and the chord enclose it as
long as it accelerates and brakes once. Where six readings in a row show an acceleration that hardly changes, the curve
through them is nearer than that. Beside it counts that a reading is true somewhere within its exchange, that a count is
no less than one, and that a loop overshoots a little.

Where an axis is read so seldom that a motion can begin and be altered between two readings, they prove less: only that
it was nowhere that its limit of velocity does not let it reach.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import islice, pairwise, takewhile
from operator import attrgetter
from typing import Final, NamedTuple, Protocol, Self

from ldcnd.contract.commands import Verb
from ldcnd.contract.history import AxisInstant, Within
from ldcnd.contract.samples import AxisState, InputLevels, Quality

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
SELDOM_NS: Final = 100_000_000
"""Between readings that are farther apart a shaft can turn round and back: its velocity may be any, ns."""
RARE_NS: Final = 300_000_000
"""Between readings that are farther apart a motion can begin, be altered and end: its place may be any in reach, ns."""
SEEN_LATE_NS: Final = 100_000_000
"""By so much later than its packet an altered motion can be entered, ns."""
OVERSPEED: Final = 1.2
"""How much faster than its limit of velocity a shaft gets, as it catches up."""
ONE_PROFILE: Final[frozenset[str]] = frozenset({Verb.MOVE_ABSOLUTE, Verb.MOVE_RELATIVE, Verb.MOVE_VELOCITY})
"""The motions that accelerate and brake once."""
SAME_ORIGIN_COUNTS: Final = 1e-3
"""Origins that differ by less are the same, written down in other units."""
QUALITIES: Final[tuple[Quality, ...]] = tuple(Quality)
BROKEN_OFF: Final = frozenset({AxisState.STOPPING, AxisState.ERROR_STOP, AxisState.DISABLED})
"""The states in which a motion ends that was to go on."""
STRETCHES: Final = 32
_LEVELS: Final = {None: 0, False: 1, True: 2}
_SHOWN: Final = tuple(_LEVELS)
_ALL_LEVELS: Final[int] = len(_SHOWN) ** len(InputLevels.model_fields)
_WORTHS: Final[int] = _ALL_LEVELS * len(QUALITIES)


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
    """Inputs and more, see `packed`."""


class Course(NamedTuple):
    """What an axis has been doing since an instant."""

    t: int
    """The instant, UTC in ns since 1970."""
    altered: bool
    """Whether a motion began, was altered or was broken off then."""
    winding: bool
    """Whether it accelerates and brakes more than once: homing, paths and what else is not `ONE_PROFILE`."""


class Gap(NamedTuple):
    """The longest time between two readings about which anything is concluded, from an instant on."""

    t: int
    """The instant, UTC in ns since 1970."""
    longest_ns: int
    """So long."""


class Readings(Protocol):
    """Readings of an axis, each later than the one before."""

    def __len__(self) -> int: ...

    def __getitem__(self, number: int, /) -> Reading: ...


class Coordinates(NamedTuple):
    """How counts of an axis and its positions belong together."""

    unit: str
    counts_per_unit: float
    """Negative where forward is backward in counts."""
    fastest: float | None
    """Its limit of velocity, in counts a second; None without one."""

    @classmethod
    def of(cls, unit: str, counts_per_unit: float, fastest: float | None) -> Self:
        """Return the coordinates of an axis; `fastest` is in units a second."""
        return cls(unit, counts_per_unit, None if fastest is None else fastest * abs(counts_per_unit))


class Past(NamedTuple):
    """What is kept of an axis."""

    readings: Readings
    """Each later than the one before."""
    courses: Sequence[Course]
    """Likewise; before the first of them nothing is known of what it did."""
    gaps: Sequence[Gap]
    """Nothing is concluded where two readings are farther apart; each later than the one before, one at least."""
    coordinates: Coordinates
    """Of the axis."""


@lru_cache(maxsize=256)
def packed(levels: tuple[bool | None, ...], quality: Quality, *, referenced: bool, lost: bool, stretch: int = 0) -> int:
    """Return as one number of 16 bits what a reading has besides its numbers.

    Args:
        levels: the inputs, in the order of `InputLevels`.
        quality: of the reading.
        referenced: whether it tells a place.
        lost: whether the place that it had told before is lost: then it is good for nothing but differences.
        stretch: a number that is another one where nothing is concluded from the reading before to this one.
    """
    worth = max(quality, Quality.UNCERTAIN, key=QUALITIES.index) if lost else quality
    number = (stretch % STRETCHES * 2 + referenced) * len(QUALITIES) + QUALITIES.index(worth)
    for level in reversed(levels):
        number = number * len(_SHOWN) + _LEVELS[level]
    return number


def course(t: int, state: AxisState, verb: str | None, *, approaches: bool) -> Course:
    """Return what an axis does from an instant on.

    Args:
        t: the instant, UTC in ns since 1970.
        state: its state from then on.
        verb: its command, None without one.
        approaches: whether it comes to its goals from one side.
    """
    winding = verb is not None and state is not AxisState.STOPPING and (verb not in ONE_PROFILE or approaches)
    return Course(t, altered=verb is not None or state in BROKEN_OFF, winding=winding)


def longest_gap_ns(rate_hz: float) -> int:
    """Return the longest time between two readings about which anything is concluded, ns."""
    return round(LONGEST_GAP * 1e9 / max(rate_hz, 1e-3))


def instant_of(past: Past, t: int) -> AxisInstant:
    """Return what is proven of an instant, UTC in ns since 1970."""
    readings, courses, gaps, coordinates = past
    place = count_until(readings, t) - 1
    if not 1 <= place < len(readings) - 2:
        return _unknown(t, coordinates, "no readings around this instant")
    start, end = readings[place], readings[place + 1]
    apart_ns = (end.t - start.t) // 4  # a slope of what is nearer is noise
    earlier = _apart(readings, place, -1, apart_ns)
    later = _apart(readings, place + 1, 1, apart_ns)
    if _stretch(start) != _stretch(end) or earlier == place or later == place + 1:
        return _unknown(t, coordinates, "the drive was out of reach just then, or its counter was set")
    before, after = readings[earlier], readings[later]
    around = before, start, end, after
    longest_ns = max(two.t - one.t for one, two in pairwise(around))
    if longest_ns > max(_longest_ns(gaps, before.t), _longest_ns(gaps, after.t)):
        return _unknown(t, coordinates, "readings are missing around this instant")
    if _quality(start) is Quality.BAD or _quality(end) is Quality.BAD:
        return _unknown(t, coordinates, "the drive did not answer then")
    if abs(start.origin - end.origin) > SAME_ORIGIN_COUNTS:
        return _unknown(t, coordinates, "the axis got other coordinates just then")
    fastest, alike = 0.0, True
    if longest_ns > SELDOM_NS and _altered(courses, before.t, after.t + SEEN_LATE_NS):
        if coordinates.fastest is None:
            reason = "its motion was altered between two readings, and it has no limit of velocity"
            return _unknown(t, coordinates, reason)
        fastest, alike = coordinates.fastest * OVERSPEED, False  # a curve through readings of two motions is none
        if longest_ns > RARE_NS:
            return _reached(start, end, t, coordinates, fastest)
    first, last = _apart(readings, earlier, -1, apart_ns), _apart(readings, later, 1, apart_ns)
    outer = (readings[first], readings[last]) if alike and first < earlier and later < last else None
    return _between(around, outer, t, coordinates, fastest)


def instants_of(past: Past, t: int, until: int) -> Iterator[AxisInstant]:
    """Yield what is known of the first instant of a range, of each reading in it, and of its last instant."""
    readings = past.readings
    yield instant_of(past, t)
    while (number := count_until(readings, t)) < len(readings) and (reading := readings[number]).t < until:
        t = reading.t
        yield instant_of(past, t)
    yield instant_of(past, until)


def count_until(readings: Readings, t: int) -> int:
    """Return how many readings are not behind an instant."""
    low, high = 0, len(readings)
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if readings[middle].t <= t else (low, middle)
    return low


def _longest_ns(gaps: Sequence[Gap], t: int) -> int:
    return gaps[max(0, bisect_right(gaps, t, key=attrgetter("t")) - 1)].longest_ns


def _apart(readings: Readings, place: int, step: int, apart_ns: int) -> int:
    """Return the number of the next reading in a direction that is far enough away, or of the last of its stretch."""
    here, found = readings[place], place
    while 0 <= found + step < len(readings) and _stretch(readings[found + step]) == _stretch(here):
        found += step
        if abs(readings[found].t - here.t) >= apart_ns:
            break
    return found


def _altered(courses: Sequence[Course], t: int, until: int) -> bool:
    """Return whether a motion was altered between two instants, or accelerated and braked more than once."""
    number = bisect_right(courses, t, key=attrgetter("t"))
    if not number:
        return True
    return courses[number - 1].winding or any(
        each.altered or each.winding for each in takewhile(lambda each: each.t <= until, islice(courses, number, None))
    )


def _reached(start: Reading, end: Reading, t: int, coordinates: Coordinates, fastest: float) -> AxisInstant:
    """Return where a shaft can have been that was at two places and was never faster than this."""
    since_s, until_s, length_s = (t - start.t) / 1e9, (end.t - t) / 1e9, (end.t - start.t) / 1e9
    error = COUNTS + fastest * (start.t_error_ns + end.t_error_ns) / 1e9
    slope = (end.counts - start.counts) / length_s
    bounds = (
        max(start.counts - fastest * since_s, end.counts - fastest * until_s) - error,
        min(start.counts + fastest * since_s, end.counts + fastest * until_s) + error,
    )
    return _instant(start, end, t, coordinates, (start.counts + slope * since_s, bounds), (slope, (-fastest, fastest)))


def _unknown(t: int, coordinates: Coordinates, reason: str) -> AxisInstant:
    return AxisInstant(t=t, unit=coordinates.unit, quality=Quality.BAD, reason=reason)


def _slope(one: Reading, two: Reading) -> float:
    return (two.counts - one.counts) / ((two.t - one.t) / 1e9)


def _between(
    around: tuple[Reading, Reading, Reading, Reading],
    outer: tuple[Reading, Reading] | None,
    t: int,
    coordinates: Coordinates,
    reach: float,
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
    speeds = min(speeds[0], -reach), max(speeds[1], reach)
    return _instant(start, end, t, coordinates, (value, bounds), (speed, speeds))


_Bounded = tuple[float, tuple[float, float]]


def _instant(
    start: Reading, end: Reading, t: int, coordinates: Coordinates, place: _Bounded, speed: _Bounded
) -> AxisInstant:
    return AxisInstant(
        t=t,
        unit=coordinates.unit,
        quality=max(_quality(start), _quality(end), key=QUALITIES.index),
        referenced=_referenced(start) and _referenced(end),
        position=_within(*place, start.origin, coordinates),
        velocity=_within(*speed, 0.0, coordinates),
        inputs=_inputs(start.rest) if start.rest % _ALL_LEVELS == end.rest % _ALL_LEVELS else None,
    )


def _within(value: float, bounds: tuple[float, float], origin: float, coordinates: Coordinates) -> Within:
    placed, *ends = ((each - origin) / coordinates.counts_per_unit for each in (value, *bounds))
    return Within(value=placed, lower=min(ends), upper=max(ends))


def _quality(reading: Reading) -> Quality:
    return QUALITIES[reading.rest // _ALL_LEVELS % len(QUALITIES)]


def _referenced(reading: Reading) -> bool:
    return bool(reading.rest // _WORTHS % 2)


def _stretch(reading: Reading) -> int:
    return reading.rest // (2 * _WORTHS)


def _inputs(number: int) -> InputLevels:
    shown = {}
    for name in InputLevels.model_fields:
        number, level = divmod(number, len(_SHOWN))
        shown[name] = _SHOWN[level]
    return InputLevels(**shown)
