"""Whether a reading of an axis can be true, given the one before, what was commanded, and what has happened meanwhile.

A reply has a checksum of one byte: of replies changed by noise, one in some hundreds passes it. And another host may
set the counter of a drive. So a reading to which no motion can have led since the last accepted one, or that shows
another status, is requested again before it is used. A true change costs one exchange; a false one never leaves this
module. Judging is pure; time is an input.
"""

import math
from dataclasses import dataclass
from enum import Enum, IntEnum

from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AnalogMotion, AxisReading, Motion, PwmOutput
from ldcnd.line.exchange import Timing

NOISE_COUNTS = 16
"""Movement of a closed loop around its target, counts."""
STEP_OF_EL = 1 / 8
"""Way that a closed loop may go between two readings without an explanation, as a fraction of its position error limit:
a load that lets go, an overshoot. A longer one is no motion."""
SPEEDS = 2.0
"""Highest speed of an axis, as a multiple of the highest velocity that is configured for it."""
OPEN_LOOP_SPEEDS = 8.0
"""The same for a shaft that is turned by hand, or by a load."""
APART_S = 0.1
"""Longest time between two consecutive readings, seconds, unless commands delay the line."""
ROUNDS = 4
"""Consecutive readings that contradict the record, and those that must agree on a jump."""

_COUNTER, _HALF = 1 << 32, 1 << 31


class Verdict(Enum):
    """Result of judging a reading."""

    BELIEVED = "believed"
    ASK_AGAIN = "ask_again"
    CONTRADICTS = "contradicts"
    """It was requested several times, and each reading contradicts the others: the drive replies, and it is not
    understood what it does."""


class Step(Enum):
    """What has happened to the counter of the drive, where no motion leads to a reading that others have confirmed."""

    JUMPED = "jumped"
    ZEROED = "zeroed"
    """It reads about 0: it was reset."""


_Seen = tuple[AxisReading, Timing]
"""A reading, and when it was true."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is to be made of a reading.

    Attributes:
        verdict: whether it is accepted.
        confirmed: the reading that this one has confirmed, and when; None if it needed none.
        step: with `confirmed`: no motion can have led from the accepted reading before to these two.
        foreign: not accepted, and it may be another drive's: no motion can have led to it, or the drive was out of
            reach and shows another place.
    """

    verdict: Verdict
    confirmed: _Seen | None = None
    step: Step | None = None
    foreign: bool = False


_BELIEVED, _STILL_CONTRADICTS = Judgement(Verdict.BELIEVED), Judgement(Verdict.CONTRADICTS)


class _Fit(IntEnum):
    """How a reading fits to an earlier one."""

    FOLLOWS = 0
    NEAR = 1
    """A second reading must agree: another status, or a little farther than the motion explains."""
    FAR = 2
    """No motion of the axis leads there: `ROUNDS` readings must agree."""


@dataclass(frozen=True, slots=True)
class _Expected:
    """A motion that was commanded: between these velocities, in counts a second, and no farther than its target."""

    low: float
    high: float
    target_counts: int | None

    def ways(self, from_counts: int, passed_s: float) -> tuple[float, float]:
        """Return how far it leads in this time, in counts: least and most."""
        if self.target_counts is None:
            return self.low * passed_s, self.high * passed_s
        left = self.target_counts - from_counts
        # what its host tracks is at its target at once
        way = left if math.isinf(self.high) else math.copysign(min(self.high * passed_s, abs(left)), left)
        return min(0.0, way), max(0.0, way)


