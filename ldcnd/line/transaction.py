"""One exchange on its way over a line, and what becomes of it: the line's own and polls; `bus` has those of callers."""

from typing import Any

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError, LdcndError, PacketRejected
from ldcnd.line.exchange import Exchange, Lane, Poller, Timing
from ldcnd.line.proof import Condition
from ldcnd.line.schedule import POLL


class Transaction:
    """One exchange on its way over the wire; exactly one of the outcomes is reported for each time it is sent.

    This one is of no caller: the line sends it itself, to prove that it is in step.

    Attributes:
        exchange: request and expected reply.
        lane: the lane in which it waited.
        wanted_at_s: when it was queued or due, in loop time.
        then_baud: the rate to use from the end of this exchange on; None for the present one.
        at_baud: the rate of this exchange alone; None for the line's.
        slow_to_deliver: processing the reply takes long, and can wait for those after it.
        condition: raises what forbids to send it, when its turn has come; None where nothing can.
        poller: whose poll it is; None for all else.
        proves: the content of the reply proves that the line is in step.
        guest: who has caused it, by the name of a port; empty for clients and the daemon.
    """

    __slots__ = ("at_baud", "exchange", "lane", "slow_to_deliver", "then_baud", "wanted_at_s")
    condition: Condition | None = None
    poller: Poller[Any] | None = None
    proves = True
    guest = ""

    def __init__(self, exchange: Exchange[Any], lane: Lane, wanted_at_s: float) -> None:
        self.exchange = exchange
        self.lane = lane
        self.wanted_at_s = wanted_at_s
        self.then_baud: int | None = None
        self.at_baud: int | None = None
        self.slow_to_deliver = False

    @property
    def abandoned(self) -> bool:
        """Whether no caller waits for the outcome."""
        return False

    @property
    def doubted(self) -> bool:
        """Whether the last time that it was sent, a reply came that may have been to something older."""
        return False

    def doubt(self) -> None:
        """Note that the reply which has come may have been to something older."""

    def may_go(self, now_s: float) -> bool:  # noqa: ARG002 - the general answer
        """Check the condition directly before sending; if it fails, that is the outcome."""
        return True

    def fail(self, error: LdcndError) -> None:
        """Give the caller the error, if there is one who waits."""

    def refuse(self, error: LdcndError) -> None:
        """Give the caller what forbids to send it, with what became of it before."""
        self.fail(error)

    def completed(self, reply: bytes, timing: Timing) -> None:
        """Take the intact reply (empty when none was due); the next request is on the wire already."""

    def lost(self, error: BusError) -> bool:  # noqa: ARG002 - the line repeats its own by itself
        """Note that no reply is valid any more; return whether to send the exchange again."""
        return False

    def give_up(self) -> None:
        """Send it no more."""

    def rejected(self) -> bool:
        """Note that the node did not execute the packet; return whether to send it again."""
        return False


class PollTransaction(Transaction):
    """A poll; it is never sent again, because the next poll comes soon enough."""

    __slots__ = ("poller",)
    proves = False

    def __init__(self, poller: Poller[Any], exchange: Exchange[Any], wanted_at_s: float) -> None:
        self.exchange, self.lane, self.wanted_at_s = exchange, POLL, wanted_at_s  # one call less for each poll
        self.then_baud = self.at_baud = None
        self.slow_to_deliver = poller.slow_to_deliver
        self.poller: Poller[Any] = poller

    @override
    def completed(self, reply: bytes, timing: Timing) -> None:
        try:
            value = self.exchange.decode(reply)
        except BadReply as error:
            self.poller.missed(error)
            return
        self.poller.deliver(value, timing)

    @override
    def lost(self, error: BusError) -> bool:
        self.poller.missed(error)
        return False

    @override
    def rejected(self) -> bool:
        self.poller.missed(PacketRejected(f"node {self.exchange.node} received a damaged packet"))
        return False
