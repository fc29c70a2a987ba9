"""How a line gets back in step after a lost or damaged reply."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

from ldcnd.bus.queue import Lane
from ldcnd.bus.turn import Turn
from ldcnd.errors import BadReply, BusError
from ldcnd.exchange import Exchange, Timing


def _no_probe(_avoid: AbstractSet[int]) -> None:
    return None


@dataclass(frozen=True, slots=True)
class Resync:
    """The fence between a reply that went wrong and the next request; the family's driver supplies it.

    The bus waits until the line has been quiet for `quiet_s`, sends `flush`, waits `settle_s`, drops what has come in,
    and runs the probe: an exchange whose reply is known beforehand and has an unusual length, so that a late reply
    cannot pass for it.

    Attributes:
        flush: bytes that end any half-received packet and draw no reply.
        quiet_s: silence after which no late reply can come any more.
        settle_s: pause after the flush.
        probe: returns such an exchange with a node outside the given ones if it can, None when it knows no node. Its
            `decode` raises `BadReply` when the reply is not the known one.
    """

    flush: bytes = b""
    quiet_s: float = 0.005
    settle_s: float = 0.0
    probe: Callable[[AbstractSet[int]], Exchange[Any] | None] = _no_probe


class Probe(Turn):
    """The line's own exchange behind the fence."""

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
        """See `Turn`; the line probes again by itself."""
        return False

    def rejected(self) -> bool:
        """See `Turn`; an intact refusal proves nothing, the line probes again by itself."""
        return False


PROBE_ROUNDS = 3
LONGEST_FENCE = 20
"""A line that never falls silent is flushed after so many quiet times all the same."""


class Fence:
    """What must happen before a line is used again.

    Attributes:
        in_step: nothing has happened since the last proof that leaves it open whose a reply is.
    """

    def __init__(self, resync: Resync) -> None:
        self.in_step = True
        self._resync = resync
        self._rounds_left = 0
        self._since_s = 0.0

    def doubt(self) -> None:
        """Something has happened: the line must prove that it is in step."""
        self._rounds_left, self.in_step = PROBE_ROUNDS, False

    def proven(self) -> None:
        """The known reply has come."""
        self._rounds_left, self.in_step = 0, True

    def raised(self, now_s: float) -> float:
        """Begin to wait for silence; return until when, if no byte comes."""
        self._since_s = now_s
        return now_s + self._resync.quiet_s

    def disturbed(self, now_s: float) -> float:
        """Note bytes in the silence; return until when to wait now."""
        quiet_s = self._resync.quiet_s
        return min(now_s + quiet_s, self._since_s + LONGEST_FENCE * quiet_s)

    def probe(self, avoid: AbstractSet[int], now_s: float) -> Probe | None:
        """Return the next proof to attempt; None when none is needed, or when no node is known that could give one."""
        if self.in_step:
            return None
        exchange = self._resync.probe(avoid)
        self._rounds_left = self._rounds_left - 1 if exchange else 0
        self.in_step = self._rounds_left == 0
        return Probe(exchange, now_s) if exchange else None
