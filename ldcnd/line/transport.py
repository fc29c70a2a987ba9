"""The contract of a byte pipe: what the bus needs of a port, and nothing else.

Not a stream: bytes are pushed to one receiver as they arrive, so that a reply costs one wake-up and no task.
"""

from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Protocol

from ldcnd.line.adapter import LineErrors


class Receiver(Protocol):
    """Who gets the bytes; called on the event loop, must not block and must not raise."""

    def data_received(self, data: bytes) -> None:
        """Take the bytes that have just arrived, at least one."""

    def transport_lost(self, reason: str) -> None:
        """Learn, once, that the pipe is gone; no byte follows."""


class Transport(ABC):
    """An open byte pipe; made by an opener, closed once.

    Attributes:
        fixed_baud: the rate cannot be changed from here (a TCP serial server).
        lag_s: how much later than the line has it the next reply may come out of this pipe; known delays only.
        pushes: `push` does something.
    """

    fixed_baud = False
    lag_s = 0.0
    pushes = False

    def offers(self, baud: int) -> bool:  # noqa: ARG002 - the general answer
        """Tell whether the pipe can be set to a rate, as far as is known before it is tried."""
        return not self.fixed_baud

    def line_errors(self) -> LineErrors | None:
        """Return what the port's driver has counted; None where it counts nothing."""
        return None

    @abstractmethod
    def attach(self, receiver: Receiver) -> None:
        """Deliver all further bytes to `receiver`; what came before is dropped. Called once, straight after opening."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Hand bytes to the wire without waiting.

        Raises:
            TransportLost: the pipe is gone.
        """

    def push(self) -> None:  # noqa: B027 - most have nothing to do
        """Let what was written leave before the caller goes on with something that takes its time."""

    @abstractmethod
    def expect(self, reply_bytes: int) -> None:
        """Hint: fewer bytes than this are no reply, so one wake-up for all of them is enough. May be ignored."""

    def collect(self) -> None:  # noqa: B027 - most keep nothing back
        """Deliver now what has arrived but was kept back because of `expect`."""

    @abstractmethod
    def discard_input(self) -> None:
        """Drop every byte that has arrived but was not delivered yet."""

    @abstractmethod
    def set_baud(self, baud: int) -> None:
        """Change the rate of both directions at once; the caller has waited until everything written has left.

        Raises:
            TransportLost: the pipe is gone, or does not have this rate.
        """

    @abstractmethod
    async def close(self) -> None:
        """Give the port back; safe to call twice."""


Opener = Callable[[], Awaitable[Transport]]
"""Reopens the pipe, raising `TransportLost` with the reason when it cannot."""