class PlausibilityGate:
    """Judges the readings of one axis, in the order in which they were taken.

    A way is explained where the velocities of both readings lead in the time that has passed, and anything between. It
    is possible from no way at all up to where a motion leads that was commanded since, and a little farther. What is
    possible is believed when two readings agree, what is not when `ROUNDS` do. Accelerations play no part: how a loop
    accelerates is what is not known of one that hunts, is jammed or has other gains.

    Attributes:
        withheld: number of readings not accepted so far.
    """

    def __init__(self, config: AxisConfig) -> None:
        self.withheld = 0
        self._known: _Seen | None = None
        self._unconfirmed: _Seen | None = None
        self._rounds = self._agreeing = 0
        self._expected: tuple[
            _Expected, ...
        ] = ()  # may run, or have run, since the accepted reading; the latest is last
        # nothing jumps away from the very first reading, which is accepted as it is
        self._sure = self._was_away = self._far = self._contradicts = False
        self.reconfigure(config)

    def reconfigure(self, config: AxisConfig) -> None:
        """Judge by other limits."""
        counts, limits = abs(config.signed_counts_per_unit), config.limits
        self._speed = SPEEDS * counts * max(config.velocity, limits.velocity or 0.0)
        self._turned_by_hand = OPEN_LOOP_SPEEDS / SPEEDS * self._speed
        self._step_counts = STEP_OF_EL * config.gains.el if config.gains else 0.0

    def expect(self, motion: Motion | AnalogMotion | PwmOutput, *, anywhere: bool = False) -> None:
        """Take a motion that is about to be loaded: from now on it explains what the axis does.

        Args:
            motion: its target is a position of the drive.
            anywhere: it goes on at up to its velocity in either direction, whatever its target.
        """
        match motion:
            case PwmOutput():
                return  # with the loop open the speed is any
            case Motion(target_counts=int()) if not anywhere:
                low, high, target = -motion.velocity_counts_per_s, motion.velocity_counts_per_s, motion.target_counts
            case Motion() if not anywhere:
                low, high, target = motion.velocity_counts_per_s, motion.velocity_counts_per_s, None
            case _:
                high = abs(motion.velocity_counts_per_s)
                low, target = -high, None
        self._expected = (*self._expected, _Expected(low, high, target))

    def after_gap(self) -> None:
        """The drive was out of reach, and may have been moved.

        Until two readings agree again, another place than before is not believed at once, and no jump is called one.
        """
        self._unconfirmed, self._rounds, self._sure, self._was_away = None, 0, False, True
        self._contradicts = False

    def judge(self, reading: AxisReading, timing: Timing, *, standing: bool) -> Judgement:
        """Judge a reading.

        Args:
            reading: from the drive.
            timing: of that reading.
            standing: the axis was at rest, and nothing was commanded since.
        """
        known, unconfirmed = self._known, self._unconfirmed
        if standing:
            self._expected = ()
        if known is None:
            return self._believe(reading, timing)
        fit = self._fit(known, reading, timing, still=standing or self._was_away)
        if self._contradicts:
            return self._contradict(reading, timing, fit)
        agrees = unconfirmed is not None and self._agrees(unconfirmed, reading, timing)
        # a counter that was set back in mid-motion soon passes where it was: it fits better to what it showed meanwhile
        fits_better = (
            unconfirmed is not None
            and agrees
            and self._far
            and _misfit(unconfirmed, reading, timing) < _misfit(known, reading, timing)
        )
        if fit is _Fit.FOLLOWS and not fits_better:
            self.withheld += self._rounds
            self._sure = True
            return self._believe(reading, timing)
        if agrees:
            # a false velocity in the reading before explains any way; the true one in this reading does not
            self._agreeing, self._far = self._agreeing + 1, self._far or fit is _Fit.FAR
        else:
            self._agreeing, self._far = 1, fit is _Fit.FAR
        # late replies of another drive agree as well
        if self._agreeing >= (ROUNDS if self._far else 2):
            step = self._step(known, reading, timing) if self._sure else None
            self._sure = True
            return self._believe(reading, timing, unconfirmed, step)
        self._unconfirmed = reading, timing
        self._rounds += 1
        foreign = self._far or (self._was_away and abs(_way(known[0], reading)) > NOISE_COUNTS)
        if self._rounds < ROUNDS:
            return Judgement(Verdict.ASK_AGAIN, foreign=foreign)
        self.withheld += self._rounds
        # what follows is compared with the latest: what was believed before may never be true again
        self._known, self._unconfirmed, self._rounds, self._agreeing = (reading, timing), None, 0, 0
        self._sure, self._contradicts = False, True
        return Judgement(Verdict.CONTRADICTS, foreign=foreign)

    def _contradict(self, reading: AxisReading, timing: Timing, fit: _Fit) -> Judgement:
        """Go on until as many polls in a row make sense as have not; a loop that hunts takes no more of the line."""
        self._agreeing = 0 if fit is _Fit.FAR else self._agreeing + 1
        if self._agreeing >= ROUNDS:
            self._contradicts = False
            return self._believe(reading, timing)
        self.withheld += 1
        self._known = reading, timing
        return _STILL_CONTRADICTS

    def _believe(
        self, reading: AxisReading, timing: Timing, confirmed: _Seen | None = None, step: Step | None = None
    ) -> Judgement:
        self._known, self._expected = (reading, timing), self._expected[-1:]
        self._unconfirmed, self._rounds, self._was_away, self._far = None, 0, False, False
        return Judgement(Verdict.BELIEVED, confirmed, step) if confirmed else _BELIEVED

    def _step(self, known: _Seen, reading: AxisReading, timing: Timing) -> Step | None:
        beyond = self._unexplained(known, reading, timing.true_until_s, by_shown=True)
        # a shaft that happens to come to rest at its 0 was led there
        if reading.begun_anew and not known[0].begun_anew and beyond > 0:
            return Step.ZEROED
        return Step.JUMPED if self._far else None

    def _fit(self, seen: _Seen, reading: AxisReading, timing: Timing, *, still: bool) -> _Fit:
        """Tell how a reading fits to an earlier one, of an axis that should not have moved when `still`."""
        before, by_s = seen[0], timing.true_until_s
        beyond = self._unexplained(seen, reading, by_s, by_shown=True)
        if beyond > 0 and self.is_out_of_reach(reading, by_s):
            return _Fit.FAR
        if beyond > 0 or not _same_status(before, reading) or (still and abs(_way(before, reading)) > NOISE_COUNTS):
            return _Fit.NEAR
        fastest = max(abs(before.velocity_counts_per_s), 0.0 if still else self._speed)
        for expected in self._expected:
            fastest = max(fastest, -expected.low, expected.high)
        odd = abs(reading.velocity_counts_per_s) > fastest + 2 * reading.velocity_resolution_counts_per_s
        return _Fit.NEAR if odd else _Fit.FOLLOWS

    def _agrees(self, unconfirmed: _Seen, reading: AxisReading, timing: Timing) -> bool:
        by_s = timing.true_until_s
        allowed = 0.0 if self._far else self._allowed(unconfirmed, reading, by_s)
        return _same_status(unconfirmed[0], reading) and self._unexplained(unconfirmed, reading, by_s) <= allowed

    def is_out_of_reach(self, reading: AxisReading, by_s: float) -> bool:
        """Tell whether no motion can have led to a reading by then, in loop time, from the last one believed."""
        known = self._known
        return known is not None and self._unexplained(known, reading, by_s) > self._allowed(known, reading, by_s)

    def _allowed(self, seen: _Seen, reading: AxisReading, by_s: float) -> float:
        """Return how much farther than explained an axis may have gone, in counts."""
        if seen[0].enabled and reading.enabled:
            return self._step_counts
        return self._step_counts + self._turned_by_hand * (by_s - seen[1].true_from_s)

    def _unexplained(self, seen: _Seen, reading: AxisReading, by_s: float, *, by_shown: bool = False) -> float:
        """Return how much farther the axis went from the one reading to the other than explained, in counts.

        Args:
            seen: the one.
            reading: the other.
            by_s: when it was true, in loop time.
            by_shown: explained by the velocities that they show, and by nothing else.
        """
        before, seen_at = seen
        passed_s = by_s - seen_at.true_from_s
        shown = before.velocity_counts_per_s * passed_s, reading.velocity_counts_per_s * passed_s
        low, high = min(shown), max(shown)
        if not by_shown:
            ways = [expected.ways(before.position_counts, passed_s) for expected in self._expected]
            low = min(low, 0.0, *(least for least, _ in ways))
            high = max(high, 0.0, *(most for _, most in ways))
        # a velocity is that of the last servo tick, which takes up to 130 ms, in whole counts: it shows what was
        resolution = max(before.velocity_resolution_counts_per_s, reading.velocity_resolution_counts_per_s)
        late = abs(reading.velocity_counts_per_s - before.velocity_counts_per_s) / resolution
        blurred = NOISE_COUNTS + late + resolution * passed_s
        way = _way(before, reading)
        return max(0.0, low - blurred - way, way - high - blurred)


