"""An open line: keeps exactly one exchange outstanding and gets back in step after a loss.

Reply-driven: when a reply is complete and intact, the next request goes on the wire first; only then is the old reply
noted, decoded and delivered. No task and no timer per exchange. On a line that is busy with polls their replies are
delivered several at a time (`BusSettings.coalesce_s`), in order, and before anything but a poll has its outcome.

No reply is ever credited to a later request. Replies of these lines carry no sequence number, so the line relies on
three facts: bytes that arrive sooner than the wire can carry them belong to something older; nothing but the reply may
follow a request; after any loss the line is resynchronised (`Resync`) before it is used again.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError, ReplyTimeout, TransportLost
from ldcnd.line.exchange import NEVER_S, Exchange, Lane, PacketEffect, ReplyVerdict, Resync, Timing
from ldcnd.line.flight_recorder import AT_ONCE_REMARK, GUEST_REMARK, BusStatistics, WireEvent, WireLog
from ldcnd.line.schedule import POLL, Schedule
from ldcnd.line.settings import LINGER_S, BusSettings
from ldcnd.line.transaction import PollTransaction, Transaction
from ldcnd.line.transport import Receiver, Transport
from ldcnd.line.watchdog import Watchdog

LANES = tuple(lane.name.lower() for lane in Lane)
"""Remarks of the wire log about packets, by lane."""
AT_ONCE = tuple(f"{lane}{AT_ONCE_REMARK}" for lane in LANES)
"""The same for packets that waited for the reply before them."""


Listener = Callable[[Exchange[Any], bytes, Timing], None]
"""Hears each intact reply before who waits for it does; returns at once and never raises."""


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
    FLUSH = "flush"
    """The flush is on its way."""
    CLOSED = "closed"


NOT_PLAIN = 0
"""No reply has so few bytes."""
ANY = 1  # byte to expect where every byte counts
LATE_S = 1.0
"""Longest delay of the next planned action, seconds; a line that is later counts as stuck."""
CLOCK_TOLERANCE = 0.9
"""A drive's baud clock may be 3 % fast and a time stamp a little early: bytes count as too early below this share."""
PROBE_ROUNDS = 3
GONE_PAUSE = 5
"""Shortest time between two probes of a node that has been gone for long, in multiples of the margin."""
LONGEST_QUARANTINE = 20
"""Longest wait for silence, in multiples of `quiet_s`; a line that is never silent is flushed after that."""
READS = PacketEffect.READS  # looked up slowly in its class
_OLDER = "may be to something older"
_FLAWS = {ReplyVerdict.CORRUPT: "is damaged", ReplyVerdict.REJECTED: "packet rejected"}


