"""A turn of an exchange queue, as the bus takes it."""

from typing import Any, TypeVar

from ldcnd.line.exchange import Poller
from ldcnd.line.queue import ExchangeQueue, Queueable

JobT = TypeVar("JobT", bound=Queueable)


def take(queue: ExchangeQueue[JobT], now_s: float) -> JobT | Poller[Any] | None:
    """Remove and return what goes on the wire now, or None when nothing is due."""
    return queue.take_job(now_s) or queue.polls.take(now_s)
