"""Whether a reading of an axis can be true, given the one before, what was commanded, and what has happened meanwhile.

A reply has a checksum of one byte: of replies changed by noise, one in some hundreds passes it. And another host may
set the counter of a drive. So a reading to which no motion can have led since the last accepted one, or that shows
another status, is requested again before it is used. A true change costs one exchange; a false one never leaves this
module. Judging is pure; time is an input.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum, IntEnum

from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AnalogMotion, AxisReading, CountsMotion, PwmOutput
from ldcnd.line.exchange import Timing

NOISE_COUNTS = 16
"""Movement of a closed loop around its target, counts."""
STEP_OF_EL = 1 / 8
"""Way that a closed loop may go between two readings without an explanation, as a fraction of its position error limit:
a load that lets go, an overshoot. A longer one is no motion. A following error grows by no more beside its profile."""
SPEEDS = 2.0
"""Highest speed of an axis, as a multiple of the highest velocity that is configured for it, or was commanded."""
OPEN_LOOP_SPEEDS = 8.0
"""The same for a shaft that is turned by hand, or by a load."""
ALIKE = 2.0
"""Highest ratio of a velocity to the one that confirms it, where it alone would not be believed."""
ROUNDS = 4
"""Consecutive readings that contradict the record, and those that must agree on a jump."""

_COUNTER, _HALF = 1 << 32, 1 << 31


class ReadingVerdict(Enum):
    """Result of judging a reading."""

    BELIEVED = "believed"
    ASK_AGAIN = "ask_again"
    CONTRADICTS = "contradicts"
    """It was requested several times, and each reading contradicts the others: the drive replies, and it is not
    understood what it does."""


class CounterStep(Enum):
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
        confirmed: what of an earlier reading this one has confirmed, and when; None if it needed none.
        step: with `confirmed`: no motion can have led from the accepted reading before to these two.
        foreign: not accepted, and it may be another drive's: no motion can have led to it, or the drive was out of
            reach and shows another place.
    """

    verdict: ReadingVerdict
    confirmed: _Seen | None = None
    step: CounterStep | None = None
    foreign: bool = False


_BELIEVED, _STILL_CONTRADICTS = Judgement(ReadingVerdict.BELIEVED), Judgement(ReadingVerdict.CONTRADICTS)


class _Fit(IntEnum):
    """How a reading fits to an earlier one."""

    FOLLOWS = 0
    CHANGED = 1
    """It shows another status, speed or following error, or an axis that should not have moved: a second must agree."""
    BEYOND = 2
    """It is a little farther than the motion explains: a second reading must agree."""
    FAR = 3
    """No motion of the axis leads there: `ROUNDS` readings must agree."""


class _Record(Enum):
    """What the last accepted reading is worth."""

    FIRST = "first"
    """There was none before, or they contradicted each other: nothing jumps away from it."""
    SURE = "sure"
    AWAY = "away"
    """The drive was out of reach since."""
    CONTRADICTED = "contradicted"
    """What came then contradicts it: what follows is compared with the latest reading."""


