"""Polylines for drives that walk through path points: speeds, points at a fixed rate, what is left of the line. Pure.

Along each segment the speed is a trapezoid; at a corner it is so low that no axis changes its own speed by more in one
period than its acceleration allows. Points are rounded from the line itself, so no error of rounding adds up. A drive
goes straight from point to point, so a corner between two of them is cut: that, the rounding, and one servo cycle
between the starts of the drives are the deviation.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from ldcnd.contract.errors import ValueOutOfRange

TURN_SHARE = 0.5
"""Of an acceleration, for turning at corners; the rest is for the speed along the way, which may change there, too."""
ROUNDING_COUNTS = 2
"""Change of step that comes from rounding alone."""
TRIALS = 12
MOST_POINTS = 50_000
"""Of one path: 27 minutes at the longer period."""


@dataclass(frozen=True, slots=True)
class PathAxis:
    """One axis of a path.

    Attributes:
        corners: where the path turns, in counts of its drive; the first is where it stands.
        counts_per_unit: of the axis.
        most_velocity: highest speed on the way, counts/s.
        most_acceleration: likewise, counts/s^2.
    """

    corners: tuple[float, ...]
    counts_per_unit: float
    most_velocity: float
    most_acceleration: float


@dataclass(frozen=True, slots=True)
class PathWalk:
    """A path as the drives will walk it.

    Attributes:
        steps: by axis, counts from each point to the next; equally many for all.
        period_s: between two points.
        deviation: farthest from the polyline, in axis units; what the servos lag behind comes on top.
    """

    steps: Mapping[str, tuple[int, ...]]
    period_s: float
    deviation: float

    @property
    def duration_s(self) -> float:
        """From the start to the last point."""
        return self.period_s * max(map(len, self.steps.values()), default=0)


@dataclass(frozen=True, slots=True)
class _Leg:
    """One segment: its ends in axis units, and how fast it is walked; lengths in axis units."""

    begin: tuple[float, ...]
    end: tuple[float, ...]
    length: float
    most_velocity: float
    acceleration: float

    def at(self, way: float) -> tuple[float, ...]:
        share = way / self.length
        return tuple(a + (b - a) * share for a, b in zip(self.begin, self.end, strict=True))

    @property
    def along(self) -> tuple[float, ...]:
        return tuple((b - a) / self.length for a, b in zip(self.begin, self.end, strict=True))


def walk(axes: Mapping[str, PathAxis], period_s: float, cycle_s: float, speed: float | None = None) -> PathWalk:
    """Plan a path.

    Args:
        axes: of the path, with equally many corners each.
        period_s: between two points.
        cycle_s: of the drives' servos: they start within one of them.
        speed: along the path, in axis units a second; None for the highest that the axes allow.

    Raises:
        ValueOutOfRange: it takes too many points.
    """
    corners = list(zip(*([c / axis.counts_per_unit for c in axis.corners] for axis in axes.values()), strict=True))
    limits = [(a.most_velocity / a.counts_per_unit, a.most_acceleration / a.counts_per_unit) for a in axes.values()]
    most_steps = [axis.most_acceleration * period_s**2 for axis in axes.values()]
    for _ in range(TRIALS):
        planned, fastest = _walk(axes, corners, limits, period_s, cycle_s, speed)
        excess = _excess(planned, most_steps)
        if excess <= 1.0:
            return planned
        speed = 0.98 * fastest / math.sqrt(excess)  # many short segments turn like an arc: with the speed squared
    raise ValueOutOfRange(
        "the path turns too sharply for the accelerations of its axes, however slowly it is walked",
        value=len(corners),
        remedy="give fewer points, or points farther apart",
    )


def _excess(planned: PathWalk, most_steps: Sequence[float]) -> float:
    """Return the highest acceleration of any axis over what it may have; what rounding makes is left out."""
    changes = [
        max(abs(b - a) for a, b in pairwise([0, *steps, 0])) - ROUNDING_COUNTS for steps in planned.steps.values()
    ]
    return max(change / most for change, most in zip(changes, most_steps, strict=True))


def _walk(
    axes: Mapping[str, PathAxis],
    corners: Sequence[tuple[float, ...]],
    limits: Sequence[tuple[float, float]],
    period_s: float,
    cycle_s: float,
    speed: float | None,
) -> tuple[PathWalk, float]:
    """Plan at a speed along the path; return the highest that comes of it, too."""
    units = [axis.counts_per_unit for axis in axes.values()]
    legs = [_leg(begin, end, limits, speed) for begin, end in pairwise(corners) if math.dist(begin, end) > 0]
    if not legs:
        return PathWalk(dict.fromkeys(axes, (0,)), period_s, 0.0), 0.0
    turns = _turning_speeds(legs, [acceleration for _, acceleration in limits], period_s)
    points, cut, fastest = _sampled(legs, turns, period_s)
    rounded = [[round(value * unit) for value, unit in zip(point, units, strict=True)] for point in points]
    begin = [round(axis.corners[0]) for axis in axes.values()]
    steps = {
        name: tuple(after[at] - before[at] for before, after in pairwise([begin, *rounded]))
        for at, name in enumerate(axes)
    }
    rounding = math.hypot(*(0.5 / unit for unit in units))
    return PathWalk(steps, period_s, cut + rounding + fastest * cycle_s), fastest


def _leg(
    begin: tuple[float, ...], end: tuple[float, ...], limits: Sequence[tuple[float, float]], speed: float | None
) -> _Leg:
    length = math.dist(begin, end)
    shares = [abs(b - a) / length for a, b in zip(begin, end, strict=True)]
    velocity = min(v / share for share, (v, _) in zip(shares, limits, strict=True) if share > 0)
    acceleration = min(a / share for share, (_, a) in zip(shares, limits, strict=True) if share > 0)
    most = velocity if speed is None else min(velocity, speed)
    return _Leg(begin, end, length, most, (1.0 - TURN_SHARE) * acceleration)


def _turning_speeds(legs: Sequence[_Leg], accelerations: Sequence[float], period_s: float) -> list[float]:
    """Return the speed at each corner, the ends included, that its own turn and the way to the others allow."""
    speeds = [0.0]
    for before, after in pairwise(legs):
        turns = [abs(b - a) for a, b in zip(before.along, after.along, strict=True)]
        allowed = [TURN_SHARE * a * period_s / turn for turn, a in zip(turns, accelerations, strict=True) if turn > 0]
        speeds.append(min([before.most_velocity, after.most_velocity, *allowed]))
    speeds.append(0.0)
    # forwards, then backwards: no corner is faster than the legs before and behind it let it be
    for at, leg in enumerate(legs):
        speeds[at + 1] = min(speeds[at + 1], math.sqrt(speeds[at] ** 2 + 2 * leg.acceleration * leg.length))
    for at in range(len(legs) - 1, -1, -1):
        leg = legs[at]
        speeds[at] = min(speeds[at], math.sqrt(speeds[at + 1] ** 2 + 2 * leg.acceleration * leg.length))
    return speeds


@dataclass(frozen=True, slots=True)
class _Ramp:
    """How a leg is walked: up to a peak, along, down to the speed of its end; times from the beginning of the leg."""

    v0: float
    v1: float
    peak: float
    acceleration: float
    length: float

    @classmethod
    def of(cls, leg: _Leg, v0: float, v1: float) -> "_Ramp":
        # where speeding up from v0 meets slowing down to v1
        reachable = math.sqrt((v0 * v0 + v1 * v1) / 2 + leg.acceleration * leg.length)
        return cls(v0, v1, max(v0, v1, min(leg.most_velocity, reachable)), leg.acceleration, leg.length)

    @property
    def _times(self) -> tuple[float, float, float]:
        up, down = (self.peak - self.v0) / self.acceleration, (self.peak - self.v1) / self.acceleration
        ramps = (self.peak + self.v0) / 2 * up + (self.peak + self.v1) / 2 * down
        return up, max(0.0, self.length - ramps) / self.peak, down

    @property
    def duration_s(self) -> float:
        return math.fsum(self._times)

    def way(self, t: float) -> float:
        up, slew, _ = self._times
        if t < up:
            return self.v0 * t + self.acceleration * t * t / 2
        if t < up + slew:
            return (self.peak + self.v0) / 2 * up + self.peak * (t - up)
        left = max(0.0, self.duration_s - t)
        return self.length - (self.v1 * left + self.acceleration * left * left / 2)


def _sampled(
    legs: Sequence[_Leg], speeds: Sequence[float], period_s: float
) -> tuple[list[tuple[float, ...]], float, float]:
    """Return the points of the path, how far the corners between them are cut, and the highest speed."""
    ramps = [_Ramp.of(leg, v0, v1) for leg, (v0, v1) in zip(legs, pairwise(speeds), strict=True)]
    total_s = math.fsum(ramp.duration_s for ramp in ramps)
    if total_s / period_s > MOST_POINTS:
        raise ValueOutOfRange(
            f"the path takes {total_s:.0f} s, more than {MOST_POINTS} points of {period_s * 1e3:.1f} ms",
            value=total_s,
            limit=MOST_POINTS * period_s,
            remedy="walk it in parts, or faster",
        )
    points: list[tuple[float, ...]] = []
    at, begun_s, cut, last = 0, 0.0, 0.0, legs[0].begin
    for number in range(1, math.ceil(total_s / period_s - 1e-9) + 1):
        t = min(number * period_s, total_s)
        passed: list[tuple[float, ...]] = []
        while at < len(legs) - 1 and t >= begun_s + ramps[at].duration_s:
            passed.append(legs[at].end)
            begun_s += ramps[at].duration_s
            at += 1
        point = legs[-1].end if t >= total_s else legs[at].at(min(ramps[at].way(t - begun_s), legs[at].length))
        # the drive goes straight from point to point, past each corner between them
        cut = max([cut, *(_from_chord(corner, last, point) for corner in passed)])
        points.append(point)
        last = point
    return points, cut, max(ramp.peak for ramp in ramps)


def _from_chord(point: Sequence[float], begin: Sequence[float], end: Sequence[float]) -> float:
    """Return how far a point is from the straight line between two others."""
    length = math.dist(begin, end)
    if length == 0:
        return math.dist(point, begin)
    along = [(b - a) / length for a, b in zip(begin, end, strict=True)]
    way = [p - a for p, a in zip(point, begin, strict=True)]
    share = min(length, max(0.0, math.fsum(w * e for w, e in zip(way, along, strict=True))))
    return math.hypot(*(w - share * e for w, e in zip(way, along, strict=True)))
