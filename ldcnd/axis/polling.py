"""Polls of one axis: when which items are read, in one exchange; whether a reading can be true says plausibility.py."""

from collections.abc import Callable, Mapping

from typing_extensions import override

from ldcnd.contract.errors import BusError
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import AxisReading, Readable
from ldcnd.line.exchange import NEVER_S, Exchange, Poller, Timing, next_on_grid

Deliver = Callable[[AxisReading, frozenset[TelemetryItem], Timing], bool]
"""Takes a reading; true when it is not accepted before the drive was read again."""
Missed = Callable[[BusError], None]


AGAIN_S = 0.001
"""Deadline of a repeated poll, or of one at a given instant, after its due time, in seconds."""
EXTRA_ITEMS = frozenset({TelemetryItem.POSITION})
"""Items of a reading at a given instant between two polls."""


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
        # a poll that is to be repeated goes first, and plans behind it
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
            # otherwise the poll is due as well, and reads all that was asked for
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
            # at once: until it agrees with another one a reading is held back
            self.due_at_s = timing.received_at_s
            self.deadline_at_s = timing.received_at_s + AGAIN_S
        else:
            self._again = None
            self._plan()
        self._reschedule(self)

    @override
    def missed(self, error: BusError) -> None:
        self._missed(error)
