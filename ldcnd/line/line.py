"""An open line: keeps exactly one exchange outstanding and gets back in step after a loss.

Reply-driven: when a reply is complete and intact, the next request goes on the wire first; only then is the old reply
noted, decoded and delivered. No task and no timer per exchange. On a line that is busy with polls their replies are
delivered several at a time (`BusSettings.coalesce_s`), in order, and before anything but a poll has its outcome.

No reply is ever credited to a later request. Replies of these lines carry no sequence number, so the line relies on
three facts: bytes that arrive sooner than the wire can carry them belong to something older; nothing but the reply may
follow a request; after any loss the line is resynchronised (`Quarantine`) before it is used again.
"""

import asyncio
from collections import deque
from enum import Enum
from typing import Protocol

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError, ReplyTimeout, TransportLost
from ldcnd.line.exchange import ReplyVerdict, Resync, Timing
from ldcnd.line.flight_recorder import BusStatistics, WireEvent, WireLog
from ldcnd.line.queue import POLL
from ldcnd.line.resync import Quarantine, ResyncExchange
from ldcnd.line.settings import LINGER_S, BusSettings
from ldcnd.line.transaction import AT_ONCE, LANES, Transaction
from ldcnd.line.transport import Receiver, Transport
from ldcnd.line.wire import CLOCK_TOLERANCE, NEVER_S, CompleteReply, Pieces, Watchdog, Wire


class Phase(Enum):
    """State of the line."""

    IDLE = "idle"
    REPLY = "reply"
    LINGER = "linger"
    """A packet that must not be repeated has its reply; a second one would prove that the first was not its own."""
    QUIET = "quiet"
    """After a request that draws no reply."""
    QUARANTINE = "quarantine"
    """Waiting for late bytes to stop."""
    SETTLE = "settle"
    """The flush is on its way."""
    CLOSED = "closed"


class Users(Protocol):
    """The interface of the bus that the line uses: its queue and its state of the nodes."""

    def take(self, now_s: float) -> Transaction | None:
        """Remove and return the next transaction, or None when nothing is due."""

    def sent(self, transaction: Transaction) -> None:
        """Note that a transaction that was taken is on the wire."""

    def prepare_next(self, transaction: Transaction, asked_at_s: float, byte_s: float) -> None:
        """Prepare the next transaction, while there is time.

        Args:
            transaction: on the wire.
            asked_at_s: when the last bit of its request leaves, in loop time.
            byte_s: how long a byte takes now.
        """

    def next_due_s(self) -> float:
        """Return when the next exchange is due, in loop time."""

    def stop_waits(self) -> bool:
        """Tell whether a stop is queued."""

    def failing(self) -> set[int]:
        """Return the nodes that did not reply to their last exchange."""

    def answered(self, transaction: Transaction, timing: Timing | None = None) -> None:
        """Note that the transaction's node replied, and when if the reply is accepted, or that no reply was due."""

    def missed(self, transaction: Transaction, now_s: float) -> None:
        """Note that the transaction's node did not reply; called before the transaction's own `lost`."""

    def again(self, transaction: Transaction) -> None:
        """Give the transaction back to the front of its lane."""

    def line_lost(self, reason: str) -> None:
        """Note the loss of the line; called once, after every transaction on it has its outcome."""


NOT_PLAIN = 0
"""No reply has so few bytes."""
ANY = 1  # byte to expect where every byte counts
LATE_S = 1.0
"""Longest delay of the next planned action, seconds; a line that is later counts as stuck."""
_FLAWS = {ReplyVerdict.CORRUPT: "is damaged", ReplyVerdict.REJECTED: "packet rejected"}


