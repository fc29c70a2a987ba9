"""Whether a reading can be true, given the one before it. Pure; time is an input.

A reply has a checksum of one byte: of replies changed by noise, one in some hundreds passes it. So a reading that the
drive cannot have reached since the last accepted reading is requested again before it is used: a position to which the
velocities do not lead, a velocity that the axis cannot have by now, any change of the status. A true change costs one
exchange; a false one never leaves this module.
"""

from enum import Enum

from ldcnd.config.axis import AxisConfig
from ldcnd.drivers.driver import AxisReading
from ldcnd.exchange import Timing

NOISE_COUNTS = 16
"""Movement of a closed loop around its target, counts."""
ACCELERATIONS = 2.0
"""Highest acceleration accepted without a second reading, as a multiple of the axis's acceleration limit."""
JUMP_SPEEDS = 2.0
"""Highest speed of a closed loop, as a multiple of the highest velocity of its axis."""
OPEN_LOOP_SPEEDS = 8.0
"""The same for a shaft that is turned by hand, or by a load."""
APART_S = 0.1
"""Longest time between two consecutive readings, seconds, unless commands delay the line."""
ROUNDS = 4
"""Consecutive contradicting readings that count as one lost reply."""

_COUNTER, _HALF = 1 << 32, 1 << 31


class Verdict(Enum):
    """Result of judging a reading."""

    BELIEVED = "believed"
    ASK_AGAIN = "ask_again"
    LOST = "lost"
    """It was requested several times, and each reading contradicts the others."""


_Seen = tuple[AxisReading, Timing]
"""A reading, and when it was true."""


