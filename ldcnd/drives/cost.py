"""Time of one exchange on the line, in seconds, without hardware. Pure: independent of clock and family.

An exchange is a request, a wait for the drive, a reply, and the delay of the adapter and the host before the next
request can begin. Only the wait varies from one exchange to the next. The exchanges of a model are in its price list,
so that the bus budget can be computed before there is a line.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ldcnd.contract.samples import TelemetryItem
from ldcnd.line.exchange import Exchange
from ldcnd.line.settings import LINGER_S

TURNAROUND_S = 0.000_25
"""Host delay from a reply's last byte to the next request's first, seconds: the 99th percentile on a small PC."""


@dataclass(frozen=True, slots=True)
class LineTiming:
    """How fast a line is.

    Attributes:
        host_baud: rate at which requests leave.
        node_baud: rate at which drives answer; their clocks do not divide to exactly the nominal rate.
        bits_per_byte: 10 for 8N1 and for 7E1.
        turnaround_s: host, between a reply and the next request.
        adapter_latency_s: delay of each reply in the adapter.
    """

    host_baud: float
    node_baud: float
    bits_per_byte: int = 10
    turnaround_s: float = TURNAROUND_S
    adapter_latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Cost:
    """Where the time of one exchange goes, in seconds, and how long its packets are.

    Attributes:
        request_s: the request's bytes.
        wait_s: the longest that the drive may take; without a reply, the quiet time that follows the request.
        reply_s: the reply's bytes.
        overhead_s: adapter and host, until the next request can begin; for a packet that must not be repeated, also the
            time in which the line makes sure that no other reply follows.
        ends_early: a drive that answers early frees the line early; not so without a reply, or when it must linger.
        request_bytes: length of the request.
        reply_bytes: longest reply.
    """

    request_s: float
    wait_s: float
    reply_s: float
    overhead_s: float
    ends_early: bool = True
    request_bytes: int = 0
    reply_bytes: int = 0

    @property
    def wire_s(self) -> float:
        """Bytes on the wire, both directions."""
        return self.request_s + self.reply_s

    @property
    def longest_s(self) -> float:
        """The whole exchange when the drive takes as long as it may."""
        return self.wire_s + self.wait_s + self.overhead_s

    @property
    def mean_s(self) -> float:
        """The whole exchange on average: drives that act at the end of a cycle wait for half of it."""
        return self.wire_s + (self.wait_s / 2 if self.ends_early else self.wait_s) + self.overhead_s


def cost_of(exchange: Exchange[Any], timing: LineTiming) -> Cost:
    """Return the time of an exchange on a line.

    Args:
        exchange: its reply, if the length varies, as long as expected.
        timing: of the line.
    """
    answered = exchange.reply_bytes > 0
    adapter_s = timing.adapter_latency_s if answered else 0.0
    linger_s = LINGER_S if answered and not exchange.repeatable else 0.0
    return Cost(
        request_s=len(exchange.request) * timing.bits_per_byte / timing.host_baud,
        wait_s=exchange.response_s,
        reply_s=exchange.reply_bytes * timing.bits_per_byte / timing.node_baud,
        overhead_s=timing.turnaround_s + adapter_s + linger_s,
        ends_early=answered and exchange.repeatable,
        request_bytes=len(exchange.request),
        reply_bytes=exchange.reply_bytes,
    )


@dataclass(frozen=True, slots=True)
class PriceList:
    """The exchanges of one model at one rate.

    Attributes:
        node_baud: the rate at which the drive answers when it is set to use the nominal one.
        reading: the exchange that reads these telemetry items, and the drive's state with them.
        commands: every other exchange that is made while the line is in use, by name, in its longest form.
        probe: the exchange in the place of a stop, to measure how long one would wait.
        stop: what brings a motor to rest; None for drives that the line cannot move.
        flush: what clears the line after a loss, `settle_s` the pause behind it.
    """

    node_baud: float
    reading: Callable[[frozenset[TelemetryItem]], Exchange[Any]]
    commands: Mapping[str, Exchange[Any]]
    probe: Exchange[Any]
    stop: Exchange[Any] | None
    flush: bytes
    settle_s: float
