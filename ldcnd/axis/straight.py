"""Straight lines: trapezoids of several drives that last equally long and ramp alike. Pure.

If every axis has the same ramp time and the same duration, each is at the same share of its way at any instant, and
the axes draw a straight line. Registers hold velocity finely and acceleration coarsely, in steps of some 58 counts/s^2
for example, so ramp times are only nearly the same; durations are made equal again by the velocities. What is
left of that is the deviation, which is worked out from the profiles as the registers will hold them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.driver import CountsMotion

SHARES = (1.0, 0.995, 0.98, 0.96, 0.93, 0.9, 0.8, 0.7, 0.6, 0.5)
"""Of an acceleration, tried one after another until the register that is nearest to it keeps the limit."""
INSTANTS = 64
"""Instants between two corners of the profiles at which the deviation is worked out."""


@dataclass(frozen=True, slots=True)
class LineAxis:
    """One axis of a line.

    Attributes:
        from_counts: where its drive believes to be.
        target_counts: where it is to go.
        counts_per_unit: of the axis.
        most_velocity: highest speed on the way, counts/s.
        most_acceleration: likewise, counts/s^2.
        quantise: returns a motion as the drive's registers will hold it.
        cycle_s: of its servo: drives that start together start within one of them.
    """

    from_counts: int
    target_counts: int
    counts_per_unit: float
    most_velocity: float
    most_acceleration: float
    quantise: Callable[[CountsMotion], CountsMotion]
    cycle_s: float

    @property
    def way(self) -> int:
        """Length of its way, counts."""
        return abs(self.target_counts - self.from_counts)


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """A trapezoid of one axis, from 0 to `way`; any consistent units."""

    way: float
    velocity: float
    acceleration: float

    @property
    def ramp_s(self) -> float:
        """Duration of each ramp."""
        return min(self.velocity / self.acceleration, math.sqrt(self.way / self.acceleration))

    @property
    def duration_s(self) -> float:
        """Duration of the whole."""
        ramp_s = self.ramp_s
        peak = ramp_s * self.acceleration
        return 2 * ramp_s + ((self.way - peak * ramp_s) / peak if peak else 0.0)

    def at(self, t_s: float) -> float:
        """Return where it is at an instant."""
        duration_s, ramp_s = self.duration_s, self.ramp_s
        if t_s <= 0:
            return 0.0
        if t_s >= duration_s:
            return self.way
        if t_s < ramp_s:
            return self.acceleration * t_s * t_s / 2
        if t_s > duration_s - ramp_s:
            return self.way - self.acceleration * (duration_s - t_s) ** 2 / 2
        return self.acceleration * ramp_s * (t_s - ramp_s / 2)


@dataclass(frozen=True, slots=True)
class StraightLine:
    """A line as the drives will draw it.

    Attributes:
        motions: by axis.
        duration_s: of the profiles, without settling.
        deviation: farthest from the line, in axis units, a count of each axis included: profiles are made of servo
            cycles. What the servos lag behind comes on top.
    """

    motions: Mapping[str, CountsMotion]
    duration_s: float
    deviation: float


def straight_line(axes: Mapping[str, LineAxis]) -> StraightLine:
    """Plan a line.

    Raises:
        ValueOutOfRange: a register cannot hold a velocity.
    """
    moved = {name: axis for name, axis in axes.items() if axis.way}
    if not moved:
        return StraightLine({name: _standing(axis) for name, axis in axes.items()}, 0.0, 0.0)
    share_a = min(axis.most_acceleration / axis.way for axis in moved.values())
    # the last of them is the peak of the triangle: beyond it velocity bounds nothing
    share_v = min(*(axis.most_velocity / axis.way for axis in moved.values()), math.sqrt(share_a))
    accelerations = {name: _acceleration(axis, share_a * axis.way) for name, axis in moved.items()}
    duration_s = max(
        Trapezoid(axis.way, share_v * axis.way, accelerations[name]).duration_s for name, axis in moved.items()
    )
    motions = {
        name: _at_least(
            axis,
            CountsMotion(axis.target_counts, _velocity(axis.way, accelerations[name], duration_s), accelerations[name]),
        )
        if name in moved
        else _standing(axis)
        for name, axis in axes.items()
    }
    profiles = {
        name: Trapezoid(
            axis.way / axis.counts_per_unit,
            motions[name].velocity_counts_per_s / axis.counts_per_unit,
            motions[name].acceleration_counts_per_s2 / axis.counts_per_unit,
        )
        for name, axis in moved.items()
    }
    longest_s = max(profile.duration_s for profile in profiles.values())
    cycle_s = max(axis.cycle_s for axis in axes.values())
    count = math.hypot(*(1.0 / axis.counts_per_unit for axis in moved.values()))
    return StraightLine(motions, longest_s, deviation_of(list(profiles.values()), cycle_s) + count)


def deviation_of(profiles: Sequence[Trapezoid], skew_s: float = 0.0) -> float:
    """Return how far profiles that start together leave the straight line between their ends.

    Args:
        profiles: of the axes that move.
        skew_s: largest delay between the starts of two of them, in seconds.
    """
    length = math.hypot(*(profile.way for profile in profiles))
    along = [profile.way / length for profile in profiles]
    corners = sorted(
        {at for each in profiles for at in (0.0, each.ramp_s, each.duration_s - each.ramp_s, each.duration_s)}
    )
    farthest = 0.0
    for begin_s, end_s in pairwise(corners):
        for number in range(INSTANTS + 1):
            at_s = begin_s + (end_s - begin_s) * number / INSTANTS
            farthest = max(farthest, _off_line([profile.at(at_s) for profile in profiles], along))
    late = (
        profile.acceleration * profile.ramp_s * skew_s * math.sqrt(max(0.0, 1.0 - share * share))
        for profile, share in zip(profiles, along, strict=True)
    )
    return farthest + max(late)


def _off_line(point: Sequence[float], along: Sequence[float]) -> float:
    share = sum(value * part for value, part in zip(point, along, strict=True))
    return math.hypot(*(value - share * part for value, part in zip(point, along, strict=True)))


def _at_least(axis: LineAxis, motion: CountsMotion) -> CountsMotion:
    """Return a motion as the registers hold it, the slowest that they do if it is slower than that."""
    try:
        return axis.quantise(motion)
    except ValueOutOfRange as error:
        if error.nearest is None:
            raise
        return axis.quantise(replace(motion, velocity_counts_per_s=float(error.nearest)))


def _standing(axis: LineAxis) -> CountsMotion:
    acceleration = _acceleration(axis, axis.most_acceleration)
    return axis.quantise(CountsMotion(axis.target_counts, axis.most_velocity, acceleration))


def _acceleration(axis: LineAxis, wanted: float) -> float:
    """Return the acceleration nearest to the wanted one that a register holds and that is not above the limit."""
    for share in SHARES:
        try:
            held = axis.quantise(CountsMotion(axis.target_counts, axis.most_velocity, wanted * share))
        except ValueOutOfRange as error:
            if error.nearest is None:
                raise
            held = axis.quantise(CountsMotion(axis.target_counts, axis.most_velocity, float(error.nearest)))
        if held.acceleration_counts_per_s2 <= axis.most_acceleration:
            break
    return held.acceleration_counts_per_s2


def _velocity(way: float, acceleration: float, duration_s: float) -> float:
    """Return the speed at which a way takes so long with this acceleration; the triangle's where it cannot."""
    # way = v (duration - v / a), of which the smaller v is meant
    ramps = acceleration * duration_s
    root = ramps * ramps - 4 * way * acceleration
    return (ramps - math.sqrt(root)) / 2 if root > 0 else math.sqrt(way * acceleration)
