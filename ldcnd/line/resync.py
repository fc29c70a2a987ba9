"""How a line gets back in step after a lost or damaged reply."""

from collections.abc import Set as AbstractSet
from typing import Any

from ldcnd.contract.errors import BadReply, BusError
from ldcnd.line.exchange import Exchange, Lane, Resync, Timing
from ldcnd.line.transaction import Transaction


class ResyncExchange(Transaction):
    """The line's own exchange at the end of a resynchronisation."""

    __slots__ = ("passed",)
    proves = True

    def __init__(self, exchange: Exchange[Any], at_s: float) -> None:
        super().__init__(exchange, Lane.STOP, at_s)
        self.passed = False

    def completed(self, reply: bytes, timing: Timing) -> None:  # noqa: ARG002 - part of the contract
        """Judge the reply by its content."""
        try:
            self.exchange.decode(reply)
        except BadReply:
            return
        self.passed = True

    def lost(self, error: BusError) -> bool:  # noqa: ARG002 - part of the contract
        """See `Transaction`; the line probes again by itself."""
        return False

    def rejected(self) -> bool:
        """See `Transaction`; an intact refusal proves nothing, the line probes again by itself."""
        return False


PROBE_ROUNDS = 3
LONGEST_QUARANTINE = 20
"""Longest wait for silence, in multiples of `quiet_s`; a line that is never silent is flushed after that."""


class Quarantine:
    """Progress of a resynchronisation: the steps before a line is used again.

    Attributes:
        in_step: since the last proof nothing has happened that makes it uncertain to which request a reply belongs.
    """

    def __init__(self, resync: Resync) -> None:
        self.in_step = True
        self._resync = resync
        self._rounds_left = 0
        self._since_s = 0.0

    def require(self) -> None:
        """Require a proof that the line is in step."""
        self._rounds_left, self.in_step = PROBE_ROUNDS, False

    def proven(self) -> None:
        """Note that the known reply has arrived."""
        self._rounds_left, self.in_step = 0, True

    def raised(self, now_s: float) -> float:
        """Begin to wait for silence; return the end of the wait if no byte arrives, in loop time."""
        self._since_s = now_s
        return now_s + self._resync.quiet_s

    def disturbed(self, now_s: float) -> float:
        """Note bytes during the silence; return the new end of the wait, in loop time."""
        quiet_s = self._resync.quiet_s
        return min(now_s + quiet_s, self._since_s + LONGEST_QUARANTINE * quiet_s)

    def probe(self, avoid: AbstractSet[int], now_s: float) -> ResyncExchange | None:
        """Return the next proof to attempt; None when none is needed, or when there is no node to probe."""
        if self.in_step:
            return None
        exchange = self._resync.probe(avoid)
        self._rounds_left = self._rounds_left - 1 if exchange else 0
        self.in_step = self._rounds_left == 0
        return ResyncExchange(exchange, now_s) if exchange else None