def _same_status(before: AxisReading, reading: AxisReading) -> bool:
    return (
        reading.enabled is before.enabled
        and reading.profile_done is before.profile_done
        and reading.homing is before.homing
        and reading.reverse_limit is before.reverse_limit
        and reading.forward_limit is before.forward_limit
        and reading.faults == before.faults
    )


def _misfit(seen: _Seen, reading: AxisReading, timing: Timing) -> float:
    """Return how far a reading is from where the mean of both velocities leads, in counts."""
    before, seen_at = seen
    velocity = (before.velocity_counts_per_s + reading.velocity_counts_per_s) / 2
    return abs(_way(before, reading) - velocity * (timing.true_until_s - seen_at.true_from_s))


def agree(one: AxisReading, other: AxisReading) -> bool:
    """Tell whether two readings, one directly after the other, show the same, but for what the velocity explains."""
    resolution = other.velocity_resolution_counts_per_s
    speed = max(abs(one.velocity_counts_per_s), abs(other.velocity_counts_per_s))
    moving_counts = (speed + resolution) * APART_S if speed > resolution else 0.0
    return abs(_way(one, other)) <= NOISE_COUNTS + moving_counts and one.faults == other.faults


def _way(before: AxisReading, after: AxisReading) -> int:
    """Return the shortest way between two counts, which wrap."""
    return (after.position_counts - before.position_counts + _HALF) % _COUNTER - _HALF
