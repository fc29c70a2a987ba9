"""One open transport: its rate, the bytes that pass over it, and the record of them."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ldcnd.contract.errors import TransportLost
from ldcnd.line.exchange import Exchange, Timing
from ldcnd.line.flight_recorder import BusStatistics, WireEvent, WireLog
from ldcnd.line.settings import BusSettings
from ldcnd.line.transaction import Transaction
from ldcnd.line.transport import Transport


class PendingEcho:
    """Bytes that were sent and whose echo has not arrived yet."""

    __slots__ = ("_due",)

    def __init__(self) -> None:
        self._due = bytearray()

    def __bool__(self) -> bool:
        """Tell whether bytes of ours are still to come back."""
        return bool(self._due)

    def sent(self, data: bytes) -> None:
        """Expect these bytes back."""
        self._due += data

    def strip(self, data: bytes) -> tuple[bytes, bytes] | None:
        """Take our own bytes off the front, by count: a reply may equal its request.

        Returns:
            The echo and the bytes after it; None when it differs from what was sent: no more echo is expected then.
        """
        count = min(len(data), len(self._due))
        if data[:count] != self._due[:count]:
            self._due.clear()
            return None
        del self._due[:count]
        return data[:count], data[count:]

    def clear(self) -> None:
        """Expect nothing back any more."""
        self._due.clear()


CLOCK_TOLERANCE = 0.9
"""A drive's baud clock may be 3 % fast and a time stamp a little early: bytes count as too early below this share."""


@dataclass(frozen=True, slots=True)
class CompleteReply:
    """As many bytes as make a reply.

    Attributes:
        reply: these bytes.
        surplus: bytes after them.
        early: some came sooner than the wire can carry them.
    """

    reply: bytes
    surplus: bytes
    early: bool


class Pieces:
    """The bytes of a reply so far.

    Attributes:
        held: these bytes.
        early: some came sooner than the wire can carry them.
    """

    __slots__ = ("_byte_s", "_over_s", "early", "held")

    def __init__(self) -> None:
        self.held = b""
        self.early = False
        self._over_s = self._byte_s = 0.0

    def begin(self, over_s: float, byte_s: float) -> None:
        """Discard held bytes; wait for the reply to a request.

        Args:
            over_s: the earliest end of the request; minus infinity where nothing can be too early.
            byte_s: how long each byte of the reply takes at least.
        """
        self.held, self.early = b"", False
        self._over_s, self._byte_s = over_s, byte_s

    def earliest_s(self, count: int) -> float:
        """Return the earliest instant at which so many bytes can have come behind the request."""
        return self._over_s + count * self._byte_s

    def add(self, exchange: Exchange[Any], data: bytes, now_s: float) -> CompleteReply | None:
        """Add bytes that have just arrived; return the reply once it is whole."""
        data = self.held + data
        self.early = self.early or now_s < self.earliest_s(len(data))
        total = exchange.total_bytes(data) if exchange.total_bytes else exchange.reply_bytes
        if total is None or len(data) < total:
            self.held = data
            return None
        whole = CompleteReply(data[:total], data[total:], self.early)
        self.held, self.early = b"", False
        return whole


NEVER_S = float("inf")


