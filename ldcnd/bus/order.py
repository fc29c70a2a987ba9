"""When drives answer that do so at the end of a cycle of their own, and which of them to ask next. Pure.

Such a drive answers at the end of the servo cycle in which the request was complete. The drives on a line are not
synchronised: one that is asked at the right instant answers at once, one that is asked just too late makes the line
wait for nearly a whole cycle. Phase and length of each cycle show in the replies.
"""

from collections.abc import Sequence
from typing import Any

from ldcnd.bus.poller import Poller
from ldcnd.bus.settings import ServoCycle
from ldcnd.exchange import Timing

MOST_DRIFT = 0.001
"""Of a cycle's length: far more than crystals differ."""
LONGEST_GAP_S = 1.0
"""After a longer pause the number of cycles in between is uncertain: the phase is taken anew."""
ENOUGH = 4
"""Replies, before a prediction is used."""
FORGETTING = 0.1
"""Least weight of a new reply in the phase."""
FORGETTING_DRIFT = 0.005
"""Least weight of a new reply in the length of the cycle."""
MOST_SCATTER = 0.15
"""Of a cycle: where replies scatter more, as behind some USB adapters, nothing can be predicted."""
GUARD_UP, GUARD_DOWN = 0.06, 0.002
"""Of a cycle: how much more time is kept in hand after a cycle was missed, and how much less after each one that was
not: about one in thirty is."""
MOST_GUARD = 0.5


class PhaseTracker:
    """The cycle of one node: a straight line through the instants at which its replies began.

    Weights are those of a least-squares fit through all replies so far, until forgetting sets in.

    Attributes:
        locked: predictions are worth something.
    """

    __slots__ = ("_count", "_cycle_s", "_period_s", "_scatter_s", "_tick_s", "locked")

    def __init__(self, cycle_s: float) -> None:
        self.locked = False
        self._cycle_s = cycle_s
        self._period_s = cycle_s
        self._tick_s = 0.0
        self._scatter_s = 0.0
        self._count = 0

    @property
    def period_s(self) -> float:
        """The length of the cycle on the host's clock."""
        return self._period_s

    def observe(self, tick_s: float) -> None:
        """Take the instant at which a reply began."""
        cycles = round((tick_s - self._tick_s) / self._period_s)
        if not self._count or tick_s - self._tick_s > LONGEST_GAP_S:
            self._tick_s, self._count, self.locked = tick_s, 1, False
            return
        if cycles < 1:
            return
        self._count = count = self._count + 1
        expected_s = self._tick_s + cycles * self._period_s
        error_s = tick_s - expected_s
        weight = max(FORGETTING, 2.0 * (2 * count - 1) / (count * (count + 1)))
        drift_weight = max(FORGETTING_DRIFT, 6.0 / (count * (count + 1)))
        self._tick_s = expected_s + min(1.0, weight) * error_s
        period_s = self._period_s + drift_weight * error_s / cycles
        slack_s = MOST_DRIFT * self._cycle_s
        self._period_s = min(max(period_s, self._cycle_s - slack_s), self._cycle_s + slack_s)
        self._scatter_s += FORGETTING * (abs(error_s) - self._scatter_s)
        self.locked = count >= ENOUGH and self._scatter_s < MOST_SCATTER * self._cycle_s

    def wait_s(self, from_s: float) -> float:
        """Return how long after an instant the next cycle ends."""
        return (self._tick_s - from_s) % self._period_s


class PhaseOrder:
    """The nodes of one line: who would make it wait least.

    A part of each cycle is kept in hand for a host that sends later than it means to and notes replies late; how much
    is learnt from the cycles that were missed.
    """

    def __init__(self, cycle: ServoCycle) -> None:
        self.guard_s = 0.0
        self._cycle_s = cycle.length_s
        self._stretch = cycle.stretch
        self._trackers: dict[int, PhaseTracker] = {}
        self._request_s: dict[int, float] = {}
        self._expected_s: dict[int, float] = {}

    def choose(self, pollers: Sequence[Poller[Any]], now_s: float) -> Poller[Any]:
        """Return the one whose answer would begin first after its request; the first one if none is known well."""
        best, shortest_s = pollers[0], float("inf")
        guard_s = self.guard_s
        for poller in pollers:
            tracker = self._trackers.get(poller.node)
            wait_s = self._cycle_s / 2
            if tracker and tracker.locked:
                wait_s = tracker.wait_s(now_s + self._request_s[poller.node] + guard_s)
            if wait_s < shortest_s:
                best, shortest_s = poller, wait_s
        self._expected_s[best.node] = shortest_s + guard_s
        return best

    def free_at_s(self, node: int, asked_at_s: float, reply_s: float) -> float:
        """Return when the line is likely to be free again behind a request that is over at an instant.

        Args:
            node: who is asked.
            asked_at_s: when the request is over, in loop time.
            reply_s: what the reply takes at the line's nominal rate.
        """
        tracker = self._trackers.get(node)
        wait_s = tracker.wait_s(asked_at_s) if tracker and tracker.locked else self._cycle_s / 2
        return asked_at_s + wait_s + self._stretch * reply_s

    def observe(self, node: int, timing: Timing) -> None:
        """Learn from a reply to a poll."""
        tracker = self._trackers.get(node)
        if tracker is None:
            tracker = self._trackers[node] = PhaseTracker(self._cycle_s)
        began_s = timing.received_at_s - self._stretch * (timing.received_at_s - timing.true_until_s)
        expected_s = self._expected_s.pop(node, None)
        if expected_s is not None and tracker.locked:
            missed = began_s - timing.true_from_s > expected_s + self._cycle_s / 2
            step = GUARD_UP if missed else -GUARD_DOWN
            self.guard_s = min(max(0.0, self.guard_s + step * self._cycle_s), MOST_GUARD * self._cycle_s)
        self._request_s[node] = timing.true_from_s - timing.sent_at_s
        tracker.observe(began_s)
