"""Which exchange goes on the wire next: four lanes and a fairness bound. Pure: knows no clock and no wire."""

import heapq
from collections import deque
from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import count
from typing import Any, Generic, Protocol, TypeVar

from ldcnd.bus.poller import Poller
from ldcnd.errors import BusBusy


class Lane(IntEnum):
    """Priorities, highest first."""

    STOP = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


class Queueable(Protocol):
    """What the queue must know of a job."""

    @property
    def abandoned(self) -> bool:
        """Whether nobody waits for this job any more."""


JobT = TypeVar("JobT", bound=Queueable)

COMMANDS_PER_POLL = 4
"""So many commands may pass a due poll before the poll goes."""
POLLS_PER_BACKGROUND = 8
"""So many due polls may pass a background job before the job goes."""
CHOICE = 16
"""The choice among equals is among so many at most, because looking at each takes time."""
SHORTEST_ROUND, LONGEST_ROUND = 0.5, 1.5
"""Turns for which a late poll waits, as shares of how many are late. The longest one keeps the longest gap below two
mean ones, also when several are passed over.
"""
LANE_LIMITS = {Lane.STOP: 256, Lane.COMMAND: 64, Lane.BACKGROUND: 64}


Choose = Callable[[Sequence[Poller[Any]], float], Poller[Any]]
"""Which of several polls to run now, at an instant in loop time; there is always one."""


