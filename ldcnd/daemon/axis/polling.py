"""Polls of one axis: when which items are read, in one exchange, and whether a reading can be true.

A reply has a checksum of one byte: of replies changed by noise, one in some hundreds passes it. So a reading that the
drive cannot have reached since the last accepted reading is requested again before it is used: a position to which the
velocities do not lead, a velocity that the axis cannot have by now, any change of the status. A true change costs one
exchange; a false one never leaves this module. Judging is pure; time is an input.
"""

from collections.abc import Callable, Mapping
from enum import Enum

from typing_extensions import override

from ldcnd.bus.poller import Poller, next_on_grid
from ldcnd.config.axis import AxisConfig
from ldcnd.drivers.driver import AxisReading, Readable
from ldcnd.errors import BusError
from ldcnd.exchange import Exchange, Timing
from ldcnd.model.samples import TelemetryItem

Deliver = Callable[[AxisReading, frozenset[TelemetryItem], Timing], bool]
"""Takes a reading; true when it is not accepted before the drive was read again."""
Missed = Callable[[BusError], None]


AGAIN_S = 0.001
"""Deadline of a repeated poll, or of one at a given instant, after its due time, in seconds."""
NEVER_S = float("inf")
EXTRA_ITEMS = frozenset({TelemetryItem.POSITION})
"""Items of a reading at a given instant between two polls."""
NOISE_COUNTS = 16
"""Movement of a closed loop around its target, counts."""
ACCELERATIONS = 2.0
"""Highest acceleration accepted without a second reading, as a multiple of the axis's acceleration limit."""
JUMP_SPEEDS = 2.0
"""Highest speed of a closed loop, as a multiple of the highest velocity of its axis, or of the one that it shows."""
OPEN_LOOP_SPEEDS = 8.0
"""The same for a shaft that is turned by hand, or by a load."""
APART_S = 0.1
"""Longest time between two consecutive readings, seconds, unless commands delay the line."""
ROUNDS = 4
"""Consecutive readings that contradict the record, and those that must agree on a jump."""

_COUNTER, _HALF = 1 << 32, 1 << 31


_Planned = tuple[Exchange[AxisReading], float, dict[TelemetryItem, float]]
"""An exchange, and when the poll and each of the slower items are due next."""


class AxisPoller(Poller[AxisReading]):
    """Polls one axis at the rate of its fastest item; the drive's state comes with every poll.

    Slower items ride along with the poll that is nearest to their own due time, so they are never more than half a poll
    period early or late, and the line carries one periodic exchange an axis. Deadlines are absolute: a late poll does
    not shift the next one, and missed periods are skipped, not made up for. A single reading between two polls can be
    requested.

    Attributes:
        rates_hz: poll rate of each item.
    """

    slow_to_deliver = True

    def __init__(
        self,
        driver: Readable,
        rates_hz: Mapping[TelemetryItem, float],
        start_at_s: float,
        deliver: Deliver,
        missed: Missed,
        reschedule: Callable[["AxisPoller"], None],
    ) -> None:
        self._reschedule = reschedule
        self._again: Exchange[AxisReading] | None = None
        self.node = driver.spec.address
        self.rates_hz = rates_hz
        self._driver = driver
        self._take_rates(rates_hz)
        self._slower_due_s = dict.fromkeys(self._slower_s, start_at_s)
        self._deliver = deliver
        self._missed = missed
        self._prepared: _Planned | None = None
        self._grid_s = self.due_at_s = start_at_s  # of the next poll, whatever is read in between
        self._extra_s = NEVER_S
        self.deadline_at_s = start_at_s + self._period_s

    def _take_rates(self, rates_hz: Mapping[TelemetryItem, float]) -> None:
        self.rates_hz = rates_hz
        self._period_s = 1.0 / max(rates_hz.values())
        self._slower_s = {item: 1.0 / rate for item, rate in rates_hz.items() if 1.0 / rate > self._period_s}
        self._fastest = frozenset(rates_hz) - frozenset(self._slower_s)

    def ask_at(self, at_s: float) -> None:
        """Have the drive read at this instant as well; replaces an earlier request that was not met yet."""
        self._extra_s = at_s
        if self._again is None and min(self._grid_s, at_s) != self.due_at_s:
            self._plan()
            self._reschedule(self)

    def _plan(self) -> None:
        """Take the next slot: of the poll, or of the requested reading if that comes first."""
        self.due_at_s = min(self._grid_s, self._extra_s)
        self.deadline_at_s = self.due_at_s + (self._period_s if self._grid_s <= self._extra_s else AGAIN_S)

    @override
    def prepare(self, at_s: float) -> None:
        self._prepared = self._planned_at(at_s)

    def next_exchange(self, now_s: float) -> Exchange[AxisReading]:
        """Return the exchange that is due, or the one to repeat."""
        planned, self._prepared = self._prepared, None
        if self._again:
            exchange, self._again = self._again, None
            self._plan()
            return exchange
        if self._extra_s <= now_s:
            self._extra_s = NEVER_S
            if now_s < self._grid_s:
                self._plan()
                return self._driver.reading(EXTRA_ITEMS)
        if planned is None or planned[1] <= now_s:
            planned = self._planned_at(now_s)
        exchange, due_at_s, self._slower_due_s = planned
        self._grid_s = self.due_at_s = due_at_s
        self.deadline_at_s = due_at_s + self._period_s
        if self._extra_s < due_at_s:
            self._plan()
        return exchange

    def _planned_at(self, now_s: float) -> _Planned:
        asked, slower_due_s = self._fastest, self._slower_due_s
        if slower_due_s:
            nearer_s = now_s + self._period_s / 2
            due = [item for item, due_s in slower_due_s.items() if due_s <= nearer_s]
            slower_due_s = slower_due_s | {
                item: next_on_grid(slower_due_s[item], self._slower_s[item], now_s) for item in due
            }
            asked = asked.union(due)
        grid_s, period_s = self._grid_s, self._period_s
        behind = int((now_s - grid_s) / period_s) if now_s > grid_s else 0
        return self._driver.reading(asked), grid_s + (behind + 1) * period_s, slower_due_s

    def deliver(self, reply: AxisReading, timing: Timing) -> None:
        """Deliver a reading, and repeat the poll at once if the receiver requires it."""
        again = self._deliver(reply, reply.asked, timing)
        if not (again or self._again):
            return
        if again:
            self._again = self._driver.reading(reply.asked)
            self.due_at_s = timing.received_at_s
            self.deadline_at_s = timing.received_at_s + AGAIN_S
        else:
            self._again = None
            self._plan()
        self._reschedule(self)

    @override
    def missed(self, error: BusError) -> None:
        self._missed(error)


