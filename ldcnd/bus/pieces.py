"""Replies that arrive in pieces, or with something in front of them or behind."""

from dataclasses import dataclass
from typing import Any

from ldcnd.exchange import Exchange

CLOCK_TOLERANCE = 0.9
"""A drive's baud clock may be 3 % fast and a time stamp a little early: bytes count as too early below this share."""


@dataclass(frozen=True, slots=True)
class Whole:
    """As many bytes as make a reply.

    Attributes:
        reply: these bytes.
        surplus: what came behind them.
        early: some came sooner than the wire can carry them.
    """

    reply: bytes
    surplus: bytes
    early: bool


class Pieces:
    """The bytes of a reply so far.

    Attributes:
        held: these bytes.
        early: some came sooner than the wire can carry them.
    """

    __slots__ = ("_byte_s", "_over_s", "early", "held")

    def __init__(self) -> None:
        self.held = b""
        self.early = False
        self._over_s = self._byte_s = 0.0

    def begin(self, sent_at_s: float, request_s: float, byte_s: float) -> None:
        """Forget what came; wait for the reply to a request.

        Args:
            sent_at_s: when that was handed over; minus infinity on a line where nothing can come too early.
            request_s: how long it takes on the wire.
            byte_s: how long each byte of the reply takes.
        """
        self.held, self.early = b"", False
        self._over_s, self._byte_s = sent_at_s + CLOCK_TOLERANCE * request_s, CLOCK_TOLERANCE * byte_s

    def earliest_s(self, count: int) -> float:
        """Return the earliest instant at which so many bytes can have come behind the request."""
        return self._over_s + count * self._byte_s

    def add(self, exchange: Exchange[Any], data: bytes, now_s: float) -> Whole | None:
        """Add bytes that have just arrived; return the reply once it is whole."""
        data = self.held + data
        self.early = self.early or now_s < self.earliest_s(len(data))
        total = exchange.total_bytes(data) if exchange.total_bytes else exchange.reply_bytes
        if total is None or len(data) < total:
            self.held = data
            return None
        whole = Whole(data[:total], data[total:], self.early)
        self.held, self.early = b"", False
        return whole