class Line(Receiver):
    """One open transport with its exchange; a `Receiver`, created at every opening.

    Args:
        settings: the line's.
        transport: the open port.
        schedule: what goes on the wire next; learns who replies.
        resync: how the line gets back in step.
        statistics: counts what passes.
        wire_log: records what passes.
        report_loss: called once with the reason when the line is lost or closed, after every transaction on it has
            its outcome.
        report_failure: called with what somebody has raised who was told of a reply or its loss; the line goes on.
        listeners: hear each intact reply.

    Attributes:
        phase: its state.
        transport: the open port.
        baud: the rate of all exchanges that have none of their own.
        byte_s: how long a byte takes now, in seconds.
        undelivered: replies to polls that wait to be delivered with those after them, oldest first.
    """

    def __init__(
        self,
        settings: BusSettings,
        transport: Transport,
        schedule: Schedule[Transaction],
        resync: Resync,
        statistics: BusStatistics,
        wire_log: WireLog,
        report_loss: Callable[[str], None],
        *,
        report_failure: Callable[[BaseException], None],
        listeners: Sequence[Listener] = (),
    ) -> None:
        self.phase = Phase.IDLE
        self.transport = transport
        self.baud, self.byte_s = settings.baud, settings.bits_per_byte / settings.baud
        self._settings = settings
        self._schedule = schedule
        self._resync = resync
        self._statistics = statistics
        self._log = wire_log
        self._report_loss = report_loss
        self._report_failure = report_failure
        self._listeners = listeners
        self._loop = asyncio.get_running_loop()
        self._watchdog = Watchdog(self._loop, self._expired)
        self._transaction: Transaction | None = None  # on the wire
        self._sent_at_s = 0.0
        self._echo = bytearray()  # bytes of ours that are still to come back
        # the reply so far: when its bytes can be here at the earliest, those that are, and whether some came sooner
        self._earliest_s, self._held, self._early = 0.0, b"", False
        self._missing, self._whole_from_s = NOT_PLAIN, NEVER_S  # bytes that complete the reply to a plain transaction
        self._kept = (b"", 0.0)  # the reply that is lingered over, and when it came
        self._distrusted = False  # the reply on the wire may be to something older
        self._in_step = True  # nothing makes it uncertain to which request a reply belongs
        self._probes_left, self._probed_s, self._quarantined_s = 0, -NEVER_S, 0.0
        self.undelivered: deque[tuple[Transaction, bytes, Timing]] = deque()
        self._coalesce_s, self._deliver_by_s = settings.coalesce_s, NEVER_S
        transport.attach(self)

    @property
    def on_wire(self) -> Transaction | None:
        """What was sent last, as long as its reply is waited for."""
        return self._transaction

    def on_time(self, now_s: float) -> bool:
        """Tell whether the line acts on time: the time of its next action is always set, and is not past."""
        if self.phase is Phase.IDLE:
            return not self._schedule.stop_waits() and now_s <= self._schedule.polls.next_due_s() + LATE_S
        due_s = self._watchdog.deadline_s
        return due_s < NEVER_S and now_s <= due_s + LATE_S

    def kick(self) -> None:
        """Check the schedule: something was added to it."""
        if self.phase is Phase.IDLE:
            self._next()
        elif self.phase is Phase.QUARANTINE and self._schedule.stop_waits():
            # it waits for the flush alone, see `_begin_quarantine`
            self._watchdog.set(self._loop.time())

    def distrust(self) -> None:
        """Resynchronise before another request: a reply that was delivered may have belonged to an older one.

        Every later reply then belongs to the request before it; so the reply on the wire is not accepted either, unless
        its exchange must not be repeated, nor are those that were not delivered yet.
        """
        while self.undelivered:
            transaction = self.undelivered.popleft()[0]
            self._tell(transaction.lost, BadReply(f"node {transaction.exchange.node}: the reply {_OLDER}"))
        self._require_probe()
        if self.phase is Phase.IDLE:
            self._begin_quarantine(self._loop.time())
        elif self.phase is Phase.REPLY and self._transaction and self._transaction.exchange.repeatable:
            # any other one lingers: if a late reply comes in its place, its own follows and shows that
            self._distrusted, self._missing = True, NOT_PLAIN

    def deliver(self) -> None:
        """Deliver the replies that wait, oldest first."""
        undelivered = self.undelivered
        while undelivered:
            self._hand_over(*undelivered.popleft())

    def _hand_over(self, transaction: Transaction, reply: bytes, timing: Timing) -> None:
        for listener in self._listeners:
            self._tell(listener, transaction.exchange, reply, timing)
        self._tell(transaction.completed, reply, timing)

    def _tell(self, told: Callable[..., bool | None], *what: object) -> bool:
        """Tell somebody what has come; what is wrong with him neither leaves the line behind half done nor closes it.

        Returns what he answers; false if he raises.
        """
        try:
            return bool(told(*what))
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # noqa: BLE001 - a panic is no Exception
            self._report_failure(error)
            return False

    def close(self, reason: str, *, for_good: bool = False) -> None:
        """Leave the line; the transaction on the wire, if any, is lost. Safe to call twice.

        Args:
            reason: for the errors.
            for_good: the bus ends: a poll that this interrupts does not count as a miss of its drive.
        """
        if self.phase is Phase.CLOSED:
            return
        # first: what is delivered may queue something, and `kick` must not find a line that takes it
        self.phase = Phase.CLOSED
        self._watchdog.cancel()
        self.deliver()
        transaction, self._transaction = self._transaction, None
        if for_good and transaction and transaction.lane is POLL:
            transaction = None  # its drive has not failed to answer
        if transaction and self._tell(
            transaction.lost, ReplyTimeout(f"node {transaction.exchange.node}: {reason} before the reply came")
        ):
            self._schedule.requeue(transaction, transaction.lane)
        # drains the schedule: what was to be sent again has its outcome there
        self._report_loss(reason)

    # -- sending -----------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Put the next exchange on the wire, or sleep until one is due."""
        if self.phase is not Phase.IDLE:
            return
        now_s = self._loop.time()
        if transaction := self._take(now_s):
            self._send(transaction, now_s, LANES[transaction.lane])
        else:
            self._rest(now_s)

    def _rest(self, now_s: float) -> None:
        """Sleep until the next exchange is due, on a line that is in step."""
        if self._in_step:
            self.transport.expect(ANY)
            self._watchdog.set(self._schedule.polls.next_due_s())
        else:
            self._begin_quarantine(now_s)

    def _take(self, now_s: float) -> Transaction | None:
        """Remove and return what goes on the wire now, or None: this is the only gate between queue and wire.

        A queue may be long, so who is at the address and whether the motion is still permitted is asked here.
        """
        schedule = self._schedule
        while self._in_step or schedule.stop_waits():  # only a stop may use a line that is not proven to be in step
            job = schedule.take_job(now_s)
            if job is None:
                poller = schedule.polls.take(now_s)
                if poller is None:
                    return None
                wanted_at_s, exchange = poller.due_at_s, poller.next_exchange(now_s)
                # a poll passes neither proof nor permission: those are asked of jobs only
                if exchange.effect is not READS:
                    raise AssertionError(f"the poll {exchange.request.hex(' ')} does not say that it only reads")
                return PollTransaction(poller, exchange, wanted_at_s)
            if job.condition and self.undelivered:
                self.deliver()  # permission is asked of all that the drives have said by now
                if self._distrusted:  # and one of them cannot have said that
                    schedule.requeue(job, job.lane)
                    return None
            if job.may_go(now_s):
                return job
        return None

    def _send(self, transaction: Transaction, now_s: float, remark: str) -> None:
        if transaction.at_baud:
            self._transaction = transaction
            # the line has its owner already: if the port is lost over the rate, `close` reports that to it
            self._tune(transaction.at_baud, for_good=False)
            if self.phase is Phase.CLOSED:
                return
        self._await_reply(transaction, remark, self._write_request(transaction, now_s))

    def _write_request(self, transaction: Transaction, now_s: float) -> str:
        """Write a request and do nothing else; return why the line was lost over it, if it was."""
        # One at a time: a second command would overwrite the first in the module's buffer, and every module drops the
        # reply that it is sending (PIC-SERVO manual, 4.1); a SmartStep is silent about it (SmartStep manual, 2.1).
        self._transaction, self._sent_at_s = transaction, now_s
        if not self._in_step and not transaction.proves:
            # a stop does not wait until no late reply can come any more, and a status packet that comes while it is on
            # its way has no number: it would be taken for heard although it was lost
            self._distrusted = True
        self.phase = Phase.REPLY if transaction.exchange.reply_bytes else Phase.QUIET
        try:
            self.transport.write(transaction.exchange.request)
        except TransportLost as error:
            return error.message
        return ""

    def _await_reply(self, transaction: Transaction, remark: str, failure: str, *, early: bool = False) -> None:
        """Note a request that has just been written, and prepare for its reply.

        When processing takes long, the line is woken one byte `early`, so that caches are warm.
        """
        exchange, settings, statistics, byte_s = transaction.exchange, self._settings, self._statistics, self.byte_s
        request, expected, sent_at_s = exchange.request, exchange.reply_bytes, self._sent_at_s
        request_s = len(request) * byte_s
        self._held, self._early = b"", False
        # a module answers a complete packet only, so nothing of its reply can be here before the request is over
        self._earliest_s = earliest_s = sent_at_s + CLOCK_TOLERANCE * request_s if settings.paced else -NEVER_S
        self._whole_from_s = earliest_s + CLOCK_TOLERANCE * byte_s * expected
        # a whole intact reply is all that it takes to go on to the next transaction
        goes_on = exchange.repeatable and not (
            exchange.total_bytes or transaction.then_baud or transaction.at_baud or transaction.proves
        )
        self._missing = missing = expected if goes_on and self._in_step and not settings.echo else NOT_PLAIN
        self.transport.expect(missing - early if missing > early else ANY)
        # a module replies at the end of its servo cycle, within 0.51 ms (PIC-SERVO manual, 4.1), a SmartStep within
        # 0.2 s (SmartStep manual, 2.1); what draws no reply needs that time of silence, or it would be overwritten
        over_s = sent_at_s + request_s + exchange.response_s
        if expected:
            over_s += expected * byte_s + settings.margin_s + self.transport.lag_s
        self._watchdog.set(over_s)
        statistics.exchanges += 1
        statistics.bytes_out += len(request)
        remark = f"{transaction.guest}{GUEST_REMARK}{remark}" if transaction.guest else remark
        self._log.add(sent_at_s, WireEvent.SENT, request, remark)
        if settings.echo:
            self._echo += request
        if poller := transaction.poller:
            self._schedule.reschedule(poller, poller.due_at_s)
        # last, so that the log has the request before the loss, and `close` reports it as one that was on the wire
        if failure:
            self.transport_lost(failure)

    def _release(self, transaction: Transaction, then_baud: int | None = None) -> None:
        """Free the line, at the rate that it has from now on."""
        self._transaction, self.phase = None, Phase.IDLE
        if then_baud or transaction.at_baud:
            self._tune(then_baud or self.baud)

    def _tune(self, baud: int, *, for_good: bool = True) -> None:
        try:
            self.transport.set_baud(baud)
        except TransportLost as error:
            self.transport_lost(error.message)
            return
        self._log.add(self._loop.time(), WireEvent.BAUD, note=str(baud))
        self.byte_s = self._settings.bits_per_byte / baud
        if for_good:
            self.baud = baud

    # -- receiving ---------------------------------------------------------------------------------------------------

    @override
    def transport_lost(self, reason: str) -> None:
        # after a failed write the port reports the loss a second time
        if self.phase is Phase.CLOSED:
            return
        self._statistics.losses += 1
        self._log.add(self._loop.time(), WireEvent.LOST, note=reason)
        self.close(reason)

    @override
    def data_received(self, data: bytes) -> None:
        now_s, transaction = self._loop.time(), self._transaction
        # nearly every reply: whole, in one piece, and no sooner than the wire can have carried it
        if transaction and len(data) == self._missing and now_s >= self._whole_from_s:
            reply = self._held + data
            if transaction.exchange.check(reply) is ReplyVerdict.INTACT:
                self._complete(transaction, reply, now_s, data)
                return
        self._parse_input(data, now_s)

    def _parse_input(self, data: bytes, now_s: float) -> None:
        """Sort bytes that need not be one whole reply."""
        was_plain, self._missing = self._missing, NOT_PLAIN
        self._statistics.bytes_in += len(data)
        if self._echo:
            # our own bytes are taken off by count, because a reply may equal its request
            own, data = data[: len(self._echo)], data[len(self._echo) :]
            if not self._echo.startswith(own):
                self._echo.clear()
                self._handle_collision(own + data, now_s)
                return
            del self._echo[: len(own)]
            self._log.add(now_s, WireEvent.ECHO, own)
        transaction = self._transaction
        if transaction and data and self.phase is Phase.LINGER:
            self._log.add(now_s, WireEvent.RECEIVED, data, "follows a reply")
            self._discard_reply(transaction, self._kept[0] + data, "was followed by another one", now_s)
            return
        if data and (transaction is None or self.phase is not Phase.REPLY):
            self._handle_stray(data, now_s)
            return
        while transaction and data:
            exchange, reply = transaction.exchange, self._held + data
            self._early = self._early or now_s < self._earliest_s + CLOCK_TOLERANCE * self.byte_s * len(reply)
            total = exchange.total_bytes(reply) if exchange.total_bytes else exchange.reply_bytes
            if total is None or len(reply) < total:
                self._held = reply
                self._log.add(now_s, WireEvent.PART, data)
                if was_plain and not self._early:
                    self._missing = exchange.reply_bytes - len(reply)
                self.transport.expect(max(ANY, self._missing))
                return
            reply, surplus = reply[:total], reply[total:]
            verdict = exchange.check(reply)
            if verdict is not ReplyVerdict.FOREIGN:
                flaw = "came too early" if self._early else _FLAWS.get(verdict, "")
                why = "came with surplus bytes" if surplus else flaw
                self._log.add(now_s, WireEvent.RECEIVED, data, why)
                if surplus or self._early or verdict is ReplyVerdict.CORRUPT:
                    self._discard_reply(transaction, reply + surplus, why, now_s)
                else:
                    self._judge(transaction, reply, verdict, now_s)
                return
            self._note_stray(data[: len(data) - len(surplus)], now_s, "foreign reply")
            self._held, self._early, data = b"", False, surplus

    def _judge(self, transaction: Transaction, reply: bytes, verdict: ReplyVerdict, now_s: float) -> None:
        """Accept a whole reply, or wait whether another one follows."""
        if self._distrusted:
            # its node has most likely obeyed, so the second one goes behind stops that were not sent yet
            if verdict is ReplyVerdict.INTACT and transaction.lane is Lane.STOP:
                transaction.doubt()
            self._discard_reply(transaction, reply, _OLDER, now_s)
        elif not transaction.exchange.repeatable and now_s < (until_s := self._true_reply_by_s(transaction)):
            # What could move a drive twice is not repeated, so its reply has to be its own: a status packet has neither
            # address nor number (PIC-SERVO manual, 4.1), so none is accepted before no other one can come.
            self.phase, self._kept = Phase.LINGER, (reply, now_s)
            self._watchdog.set(until_s)
        else:
            self._accept(transaction, reply, verdict, now_s)

    def _true_reply_by_s(self, transaction: Transaction) -> float:
        """Return until when the node's own reply may still arrive after another one; minus infinity when unpaced."""
        if not self._settings.paced:
            return -NEVER_S
        return self._sent_at_s + transaction.exchange.longest_s(self.byte_s) + LINGER_S

    def _accept(self, transaction: Transaction, reply: bytes, verdict: ReplyVerdict, now_s: float) -> None:
        if verdict is ReplyVerdict.REJECTED:
            self._handle_rejection(transaction, reply, now_s)
        elif transaction.proves:
            self._judge_probe(transaction, reply, now_s)
        else:
            self._complete(transaction, reply, now_s)

    def _complete(self, transaction: Transaction, reply: bytes, now_s: float, arrived: bytes = b"") -> None:
        """Write the next request before anything else: until then the wire is idle, afterwards there is time.

        Args:
            transaction: which is complete.
            reply: to it.
            now_s: when its last byte came, in loop time.
            arrived: those of its bytes that are not noted yet.
        """
        slow, sent_at_s, byte_s = transaction.slow_to_deliver, self._sent_at_s, self.byte_s
        # before the next request is written, which has the rate of the line
        if transaction.then_baud or transaction.at_baud:
            self._release(transaction, transaction.then_baud)
        following, failure = self._write_next(now_s, push=slow)
        if arrived:
            self._statistics.bytes_in += len(arrived)
            self._log.add(now_s, WireEvent.RECEIVED, arrived)
        # behind a stop that goes out on a line out of step it is the reply to that one which is distrusted
        if self._distrusted and following is None:
            self._discard_reply(transaction, reply, _OLDER, now_s)
            return
        timing = self._count_reply(transaction, reply, sent_at_s, byte_s, now_s)
        is_poll = transaction.lane is POLL
        self._schedule.record_reply(transaction.exchange, timing if is_poll else None)
        undelivered, waits = self.undelivered, False
        if not undelivered:
            # the oldest one that waits decides, so that none waits for longer
            self._deliver_by_s = now_s + self._coalesce_s
        if joins := slow or bool(undelivered):
            undelivered.append((transaction, reply, timing))
        if following is None:
            if self.phase is Phase.IDLE:
                self._rest(self._loop.time())
        elif following.at_baud:
            self._send(following, now_s, AT_ONCE[following.lane])
        else:
            # the next reply should come in about the time that this one took
            waits = slow and following.lane is POLL and now_s + now_s - sent_at_s < self._deliver_by_s
            self._await_reply(following, AT_ONCE[following.lane], failure, early=slow and not self._coalesce_s)
        if not joins:
            self._hand_over(transaction, reply, timing)
        elif not waits:
            self.deliver()
        if self._missing and is_poll and (following := self._transaction):
            # callers that wait for a reply got it first
            exchange, byte_s = following.exchange, self.byte_s
            asked_at_s = self._sent_at_s + len(exchange.request) * byte_s
            self._schedule.prepare(exchange.node, asked_at_s, exchange.reply_bytes * byte_s)

    def _write_next(self, now_s: float, *, push: bool) -> tuple[Transaction | None, str]:
        """Write the next request, and `push` it; return it, and why the line was lost over it, if it was.

        One that has a rate of its own is not written yet.
        """
        following, failure = self._take(now_s), ""
        if following is not None and not following.at_baud:
            failure = self._write_request(following, self._loop.time())
            if push and self.transport.pushes:
                self.transport.push()
        elif self.phase is not Phase.CLOSED:
            self._transaction, self.phase = None, Phase.IDLE
        return following, failure

    def _count_reply(
        self, transaction: Transaction, reply: bytes, sent_at_s: float, byte_s: float, now_s: float
    ) -> Timing:
        """Count an intact reply; return when it was true."""
        statistics = self._statistics
        request_s, reply_s = len(transaction.exchange.request) * byte_s, len(reply) * byte_s
        over_s, begun_s, late_s = sent_at_s + request_s, now_s - reply_s, now_s - transaction.wanted_at_s
        statistics.replies += 1
        statistics.wire_busy_s += request_s + reply_s
        statistics.latency[transaction.lane].add(max(0.0, late_s))
        return Timing(sent_at_s, over_s, max(over_s, begun_s), now_s)

    def _handle_rejection(self, transaction: Transaction, reply: bytes, now_s: float) -> None:
        """Go on after a node did not execute our packet: the line is in step, and sending again is always safe."""
        # after a checksum, framing or overrun error a module executes nothing but still replies (PIC-SERVO manual, 4.1)
        self._statistics.rejected_packets += 1
        self.deliver()
        if self._distrusted:
            self._discard_reply(transaction, reply, _OLDER, now_s)
            return
        self._schedule.record_reply(transaction.exchange)
        if self._tell(transaction.rejected):
            self._send_again(transaction)
        self._release(transaction)
        self._next()

    # -- losses ------------------------------------------------------------------------------------------------------

    def _discard_reply(self, transaction: Transaction, reply: bytes, why: str, now_s: float) -> None:
        self._statistics.corrupt_replies += 1
        self._lose(transaction, BadReply(f"node {transaction.exchange.node}: reply {reply.hex(' ')} {why}"), now_s)

    def _lose(self, transaction: Transaction, error: BusError, now_s: float) -> None:
        """End the transaction whose reply cannot be valid any more, and resynchronise the line."""
        self.deliver()
        if not transaction.doubted:  # its node has most likely answered
            self._schedule.record_loss(transaction.exchange.node)
        if poller := transaction.poller:
            lost_s = transaction.exchange.longest_s(self.byte_s) + self._settings.margin_s
            lost_s += self._resync.longest_s(self.byte_s, self._schedule.mute.failing())
            self._schedule.put_off(poller, now_s, lost_s)
        if not transaction.proves:  # a probe that fails has its rounds counted
            self._require_probe()
        # before the resynchronisation, which a stop that is sent again cuts short
        if self._tell(transaction.lost, error):
            self._send_again(transaction)
        self._release(transaction)
        self._begin_quarantine(now_s)

    def _send_again(self, transaction: Transaction) -> None:
        self._statistics.resent += 1
        self._schedule.requeue(transaction, transaction.lane)

    def _handle_collision(self, data: bytes, now_s: float) -> None:
        """Handle an echo that differs from what was sent."""
        if self._transaction and self.phase is Phase.REPLY:
            # two senders at once: neither the request nor what follows it can be trusted
            why = "follows an echo that differs: collision"
            self._log.add(now_s, WireEvent.RECEIVED, data, why)
            self._discard_reply(self._transaction, data, why, now_s)
        else:
            self._handle_stray(data, now_s)

    def _note_stray(self, data: bytes, now_s: float, why: str = "") -> None:
        self._statistics.stray_bytes += len(data)
        self._log.add(now_s, WireEvent.STRAY, data, why)

    def _handle_stray(self, data: bytes, now_s: float) -> None:
        """Handle bytes outside a reply: late ones in a resynchronisation, otherwise a sign of being out of step."""
        self._note_stray(data, now_s)
        if self.phase is Phase.QUARANTINE and not self._schedule.stop_waits():
            quiet_s = self._resync.quiet_s
            # each late byte begins the silence anew, but no node that babbles keeps the line for good
            self._watchdog.set(min(now_s + quiet_s, self._quarantined_s + LONGEST_QUARANTINE * quiet_s))
        elif self.phase is Phase.IDLE:
            # nothing was asked: it answers something older, and the next reply may, too
            self._require_probe()
            self._begin_quarantine(now_s)

    # -- resynchronisation: silence, flush, and a reply that is known beforehand --------------------------------------

    def _require_probe(self) -> None:
        self._probes_left, self._in_step = PROBE_ROUNDS, False

    def _begin_quarantine(self, now_s: float) -> None:
        """Wait until no late reply can come any more; a stop that was not sent yet waits for the flush alone."""
        if self.phase is Phase.CLOSED:
            return
        self.phase, self._quarantined_s, self._distrusted = Phase.QUARANTINE, now_s, False
        self._statistics.resynchronisations += 1
        self._log.add(now_s, WireEvent.RESYNC)
        self.transport.expect(ANY)
        self._echo.clear()
        # a request makes all modules drop their replies and listen (PIC-SERVO manual, 4.1), so a stop need not wait
        self._watchdog.set(now_s if self._schedule.stop_waits() else now_s + self._resync.quiet_s)

    def _flush(self, now_s: float) -> None:
        """Fill up any half-received packet, so that the next request is not taken for the rest of it."""
        # 16 nulls, a millisecond, and whatever was received is dropped (PIC-SERVO manual, 4.1, network initialization);
        # a lone end of line is no command of 14 characters, so a SmartStep is silent about it (SmartStep manual, 2.1)
        self.phase = Phase.FLUSH
        # an adapter may return the flush late, and what is left of it would be stray behind the next request
        flush, echo_s = self._resync.flush, self._settings.margin_s if self._settings.echo else 0.0
        self._watchdog.set(now_s + len(flush) * self.byte_s + self._resync.settle_s + echo_s)
        if not flush:
            return
        self._log.add(now_s, WireEvent.SENT, flush, "flush")
        self._statistics.bytes_out += len(flush)
        if self._settings.echo:
            self._echo += flush
        try:
            self.transport.write(flush)
        except TransportLost as error:
            self.transport_lost(error.message)

    def _probe(self, now_s: float) -> None:
        """After the flush: prove with a known reply that the line is in step, unless a stop cannot wait for that."""
        self.transport.discard_input()  # what came after the silence is as old as what came before it
        self._echo.clear()
        self.phase = Phase.IDLE
        if self._in_step or self._schedule.stop_waits():
            self._next()
            return
        mute = self._schedule.mute
        exchange = self._resync.probe(mute.failing())
        # where nobody has answered for long, one that could is asked once, and not after each loss: the search for the
        # lost, and stops that wait, take their time from the same silence
        gone = exchange is None or mute.misses.get(exchange.node, 0) > PROBE_ROUNDS
        self._probes_left = 0 if gone else self._probes_left - 1
        self._in_step = self._probes_left == 0  # silence and flush have to do where no node proves it
        if exchange and not (gone and now_s < self._probed_s + GONE_PAUSE * self._settings.margin_s):
            self._probed_s = now_s
            self._send(Transaction(exchange, Lane.STOP, now_s), now_s, "probe")
        else:
            self._next()

    def _judge_probe(self, probe: Transaction, reply: bytes, now_s: float) -> None:
        self._count_reply(probe, reply, self._sent_at_s, self.byte_s, now_s)
        try:
            # by content and by length, because a late reply to a poll has an intact checksum too
            probe.exchange.decode(reply)
        except BadReply:
            why = "is not the known one"
            self._log.add(now_s, WireEvent.RECEIVED, note=why)
            self._discard_reply(probe, reply, why, now_s)
            return
        self._probes_left, self._in_step = 0, True
        self._schedule.record_reply(probe.exchange)
        self._release(probe)
        self._next()

    # -- time --------------------------------------------------------------------------------------------------------

    def _expired(self, now_s: float) -> None:
        if self.phase in (Phase.LINGER, Phase.QUIET):
            self._log.add(now_s, WireEvent.SETTLED)
        match self.phase:
            case Phase.IDLE:
                self._next()
            case Phase.REPLY if self._transaction:
                self._time_out(self._transaction, now_s)
            case Phase.LINGER if self._transaction:
                reply, received_at_s = self._kept
                self._accept(self._transaction, reply, self._transaction.exchange.check(reply), received_at_s)
            case Phase.QUIET if self._transaction:
                self._end_silence(self._transaction, now_s)
            case Phase.QUARANTINE:
                self._flush(now_s)
            case Phase.FLUSH:
                self._probe(now_s)

    def _time_out(self, transaction: Transaction, now_s: float) -> None:
        self.transport.collect()
        if self._transaction is not transaction or self.phase is not Phase.REPLY:
            return  # the reply was there after all
        self._statistics.timeouts += 1
        got = f"{len(self._held)} of {transaction.exchange.reply_bytes} bytes" if self._held else "nothing"
        error = ReplyTimeout(f"node {transaction.exchange.node} on bus {self._settings.name} sent {got} in time")
        self._log.add(now_s, WireEvent.TIMEOUT, note=error.message)
        self._lose(transaction, error, now_s)

    def _end_silence(self, transaction: Transaction, now_s: float) -> None:
        """End an exchange without a reply: it is complete once the line may be used again."""
        # a group without a leader does not reply; the host leaves it 0.51 ms (PIC-SERVO manual, 4.1, group addresses)
        sent_at_s, request_s = self._sent_at_s, len(transaction.exchange.request) * self.byte_s
        self._statistics.wire_busy_s += request_s
        self._release(transaction, transaction.then_baud)
        self._next()
        self._tell(transaction.completed, b"", Timing(sent_at_s, sent_at_s + request_s, now_s, now_s))
