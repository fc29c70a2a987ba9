"""Which exchange goes on the wire next: four lanes and a fairness bound. Pure: knows no clock and no wire."""

from collections import deque
from enum import IntEnum
from typing import Any, Generic, Protocol, TypeVar

from ldcnd.bus.poll_queue import PollQueue
from ldcnd.bus.poll_rank import Choose
from ldcnd.bus.poller import Poller
from ldcnd.errors import BusBusy


class Lane(IntEnum):
    """Priorities, highest first."""

    STOP = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


STOP, COMMAND, POLL, BACKGROUND = Lane  # Lane.STOP is looked up slowly, and turns are taken between two packets


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
LANE_LIMITS = {Lane.STOP: 256, Lane.COMMAND: 64, Lane.BACKGROUND: 64}


class ExchangeQueue(Generic[JobT]):
    """Jobs of three lanes, first in first out, and the pollers of the fourth, see `PollQueue`.

    A stop goes before everything. Commands go before polls, but a due poll waits for at most `COMMANDS_PER_POLL`
    commands; background jobs wait for at most `POLLS_PER_BACKGROUND` polls.
    """

    def __init__(self, choose: Choose | None = None) -> None:
        self._choose = choose
        self._polls = PollQueue(choose)
        self._probe: JobT | None = None
        self._jobs: dict[Lane, deque[JobT]] = {lane: deque() for lane in LANE_LIMITS}
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
        self._polls.schedule(poller, at_s)

    def unschedule(self, poller: Poller[Any]) -> None:
        """Forget a poller; unknown ones are ignored."""
        self._polls.unschedule(poller)

    def stop_waits(self) -> bool:
        """Tell whether a stop is queued that somebody waits for."""
        return any(not stop.abandoned for stop in self._jobs[Lane.STOP])

    def next_due_s(self) -> float:
        """Return when the next poller is due; infinity when there is none."""
        return self._polls.next_due_s()

    def take_job(self, now_s: float) -> JobT | None:
        """Remove and return the job that goes on the wire now, or None when it is a poll's turn or nothing is due."""
        if self._probe is None and not any(self._jobs.values()):  # as nearly always, and this is between two packets
            self._commands_in_a_row = 0
            return None
        if stop := self._take_job(STOP):
            return stop
        probe, self._probe = self._probe, None
        if probe and not probe.abandoned:
            return probe
        poll_due = self._polls.is_due(now_s)
        if not (poll_due and self._commands_in_a_row >= COMMANDS_PER_POLL) and (command := self._take_job(COMMAND)):
            self._commands_in_a_row += 1
            return command
        self._commands_in_a_row = 0
        if not poll_due or self._polls_in_a_row >= POLLS_PER_BACKGROUND:
            self._polls_in_a_row = 0
            return self._take_job(BACKGROUND)
        self._polls_in_a_row += 1
        return None

    def take_poll(self, now_s: float) -> Poller[Any] | None:
        """Remove and return the poller whose turn it is when no job goes, or None when none is due."""
        return self._polls.take(now_s) if self._polls.is_due(now_s) else None

    def look_ahead(self, at_s: float) -> Poller[Any] | None:
        """Choose the next poll ahead, see `PollQueue`; jobs may still go before it."""
        return self._polls.look_ahead(at_s)

    def drain(self) -> list[JobT]:
        """Forget all pollers; remove and return all jobs, stops first."""
        self._polls = PollQueue(self._choose)
        drained = [self._probe] if self._probe else []
        self._probe = None
        drained += [job for lane in sorted(self._jobs) for job in self._jobs[lane]]
        for waiting in self._jobs.values():
            waiting.clear()
        return drained

    def _take_job(self, lane: Lane) -> JobT | None:
        waiting = self._jobs[lane]
        while waiting:
            job = waiting.popleft()
            if not job.abandoned:
                return job
        return None
