"""Periodic exchanges: the interface between the bus and its pollers.

The bus takes the next exchange of a poller only when the line is free for it, so an overloaded line delays polls but
never queues several of one poller.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Generic, TypeVar

from ldcnd.contract.errors import BusError
from ldcnd.contract.samples import TelemetryItem
from ldcnd.line.exchange import Exchange, Timing

ReplyT = TypeVar("ReplyT")

NO_DEADLINE_S = float("inf")
"""Deadline of a poll that only uses time left by all other polls; it is never late."""


def next_on_grid(due_s: float, period_s: float, now_s: float) -> float:
    """Return the first due time after `now_s` that is whole periods, at least one, behind `due_s`."""
    behind = max(0, int((now_s - due_s) / period_s))
    return due_s + (behind + 1) * period_s


class Priority(IntEnum):
    """Order of polls on a line that has fallen behind, highest first."""

    HIGH = 0
    NORMAL = 1
    LOW = 2


class Poller(ABC, Generic[ReplyT]):
    """One periodic user of the line; every method runs on the event loop, returns at once and never raises.

    Attributes:
        node: the node that it polls; one that does not reply is polled less and less often.
        due_at_s: when its next slot is due, in loop time; read by the bus after each slot.
        deadline_at_s: when that slot should be over; of those that are due, the earliest deadline goes first.
        priority: its rank while the line cannot carry all polls; does not change while it waits for a slot.
        rates_hz: rate at which it reads each telemetry item; empty for one that reads none.
        slow_to_deliver: processing a reply takes long, so the next request is sent first, and several may be processed
            together; see `Line`.
    """

    node: int
    due_at_s: float
    deadline_at_s: float = 0.0
    priority: Priority = Priority.NORMAL
    rates_hz: Mapping[TelemetryItem, float] = MappingProxyType({})
    slow_to_deliver: bool = False

    def prepare(self, at_s: float) -> None:
        """Prepare the next exchange, which takes time; the next slot is expected at about that instant."""

    @abstractmethod
    def next_exchange(self, now_s: float) -> Exchange[ReplyT]:
        """Return the exchange to run now and move `due_at_s` on."""

    @abstractmethod
    def deliver(self, reply: ReplyT, timing: Timing) -> None:
        """Take the decoded reply; the next request is on the wire already."""

    @abstractmethod
    def missed(self, error: BusError) -> None:
        """Note that this slot brought no reply."""