_FIRST, _SURE, _AWAY, _CONTRADICTED = _Record  # `_Record.SURE` is looked up slowly, and every poll needs it


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
        self._commanded: tuple[int, float] | None = None  # where the loop was to be last, and when, in loop time
        self._record = _FIRST
        self._unconfirmed: _Seen | None = None
        self._rounds = self._agreeing = 0
        self._far = False  # of those rounds, one at least
        # may run, or have run, since the accepted reading; the latest is last
        self._expected: tuple[_Expected, ...] = ()
        self.reconfigure(config)

    def reconfigure(self, config: AxisConfig) -> None:
        """Judge by other limits."""
        counts, limits = abs(config.signed_counts_per_unit), config.limits
        self._speed = SPEEDS * counts * max(config.velocity, limits.velocity or 0.0)
        self._turned_by_hand = OPEN_LOOP_SPEEDS / SPEEDS * self._speed
        # by the loosest of its loops: which of them holds it may change in the middle of a motion
        limits_of_error = [each.el for each in (config.gains, *config.gain_sets.values()) if each]
        self._step_counts = STEP_OF_EL * max(limits_of_error, default=0)

    def expect(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, anywhere: bool = False) -> None:
        """Take a motion that is about to be loaded: from now on it explains what the axis does.

        Args:
            motion: its target is a position of the drive.
            anywhere: it goes on at up to its velocity in either direction, whatever its target.
        """
        match motion:
            case PwmOutput():
                return  # with the loop open the speed is any
            case CountsMotion(target_counts=int()) if not anywhere:
                low, high, target = -motion.velocity_counts_per_s, motion.velocity_counts_per_s, motion.target_counts
            case CountsMotion() if not anywhere:
                low, high, target = motion.velocity_counts_per_s, motion.velocity_counts_per_s, None
            case _:
                high = abs(motion.velocity_counts_per_s)
                low, target = -high, None
        self._expected = (*self._expected, _Expected(low, high, target))

    def after_gap(self) -> None:
        """The drive was out of reach, and may have been moved.

        Until two readings agree again, another place than before is not believed at once, and no jump is called one.
        """
        self._unconfirmed, self._rounds, self._record, self._commanded = None, 0, _AWAY, None

    def judge(self, reading: AxisReading, timing: Timing, *, standing: bool) -> Judgement:
        """Judge a reading.

        Args:
            reading: from the drive.
            timing: of that reading.
            standing: the axis was at rest, and nothing was commanded since.
        """
        known = self._known
        # what was commanded is over, and explains no way from here
        if standing:
            self._expected = ()
        if known is None:
            return self._believe(reading, timing, record=_FIRST)
        before, error = known[0], reading.following_error_counts
        still = standing or self._record is _AWAY or self._has_arrived(before, reading)
        way, middle, half, tolerance = _shown_way(known, reading, timing.true_until_s)
        if abs(way - middle) > half + tolerance:
            fit = _Fit.FAR if self.is_out_of_reach(reading, timing.true_until_s) else _Fit.BEYOND
        elif (
            not _same_status(before, reading)
            or (still and abs(way) > NOISE_COUNTS)
            or (
                abs(reading.velocity_counts_per_s) > abs(before.velocity_counts_per_s)
                and self._is_too_fast(before, reading, still=still)
            )
            or (error is not None and abs(error) > self._step_counts and self._lags_too_far(reading, timing))
        ):
            fit = _Fit.CHANGED
        elif self._unconfirmed or self._record is _CONTRADICTED:
            fit = _Fit.FOLLOWS
        else:
            self._known, self._record = (reading, timing), _SURE
            if error is not None:
                self._commanded = reading.position_counts + error, timing.true_from_s
            if self._expected:
                # those before the latest have been replaced by it
                self._expected = self._expected[-1:]
            return _BELIEVED
        return self._weigh(known, reading, timing, fit, still=still)

    def _weigh(self, known: _Seen, reading: AxisReading, timing: Timing, fit: _Fit, *, still: bool) -> Judgement:
        """Judge a reading that does not follow, or that comes after one that did not."""
        record, unconfirmed = self._record, self._unconfirmed
        if record is _CONTRADICTED:
            return self._contradict(reading, timing, fit)
        agreed = self._confirmed(known[0], unconfirmed, reading, timing, still=still) if unconfirmed else None
        # a counter that was set back in mid-motion soon passes where it was: it fits better to what it showed meanwhile
        back = agreed and self._far and _misfit(agreed, reading, timing) < _misfit(known, reading, timing)
        if fit is _Fit.FOLLOWS and not back:
            self.withheld += self._rounds
            return self._believe(reading, timing)
        self._agreeing = self._agreeing + 1 if agreed else 1
        # a false velocity in the reading before explains any way; the true one in this reading does not
        self._far = fit is _Fit.FAR or (agreed is not None and self._far)
        # late replies of another drive agree as well
        if self._agreeing >= (ROUNDS if self._far else 2):
            step = None
            if record is _SURE:
                # a shaft that happens to come to rest at its 0 was led there, or was sent there between two slow polls
                zeroed = (
                    reading.begun_anew
                    and agreed is not None
                    and agreed[0].begun_anew  # one alone has perhaps come late, from a shaft that passes there
                    and not known[0].begun_anew
                    and fit >= _Fit.BEYOND
                    and (self._far or not self._is_at_target(reading))
                )
                step = CounterStep.ZEROED if zeroed else CounterStep.JUMPED if self._far else None
            return self._believe(reading, timing, agreed, step)
        self._unconfirmed = reading, timing
        self._rounds += 1
        way, *_ = _shown_way(known, reading, timing.true_until_s)
        foreign = self._far or (record is _AWAY and abs(way) > NOISE_COUNTS)
        if self._rounds < ROUNDS:
            return Judgement(ReadingVerdict.ASK_AGAIN, foreign=foreign)
        self.withheld += self._rounds
        # what follows is compared with the latest: what was believed before may never be true again
        self._known, self._unconfirmed, self._rounds, self._agreeing = (reading, timing), None, 0, 0
        self._record = _CONTRADICTED
        return Judgement(ReadingVerdict.CONTRADICTS, foreign=foreign)

    def _is_at_target(self, reading: AxisReading) -> bool:
        return any(
            each.target_counts is not None and abs(each.target_counts - reading.position_counts) <= NOISE_COUNTS
            for each in self._expected
        )

    def _contradict(self, reading: AxisReading, timing: Timing, fit: _Fit) -> Judgement:
        """Go on until as many polls in a row make sense as have not; a loop that hunts takes no more of the line."""
        self._agreeing = 0 if fit is _Fit.FAR else self._agreeing + 1
        if self._agreeing >= ROUNDS:
            return self._believe(reading, timing, record=_FIRST)
        self.withheld += 1
        self._known = reading, timing
        return _STILL_CONTRADICTS

    def _believe(
        self,
        reading: AxisReading,
        timing: Timing,
        confirmed: _Seen | None = None,
        step: CounterStep | None = None,
        record: _Record = _SURE,
    ) -> Judgement:
        self._known, self._expected, self._record = (reading, timing), self._expected[-1:], record
        self._unconfirmed, self._rounds = None, 0
        if (error := reading.following_error_counts) is not None:
            self._commanded = reading.position_counts + error, timing.true_from_s
        return Judgement(ReadingVerdict.BELIEVED, confirmed, step)

    def _has_arrived(self, before: AxisReading, reading: AxisReading) -> bool:
        """Tell whether a profile has led to its target before, and nothing was commanded since."""
        if not (reading.enabled and before.profile_done and reading.profile_done and len(self._expected) == 1):
            return False
        [last] = self._expected
        return last.target_counts is not None and not math.isinf(last.high)

    def _is_too_fast(self, before: AxisReading, reading: AxisReading, *, still: bool) -> bool:
        """Tell whether an axis that did not turn as fast before cannot do so by now."""
        fastest = abs(before.velocity_counts_per_s)
        # what was commanded bounds a closed loop only
        expected = self._expected if reading.enabled else ()
        if not (still or expected):
            fastest = max(fastest, self._speed)
        for each in () if still else expected:
            fastest = max(fastest, -SPEEDS * each.low, SPEEDS * each.high)
        return abs(reading.velocity_counts_per_s) > fastest + 2 * reading.velocity_resolution_counts_per_s

    def _lags_too_far(self, reading: AxisReading, timing: Timing) -> bool:
        """Tell whether the following error says that its loop was to be where no profile can have led it by now."""
        error, before = reading.following_error_counts, self._commanded
        if error is None or before is None or abs(error) <= self._step_counts or not reading.enabled:
            return False
        fastest = max((max(-each.low, each.high) for each in self._expected), default=0.0)
        way = abs(reading.position_counts + error - before[0])
        # what its host tracks is at its target at once: then this is infinite
        return way > self._step_counts + fastest * (timing.true_until_s - before[1])

    def _confirmed(
        self, known: AxisReading, unconfirmed: _Seen, reading: AxisReading, timing: Timing, *, still: bool
    ) -> _Seen | None:
        """Return what of an earlier reading this one confirms; None if they contradict each other."""
        before, now = unconfirmed[0].velocity_counts_per_s, reading.velocity_counts_per_s
        highest = self._speed if reading.enabled else self._turned_by_hand
        # a false velocity would explain any way from one reading to the next: one that no axis has must be shown twice
        if abs(now) > highest and not (now * before > 0 and abs(now) <= ALIKE * abs(before)):
            return None
        were_fast = self._is_too_fast(known, unconfirmed[0], still=still)
        fast = self._is_too_fast(known, reading, still=still)
        lagged, lags = self._lags_too_far(*unconfirmed), self._lags_too_far(reading, timing)
        if (fast and not were_fast) or (lags and not lagged):
            return None
        if (were_fast and not fast) or abs(before) > highest >= abs(now):
            unconfirmed = replace(unconfirmed[0], velocity_counts_per_s=now), unconfirmed[1]
        if lagged and not lags:
            unconfirmed = replace(unconfirmed[0], following_error_counts=None), unconfirmed[1]
        # what begins to move without a command shows its speed as well
        exactly = self._far or not self._expected
        led = self._is_led(unconfirmed, reading, timing.true_until_s, exactly=exactly)
        return unconfirmed if led and _same_status(unconfirmed[0], reading) else None

    def is_out_of_reach(self, reading: AxisReading, by_s: float) -> bool:
        """Tell whether no motion can have led to a reading by then, in loop time, from the last one believed."""
        return self._known is not None and not self._is_led(self._known, reading, by_s)

    def _is_led(self, seen: _Seen, reading: AxisReading, by_s: float, *, exactly: bool = False) -> bool:
        """Tell whether an axis may have come from the one reading to the other; `exactly`, by what is explained."""
        way, middle, half, spare = _shown_way(seen, reading, by_s)
        low, high = min(0.0, middle - half), max(0.0, middle + half)
        before, passed_s = seen[0], by_s - seen[1].true_from_s
        for expected in self._expected:
            least, most = expected.ways(before.position_counts, passed_s)
            low, high = min(low, least), max(high, most)
        if not exactly:
            spare += self._step_counts
            spare += 0.0 if before.enabled and reading.enabled else self._turned_by_hand * passed_s
        return low - spare <= way <= high + spare