class ExchangeQueue(Generic[JobT]):
    """Jobs of three lanes, first in first out, and the pollers of the fourth, earliest deadline first.

    A stop goes before everything. Commands go before polls, but a due poll waits for at most `COMMANDS_PER_POLL`
    commands; background jobs wait for at most `POLLS_PER_BACKGROUND` polls.

    Where deadlines leave a choice it is somebody else's: among polls with the same deadline, and among those that are
    late already. These have no deadline to lose, so they take turns: half of them go before one goes again, and who was
    passed over for `LONGEST_ROUND` rounds goes now.
    """

    def __init__(self, choose: Choose | None = None) -> None:
        self._choose = choose
        self._probe: JobT | None = None
        self._turn = 0
        self._late: list[tuple[int, float, Poller[Any]]] = []  # since which turn, and since when it is due
        self._jobs: dict[Lane, deque[JobT]] = {lane: deque() for lane in LANE_LIMITS}
        self._later: list[tuple[float, int, Poller[Any]]] = []
        self._due: list[tuple[float, float, int, Poller[Any]]] = []
        self._entries: dict[Poller[Any], int] = {}
        self._serial = count()
        self._commands_in_a_row = 0
        self._polls_in_a_row = 0

    def push(self, job: JobT, lane: Lane) -> None:
        """Queue a job behind its lane's others.

        Raises:
            BusBusy: the lane is full.
        """
        waiting = self._jobs[lane]
        if len(waiting) >= LANE_LIMITS[lane]:
            waiting = self._jobs[lane] = deque(other for other in waiting if not other.abandoned)
        if len(waiting) >= LANE_LIMITS[lane]:
            raise BusBusy(
                f"{len(waiting)} exchanges wait in the {lane.name.lower()} lane already; nothing was sent",
                limit=LANE_LIMITS[lane],
                remedy="send commands more slowly",
            )
        waiting.append(job)

    def push_front(self, job: JobT, lane: Lane) -> None:
        """Give a job that has to be sent again the next turn of its lane."""
        self._jobs[lane].appendleft(job)

    def takes_probe(self) -> bool:
        """Tell whether a probe would be alone: no stop waits, and no other probe."""
        return self._probe is None and not self.stop_waits()

    def push_probe(self, job: JobT) -> None:
        """Let a job wait as the only stop would: behind every stop and in front of everything else."""
        self._probe = job

    def waiting(self, lane: Lane) -> list[JobT]:
        """Return the jobs of a lane, first to go first."""
        return list(self._jobs[lane])

    def schedule(self, poller: Poller[Any], at_s: float) -> None:
        """Let a poller have its next turn at `at_s`; replaces any turn it had."""
        self.unschedule(poller)
        serial = self._entries[poller] = next(self._serial)
        heapq.heappush(self._later, (at_s, serial, poller))

    def unschedule(self, poller: Poller[Any]) -> None:
        """Forget a poller; unknown ones are ignored."""
        if self._entries.pop(poller, None) is not None:
            self._late = [late for late in self._late if late[2] is not poller]

    def stop_waits(self) -> bool:
        """Tell whether a stop is queued that somebody waits for."""
        return any(not stop.abandoned for stop in self._jobs[Lane.STOP])

    def next_due_s(self) -> float:
        """Return when the next poller is due; infinity when there is none."""
        self._drop_stale_polls()
        if self._late:
            return self._late[0][1]
        if self._due:
            return self._due[0][1]
        return self._later[0][0] if self._later else float("inf")

    def take(self, now_s: float) -> JobT | Poller[Any] | None:
        """Remove and return what goes on the wire now, or None when nothing is due."""
        if stop := self._take_job(Lane.STOP):
            return stop
        probe, self._probe = self._probe, None
        if probe and not probe.abandoned:
            return probe
        poll_due = self._poll_is_due(now_s)
        if not (poll_due and self._commands_in_a_row >= COMMANDS_PER_POLL) and (
            command := self._take_job(Lane.COMMAND)
        ):
            self._commands_in_a_row += 1
            return command
        self._commands_in_a_row = 0
        if not poll_due or self._polls_in_a_row >= POLLS_PER_BACKGROUND:
            self._polls_in_a_row = 0
            if background := self._take_job(Lane.BACKGROUND):
                return background
        if not poll_due:
            return None
        self._polls_in_a_row += 1
        poller = self._take_chosen(self._choose, now_s) if self._choose else heapq.heappop(self._due)[3]
        del self._entries[poller]
        return poller

    def drain(self) -> list[JobT]:
        """Forget all pollers; remove and return all jobs, stops first."""
        self._entries.clear()
        self._later.clear()
        self._due.clear()
        self._late.clear()
        drained = [self._probe] if self._probe else []
        self._probe = None
        drained += [job for lane in sorted(self._jobs) for job in self._jobs[lane]]
        for waiting in self._jobs.values():
            waiting.clear()
        return drained

    def _take_chosen(self, choose: Choose, now_s: float) -> Poller[Any]:
        """Let somebody choose among those that deadlines do not tell apart."""
        self._turn += 1
        while self._due and self._due[0][0] <= now_s:
            _, at_s, _, poller = heapq.heappop(self._due)
            self._late.append((self._turn, at_s, poller))
            self._drop_stale_polls()
        if self._late:
            longest = LONGEST_ROUND * len(self._late)
            since, _, first = self._late[0]
            before = self._turn - SHORTEST_ROUND * len(self._late)
            among = [poller for turn, _, poller in self._late if turn <= before] or [first]
            chosen = first if self._turn - since >= longest else choose(among, now_s)
            self._late = [late for late in self._late if late[2] is not chosen]
            return chosen
        equal = [heapq.heappop(self._due)]
        self._drop_stale_polls()
        while len(equal) < CHOICE and self._due and self._due[0][0] == equal[0][0]:
            equal.append(heapq.heappop(self._due))
            self._drop_stale_polls()
        chosen = choose([poller for *_, poller in equal], now_s)
        for entry in equal:
            if entry[3] is not chosen:
                heapq.heappush(self._due, entry)
        return chosen

    def _take_job(self, lane: Lane) -> JobT | None:
        waiting = self._jobs[lane]
        while waiting:
            job = waiting.popleft()
            if not job.abandoned:
                return job
        return None

    def _poll_is_due(self, now_s: float) -> bool:
        """Rank those that have become due by their deadlines, and tell whether there is one."""
        while self._later and self._later[0][0] <= now_s:
            at_s, serial, poller = heapq.heappop(self._later)
            heapq.heappush(self._due, (poller.deadline_at_s, at_s, serial, poller))
        self._drop_stale_polls()
        return bool(self._due or self._late)

    def _drop_stale_polls(self) -> None:
        while self._due and self._entries.get(self._due[0][3]) != self._due[0][2]:
            heapq.heappop(self._due)
        while self._later and self._entries.get(self._later[0][2]) != self._later[0][1]:
            heapq.heappop(self._later)
