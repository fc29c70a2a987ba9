"""One packet out, at most one back: the seam between the codecs and the bus.

A codec builds an `Exchange`; the bus runs it without knowing what the bytes mean. An exchange is a value: it holds no
state, can be prepared once and run any number of times.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

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
    """An intact reply by which the node says it did not execute our damaged packet; resending is always safe."""


class PacketEffect(Enum):
    """What a packet does to the one who takes it."""

    READS = "reads"
    """Nothing, or it only fills up what was received in part."""
    RELIEVES = "relieves"
    """It takes energy out: it stops the motor or switches it off, and does nothing else."""
    ARRANGES = "arranges"
    """It gives an address, a group or a rate, or resets who is to be given one."""
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
