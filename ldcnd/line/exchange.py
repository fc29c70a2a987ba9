"""What drivers give the bus: exchanges, pollers, and how their line gets back in step.

A codec builds an `Exchange`, one packet out and at most one back; the bus runs it without knowing what the bytes mean.
An exchange is a value: it holds no state, can be prepared once and run any number of times.

The bus takes the next exchange of a poller only when the line is free for it, so an overloaded line delays polls but
never queues several of one poller.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from enum import Enum, IntEnum
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from ldcnd.contract.errors import BusError
from ldcnd.contract.samples import TelemetryItem

ReplyT = TypeVar("ReplyT")


class ReplyVerdict(Enum):
    """The validity of complete reply bytes, decided before the line is used again."""

    INTACT = "intact"
    """The reply belongs to this request and may be decoded."""
    CORRUPT = "corrupt"
    """Damaged or foreign bytes: the line is out of step."""
    FOREIGN = "foreign"
    """Well formed, but not the answer to this request: skipped, the bus reads on until the deadline."""
    REJECTED = "rejected"
    """An intact reply by which the node says it did not execute our damaged packet; resending is always safe.

    Source: PIC-SERVO manual, 4.1, and 5.3, status bit cksum_error.
    """


class PacketEffect(Enum):
    """What a packet does to the one who takes it."""

    READS = "reads"
    """Nothing, or it only fills up what was received in part."""
    RELIEVES = "relieves"
    """It takes energy out: it stops the motor or switches it off, and does nothing else."""
    ARRANGES = "arranges"
    """It gives an address, a group, a rate or the form of replies, or resets who is to be given one."""
    CHANGES = "changes"
    """Anything else."""


@dataclass(frozen=True, slots=True)
class Exchange(Generic[ReplyT]):
    """A request and the properties of its reply that the bus needs.

    Attributes:
        node: who answers; back-off and statistics are kept per node. Group addresses count as nodes of their own.
        request: the bytes to send, complete with framing and checksum.
        reply_bytes: length of the expected reply; 0 when no reply will come.
        check: judges complete reply bytes in well under a microsecond; never raises.
        decode: turns intact bytes into a value; raises `BadReply` and nothing else.
        response_s: the longest time the node may take between the last request byte and the first reply byte; for an
            exchange without a reply, the quiet time that the line needs after it.
        repeatable: may the bus send the request again after its reply was lost? Never true for what could move a
            drive twice.
        total_bytes: for replies whose length depends on their content: given the received bytes, the total length, or
            None when it is not known yet. When absent the length is `reply_bytes`.
        effect: a codec that does not say what its packet does gets the strictest treatment: see `Proofs` and
            `only_while` of the bus.
        unseen: no reading shows whether the node has taken it, and a late reply to something older can pass for its
            acknowledgement: `Bus.execute` sends it twice, if it may be repeated.
    """

    node: int
    request: bytes
    reply_bytes: int
    check: Callable[[bytes], ReplyVerdict]
    decode: Callable[[bytes], ReplyT]
    response_s: float
    repeatable: bool
    total_bytes: Callable[[bytes], int | None] | None = None
    effect: PacketEffect = PacketEffect.CHANGES
    unseen: bool = False

    @property
    def times(self) -> int:
        """How often it is sent when nothing is lost."""
        return 2 if self.unseen and self.repeatable else 1

    def longest_s(self, byte_s: float) -> float:
        """Return how long it occupies the line at most when nothing is lost, first bit to last, in seconds.

        Args:
            byte_s: how long a byte takes.
        """
        return (len(self.request) + self.reply_bytes) * byte_s + self.response_s


@dataclass(frozen=True, slots=True)
class Timing:
    """When an exchange happened, on the bus's clock (seconds of the event loop).

    Attributes:
        sent_at_s: when the request was handed to the transport.
        true_from_s: the earliest instant at which the values in the reply can have been true (the request's last bit).
        true_until_s: the latest such instant (the reply's first bit).
        received_at_s: when the reply's last byte was read.
    """

    sent_at_s: float
    true_from_s: float
    true_until_s: float
    received_at_s: float


@dataclass(frozen=True, slots=True)
class Resync:
    """The resynchronisation between a lost reply and the next request.

    The bus waits until the line has been quiet for `quiet_s`, sends `flush`, waits `settle_s`, discards the input,
    and runs the probe: an exchange whose reply is known beforehand and has an unusual length, so that a late reply
    cannot pass for it.

    Attributes:
        flush: bytes that end any half-received packet and draw no reply.
        quiet_s: silence after which no late reply can come any more.
        settle_s: pause after the flush.
        probe: returns such an exchange with a node outside the given ones if it can, None when there is no node. Its
            `decode` raises `BadReply` when the reply is not the known one.
    """

    flush: bytes = b""
    quiet_s: float = 0.005
    settle_s: float = 0.0
    probe: Callable[[AbstractSet[int]], Exchange[Any] | None] = lambda _avoid: None

    def longest_s(self, byte_s: float, avoid: AbstractSet[int]) -> float:
        """Return how long it takes when nothing is lost, in seconds.

        Args:
            byte_s: how long a byte takes.
            avoid: nodes that do not reply.
        """
        probe = self.probe(avoid)
        probe_s = probe.longest_s(byte_s) if probe else 0.0
        return self.quiet_s + len(self.flush) * byte_s + self.settle_s + probe_s


class Lane(IntEnum):
    """Priorities of exchanges, highest first."""

    STOP = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


NEVER_S = float("inf")
"""An instant that does not come, and a period that does not end, in seconds."""
NO_DEADLINE_S = NEVER_S
"""Deadline of a poll that only uses time left by all other polls; it is never late."""


def next_on_grid(due_s: float, period_s: float, now_s: float) -> float:
    """Return the first due time after `now_s` that is whole periods, at least one, behind `due_s`."""
    behind = max(0, int((now_s - due_s) / period_s))
    return due_s + (behind + 1) * period_s


class Priority(IntEnum):
    """Order of polls on a line that has fallen behind, highest first."""

    HIGH = 0
    NORMAL = 1
    LOW = 2


class Poller(ABC, Generic[ReplyT]):
    """One periodic user of the line; every method runs on the event loop, returns at once and never raises.

    Attributes:
        node: the node that it polls; one that does not reply is polled less and less often.
        due_at_s: when its next slot is due, in loop time; read by the bus after each slot.
        deadline_at_s: when that slot should be over; of those that are due, the earliest deadline goes first.
        priority: its rank while the line cannot carry all polls; does not change while it waits for a slot.
        rates_hz: rate at which it reads each telemetry item; empty for one that reads none.
        slow_to_deliver: processing a reply takes long, so the next request is sent first, and several may be processed
            together; see `Line`.
    """

    node: int
    due_at_s: float
    deadline_at_s: float = 0.0
    priority: Priority = Priority.NORMAL
    rates_hz: Mapping[TelemetryItem, float] = MappingProxyType({})
    slow_to_deliver: bool = False

    def prepare(self, at_s: float) -> None:
        """Prepare the next exchange, which takes time; the next slot is expected at about that instant."""

    @abstractmethod
    def next_exchange(self, now_s: float) -> Exchange[ReplyT]:
        """Return the exchange to run now and move `due_at_s` on."""

    @abstractmethod
    def deliver(self, reply: ReplyT, timing: Timing) -> None:
        """Take the decoded reply; the next request is on the wire already."""

    @abstractmethod
    def missed(self, error: BusError) -> None:
        """Note that this slot brought no reply."""
