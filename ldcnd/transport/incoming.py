"""The receiving side of a port that asyncio reads: bytes go on as they come, the loss is reported once."""

import asyncio

from typing_extensions import override

from ldcnd.errors import TransportLost
from ldcnd.transport.transport import Receiver


class Incoming(asyncio.Protocol):
    """Stands between an asyncio transport and the port's receiver.

    Attributes:
        reason: why the port can no longer be used; empty while it can.
        ended: set once asyncio has let go of the port: no byte follows, and the descriptor is about to be closed.
    """

    def __init__(self, name: str) -> None:
        self.reason = ""
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

    @override
    def data_received(self, data: bytes) -> None:
        if self._receiver and not self.reason:
            self._receiver.data_received(data)

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self.lost(str(exc) if exc else "the far end closed it")
        self.ended.set()
        self._report()

    def _report(self) -> None:
        receiver, self._receiver = self._receiver, None
        if receiver:
            receiver.transport_lost(self.reason)
