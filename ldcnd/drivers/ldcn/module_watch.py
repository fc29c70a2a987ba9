"""Asks a module that is no axis for its status byte now and then, so that its loss is noticed."""

import asyncio

from ldcnd.bus.poller import Poller, next_on_grid
from ldcnd.drivers.ldcn import commands
from ldcnd.drivers.ldcn.destinations import Node
from ldcnd.drivers.ldcn.identities import ANY_DIALECT
from ldcnd.drivers.ldcn.status import STATUS_BYTE_ONLY, Status
from ldcnd.errors import BusError
from ldcnd.exchange import Exchange, Timing

PERIOD_S = 1.0


class ModuleWatch(Poller[Status]):
    """One module's status byte.

    Attributes:
        status: the latest, 0 to 255; None while it does not answer.
    """

    def __init__(self, address: int) -> None:
        self.node = address
        self.status: int | None = None
        self.due_at_s = asyncio.get_running_loop().time()
        self.deadline_at_s = self.due_at_s + PERIOD_S
        self._exchange = commands.read_status(Node(address, ANY_DIALECT), STATUS_BYTE_ONLY)

    def next_exchange(self, now_s: float) -> Exchange[Status]:
        """See `Poller`; a late turn does not shift the next one."""
        self.due_at_s = next_on_grid(self.due_at_s, PERIOD_S, now_s)
        self.deadline_at_s = self.due_at_s + PERIOD_S
        return self._exchange

    def deliver(self, reply: Status, timing: Timing) -> None:  # noqa: ARG002 - part of the contract
        """See `Poller`."""
        self.status = int(reply.flags)

    def missed(self, error: BusError) -> None:  # noqa: ARG002 - part of the contract
        """See `Poller`."""
        self.status = None