class Line(Receiver):
    """One open transport with its exchange; a `Receiver`, created at every opening.

    Attributes:
        phase: its state.
        wire: its end on the host.
        undelivered: replies to polls that wait to be delivered with those after them, oldest first.
    """

    def __init__(
        self,
        settings: BusSettings,
        transport: Transport,
        users: Users,
        resync: Resync,
        statistics: BusStatistics,
        wire_log: WireLog,
    ) -> None:
        self.phase = Phase.IDLE
        self._settings = settings
        self.wire = Wire(settings, transport, statistics, wire_log)
        self._transport, self._log = transport, wire_log
        self._users = users
        self._resync = resync
        self._quarantine = Quarantine(resync)
        self._statistics = statistics
        self._loop = asyncio.get_running_loop()
        self._watchdog = Watchdog(self._loop, self._expired)
        self._transaction: Transaction | None = None
        self._distrusted = False
        self._sent_at_s = 0.0
        self._pieces = Pieces()
        self._missing, self._whole_from_s = NOT_PLAIN, NEVER_S  # bytes that complete the reply to a plain transaction
        self._kept = (b"", 0.0)  # the reply that is lingered over, and when it came
        self.undelivered: deque[tuple[Transaction, bytes, Timing]] = deque()
        self._coalesce_s, self._deliver_by_s = settings.coalesce_s, NEVER_S
        transport.attach(self)

    def on_time(self, now_s: float) -> bool:
        """Tell whether the line acts on time: the time of its next action is always set, and is not past."""
        if self.phase is Phase.IDLE:
            return not self._users.stop_waits() and now_s <= self._users.next_due_s() + LATE_S
        due_s = self._watchdog.deadline_s
        return due_s < NEVER_S and now_s <= due_s + LATE_S

    def kick(self) -> None:
        """Check the queue: something was added to it."""
        if self.phase is Phase.IDLE:
            self._next()
        elif self.phase is Phase.QUARANTINE and self._users.stop_waits():
            self._watchdog.set(self._loop.time())

    def distrust(self) -> None:
        """Resynchronise before another reply is accepted: a reply may have belonged to an older request.

        Every later reply then belongs to the request before it; so the reply on the wire is not accepted either, unless
        its exchange must not be repeated, nor are those that were not delivered yet.
        """
        while self.undelivered:
            transaction = self.undelivered.popleft()[0]
            transaction.lost(BadReply(f"node {transaction.exchange.node}: the reply may be to something older"))
        if self.phase is Phase.IDLE:
            self._quarantine.require()
            self._begin_quarantine(self._loop.time())
        elif self.phase is Phase.REPLY and self._transaction and self._transaction.exchange.repeatable:
            self._distrusted, self._missing = True, NOT_PLAIN

    def deliver(self) -> None:
        """Deliver the replies that wait, oldest first."""
        undelivered = self.undelivered
        while undelivered:
            transaction, reply, timing = undelivered.popleft()
            transaction.completed(reply, timing)

    def close(self, reason: str, *, for_good: bool = False) -> None:
        """Leave the line; the transaction on the wire, if any, is lost. Safe to call twice.

        Args:
            reason: for the errors.
            for_good: the bus ends: a poll that this interrupts does not count as a miss of its drive.
        """
        if self.phase is Phase.CLOSED:
            return
        self.phase = Phase.CLOSED
        self._watchdog.cancel()
        self.deliver()
        transaction, self._transaction = self._transaction, None
        if for_good and transaction and transaction.lane is POLL:
            transaction = None
        if transaction and transaction.lost(
            ReplyTimeout(f"node {transaction.exchange.node}: {reason} before the reply came")
        ):
            self._users.again(transaction)
        self._users.line_lost(reason)

    # -- receiver ----------------------------------------------------------------------------------------------------

    @override
    def transport_lost(self, reason: str) -> None:
        # after a failed write the port reports the loss a second time
        if self.phase is Phase.CLOSED:
            return
        self._statistics.losses += 1
        self.wire.note(WireEvent.LOST, self._loop.time(), remark=reason)
        self.close(reason)

    @override
    def data_received(self, data: bytes) -> None:
        now_s, transaction = self._loop.time(), self._transaction
        if transaction and len(data) == self._missing and now_s >= self._whole_from_s:
            reply = self._pieces.held + data
            if transaction.exchange.check(reply) is ReplyVerdict.INTACT:
                self._complete_plain(transaction, reply, data, now_s)
                return
        self._take_apart(data, now_s)

    def _take_apart(self, data: bytes, now_s: float) -> None:
        """Sort bytes that need not be one whole reply."""
        was_plain, self._missing = self._missing, NOT_PLAIN
        self._statistics.bytes_in += len(data)
        own_taken_off = self.wire.without_echo(data, now_s)
        if own_taken_off is None:
            self._collided(data, now_s)
            return
        data = own_taken_off
        if (transaction := self._transaction) and data and self.phase is Phase.LINGER:
            self.wire.note(WireEvent.RECEIVED, now_s, data, "follows a reply")
            self._distrust(transaction, self._kept[0] + data, "was followed by another one", now_s)
            return
        if data and (transaction is None or self.phase is not Phase.REPLY):
            self._stray(data, now_s)
            return
        while transaction and data:
            whole = self._pieces.add(transaction.exchange, data, now_s)
            if whole is None:
                self.wire.note(WireEvent.PART, now_s, data)
                if was_plain and not self._pieces.early:
                    self._missing = transaction.exchange.reply_bytes - len(self._pieces.held)
                self._transport.expect(max(ANY, self._missing))
                return
            verdict = transaction.exchange.check(whole.reply)
            if verdict is not ReplyVerdict.FOREIGN:
                self._judge(transaction, whole, verdict, data, now_s)
                return
            self.wire.stray(data[: len(data) - len(whole.surplus)], now_s, "foreign reply")
            data = whole.surplus

    def _judge(
        self, transaction: Transaction, whole: CompleteReply, verdict: ReplyVerdict, arrived: bytes, now_s: float
    ) -> None:
        """Accept a reply, wait for a better one, or reject it."""
        flaw = "came too early" if whole.early else _FLAWS.get(verdict, "")
        why = "came with surplus bytes" if whole.surplus else flaw
        self.wire.note(WireEvent.RECEIVED, now_s, arrived, why)
        if self._distrusted:
            self._distrust(transaction, whole.reply, "may be to something older", now_s)
        elif whole.surplus or whole.early or verdict is ReplyVerdict.CORRUPT:
            self._distrust(transaction, whole.reply + whole.surplus, why, now_s)
        elif not transaction.exchange.repeatable and now_s < (until_s := self._true_reply_by_s(transaction)):
            # not accepted before no other reply can come
            self.phase, self._kept = Phase.LINGER, (whole.reply, now_s)
            self._watchdog.set(until_s)
        elif verdict is ReplyVerdict.REJECTED:
            self._rejected(transaction)
        else:
            self._complete(transaction, whole.reply, now_s)

    def _true_reply_by_s(self, transaction: Transaction) -> float:
        """Return until when the node's own reply may still arrive after another one; minus infinity when unpaced."""
        if not self._settings.paced:
            return -NEVER_S
        return self._sent_at_s + self.wire.longest_s(transaction.exchange) + LINGER_S

    def _settle(self, transaction: Transaction, reply: bytes, now_s: float) -> None:
        if transaction.exchange.check(reply) is ReplyVerdict.REJECTED:
            self._rejected(transaction)
        else:
            self._complete(transaction, reply, now_s)

    def _complete_plain(self, transaction: Transaction, reply: bytes, arrived: bytes, now_s: float) -> None:
        """Write the next request before anything else: until then the wire is idle, afterwards there is time."""
        sent_at_s, failure, users, slow = self._sent_at_s, "", self._users, transaction.slow_to_deliver
        following = users.take(now_s)
        if following is not None and not following.at_baud:
            failure = self._put(following, self._loop.time())
            if slow and self._transport.pushes:
                self._transport.push()
        else:
            self._transaction, self.phase = None, Phase.IDLE
        self._statistics.bytes_in += len(arrived)
        self._log.add(now_s, WireEvent.RECEIVED, arrived)
        timing = self.wire.replied(transaction, reply, sent_at_s, now_s)
        users.answered(transaction, timing)
        undelivered, waits = self.undelivered, False
        if not undelivered:
            self._deliver_by_s = now_s + self._coalesce_s
        if joins := slow or bool(undelivered):
            undelivered.append((transaction, reply, timing))
        if following is None:
            self._next(AT_ONCE)
        elif following.at_baud:
            self._send(following, now_s, AT_ONCE[following.lane])
        else:
            # the next reply should come in about the time that this one took
            waits = slow and following.lane is POLL and now_s + now_s - sent_at_s < self._deliver_by_s
            self._attend(following, AT_ONCE[following.lane], failure, early=slow and not self._coalesce_s)
        if not joins:
            transaction.completed(reply, timing)
        elif not waits:
            self.deliver()
        if self._missing and transaction.lane is POLL and (following := self._transaction):
            # callers that wait for a reply got it first
            byte_s = self.wire.byte_s
            users.prepare_next(following, self._sent_at_s + len(following.exchange.request) * byte_s, byte_s)

    def _complete(self, transaction: Transaction, reply: bytes, now_s: float) -> None:
        """Free the line, start the next exchange, and only then let this one be decoded and delivered."""
        timing = self.wire.replied(transaction, reply, self._sent_at_s, now_s)
        if isinstance(transaction, ResyncExchange):
            self._probed(transaction, reply, timing, now_s)
            return
        self._release(transaction, transaction.then_baud)
        self._next(AT_ONCE)
        self._users.answered(transaction, timing)
        if self.undelivered:  # only polls follow those that wait, so it is one
            self.undelivered.append((transaction, reply, timing))
            self.deliver()
        else:
            transaction.completed(reply, timing)

    def _release(self, transaction: Transaction, then_baud: int | None = None) -> None:
        """Free the line, at the rate that it has from now on."""
        self._transaction, self.phase = None, Phase.IDLE
        if then_baud or transaction.at_baud:
            self._tune(then_baud or self.wire.baud)

    def _rejected(self, transaction: Transaction) -> None:
        """The node did not execute our packet: the line is in step, and sending again is always safe."""
        self._statistics.rejected_packets += 1
        self.deliver()
        self._users.answered(transaction)
        if transaction.rejected():
            self._send_again(transaction)
        self._release(transaction)
        self._next()

    # -- losses ------------------------------------------------------------------------------------------------------

    def _distrust(self, transaction: Transaction, reply: bytes, why: str, now_s: float) -> None:
        self._statistics.corrupt_replies += 1
        self._lose(transaction, BadReply(f"node {transaction.exchange.node}: reply {reply.hex(' ')} {why}"), now_s)

    def _lose(self, transaction: Transaction, error: BusError, now_s: float) -> None:
        """Settle the transaction whose reply cannot be valid any more, and resynchronise the line."""
        self.deliver()
        self._users.missed(transaction, now_s)
        if not isinstance(transaction, ResyncExchange):
            self._quarantine.require()
        # before the resynchronisation, which a stop that is sent again cuts short
        if transaction.lost(error):
            self._send_again(transaction)
        self._release(transaction)
        self._begin_quarantine(now_s)

    def _send_again(self, transaction: Transaction) -> None:
        self._statistics.resent += 1
        self._users.again(transaction)

    def _collided(self, data: bytes, now_s: float) -> None:
        """Handle an echo that differs from what was sent."""
        if self._transaction and self.phase is Phase.REPLY:
            why = "follows an echo that differs: collision"
            self.wire.note(WireEvent.RECEIVED, now_s, data, why)
            self._distrust(self._transaction, data, why, now_s)
        else:
            self._stray(data, now_s)

    def _stray(self, data: bytes, now_s: float) -> None:
        """Handle bytes outside a reply: late ones in a resynchronisation, otherwise a sign of being out of step."""
        self.wire.stray(data, now_s)
        if self.phase is Phase.QUARANTINE and not self._users.stop_waits():
            self._watchdog.set(self._quarantine.disturbed(now_s))
        elif self.phase is Phase.IDLE:
            self._quarantine.require()
            self._begin_quarantine(now_s)

    def _begin_quarantine(self, now_s: float) -> None:
        if self.phase is Phase.CLOSED:
            return
        self._distrusted = False
        self._statistics.resynchronisations += 1
        self.wire.note(WireEvent.RESYNC, now_s)
        self.phase = Phase.QUARANTINE
        self._transport.expect(ANY)
        self.wire.forget_echo()
        silent_s = self._quarantine.raised(now_s)
        self._watchdog.set(now_s if self._users.stop_waits() else silent_s)

    def _flush(self, now_s: float) -> None:
        self.phase = Phase.SETTLE
        flush = self._resync.flush
        echo_s = self._settings.margin_s if self._settings.echo else 0.0
        self._watchdog.set(now_s + len(flush) * self.wire.byte_s + self._resync.settle_s + echo_s)
        if flush:
            self.wire.sent(flush, now_s, "flush")
            if failure := self.wire.write(flush):
                self.transport_lost(failure)

    def _flushed(self, now_s: float) -> None:
        """After the flush: prove with a known reply that the line is in step, unless a stop cannot wait for that."""
        self.wire.discard_input()
        self.phase = Phase.IDLE
        probe = None if self._users.stop_waits() else self._quarantine.probe(self._users.failing(), now_s)
        if probe:
            self._send(probe, now_s, "probe")
        else:
            self._next()

    def _probed(self, probe: ResyncExchange, reply: bytes, timing: Timing, now_s: float) -> None:
        probe.completed(reply, timing)
        if not probe.passed:
            why = "is not the known one"
            self.wire.note(WireEvent.RECEIVED, now_s, remark=why)
            self._distrust(probe, reply, why, now_s)
            return
        self._quarantine.proven()
        self._users.answered(probe)
        self._release(probe)
        self._next()

    # -- sending -----------------------------------------------------------------------------------------------------

    def _next(self, remarks: tuple[str, ...] = LANES) -> None:
        """Put the next exchange on the wire, with its lane's remark in the log, or sleep until one is due."""
        if self.phase is not Phase.IDLE:
            return
        now_s = self._loop.time()
        if not (self._quarantine.in_step or self._users.stop_waits()):
            self._begin_quarantine(now_s)  # only a stop may use a line that is not proven to be in step
            return
        if transaction := self._users.take(now_s):
            self._send(transaction, now_s, remarks[transaction.lane])
        else:
            self._transport.expect(ANY)
            self._watchdog.set(self._users.next_due_s())

    def _send(self, transaction: Transaction, now_s: float, remark: str) -> None:
        if transaction.at_baud:
            self._transaction = transaction
            self._tune(transaction.at_baud, for_good=False)
            if self.phase is Phase.CLOSED:
                return
        self._attend(transaction, remark, self._put(transaction, now_s))

    def _put(self, transaction: Transaction, now_s: float) -> str:
        """Write a request and do nothing else; return why the line was lost over it, if it was."""
        self._transaction, self._sent_at_s = transaction, now_s
        self.phase = Phase.REPLY if transaction.exchange.reply_bytes else Phase.QUIET
        try:
            self._transport.write(transaction.exchange.request)
        except TransportLost as error:
            return error.message
        return ""

    def _attend(self, transaction: Transaction, remark: str, failure: str, *, early: bool = False) -> None:
        """Note a request that has just been written, and prepare for its reply.

        When processing takes long, the line is woken one byte `early`, so that caches are warm.
        """
        exchange, settings, wire, statistics = transaction.exchange, self._settings, self.wire, self._statistics
        request, expected, byte_s, sent_at_s = exchange.request, exchange.reply_bytes, wire.byte_s, self._sent_at_s
        request_s = len(request) * byte_s
        earliest_s = sent_at_s + CLOCK_TOLERANCE * request_s if settings.paced else -NEVER_S
        self._pieces.begin(earliest_s, CLOCK_TOLERANCE * byte_s)
        self._whole_from_s = earliest_s + CLOCK_TOLERANCE * byte_s * expected
        # a whole intact reply is all that it takes to go on to the next transaction
        goes_on = exchange.repeatable and not (
            exchange.total_bytes or transaction.then_baud or transaction.at_baud or transaction.proves
        )
        self._missing = missing = expected if goes_on and self._quarantine.in_step and not settings.echo else NOT_PLAIN
        self._transport.expect(missing - early if missing > early else ANY)
        over_s = sent_at_s + request_s + exchange.response_s
        if expected:
            over_s += expected * byte_s + settings.margin_s + self._transport.lag_s
        self._watchdog.set(over_s)
        statistics.exchanges += 1
        statistics.bytes_out += len(request)
        self._log.add(sent_at_s, WireEvent.SENT, request, remark)
        if wire.echo is not None:
            wire.echo.sent(request)
        self._users.sent(transaction)
        if failure:
            self.transport_lost(failure)

    def _tune(self, baud: int, *, for_good: bool = True) -> None:
        try:
            self.wire.tune(baud, for_good=for_good)
        except TransportLost as error:
            self.transport_lost(error.message)

    # -- time --------------------------------------------------------------------------------------------------------

    def _expired(self, now_s: float) -> None:
        if self.phase in (Phase.LINGER, Phase.QUIET):
            self.wire.note(WireEvent.SETTLED, now_s)
        match self.phase:
            case Phase.IDLE:
                self._next()
            case Phase.REPLY if self._transaction:
                self._timed_out(self._transaction, now_s)
            case Phase.LINGER if self._transaction:
                self._settle(self._transaction, *self._kept)
            case Phase.QUIET if self._transaction:
                self._quiet_over(self._transaction, now_s)
            case Phase.QUARANTINE:
                self._flush(now_s)
            case Phase.SETTLE:
                self._flushed(now_s)

    def _timed_out(self, transaction: Transaction, now_s: float) -> None:
        self._transport.collect()
        if self._transaction is not transaction or self.phase is not Phase.REPLY:
            return  # the reply was there after all
        self._statistics.timeouts += 1
        got = f"{len(held)} of {transaction.exchange.reply_bytes} bytes" if (held := self._pieces.held) else "nothing"
        error = ReplyTimeout(f"node {transaction.exchange.node} on bus {self._settings.name} sent {got} in time")
        self.wire.note(WireEvent.TIMEOUT, now_s, remark=error.message)
        self._lose(transaction, error, now_s)

    def _quiet_over(self, transaction: Transaction, now_s: float) -> None:
        """An exchange without a reply is complete once the line may be used again."""
        timing = self.wire.silent(transaction, self._sent_at_s, now_s)
        self._users.answered(transaction)
        self._release(transaction, transaction.then_baud)
        self._next()
        transaction.completed(b"", timing)