def _shown_way(seen: _Seen, reading: AxisReading, by_s: float) -> tuple[int, float, float, float]:
    """Return the way from the one reading to the other, and what explains it: the velocities that they show.

    These lead to the second number, give or take the third; the fourth is a tolerance. All are counts, the other
    reading was true by then, in loop time.
    """
    before, seen_at = seen
    passed_s = by_s - seen_at.true_from_s
    earlier, velocity = before.velocity_counts_per_s, reading.velocity_counts_per_s
    way = (reading.position_counts - before.position_counts + _HALF) % _COUNTER - _HALF  # the shortest: counts wrap
    # a velocity is that of the last servo tick, which takes up to 130 ms, in whole counts: it shows what was
    resolution = max(before.velocity_resolution_counts_per_s, reading.velocity_resolution_counts_per_s)
    change = abs(velocity - earlier)
    tolerance = NOISE_COUNTS + change / resolution + resolution * passed_s
    middle, half = (earlier + velocity) / 2 * passed_s, change / 2 * passed_s
    if before.velocity_uncertain or reading.velocity_uncertain:
        # they are the highest that are possible: every slower motion explains its way as well
        low, high = min(0.0, middle - half), max(0.0, middle + half)
        middle, half = (low + high) / 2, (high - low) / 2
    return way, middle, half, tolerance


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
    way, middle, *_ = _shown_way(seen, reading, timing.true_until_s)
    return abs(way - middle)


def agree(one: AxisReading, other: AxisReading, apart_s: float) -> bool:
    """Tell whether two readings show the same, but for what the velocity explains that can be behind what is shown.

    Args:
        one: the first.
        other: the second.
        apart_s: the longest time that can lie between the instants at which they were true.
    """
    resolution = other.velocity_resolution_counts_per_s
    speed = max(abs(one.velocity_counts_per_s), abs(other.velocity_counts_per_s))
    moving_counts = (speed + resolution) * apart_s
    way = (other.position_counts - one.position_counts + _HALF) % _COUNTER - _HALF
    return abs(way) <= NOISE_COUNTS + moving_counts and one.faults == other.faults
