"""An open line: keeps exactly one exchange outstanding and gets back in step after a loss.

Reply-driven: when a reply is complete and intact, the next request goes on the wire first; only then is the old reply
decoded and delivered. No task and no timer per exchange.

No reply is ever credited to a later request. Replies of these lines carry no sequence number, so the line relies on
three facts: bytes that arrive sooner than the wire can carry them belong to something older; nothing but the reply may
follow a request; after any loss the line is fenced and probed (`Resync`) before it is used again.
"""

import asyncio
from enum import Enum

from ldcnd.bus.resync import Probe, Resync
from ldcnd.bus.settings import LINGER_S, BusSettings
from ldcnd.bus.statistics import BusStatistics
from ldcnd.bus.turn import AT_ONCE, LANES, Turn
from ldcnd.bus.users import Users
from ldcnd.bus.watchdog import NEVER_S, Watchdog
from ldcnd.bus.wire_log import WireEvent, WireLog
from ldcnd.errors import BadReply, BusError, ReplyTimeout, TransportLost
from ldcnd.exchange import ReplyVerdict, Timing
from ldcnd.transport.transport import Transport

CLOCK_TOLERANCE = 0.9
"""A drive's baud clock may be 3 % fast and a time stamp a little early: bytes count as too early below this share."""
PROBE_ROUNDS = 3
LONGEST_FENCE = 20
"""A line that never falls silent is flushed after so many quiet times all the same."""
_FLAWS = {ReplyVerdict.CORRUPT: "is damaged", ReplyVerdict.REJECTED: "packet rejected"}
LATE_S = 1.0
"""A line that is so far behind what it had planned next does not turn."""


class Phase(Enum):
    """What the line is doing."""

    IDLE = "idle"
    REPLY = "reply"
    LINGER = "linger"
    """A packet that must not be repeated has its reply; a second one would prove that the first was not its own."""
    QUIET = "quiet"
    """After a request that draws no reply."""
    FENCE = "fence"
    """Waiting for late bytes to stop."""
    SETTLE = "settle"
    """The flush is on its way."""
    CLOSED = "closed"


