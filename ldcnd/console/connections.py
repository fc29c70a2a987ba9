"""HTTP connections of the console: bounded in number and in time, so that a stop is accepted whatever others do.

uvicorn bounds the time between two requests only: a request of which half was sent would stay for ever.
"""

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS = 100
"""Without web sockets. One more takes the place of the one that has been waiting for a request for longest."""
HEAD_TIME_S = 10.0
"""From the connection, or from the answer before, until the next request has come with all its headers."""
BUSY_TIME_S = 90.0
"""From then until its answer has been taken; the longest command has 60 s."""
HANDSHAKE_TIME_S = 5.0
"""For TLS."""


class BoundedH11(H11Protocol):
    """One connection."""

    _limit: asyncio.TimerHandle | None = None
    _was_busy = False
    _upgraded = False

    @property
    def busy(self) -> bool:
        """Whether a request is under way."""
        # None before the first request, whatever the annotation of uvicorn says
        return bool(self.cycle) and not self.cycle.response_complete

    @property
    def since_s(self) -> float:
        """When it began to wait for a request, or to answer one, in loop time."""
        return self._limit.when() if self._limit else self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to count; with too many, the one that waits for longest gives way."""
        super().connection_made(transport)
        self._set_limit(HEAD_TIME_S)
        waiting = [each for each in self.connections if isinstance(each, BoundedH11)]
        if len(waiting) > MOST_CONNECTIONS:
            idle = [each for each in waiting if not each.busy]
            min(idle, key=lambda each: each.since_s).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._end_limit()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take a part of a request."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand over to the web socket, which has limits of its own."""
        self._upgraded = True
        self._end_limit()
        super().handle_websocket_upgrade(event)

    def _watch(self) -> None:
        if self.busy is not self._was_busy and not self._upgraded:
            self._was_busy = self.busy
            self._set_limit(BUSY_TIME_S if self.busy else HEAD_TIME_S)

    def _set_limit(self, seconds: float) -> None:
        self._end_limit()
        self._limit = self.loop.call_later(seconds, self.transport.abort)

    def _end_limit(self) -> None:
        if self._limit:
            self._limit.cancel()
            self._limit = None
