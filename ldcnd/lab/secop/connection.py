"""A connection of a SECoP client: it is answered in its order, but what takes energy out waits for nothing.

frappy-core answers one request of one client after the other, and one that waits for a drive holds up all that come
behind it. Here a thread of each connection reads ahead: a stop is sent when it is read.
"""

import queue
import threading
from collections.abc import Coroutine
from typing import Any, Protocol

from frappy.protocol.interface import decode_msg
from frappy.protocol.interface.handler import ConnectionClose
from frappy.protocol.interface.tcp import TCPRequestHandler
from frappy.protocol.messages import ERRORPREFIX

MOST_AHEAD = 1000
"""Requests of one client that may wait; one behind them is refused, unless it takes energy out."""
LONGEST_LINE = 2**16
"""Bytes of a request; whoever sends more without an end is disconnected."""

Message = tuple[str, str | None, Any]
Stops = dict[str, int]


class Calming(Protocol):
    """Carries out what takes energy out."""

    def stops(self) -> Stops:
        """Return how often each axis was stopped or switched off so far."""

    def calm(self, message: Message) -> "Coroutine[object, object, object] | None":
        """Return what carries a message out that takes energy out, None for any other; it counts from here on."""

    def carry_out(self, work: "Coroutine[object, object, object]", connection: "Connection", message: Message) -> None:
        """Begin it, and answer its client once it is done."""


class Connection(TCPRequestHandler):  # type: ignore[misc] # frappy has no types
    """One client; `handle` of frappy takes what is read from here one by one.

    Attributes:
        stops: of the request under way, how often each axis had been stopped when it was read.
    """

    def setup(self) -> None:
        """Begin to read."""
        super().setup()
        self.stops: Stops = {}
        self._node: Calming = self.server.dispatcher.srv
        self._ahead: queue.Queue[tuple[bytes, Stops] | None] = queue.Queue(MOST_AHEAD + 1)
        threading.Thread(target=self._read_ahead, name="secop reads", daemon=True).start()

    def receive(self) -> bytes:
        """Return the next request, as a line.

        Raises:
            ConnectionClose: there are no more.
        """
        read = self._ahead.get()
        if read is None:
            raise ConnectionClose("the client has gone")
        line, self.stops = read
        return line

    def _read_ahead(self) -> None:
        rest = b""
        try:
            while self.running and len(rest) < LONGEST_LINE:
                *lines, rest = (rest + (super().receive() or b"")).split(b"\n")
                for line in lines:
                    self._take(line)
        except (ConnectionClose, OSError):
            pass
        finally:
            self._ahead.put(None)  # it has a place of its own

    def _take(self, line: bytes) -> None:
        message: Message | None = None
        try:
            message = decode_msg(line)
            work = self._node.calm(message)
        except (ValueError, UnicodeError):  # frappy says what is wrong with it
            work = None
        if work is not None and message is not None:
            self._node.carry_out(work, self, message)
        elif self._ahead.qsize() < MOST_AHEAD:
            self._ahead.put((line + b"\n", self._node.stops()))
        elif message is not None:
            error = ["IsBusy", f"{MOST_AHEAD} requests of this connection wait already", {}]
            self.send_reply((ERRORPREFIX + message[0], message[1], error))

    def finish(self) -> None:
        """End what reads, too."""
        self.running = False
        super().finish()
