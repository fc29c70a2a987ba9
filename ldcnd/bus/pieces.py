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
    """The bytes of a reply so far."""

    __slots__ = ("_byte_s", "_early", "_held", "_over_s")

    def __init__(self) -> None:
        self._held = b""
        self._early = False
        self._over_s = self._byte_s = 0.0

    def __len__(self) -> int:
        """Return how many bytes there are."""
        return len(self._held)

    def begin(self, request_over_s: float, byte_s: float) -> None:
        """Forget what came; wait for the reply to a request that is over at that instant."""
        self._held, self._early = b"", False
        self._over_s, self._byte_s = request_over_s, CLOCK_TOLERANCE * byte_s

    def earliest_s(self, count: int) -> float:
        """Return the earliest instant at which so many bytes can have come behind the request."""
        return self._over_s + count * self._byte_s

    def add(self, exchange: Exchange[Any], data: bytes, now_s: float) -> Whole | None:
        """Add bytes that have just arrived; return the reply once it is whole."""
        data = self._held + data
        self._early = self._early or now_s < self.earliest_s(len(data))
        total = exchange.total_bytes(data) if exchange.total_bytes else exchange.reply_bytes
        if total is None or len(data) < total:
            self._held = data
            return None
        whole = Whole(data[:total], data[total:], self._early)
        self._held, self._early = b"", False
        return whole
