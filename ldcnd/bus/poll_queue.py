"""Whose poll goes on the wire next: by deadline while the line keeps up, by priority once it does not. Pure."""

import heapq
from itertools import count
from typing import Any

from ldcnd.bus.poll_rank import Choose, PollRank
from ldcnd.bus.poller import NO_DEADLINE_S, Poller, Priority

NORMAL = Priority.NORMAL
POLLS_PER_LOWER = 16
"""So many polls may pass a late one of a lower priority before such a one goes. On a line of 31 axes at 19200 baud that
one priority could fill alone, each of the others is asked every five seconds then, as seldom as a drive that is mute.
"""


class PollQueue:
    """Pollers, each with its next turn.

    As long as no poll that is due is late, the earliest deadline goes first, whatever the priority. Once one is, the
    line has fallen behind; until it has caught up, which is when nothing with a deadline is due, the highest priority
    goes first, and deadlines count within one priority only. That concerns all that are due and not just the late ones:
    who is only asked once it is late has lost a turn by then.

    A late poll of a lower priority waits for at most `POLLS_PER_LOWER` others for each late one before it.

    Who goes next can be chosen ahead, while the line is busy. As long as the line keeps up, a poll that becomes due
    meanwhile goes before if its deadline is earlier, so whoever has the earliest one never waits for a choice made too
    soon.

    Args:
        choose: who chooses where deadlines leave a choice, see `PollRank`; None for who is due longest.
    """

    def __init__(self, choose: Choose | None) -> None:
        self._ranks = tuple(PollRank(choose) for _ in Priority)  # highest first
        self._only: PollRank | None = self._ranks[NORMAL]  # None once other priorities take part
        self._later: list[tuple[float, int, Poller[Any]]] = []
        self._turns: dict[Poller[Any], int] = {}  # those that are valid of `_later`
        self._due: set[Poller[Any]] = set()
        self._serial = count()
        self._behind = False
        self._passed = 0
        self._ahead: Poller[Any] | None = None  # who was chosen ahead

    def schedule(self, poller: Poller[Any], at_s: float) -> None:
        """Let a poller have its next turn at `at_s`; replaces any turn it had."""
        if poller in self._due or poller is self._ahead:
            self.unschedule(poller)
        if poller.priority is not NORMAL:
            self._only = None
        serial = self._turns[poller] = next(self._serial)
        heapq.heappush(self._later, (at_s, serial, poller))

    def unschedule(self, poller: Poller[Any]) -> None:
        """Forget a poller; unknown ones are ignored."""
        self._turns.pop(poller, None)
        if poller is self._ahead:
            self._ahead = None
        if poller in self._due:
            self._due.discard(poller)
            self._ranks[poller.priority].remove(poller)

    def next_due_s(self) -> float:
        """Return when the next poller is due; infinity when there is none."""
        if self._ahead:
            return self._ahead.due_at_s
        for rank in self._ranks:
            if rank:
                return rank.since_s
        while self._later and self._turns.get(self._later[0][2]) != self._later[0][1]:
            heapq.heappop(self._later)
        return self._later[0][0] if self._later else float("inf")

    def is_due(self, now_s: float) -> bool:
        """Tell whether there is a poll to run."""
        if self._ahead:
            return True
        self._rank_due(now_s)
        if self._due:
            return True
        self._behind = False
        return False

    def look_ahead(self, at_s: float) -> Poller[Any] | None:
        """Choose who of those that are due at about `at_s` goes then; None when nobody is, or one is chosen already."""
        if self._ahead or not self.is_due(at_s):
            return None
        self._ahead = self._take(at_s)
        return self._ahead

    def take(self, now_s: float) -> Poller[Any]:
        """Remove and return the poller whose turn it is; one is due."""
        ahead = self._ahead
        if ahead and not self._is_overtaken(ahead, now_s):
            self._ahead = None
            return ahead
        return self._take(now_s)

    def _is_overtaken(self, ahead: Poller[Any], now_s: float) -> bool:
        if self._later and self._later[0][0] <= now_s:
            self._rank_due(now_s)
        if (only := self._only) is not None:
            return only.deadline_s < ahead.deadline_at_s
        if self._behind:
            return False
        return any(rank.deadline_s < ahead.deadline_at_s for rank in self._ranks)

    def _rank_due(self, now_s: float) -> None:
        while self._later and self._later[0][0] <= now_s:
            at_s, serial, poller = heapq.heappop(self._later)
            if self._turns.get(poller) == serial:
                del self._turns[poller]
                self._due.add(poller)
                self._ranks[poller.priority].add(poller, at_s, serial)

    def _take(self, now_s: float) -> Poller[Any]:
        rank = self._next_rank(now_s) if self._only is None else self._only
        poller = rank.take(now_s)
        self._due.discard(poller)
        return poller

    def _next_rank(self, now_s: float) -> PollRank:
        """Return the priority whose turn it is."""
        ranks = [rank for rank in self._ranks if rank]
        late = [rank for rank in ranks if rank.is_late(now_s)]
        earliest = min(ranks, key=lambda rank: rank.deadline_s)
        if late:
            self._behind = True
        elif earliest.deadline_s == NO_DEADLINE_S:
            self._behind = False
        if not self._behind:
            return earliest
        lower = [rank for rank in late if rank is not ranks[0]]
        self._passed = self._passed + 1 if lower else 0
        if self._passed <= POLLS_PER_LOWER:
            return ranks[0]
        self._passed = 0
        return min(lower, key=lambda rank: rank.since_s)
