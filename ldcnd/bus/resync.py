"""How a line gets back in step after a lost or damaged reply."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

from ldcnd.bus.exchange_queue import Lane
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
    plain = False

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