class Line:
    """One open transport and what is on it; a `Receiver`, made anew at every opening."""

    def __init__(
        self,
        settings: BusSettings,
        transport: Transport,
        users: Users,
        resync: Resync,
        statistics: BusStatistics,
        wire_log: WireLog,
    ) -> None:
        self.baud = settings.baud
        self.phase = Phase.IDLE
        self._settings = settings
        self._transport = transport
        self._users = users
        self._resync = resync
        self._statistics = statistics
        self._wire_log = wire_log
        self._loop = asyncio.get_running_loop()
        self._watchdog = Watchdog(self._loop, self._expired)
        self._byte_s = settings.bits_per_byte / settings.baud
        self._turn: Turn | None = None
        self._buffer = bytearray()
        self._kept = (b"", 0.0)  # the reply that is lingered over, and when it came
        self._buffered_early = False
        self._echo = bytearray()  # sent, and not come back yet
        self._sent_at_s = self._request_over_s = self._fenced_at_s = 0.0
        self._probes_left = 0  # more than 0: the line is out of step until a probe proves the opposite
        transport.attach(self)

    @property
    def fixed_baud(self) -> bool:
        """Whether the transport cannot change its rate."""
        return self._transport.fixed_baud

    def turning(self, now_s: float) -> bool:
        """Tell whether the line keeps to its own plan: it always knows when it will act next, and then does."""
        if self.phase is Phase.IDLE:
            return not self._users.stop_waits() and now_s <= self._users.next_due_s() + LATE_S
        due_s = self._watchdog.deadline_s
        return due_s < NEVER_S and now_s <= due_s + LATE_S

    def kick(self) -> None:
        """Look at the queue: something was added to it."""
        if self.phase is Phase.IDLE:
            self._next()
        elif self.phase is Phase.FENCE and self._users.stop_waits():
            self._watchdog.set(self._loop.time())

    def close(self, reason: str) -> None:
        """Leave the line; the turn on the wire, if any, is lost. Safe to call twice."""
        if self.phase is Phase.CLOSED:
            return
        self.phase = Phase.CLOSED
        self._watchdog.cancel()
        turn, self._turn = self._turn, None
        if turn and turn.lost(ReplyTimeout(f"node {turn.exchange.node}: {reason} before the reply came")):
            self._users.again(turn)
        self._users.line_lost(reason)

    # -- receiver ----------------------------------------------------------------------------------------------------

    def transport_lost(self, reason: str) -> None:
        """See `Receiver`; a write that failed has told it already when the port tells it again."""
        if self.phase is Phase.CLOSED:
            return
        self._statistics.losses += 1
        self._note(WireEvent.LOST, reason)
        self.close(reason)

    def data_received(self, data: bytes) -> None:
        """See `Receiver`."""
        now_s = self._loop.time()
        self._statistics.bytes_in += len(data)
        if self._echo and not (data := self._strip_echo(data, now_s)):
            return
        if (turn := self._turn) and self.phase is Phase.LINGER:
            self._wire_log.add(now_s, WireEvent.RECEIVED, data, "follows a reply")
            self._distrust(turn, self._kept[0] + data, "was followed by another one", now_s)
            return
        if turn is None or self.phase is not Phase.REPLY:
            self._stray(data, now_s)
            return
        arrived = data
        if self._buffer:
            data = bytes(self._buffer) + data
            self._buffer.clear()
        exchange, early = turn.exchange, self._buffered_early
        while data:
            early = early or now_s < self._request_over_s + CLOCK_TOLERANCE * len(data) * self._byte_s
            total = exchange.total_bytes(data) if exchange.total_bytes else exchange.reply_bytes
            if total is None or len(data) < total:
                self._wire_log.add(now_s, WireEvent.PART, arrived)
                self._buffer += data
                self._buffered_early = early
                return
            reply, data = data[:total], data[total:]
            verdict = exchange.check(reply)
            if verdict is ReplyVerdict.FOREIGN:
                self._wire_log.add(now_s, WireEvent.STRAY, arrived[: len(arrived) - len(data)], "foreign reply")
                arrived = data
                self._statistics.stray_bytes += total
                early = self._buffered_early = False
                continue
            why = "came with surplus bytes" if data else "came too early" if early else _FLAWS.get(verdict, "")
            self._wire_log.add(now_s, WireEvent.RECEIVED, arrived, why)
            if data or early or verdict is ReplyVerdict.CORRUPT:
                self._distrust(turn, reply + data, why, now_s)
            elif not exchange.repeatable and now_s < (until_s := self._true_reply_by_s(turn)):
                # not believed before no other reply can come
                self.phase, self._kept = Phase.LINGER, (reply, now_s)
                self._watchdog.set(until_s)
            elif verdict is ReplyVerdict.REJECTED:
                self._rejected(turn)
            else:
                self._complete(turn, reply, now_s)
            return

    def _true_reply_by_s(self, turn: Turn) -> float:
        """Return until when the node's own reply may still come although one has come already; never when unpaced."""
        if not self._settings.paced:
            return -NEVER_S
        exchange = turn.exchange
        wire_s = (len(exchange.request) + exchange.reply_bytes) * self._byte_s
        return self._sent_at_s + wire_s + exchange.response_s + LINGER_S

    def _settle(self, turn: Turn, reply: bytes, now_s: float) -> None:
        if turn.exchange.check(reply) is ReplyVerdict.REJECTED:
            self._rejected(turn)
        else:
            self._complete(turn, reply, now_s)

    def _complete(self, turn: Turn, reply: bytes, now_s: float) -> None:
        """Free the line, start the next exchange, and only then let this one be decoded and delivered."""
        request_s, reply_s = len(turn.exchange.request) * self._byte_s, len(reply) * self._byte_s
        sent_s = self._sent_at_s + request_s
        timing = Timing(self._sent_at_s, sent_s, max(now_s - reply_s, sent_s), now_s)
        self._statistics.replies += 1
        self._statistics.wire_busy_s += request_s + reply_s
        if isinstance(turn, Probe):
            self._probed(turn, reply, timing, now_s)
            return
        self._users.answered(turn)
        self._release(turn)
        self._next(AT_ONCE)
        self._statistics.latency[turn.lane].add(max(0.0, now_s - turn.wanted_at_s))
        turn.completed(reply, timing)

    def _release(self, turn: Turn) -> None:
        self._turn, self.phase = None, Phase.IDLE
        if turn.then_baud or turn.at_baud:
            self._tune(turn.then_baud or self.baud)

    def _rejected(self, turn: Turn) -> None:
        """The node did not execute our packet: the line is in step, and sending again is always safe."""
        self._statistics.rejected_packets += 1
        self._users.answered(turn)
        self._turn, self.phase = None, Phase.IDLE
        if turn.rejected():
            self._statistics.resent += 1
            self._users.again(turn)
        if turn.at_baud:
            self._tune(self.baud)
        self._next()

    # -- losses ------------------------------------------------------------------------------------------------------

    def _distrust(self, turn: Turn, reply: bytes, why: str, now_s: float) -> None:
        self._statistics.corrupt_replies += 1
        self._lose(turn, BadReply(f"node {turn.exchange.node}: reply {reply.hex(' ')} {why}"), now_s)

    def _lose(self, turn: Turn, error: BusError, now_s: float) -> None:
        """Settle the turn whose reply will never be trusted, and fence the line."""
        self._turn = None
        self._buffer.clear()
        self._users.missed(turn, now_s)
        if not isinstance(turn, Probe):
            self._probes_left = PROBE_ROUNDS
        # before the fence, which a stop that is sent again cuts short
        if turn.lost(error):
            self._statistics.resent += 1
            self._users.again(turn)
        if turn.at_baud:
            self._tune(self.baud)
        self._fence(now_s)

    def _stray(self, data: bytes, now_s: float) -> None:
        """Bytes that nobody asked for: late ones while fenced, a sign of being out of step otherwise."""
        self._statistics.stray_bytes += len(data)
        self._wire_log.add(now_s, WireEvent.STRAY, data)
        if self.phase is Phase.FENCE and not self._users.stop_waits():
            quiet_s = self._resync.quiet_s
            self._watchdog.set(min(now_s + quiet_s, self._fenced_at_s + LONGEST_FENCE * quiet_s))
        elif self.phase is Phase.IDLE:
            self._probes_left = PROBE_ROUNDS
            self._fence(now_s)

    def _fence(self, now_s: float) -> None:
        if self.phase is Phase.CLOSED:
            return
        self._statistics.resynchronisations += 1
        self._wire_log.add(now_s, WireEvent.RESYNC)
        self.phase = Phase.FENCE
        self._echo.clear()
        self._fenced_at_s = now_s
        self._watchdog.set(now_s if self._users.stop_waits() else now_s + self._resync.quiet_s)

    def _flush(self, now_s: float) -> None:
        self.phase = Phase.SETTLE
        echo_s = self._settings.margin_s if self._settings.echo else 0.0
        self._watchdog.set(now_s + len(self._resync.flush) * self._byte_s + self._resync.settle_s + echo_s)
        if self._resync.flush:
            self._write(self._resync.flush, now_s, "flush")

    def _flushed(self, now_s: float) -> None:
        """Behind the fence: prove with a known reply that the line is in step, unless a stop cannot wait for that."""
        self._transport.discard_input()
        self._echo.clear()
        self.phase = Phase.IDLE
        if self._probes_left and not self._users.stop_waits():
            exchange = self._resync.probe(self._users.failing())
            self._probes_left = self._probes_left - 1 if exchange else 0
            if exchange:
                self._send(Probe(exchange, now_s), now_s, "probe")
                return
        self._next()

    def _probed(self, probe: Probe, reply: bytes, timing: Timing, now_s: float) -> None:
        probe.completed(reply, timing)
        if not probe.passed:
            self._note(WireEvent.RECEIVED, why := "is not the known one")
            self._distrust(probe, reply, why, now_s)
            return
        self._probes_left = 0
        self._users.answered(probe)
        self._release(probe)
        self._next()

    # -- sending -----------------------------------------------------------------------------------------------------

    def _next(self, remarks: tuple[str, ...] = LANES) -> None:
        """Put the next exchange on the wire, with its lane's remark in the log, or sleep until one is due."""
        if self.phase is not Phase.IDLE:
            return
        now_s = self._loop.time()
        if self._probes_left and not self._users.stop_waits():
            self._fence(now_s)  # only a stop may use a line that is not proven to be in step
            return
        turn = self._users.take(now_s)
        if turn is None:
            self._watchdog.set(self._users.next_due_s())
        else:
            self._send(turn, now_s, remarks[turn.lane])

    def _send(self, turn: Turn, now_s: float, remark: str) -> None:
        exchange, settings, self._turn = turn.exchange, self._settings, turn
        if turn.at_baud:
            self._tune(turn.at_baud, for_good=False)
            if self.phase is Phase.CLOSED:
                return
        request_s, reply_s = len(exchange.request) * self._byte_s, exchange.reply_bytes * self._byte_s
        self._sent_at_s, self._buffered_early = now_s, False
        self._request_over_s = now_s + CLOCK_TOLERANCE * request_s if settings.paced else -NEVER_S
        self._statistics.exchanges += 1
        if exchange.reply_bytes:
            self.phase = Phase.REPLY
            self._transport.expect(exchange.reply_bytes + (len(exchange.request) if settings.echo else 0))
            patience_s = exchange.response_s + settings.margin_s + self._transport.lag_s
            self._watchdog.set(now_s + request_s + reply_s + patience_s)
        else:
            self.phase = Phase.QUIET
            self._watchdog.set(now_s + request_s + exchange.response_s)
        self._write(exchange.request, now_s, remark)

    def _write(self, data: bytes, now_s: float, remark: str) -> None:
        self._wire_log.add(now_s, WireEvent.SENT, data, remark)
        self._statistics.bytes_out += len(data)
        if self._settings.echo:
            self._echo += data
        try:
            self._transport.write(data)
        except TransportLost as error:
            self.transport_lost(error.message)

    def _strip_echo(self, data: bytes, now_s: float) -> bytes:
        """Take our own bytes off the front, by count: a reply may look exactly like its request."""
        count = min(len(data), len(self._echo))
        if data[:count] == self._echo[:count]:
            del self._echo[:count]
            self._wire_log.add(now_s, WireEvent.ECHO, data[:count])
            return data[count:]
        self._echo.clear()
        if self._turn and self.phase is Phase.REPLY:
            self._wire_log.add(now_s, WireEvent.RECEIVED, data, why := "follows an echo that differs: collision")
            self._distrust(self._turn, data, why, now_s)
        else:
            self._stray(data, now_s)
        return b""

    def _tune(self, baud: int, *, for_good: bool = True) -> None:
        try:
            self._transport.set_baud(baud)
        except TransportLost as error:
            self.transport_lost(error.message)
            return
        self._note(WireEvent.BAUD, str(baud))
        self._byte_s = self._settings.bits_per_byte / baud
        if for_good:
            self.baud = baud

    # -- time --------------------------------------------------------------------------------------------------------

    def _expired(self, now_s: float) -> None:
        if self.phase in (Phase.LINGER, Phase.QUIET):
            self._wire_log.add(now_s, WireEvent.SETTLED)
        match self.phase:
            case Phase.IDLE:
                self._next()
            case Phase.REPLY if self._turn:
                self._timed_out(self._turn, now_s)
            case Phase.LINGER if self._turn:
                self._settle(self._turn, *self._kept)
            case Phase.QUIET if self._turn:
                self._quiet_over(self._turn, now_s)
            case Phase.FENCE:
                self._flush(now_s)
            case Phase.SETTLE:
                self._flushed(now_s)

    def _timed_out(self, turn: Turn, now_s: float) -> None:
        self._statistics.timeouts += 1
        got = f"{len(self._buffer)} of {turn.exchange.reply_bytes} bytes" if self._buffer else "nothing"
        error = ReplyTimeout(f"node {turn.exchange.node} on bus {self._settings.name} sent {got} in time")
        self._wire_log.add(now_s, WireEvent.TIMEOUT, note=error.message)
        self._lose(turn, error, now_s)

    def _quiet_over(self, turn: Turn, now_s: float) -> None:
        """An exchange without a reply is complete once the line may be used again."""
        sent_s = self._sent_at_s + len(turn.exchange.request) * self._byte_s
        self._statistics.wire_busy_s += sent_s - self._sent_at_s
        self._users.answered(turn)
        self._release(turn)
        self._next()
        turn.completed(b"", Timing(self._sent_at_s, sent_s, now_s, now_s))

    def _note(self, event: WireEvent, note: str = "") -> None:
        self._wire_log.add(self._loop.time(), event, b"", note)
