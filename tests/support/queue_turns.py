"""A turn of a schedule, as the line takes it."""

from typing import Any, TypeVar

from ldcnd.line.exchange import Poller
from ldcnd.line.schedule import Choose, PollQueue, Queueable, Schedule

JobT = TypeVar("JobT", bound=Queueable)


def take(queue: Schedule[JobT], now_s: float) -> JobT | Poller[Any] | None:
    """Remove and return what goes on the wire now, or None when nothing is due."""
    return queue.take_job(now_s) or queue.polls.take(now_s)


def schedule_by(choose: Choose | None) -> Schedule[Any]:
    """Return a schedule whose polls are ordered by a function where deadlines leave a choice."""
    schedule: Schedule[Any] = Schedule()
    schedule.polls = PollQueue(choose)
    return schedule
