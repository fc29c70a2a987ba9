"""The due polls of one priority: who of them goes next. Pure: knows no clock and no wire."""

import heapq
from collections.abc import Callable, Sequence
from typing import Any

from ldcnd.bus.poller import NO_DEADLINE_S, Poller

CHOICE = 16
"""The choice among equals is among so many at most, because looking at each takes time."""
SHORTEST_ROUND, LONGEST_ROUND = 0.5, 1.5
"""Turns for which a late poll waits, as shares of how many are late. The longest one keeps the longest gap below two
mean ones, also when several are passed over.
"""
FEW = 4
"""So many wait for a turn less than that: turns are counted, not seconds, and with few of them chance weighs more."""

Choose = Callable[[Sequence[Poller[Any]], float], Poller[Any]]
"""Which of several polls to run now, at an instant in loop time; there is always one."""


class PollRank:
    """Polls of one priority that are due; false while there is none. The earliest deadline goes first.

    Where deadlines leave a choice it is somebody else's: among polls with the same deadline, and among those that are
    late already. These have no deadline to lose, so they take turns: half of them go before one goes again, and who was
    passed over for `LONGEST_ROUND` rounds goes now.
    """

    def __init__(self, choose: Choose | None) -> None:
        self._choose = choose
        self._turn = 0
        self._late: list[tuple[int, float, Poller[Any]]] = []  # since which turn, and since when it is due
        self._due: list[tuple[float, float, int, Poller[Any]]] = []

    def __bool__(self) -> bool:
        return bool(self._due or self._late)

    @property
    def since_s(self) -> float:
        """Since when the first one is due."""
        return self._late[0][1] if self._late else self._due[0][1]

    @property
    def deadline_s(self) -> float:
        """The earliest deadline of those that were not late yet when one was last taken."""
        return self._due[0][0] if self._due else NO_DEADLINE_S

    def is_late(self, now_s: float) -> bool:
        """Tell whether the deadline of one has passed."""
        return bool(self._late) or self.deadline_s <= now_s

    def add(self, poller: Poller[Any], at_s: float, serial: int) -> None:
        """Take a poll that has become due at `at_s`; equal ones go in the order of their serial numbers."""
        heapq.heappush(self._due, (poller.deadline_at_s, at_s, serial, poller))

    def remove(self, poller: Poller[Any]) -> None:
        """Forget a poll; unknown ones are ignored."""
        self._late = [late for late in self._late if late[2] is not poller]
        self._due = [due for due in self._due if due[3] is not poller]
        heapq.heapify(self._due)

    def take(self, now_s: float) -> Poller[Any]:
        """Remove and return the one that goes now."""
        if self._choose is None:
            return heapq.heappop(self._due)[3]
        self._turn += 1
        while self._due and self._due[0][0] <= now_s:
            _, at_s, _, poller = heapq.heappop(self._due)
            self._late.append((self._turn, at_s, poller))
        return self._take_late(self._choose, now_s) if self._late else self._take_equal(self._choose, now_s)

    def _take_late(self, choose: Choose, now_s: float) -> Poller[Any]:
        since, _, first = self._late[0]
        late = len(self._late)
        if self._turn - since >= LONGEST_ROUND * late - FEW / late:
            del self._late[0]
            return first
        before = self._turn - SHORTEST_ROUND * late
        among = [poller for turn, _, poller in self._late if turn <= before] or [first]
        chosen = choose(among, now_s)
        del self._late[among.index(chosen)]  # both begin with who is late longest
        return chosen

    def _take_equal(self, choose: Choose, now_s: float) -> Poller[Any]:
        equal = [heapq.heappop(self._due)]
        while len(equal) < CHOICE and self._due and self._due[0][0] == equal[0][0]:
            equal.append(heapq.heappop(self._due))
        chosen = choose([poller for *_, poller in equal], now_s)
        for entry in equal:
            if entry[3] is not chosen:
                heapq.heappush(self._due, entry)
        return chosen
