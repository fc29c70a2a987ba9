"""An exchange with the receiver of its outcome, and the condition under which it may still be sent."""

import asyncio
from abc import ABC, abstractmethod
from typing import Any

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError, LdcndError, OutcomeUnknown, PacketRejected, ReplyTimeout
from ldcnd.line.exchange import Exchange, Lane, Timing
from ldcnd.line.flight_recorder import AT_ONCE_REMARK
from ldcnd.line.proof import Condition

LANES = tuple(lane.name.lower() for lane in Lane)
"""Remarks of the wire log about packets, by lane."""
AT_ONCE = tuple(f"{lane}{AT_ONCE_REMARK}" for lane in LANES)
"""The same for packets that waited for the reply before them."""


class Transaction(ABC):
    """One exchange on its way over the wire; exactly one of the outcomes is reported for each time it is sent.

    Attributes:
        exchange: request and expected reply.
        lane: the lane in which it waited.
        wanted_at_s: when it was queued or due, in loop time.
        then_baud: the rate to use from the end of this exchange on; None for the present one.
        at_baud: the rate of this exchange alone; None for the line's.
        slow_to_deliver: processing the reply takes long, and can wait for those after it.
    """

    __slots__ = ("at_baud", "exchange", "lane", "slow_to_deliver", "then_baud", "wanted_at_s")
    proves = False
    """Whether the line judges the content of the reply itself."""

    def __init__(self, exchange: Exchange[Any], lane: Lane, wanted_at_s: float) -> None:
        self.exchange = exchange
        self.lane = lane
        self.wanted_at_s = wanted_at_s
        self.then_baud: int | None = None
        self.at_baud: int | None = None
        self.slow_to_deliver = False

    @abstractmethod
    def completed(self, reply: bytes, timing: Timing) -> None:
        """Take the intact reply (empty when none was due); the next request is on the wire already."""

    @abstractmethod
    def lost(self, error: BusError) -> bool:
        """Note that no reply is valid any more; return whether to send the exchange again."""

    @abstractmethod
    def rejected(self) -> bool:
        """Note that the node did not execute the packet; return whether to send it again."""


class Job(Transaction):
    """An exchange that a caller waits for; its future gets exactly one outcome, `timing` says when that was."""

    __slots__ = ("attempts", "attempts_left", "condition", "future", "timing")

    def __init__(
        self,
        exchange: Exchange[Any],
        lane: Lane,
        wanted_at_s: float,
        future: "asyncio.Future[Any]",
        *,
        attempts: int,
        condition: Condition | None = None,
    ) -> None:
        super().__init__(exchange, lane, wanted_at_s)
        self.condition = condition
        self.future = future
        self.timing: Timing | None = None
        self.attempts = attempts
        self.attempts_left = attempts

    @property
    def abandoned(self) -> bool:
        """Whether no caller waits for the outcome."""
        return self.future.done()

    def may_go(self) -> bool:
        """Check the condition directly before sending; if it fails, the caller gets the reason."""
        if self.condition is None:
            return True
        try:
            self.condition()
        except LdcndError as error:
            self.fail(error)
            return False
        return True

    def fail(self, error: LdcndError) -> None:
        """Give the caller the error, unless it has gone."""
        if not self.future.done():
            self.future.set_exception(error)

    @override
    def completed(self, reply: bytes, timing: Timing) -> None:
        if self.future.done():
            return
        try:
            value = self.exchange.decode(reply)
        except BadReply as error:
            self.fail(error)
            return
        self.timing = timing
        self.future.set_result(value)

    @override
    def lost(self, error: BusError) -> bool:
        exchange = self.exchange
        if not exchange.repeatable:
            self.fail(
                OutcomeUnknown(
                    f"{error.message}; the packet {exchange.request.hex(' ')} must not be repeated and may or may not"
                    " have been executed",
                    remedy="read the axis state before anything else",
                )
            )
            return False
        if self.attempts_left > 0:
            return True
        self.fail(
            ReplyTimeout(
                f"no intact reply in {self.attempts} attempts: {error.message}",
                remedy="check the drive's power and address, and the cable",
            )
        )
        return False

    @override
    def rejected(self) -> bool:
        if self.attempts_left > 0:
            return True
        self.fail(
            PacketRejected(
                f"node {self.exchange.node} received {self.attempts} damaged packets and executed none of them",
                remedy="check cable, termination and baud rate",
            )
        )
        return False


class StopProbe(Job):
    """A harmless exchange in the place of a stop, to measure how long a stop would wait."""

    __slots__ = ()