class PlausibilityGate:
    """Judges the readings of one axis, in the order in which they were taken.

    Attributes:
        jumped: no motion can have led from the accepted reading before the last one to the last one.
        zeroed: the drive's counter has gone to about 0, and no motion has led there: reset; with `confirmed`.
        foreign: the last reading was not accepted, and no motion can have led to it: it may be another drive's.
        confirmed: the reading that the last accepted one has confirmed, and when; None if it needed none.
        withheld: number of readings not accepted so far.
    """

    def __init__(self, config: AxisConfig) -> None:
        self.jumped = False
        self.zeroed = False
        self.foreign = False
        self.confirmed: tuple[AxisReading, Timing] | None = None
        self.withheld = 0
        self._known: _Seen | None = None
        self._doubtful: _Seen | None = None
        self._rounds = 0
        self._sure = False  # nothing jumps away from the very first reading, which is accepted as it is
        self.reconfigure(config)

    def reconfigure(self, config: AxisConfig) -> None:
        """Judge by other limits."""
        counts, limits = abs(config.signed_counts_per_unit), config.limits
        self._speed = counts * max(config.velocity, limits.velocity or 0.0)
        self._acceleration = ACCELERATIONS * counts * max(config.acceleration, limits.acceleration or 0.0)
        self._following = config.gains.el if config.gains else 0

    def after_gap(self) -> None:
        """The drive was out of reach, and may have been moved: no jump is called one until two readings agree again."""
        self._doubtful, self._rounds, self._sure = None, 0, False

    def judge(self, reading: AxisReading, timing: Timing, *, standing: bool) -> Verdict:
        """Judge a reading.

        Args:
            reading: from the drive.
            timing: of that reading.
            standing: the axis was at rest, and nothing was commanded since.
        """
        known = self._known
        self.jumped, self.confirmed, self.foreign = False, None, False
        if known is None:
            return self._believe(reading, timing)
        if self._follows(known, reading, timing, NOISE_COUNTS if standing else None):
            if self._doubtful:
                self.withheld += self._rounds
            self._sure = True
            self._known, self._doubtful, self._rounds = (reading, timing), None, 0
            return Verdict.BELIEVED
        if self._doubtful and self._follows(self._doubtful, reading, timing, None):
            self.jumped = self._sure and self._is_jump(known, reading, timing)
            self.zeroed = self._sure and self._is_zeroed(known, reading, timing)
            self._sure = True
            self.confirmed = self._doubtful
            return self._believe(reading, timing)
        self._doubtful = reading, timing
        self._rounds += 1
        self.foreign = self._is_jump(known, reading, timing)
        if self._rounds < ROUNDS:
            return Verdict.ASK_AGAIN
        self.withheld += self._rounds
        self._doubtful, self._rounds = None, 0
        return Verdict.LOST

    def _believe(self, reading: AxisReading, timing: Timing) -> Verdict:
        self._known = reading, timing
        self._doubtful, self._rounds = None, 0
        return Verdict.BELIEVED

    def _follows(self, seen: _Seen, reading: AxisReading, timing: Timing, within_counts: int | None) -> bool:
        """Tell whether a drive that gave the one reading can give the other by now.

        Args:
            seen: the one.
            reading: the other.
            timing: when it was true.
            within_counts: how far apart they may be; worked out from both velocities when missing.
        """
        before, seen_at = seen
        if (
            reading.enabled is not before.enabled
            or reading.profile_done is not before.profile_done
            or reading.homing is not before.homing
            or reading.reverse_limit is not before.reverse_limit
            or reading.forward_limit is not before.forward_limit
            or reading.faults != before.faults
        ):
            return False
        passed_s = timing.true_until_s - seen_at.true_from_s
        velocity, resolution = reading.velocity_counts_per_s, reading.velocity_resolution_counts_per_s
        changed = abs(velocity - before.velocity_counts_per_s)
        if changed > self._acceleration * passed_s + 2 * resolution:
            return False
        if within_counts is not None:
            return abs(_way(before, reading)) <= within_counts
        return self._led_there(seen, reading, timing)

    def _led_there(self, seen: _Seen, reading: AxisReading, timing: Timing) -> bool:
        """Tell whether the velocities lead from the one position to the other."""
        before, seen_at = seen
        passed_s = timing.true_until_s - seen_at.true_from_s
        velocities = reading.velocity_counts_per_s + before.velocity_counts_per_s
        resolution = reading.velocity_resolution_counts_per_s
        reach = NOISE_COUNTS + 2 * resolution * passed_s + self._acceleration * passed_s * passed_s / 4
        return abs(_way(before, reading) - velocities / 2 * passed_s) <= reach

    def _is_zeroed(self, seen: _Seen, reading: AxisReading, timing: Timing) -> bool:
        """Tell whether the counter was reset to 0: a shaft that happens to come to rest at its 0 shows a velocity."""
        return reading.begun_anew and not seen[0].begun_anew and not self._led_there(seen, reading, timing)

    def _is_jump(self, seen: _Seen, reading: AxisReading, timing: Timing) -> bool:
        """Tell whether an axis cannot have come from the one reading to the other by moving."""
        speeds = JUMP_SPEEDS if reading.enabled else OPEN_LOOP_SPEEDS
        before, seen_at = seen
        reach = speeds * self._speed * (timing.true_until_s - seen_at.true_from_s) + self._following + NOISE_COUNTS
        return abs(_way(before, reading)) > reach


def agree(one: AxisReading, other: AxisReading) -> bool:
    """Tell whether two readings, one directly after the other, show the same, but for what the velocity explains."""
    resolution = other.velocity_resolution_counts_per_s
    speed = max(abs(one.velocity_counts_per_s), abs(other.velocity_counts_per_s))
    moving_counts = (speed + resolution) * APART_S if speed > resolution else 0.0
    return abs(_way(one, other)) <= NOISE_COUNTS + moving_counts and one.faults == other.faults


def _way(before: AxisReading, after: AxisReading) -> int:
    """Return the shortest way between two counts, which wrap."""
    return (after.position_counts - before.position_counts + _HALF) % _COUNTER - _HALF
