"""Faults of a simulated line: what may go wrong, how often, when; seeded, so that a run can be repeated bit by bit."""

import math
import random
from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """Kinds of faults of one request or one reply, or of the line when a request is sent."""

    REQUEST_LOST = "request_lost"
    REQUEST_BYTE_LOST = "request_byte_lost"
    REQUEST_BIT_FLIPPED = "request_bit_flipped"
    REPLY_LOST = "reply_lost"
    REPLY_BYTE_LOST = "reply_byte_lost"
    REPLY_BIT_FLIPPED = "reply_bit_flipped"
    REPLY_FALSIFIED = "reply_falsified"
    """Two bytes of a reply change so that its checksum, the sum of the bytes before it, holds."""
    REPLY_DELAYED = "reply_delayed"
    REPLY_DUPLICATED = "reply_duplicated"
    UNPLUGGED = "unplugged"
    """The adapter disappears when the request is sent."""
    ECHO = "echo"
    """The host receives its own request."""


@dataclass(frozen=True, slots=True)
class LineFault:
    """One thing that may go wrong.

    Attributes:
        probability: of it happening to one request or reply, 0 to 1.
        from_s: the fault is possible from this instant of the line's clock on,
        until_s: and before this one.
        longest_s: for `REPLY_DELAYED` the longest delay, for `UNPLUGGED` the duration.
    """

    kind: FaultKind
    probability: float = 1.0
    from_s: float = -math.inf
    until_s: float = math.inf
    longest_s: float = 0.0


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """Everything that may go wrong on one line, and the seed of the dice."""

    faults: tuple[LineFault, ...] = ()
    seed: int = 1


@dataclass(frozen=True, slots=True)
class FaultyRequest:
    """A request after the faults.

    Attributes:
        values: the bytes that reach the modules; None in the place of a lost one.
        echoed: the host receives its own bytes.
        unplugged_s: for how long the adapter disappears; 0 when it stays.
    """

    values: tuple[int | None, ...]
    echoed: bool = False
    unplugged_s: float = 0.0


@dataclass(frozen=True, slots=True)
class FaultyReply:
    """A reply after the faults; `delay_s` is added between the wire and the host, like a sluggish adapter does."""

    data: bytes
    delay_s: float = 0.0
    copies: int = 1


class FaultInjector:
    """Plays a plan: the same requests and replies at the same times meet the same faults."""

    def __init__(self, plan: FaultPlan) -> None:
        self._faults = plan.faults
        self._dice = random.Random(plan.seed)  # noqa: S311 - reproducible on purpose

    def begin(self, fault: LineFault) -> None:
        """Add something to the plan."""
        self._faults = (*self._faults, fault)

    def end(self, fault: LineFault) -> None:
        """Take it off the plan; safe to call twice."""
        self._faults = tuple(each for each in self._faults if each is not fault)

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        """Return the request after its faults."""
        if not self._faults:
            return FaultyRequest(tuple(data))
        struck = self._strike(at_s)
        values: list[int | None] = list(data)
        if FaultKind.REQUEST_BIT_FLIPPED in struck:
            values = [*self._flip(data)]
        if FaultKind.REQUEST_BYTE_LOST in struck:
            values[self._dice.randrange(len(values))] = None
        if FaultKind.REQUEST_LOST in struck:
            values = [None] * len(values)
        unplugged = struck.get(FaultKind.UNPLUGGED)
        return FaultyRequest(tuple(values), FaultKind.ECHO in struck, unplugged.longest_s if unplugged else 0.0)

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        """Return the reply after its faults; empty when nothing of it is left."""
        if not self._faults:
            return FaultyReply(data)
        struck = self._strike(at_s)
        if FaultKind.REPLY_LOST in struck:
            return FaultyReply(b"")
        if FaultKind.REPLY_BIT_FLIPPED in struck:
            data = self._flip(data)
        if FaultKind.REPLY_FALSIFIED in struck and len(data) > 1:
            data = self._falsify(data)
        if FaultKind.REPLY_BYTE_LOST in struck:
            lost = self._dice.randrange(len(data))
            data = data[:lost] + data[lost + 1 :]
        delayed = struck.get(FaultKind.REPLY_DELAYED)
        delay_s = self._dice.uniform(0.0, delayed.longest_s) if delayed else 0.0
        return FaultyReply(data, delay_s, copies=2 if FaultKind.REPLY_DUPLICATED in struck else 1)

    def _strike(self, at_s: float) -> dict[FaultKind, LineFault]:
        return {
            fault.kind: fault
            for fault in self._faults
            if fault.from_s <= at_s < fault.until_s and self._dice.random() < fault.probability
        }

    def _falsify(self, data: bytes) -> bytes:
        """Change one byte, and the last one, the checksum, by as much."""
        falsified, by = bytearray(data), self._dice.randrange(1, 256)
        for at in (self._dice.randrange(len(data) - 1), -1):
            falsified[at] = (falsified[at] + by) % 256
        return bytes(falsified)

    def _flip(self, data: bytes) -> bytes:
        bit = self._dice.randrange(8 * len(data))
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)