class Verdict(Enum):
    """Result of judging a reading."""

    BELIEVED = "believed"
    ASK_AGAIN = "ask_again"
    CONTRADICTS = "contradicts"
    """It was requested several times, and each reading contradicts the others: the drive replies, and it is not
    understood what it does."""


_Seen = tuple[AxisReading, Timing]
"""A reading, and when it was true."""


class PlausibilityGate:
    """Judges the readings of one axis, in the order in which they were taken.

    Attributes:
        jumped: no motion can have led from the accepted reading before the last one to the last one.
        zeroed: the drive's counter has gone to about 0, and no motion has led there: reset; with `confirmed`.
        foreign: the last reading was not accepted, and it may be another drive's: no motion can have led to it, or the
            drive was out of reach and shows another place.
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
        self._unconfirmed: _Seen | None = None
        self._rounds = self._agreeing = 0
        # nothing jumps away from the very first reading, which is accepted as it is
        self._sure = self._was_away = False
        self.reconfigure(config)

    def reconfigure(self, config: AxisConfig) -> None:
        """Judge by other limits."""
        counts, limits = abs(config.signed_counts_per_unit), config.limits
        self._speed = counts * max(config.velocity, limits.velocity or 0.0)
        self._acceleration = ACCELERATIONS * counts * max(config.acceleration, limits.acceleration or 0.0)
        self._following = config.gains.el if config.gains else 0

    def after_gap(self) -> None:
        """The drive was out of reach, and may have been moved.

        Until two readings agree again, another place than before is not believed at once, and no jump is called one.
        """
        self._unconfirmed, self._rounds, self._sure, self._was_away = None, 0, False, True

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
        if self._follows(known, reading, timing, NOISE_COUNTS if standing or self._was_away else None):
            if self._unconfirmed:
                self.withheld += self._rounds
            self._sure, self._was_away = True, False
            self._known, self._unconfirmed, self._rounds = (reading, timing), None, 0
            return Verdict.BELIEVED
        jumped = self._is_jump(known, reading, timing.true_until_s)
        if self._unconfirmed and self._follows(self._unconfirmed, reading, timing, None):
            self._agreeing += 1
            # late replies of another drive agree as well
            if self._agreeing >= ROUNDS or not jumped:
                self.jumped = self._sure and jumped
                self.zeroed = self._sure and self._is_zeroed(known, reading, timing)
                self._sure = True
                self.confirmed = self._unconfirmed
                return self._believe(reading, timing)
        else:
            self._agreeing = 1
        self._unconfirmed = reading, timing
        self._rounds += 1
        self.foreign = jumped or (self._was_away and abs(_way(known[0], reading)) > NOISE_COUNTS)
        if self._rounds < ROUNDS:
            return Verdict.ASK_AGAIN
        self.withheld += self._rounds
        # what follows is compared with the latest: what was believed before may never be true again
        self._known, self._unconfirmed, self._rounds, self._sure = (reading, timing), None, 0, False
        return Verdict.CONTRADICTS

    def _believe(self, reading: AxisReading, timing: Timing) -> Verdict:
        self._known = reading, timing
        self._unconfirmed, self._rounds, self._was_away = None, 0, False
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
        if abs(_way(before, reading) - velocities / 2 * passed_s) > reach:
            return False
        # long after the other one, what it may accelerate leads anywhere
        return not self._is_jump(seen, reading, timing.true_until_s)

    def _is_zeroed(self, seen: _Seen, reading: AxisReading, timing: Timing) -> bool:
        """Tell whether the counter was reset to 0: a shaft that happens to come to rest at its 0 shows a velocity."""
        return reading.begun_anew and not seen[0].begun_anew and not self._led_there(seen, reading, timing)

    def is_out_of_reach(self, reading: AxisReading, by_s: float) -> bool:
        """Tell whether no motion can have led to a reading by then, in loop time, from the last one believed."""
        return self._known is not None and self._is_jump(self._known, reading, by_s)

    def _is_jump(self, seen: _Seen, reading: AxisReading, by_s: float) -> bool:
        """Tell whether an axis cannot have come from the one reading to the other by moving."""
        before, seen_at = seen
        shown = max(abs(reading.velocity_counts_per_s), abs(before.velocity_counts_per_s))
        # without a limit, a command may be faster than the axis's own velocity
        speed = max((JUMP_SPEEDS if reading.enabled else OPEN_LOOP_SPEEDS) * self._speed, JUMP_SPEEDS * shown)
        reach = speed * (by_s - seen_at.true_from_s) + self._following + NOISE_COUNTS
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
