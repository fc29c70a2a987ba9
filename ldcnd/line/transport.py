"""The contract of a byte pipe: what the bus needs of a port, and nothing else.

Not a stream: bytes are pushed to one receiver as they arrive, so that a reply costs one wake-up and no task.
`Incoming` is the receiving side of a port that asyncio reads.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Literal, Protocol

from pydantic import Field
from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.contract.frozen import Frozen
from ldcnd.line.adapter import LineErrors

ENABLED, RTS_ON_SEND, RTS_AFTER_SEND, RX_DURING_TX, TERMINATE_BUS = 1, 2, 4, 16, 32
"""Flags of `struct serial_rs485`."""
LONGEST_RTS_DELAY_MS = 100
"""The kernel's serial core shortens longer ones."""

Framing = Literal["8n1", "7e1"]


class Rs485Config(Frozen):
    """Direction control of an RS-485 transmitter by the kernel, which switches RTS around each packet."""

    rts_on_send: bool = True
    """RTS is on while sending and off otherwise; false for ports that are wired the other way round."""
    before_ms: int = Field(default=0, ge=0, le=LONGEST_RTS_DELAY_MS)
    """Time from switching the transmitter on to the first bit, in ms."""
    after_ms: int = Field(default=0, ge=0, le=LONGEST_RTS_DELAY_MS)
    """Time from the last bit to switching the transmitter off, in ms."""
    receive_own: bool = False
    """The receiver stays on while sending: on two wires the host then receives its own bytes, see `echo`."""
    terminate: bool = False
    """Switch on the terminating resistor of a port that has one."""

    @property
    def flags(self) -> int:
        """As in `struct serial_rs485`."""
        flags = ENABLED | (RTS_ON_SEND if self.rts_on_send else RTS_AFTER_SEND)
        flags |= RX_DURING_TX if self.receive_own else 0
        return flags | (TERMINATE_BUS if self.terminate else 0)


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


MOST_HEARD = 120


class Incoming(asyncio.Protocol):
    """Stands between an asyncio transport and the port's receiver.

    Attributes:
        name: of the port.
        reason: why the port can no longer be used; empty while it can.
        heard: the first bytes of the far end, which may be words for people.
        ended: set once asyncio has let go of the port: no byte follows, and the descriptor is about to be closed.
    """

    def __init__(self, name: str) -> None:
        self.reason = ""
        self.heard = bytearray()
        self.ended = asyncio.Event()
        self.name = name
        self._receiver: Receiver | None = None  # no receiver before `attach` and after `detach`

    def attach(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on; a port that is lost already is reported from the loop, not from here."""
        self._receiver = receiver
        # a server that closes at once has done so before the line is there
        if self.ended.is_set():
            asyncio.get_running_loop().call_soon(self._report)

    def detach(self) -> None:
        """Deliver nothing more, not even the end: the port is being closed on purpose."""
        self.reason = self.reason or f"{self.name} is closed"
        self._receiver = None

    def lost(self, why: str) -> TransportLost:
        """Note the first reason for which the port can no longer be used; return it as an error."""
        self.reason = self.reason or f"{self.name} was lost: {why}"
        return TransportLost(self.reason, remedy="check the adapter and its cable; the port is opened again by itself")

    def hear(self, data: bytes) -> None:
        """Keep the first bytes that came, also of those that are dropped."""
        if len(self.heard) < MOST_HEARD:
            self.heard += data[: MOST_HEARD - len(self.heard)]

    def drop(self, data: bytes) -> None:
        """Deliver nothing of what came before it was wanted."""
        self.hear(data)

    def _words(self) -> str:
        """Return what the far end has said before it closed, if it was text: serial servers say why they do."""
        said = " ".join(self.heard.decode("ascii", errors="ignore").split())
        return f", saying {said!r}" if said and said.isprintable() and self.heard.isascii() else ""

    @override
    def data_received(self, data: bytes) -> None:
        self.hear(data)
        if self._receiver and not self.reason:
            self._receiver.data_received(data)

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self.lost(str(exc) if exc else f"the far end closed it{self._words()}")
        self.ended.set()
        self._report()

    def _report(self) -> None:
        receiver, self._receiver = self._receiver, None
        if receiver:
            receiver.transport_lost(self.reason)
