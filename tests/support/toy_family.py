"""A drive family just large enough to test a bus: replies carry the number of their request, unseen by the check.

Request: A5, node, wanted reply length, number (2 bytes), sum. Reply: kind, number (2 bytes), filling, sum. As on the
real lines, neither address nor number of a reply is checked before it is credited: only decoding reveals them.
"""

from collections.abc import Set as AbstractSet

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError
from ldcnd.line.exchange import Exchange, PacketEffect, Poller, ReplyVerdict, Resync, Timing
from tests.support.scripted_line import Say, Script

REQUEST_BYTES = 6
REPLY_BYTES = 8
PROBE_BYTES = 11
PROBE_NUMBER = 0xFFFF
PROBE_NODE = 99
FLUSH = bytes(4)
RESPONSE_S = 0.001
OK, REJECTED, FOREIGN, NONSENSE = 1, 2, 3, 4


def request(node: int, number: int, reply_bytes: int = REPLY_BYTES) -> bytes:
    """Build a request."""
    body = bytes([0xA5, node, reply_bytes]) + number.to_bytes(2, "big")
    return body + bytes([sum(body) & 0xFF])


def reply(number: int, reply_bytes: int = REPLY_BYTES, kind: int = OK) -> bytes:
    """Build a reply."""
    body = (bytes([kind]) + number.to_bytes(2, "big")).ljust(reply_bytes - 1, b"\x55")
    return body + bytes([sum(body) & 0xFF])


def node_of(packet: bytes) -> int:
    """Return whom a request addresses."""
    return packet[1]


def number_of(packet: bytes) -> int:
    """Return the number of a request."""
    return int.from_bytes(packet[3:5], "big")


def check(data: bytes) -> ReplyVerdict:
    """Judge a reply by its sum and kind."""
    if sum(data[:-1]) & 0xFF != data[-1]:
        return ReplyVerdict.CORRUPT
    return {REJECTED: ReplyVerdict.REJECTED, FOREIGN: ReplyVerdict.FOREIGN}.get(data[0], ReplyVerdict.INTACT)


def decode(data: bytes) -> int:
    """Return the number of the request that this reply answers."""
    if data[0] != OK:
        raise BadReply(f"unknown kind {data[0]}")
    return int.from_bytes(data[1:3], "big")


def exchange(
    number: int,
    node: int = 1,
    *,
    repeatable: bool = True,
    reply_bytes: int = REPLY_BYTES,
    response_s: float = RESPONSE_S,
) -> Exchange[int]:
    """Ask a node for the number back; without reply bytes, tell it and keep the line quiet for `response_s`."""
    return Exchange(
        node=node,
        request=request(node, number, reply_bytes),
        reply_bytes=reply_bytes,
        check=check,
        decode=decode if reply_bytes else lambda _data: number,
        response_s=response_s,
        repeatable=repeatable,
        effect=PacketEffect.READS,
    )


def _decode_probe(data: bytes) -> int:
    number = decode(data)
    if number != PROBE_NUMBER:
        raise BadReply(f"not the probe's reply: {number}")
    return number


def probe(avoid: AbstractSet[int]) -> Exchange[int] | None:
    """Probe the node that exists for it."""
    if PROBE_NODE in avoid:
        return None
    return Exchange(
        node=PROBE_NODE,
        request=request(PROBE_NODE, PROBE_NUMBER, PROBE_BYTES),
        reply_bytes=PROBE_BYTES,
        check=check,
        decode=_decode_probe,
        response_s=RESPONSE_S,
        repeatable=True,
        effect=PacketEffect.READS,
    )


RESYNC = Resync(flush=FLUSH, quiet_s=0.005, settle_s=0.001, probe=probe)


def answer(packet: bytes) -> list[Say]:
    """Answer a request as a healthy node does; a flush and a request without a reply draw nothing."""
    if packet == FLUSH or not packet[2]:
        return []
    return [Say(reply(number_of(packet), packet[2]))]


def all_but(*mute: int) -> Script:
    """Return a script in which these nodes never answer."""
    return lambda packet: [] if packet != FLUSH and node_of(packet) in mute else answer(packet)


class ToyPoller(Poller[int]):
    """Asks its node once per period at absolute deadlines; keeps what it was told."""

    def __init__(self, node: int, period_s: float, due_at_s: float = 0.0) -> None:
        self.node = node
        self.period_s = period_s
        self.due_at_s = due_at_s
        self.asked_at_s: list[float] = []
        self.delivered: list[int] = []
        self.timings: list[Timing] = []
        self.errors: list[BusError] = []

    def next_exchange(self, now_s: float) -> Exchange[int]:
        """See `Poller`; slots that have passed already are left out."""
        self.asked_at_s.append(now_s)
        self.due_at_s += max(1, 1 + int((now_s - self.due_at_s) / self.period_s)) * self.period_s
        return exchange(len(self.asked_at_s) & 0x7FFF, self.node)

    @override
    def deliver(self, reply: int, timing: Timing) -> None:
        self.delivered.append(reply)
        self.timings.append(timing)

    @override
    def missed(self, error: BusError) -> None:
        self.errors.append(error)
