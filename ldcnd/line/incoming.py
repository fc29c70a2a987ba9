"""The receiving side of a port that asyncio reads: bytes go on as they come, the loss is reported once."""

import asyncio

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.transport import Receiver

MOST_HEARD = 120


class Incoming(asyncio.Protocol):
    """Stands between an asyncio transport and the port's receiver.

    Attributes:
        reason: why the port can no longer be used; empty while it can.
        heard: the first bytes of the far end, which may be words for people.
        ended: set once asyncio has let go of the port: no byte follows, and the descriptor is about to be closed.
    """

    def __init__(self, name: str) -> None:
        self.reason = ""
        self.heard = bytearray()
        self.ended = asyncio.Event()
        self._name = name
        self._receiver: Receiver | None = None  # no receiver before `attach` and after `detach`

    def attach(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on; a port that is lost already is reported from the loop, not from here."""
        self._receiver = receiver
        if self.ended.is_set():
            asyncio.get_running_loop().call_soon(self._report)

    def detach(self) -> None:
        """Deliver nothing more, not even the end: the port is being closed on purpose."""
        self.reason = self.reason or f"{self._name} is closed"
        self._receiver = None

    def lost(self, why: str) -> TransportLost:
        """Note the first reason for which the port can no longer be used; return it as an error."""
        self.reason = self.reason or f"{self._name} was lost: {why}"
        return TransportLost(self.reason, remedy="check the adapter and its cable; the port is opened again by itself")

    def hear(self, data: bytes) -> None:
        """Keep the first bytes that came, also of those that are dropped."""
        if len(self.heard) < MOST_HEARD:
            self.heard += data[: MOST_HEARD - len(self.heard)]

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