class Watchdog:
    """Calls back once the deadline has passed.

    Moving the deadline later costs an assignment: the timer fires at the old time, compares, and is set again. So a
    line that answers in time creates a few timers a second, not one per exchange.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, expired: Callable[[float], None]) -> None:
        self._loop = loop
        self._expired = expired
        self._deadline_s = NEVER_S
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at_s = NEVER_S

    @property
    def deadline_s(self) -> float:
        """The deadline, in loop time; infinity when there is none."""
        return self._deadline_s

    def set(self, at_s: float) -> None:
        """Move the deadline, in loop time; infinity for none."""
        self._deadline_s = at_s
        if at_s < self._timer_at_s:
            if self._timer:
                self._timer.cancel()
            self._timer_at_s = at_s
            self._timer = self._loop.call_at(at_s, self._look)

    def cancel(self) -> None:
        """Cancel the deadline and the timer."""
        self._deadline_s = self._timer_at_s = NEVER_S
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        self._timer, self._timer_at_s = None, NEVER_S
        now_s = self._loop.time()
        if now_s >= self._deadline_s:
            self._deadline_s = NEVER_S
            self._expired(now_s)
        elif self._deadline_s < NEVER_S:
            self.set(self._deadline_s)


class Wire:
    """The host's end of a line: counts and logs bytes, and computes how long they take.

    Attributes:
        baud: the rate of all turns that have none of their own.
        byte_s: how long a byte takes now, in seconds.
        fixed_baud: the transport cannot change its rate.
        transport: the pipe.
        echo: bytes whose echo is still due; None on a line without echo.
        log: the record of all bytes.
    """

    def __init__(
        self, settings: BusSettings, transport: Transport, statistics: BusStatistics, wire_log: WireLog
    ) -> None:
        self.baud = settings.baud
        self.byte_s = settings.bits_per_byte / settings.baud
        self.fixed_baud = transport.fixed_baud
        self._bits_per_byte = settings.bits_per_byte
        self.transport = transport
        self._statistics = statistics
        self.log = wire_log
        self._loop = asyncio.get_running_loop()
        self.echo = PendingEcho() if settings.echo else None

    def longest_s(self, exchange: Exchange[Any]) -> float:
        """Return how long an exchange can take at the present rate, first bit to last, in seconds."""
        return (len(exchange.request) + exchange.reply_bytes) * self.byte_s + exchange.response_s

    def tune(self, baud: int, *, for_good: bool) -> None:
        """Change the rate.

        Raises:
            TransportLost: the pipe is gone.
        """
        self.transport.set_baud(baud)
        self.log.add(self._loop.time(), WireEvent.BAUD, note=str(baud))
        self.byte_s = self._bits_per_byte / baud
        if for_good:
            self.baud = baud

    def discard_input(self) -> None:
        """Discard the input and the echo that is still due."""
        self.transport.discard_input()
        self.forget_echo()

    def write(self, data: bytes) -> str:
        """Hand bytes to the transport and do nothing else, `sent` is due behind it; return why it is lost, if it is."""
        try:
            self.transport.write(data)
        except TransportLost as error:
            return error.message
        return ""

    # -- what passes ---------------------------------------------------------------------------------------------------

    def sent(self, data: bytes, at_s: float, remark: str) -> None:
        """Note what was written."""
        self.log.add(at_s, WireEvent.SENT, data, remark)
        self._statistics.bytes_out += len(data)
        if self.echo is not None:
            self.echo.sent(data)

    def without_echo(self, data: bytes, now_s: float) -> bytes | None:
        """Take our own bytes off the input; None when it should be our own bytes and is not."""
        if not self.echo:
            return data
        stripped = self.echo.strip(data)
        if stripped is None:
            return None
        own, rest = stripped
        self.log.add(now_s, WireEvent.ECHO, own)
        return rest

    def forget_echo(self) -> None:
        """Expect nothing of ours back any more."""
        if self.echo:
            self.echo.clear()

    def replied(self, transaction: Transaction, reply: bytes, sent_at_s: float, now_s: float) -> Timing:
        """Count an intact reply; return when it was true."""
        statistics, byte_s = self._statistics, self.byte_s
        request_s, reply_s = len(transaction.exchange.request) * byte_s, len(reply) * byte_s
        over_s, begun_s, late_s = sent_at_s + request_s, now_s - reply_s, now_s - transaction.wanted_at_s
        statistics.replies += 1
        statistics.wire_busy_s += request_s + reply_s
        statistics.latency[transaction.lane].add(max(0.0, late_s))
        return Timing(sent_at_s, over_s, max(over_s, begun_s), now_s)

    def silent(self, transaction: Transaction, sent_at_s: float, now_s: float) -> Timing:
        """Count a request that draws no reply; return when it took effect."""
        request_s = len(transaction.exchange.request) * self.byte_s
        self._statistics.wire_busy_s += request_s
        return Timing(sent_at_s, sent_at_s + request_s, now_s, now_s)

    def stray(self, data: bytes, now_s: float, why: str = "") -> None:
        """Note bytes that belong to no request."""
        self._statistics.stray_bytes += len(data)
        self.log.add(now_s, WireEvent.STRAY, data, why)

    def note(self, event: WireEvent, now_s: float, data: bytes = b"", remark: str = "") -> None:
        """Note anything else."""
        self.log.add(now_s, event, data, remark)
