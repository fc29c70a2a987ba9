"""One bus: owns the port, reopens it after a loss, and schedules the exchanges of its users on the line."""

import asyncio
from typing import Any, TypeVar

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusDown, BusError, LdcndError, NotSupported, PacketRejected, TransportLost
from ldcnd.line.adapter import LineErrors
from ldcnd.line.exchange import Exchange, Lane, PacketEffect, Poller, Resync, Timing
from ldcnd.line.flight_recorder import BusStatistics, WireEvent, WireLog
from ldcnd.line.line import Line, Phase, Users
from ldcnd.line.proof import ALWAYS_SENT, Proofs
from ldcnd.line.queue import POLL, ExchangeQueue, PhaseOrder
from ldcnd.line.settings import BusSettings
from ldcnd.line.transaction import Job, StopProbe, Transaction
from ldcnd.line.transport import Opener, Transport
from ldcnd.log import get_logger

MISSES_BEFORE_BACKOFF = 3
MUTE_SHARE = 0.005
"""Fraction of the line's time that polls without a reply may take, so that mute nodes cost the others little."""
FIRST_BACKOFF_S = 0.05
LONGEST_BACKOFF_S = 5.0
"""Longest pause between two polls of a mute node, seconds, whatever fraction of the line they take."""


class MuteNodes:
    """The nodes that do not reply.

    Attributes:
        misses: consecutive exchanges without a reply, by node; nodes that reply are absent.
    """

    def __init__(self) -> None:
        self.misses: dict[int, int] = {}
        self._backed_off: set[int] = set()

    def failing(self) -> set[int]:
        """Return the nodes that did not reply to their last exchange."""
        return set(self.misses)

    def missed(self, node: int) -> None:
        """Count an exchange without a reply."""
        self.misses[node] = self.misses.get(node, 0) + 1

    def pause_s(self, node: int, lost_s: float) -> float:
        """Return how long to pause polling a node whose poll has just been lost, in seconds.

        Args:
            node: its miss was counted.
            lost_s: time that a poll without a reply takes on the line.
        """
        beyond = self.misses[node] - MISSES_BEFORE_BACKOFF
        if beyond < 0:
            return 0.0
        self._backed_off.add(node)
        many = len(self._backed_off)
        doubled_s = many * FIRST_BACKOFF_S * 2.0 ** min(10, beyond)
        return min(doubled_s, many * lost_s / MUTE_SHARE, LONGEST_BACKOFF_S)

    def answered(self, node: int) -> int | None:
        """Note a reply; return another node to poll at once, if this one was backed off.

        A common cause, such as a connector or the supply of one node, often ends for all mute nodes together.
        """
        if self.misses.pop(node, None) is None or node not in self._backed_off:
            return None
        self._backed_off.discard(node)
        return min(self._backed_off, key=lambda other: (other < node, other), default=None)  # the chain, once round

    def forget(self) -> None:
        """Clear all misses: the line was opened."""
        self.misses.clear()
        self._backed_off.clear()


class PollTransaction(Transaction):
    """A poll; it is never sent again, because the next poll comes soon enough."""

    __slots__ = ("poller",)

    def __init__(self, poller: Poller[Any], exchange: Exchange[Any], wanted_at_s: float) -> None:
        self.exchange, self.lane, self.wanted_at_s = exchange, POLL, wanted_at_s  # one call less for each poll
        self.then_baud = self.at_baud = None
        self.slow_to_deliver = poller.slow_to_deliver
        self.poller = poller

    @override
    def completed(self, reply: bytes, timing: Timing) -> None:
        try:
            value = self.exchange.decode(reply)
        except BadReply as error:
            self.poller.missed(error)
            return
        self.poller.deliver(value, timing)

    @override
    def lost(self, error: BusError) -> bool:
        self.poller.missed(error)
        return False

    @override
    def rejected(self) -> bool:
        self.poller.missed(PacketRejected(f"node {self.exchange.node} received a damaged packet"))
        return False


ReplyT = TypeVar("ReplyT")

log = get_logger("bus")

FIRST_REOPEN_S = 0.1
LONGEST_REOPEN_S = 2.0
STAYS_S = 3.0
"""A port that is lost sooner than this was not really open: as of a serial server that accepts and closes, seconds."""
LONGEST_OPENING_S = 10.0
"""Upper bound of closing a lost port and opening it again, seconds; both are bounded by themselves."""


READS = PacketEffect.READS  # looked up slowly in its class


class Bus(Users):
    """The owner of one line; every method runs on the event loop that `run` runs on.

    Attributes:
        proofs: who is known to be at which address; what changes anything is sent to no other.
    """

    def __init__(self, settings: BusSettings, opener: Opener, resync: Resync | None = None) -> None:
        self.settings = settings
        self.statistics = BusStatistics()
        self.wire_log = WireLog(settings.recorded_s, settings.recorded_bytes)
        self._resync = resync or Resync()
        self.proofs = Proofs()
        self._opener = opener
        self._loop = asyncio.get_running_loop()
        self._order = PhaseOrder(settings.cycle) if settings.cycle else None
        self._queue: ExchangeQueue[Job] = ExchangeQueue(self._order.choose if self._order else None)
        self._pollers: set[Poller[Any]] = set()  # also those whose poll is on the wire
        self._mute = MuteNodes()
        self._line: Line | None = None  # None while the port is not open
        self._opened = asyncio.Event()
        self._closed = asyncio.Event()
        self._closed.set()
        self._loss_reason = ""
        self._tried_at_s = self._loop.time()  # when the port was last lost or tried

    # -- for users of the line ---------------------------------------------------------------------------------------

    async def execute(self, exchange: Exchange[ReplyT], lane: Lane = Lane.COMMAND, *, once: bool = False) -> ReplyT:
        """Run one exchange in its lane's turn and return the decoded reply.

        With `once` it is not sent again when the node reports that the packet was damaged: the damage may be in that
        report, and then the packet was executed.

        When its turn comes, an exchange that changes anything is sent only to who is proven to be who is meant
        (`Proofs`), and only if the condition of the caller's context (`only_while`) holds. Cancelling the caller never
        leaves half a packet on the wire; a sent exchange completes and its reply is dropped.

        Raises:
            BusDown: the line is not open, or was lost before the request was sent.
            BusBusy: the lane is full.
            ReplyTimeout: no intact reply after the allowed attempts; the exchange was repeatable.
            OutcomeUnknown: the reply was lost and the exchange must not be repeated.
            PacketRejected: the node refused our packet as damaged at every attempt; it was not executed.
            BadReply: the reply was intact but makes no sense.
            AxisUnreachable, NotIdentified: not proven to be who is meant; nothing was sent.
            LdcndError: as the condition refused it; nothing was sent.
        """
        return await self._submit(exchange, lane, once=once)

    async def execute_timed(self, exchange: Exchange[ReplyT]) -> tuple[ReplyT, Timing]:
        """Run one command exchange; return the decoded reply, and when it happened.

        Raises:
            As `execute`.
        """
        job = self._job(exchange, Lane.COMMAND)
        reply: ReplyT = await self._queued(job)
        if job.timing is None:
            raise AssertionError("a reply without the instant at which it came")
        return reply, job.timing

    async def change_baud(self, exchange: Exchange[ReplyT], baud: int) -> ReplyT:
        """Run the exchange that tells the nodes to change their rate, then change ours before anything else is sent.

        Raises:
            As `execute`; NotSupported when the transport cannot change to this rate.
        """
        self._require_changeable(baud)
        return await self._submit(exchange, Lane.COMMAND, then_baud=baud)

    async def execute_at(self, baud: int, exchange: Exchange[ReplyT]) -> ReplyT:
        """Run one command exchange at another rate than the line's, which it has back before anything else is sent.

        For a node that may be at that rate; to the others it is noise.

        Raises:
            As `execute`; NotSupported when the transport cannot change to this rate.
        """
        self._require_changeable(baud)
        return await self._submit(exchange, Lane.COMMAND, at_baud=baud)

    async def probe_stop_wait(self) -> None:
        """Measure how long a single stop would have to wait now, with a harmless exchange in its place.

        Real stops overtake it. The result is in `BusStatistics.stop_wait`. Without a node to probe, it does nothing.

        Raises:
            BusDown, ReplyTimeout, PacketRejected, BadReply: as `execute`; the probe is not repeated.
        """
        exchange = self._resync.probe(self._mute.failing())
        if exchange is None or self._line is None or not self._queue.takes_probe():
            return
        future: asyncio.Future[Any] = self._loop.create_future()
        self._queue.push_probe(StopProbe(exchange, Lane.STOP, self._loop.time(), future, attempts=1))
        self._kick()
        await future

    def add_poller(self, poller: Poller[Any]) -> None:
        """Let a poller take part from its `due_at_s` on; adding it again only moves its turn.

        All pollers are removed when the line is lost; they are added again when the network is initialised again.
        """
        self._pollers.add(poller)
        self._queue.schedule(poller, poller.due_at_s)
        self._kick()

    def remove_poller(self, poller: Poller[Any]) -> None:
        """Stop polling; a poll on the wire is still delivered."""
        self._pollers.discard(poller)
        self._queue.unschedule(poller)

    def drop(self, reason: str) -> None:
        """Give the line up as if it had been lost; it is opened again as after any loss."""
        if self._line:
            self._line.close(reason)

    def distrust(self) -> None:
        """Resynchronise the line: a reply was one that its node cannot have sent."""
        if self._line:
            self._line.distrust()

    def withdraw(self, node: int, error: LdcndError) -> None:
        """Fail every command that still waits for this node; what is on the wire runs on. Stops are not touched."""
        for job in self._queue.waiting(Lane.COMMAND):
            if job.exchange.node == node:
                job.fail(error)

    def waiting(self, lane: Lane) -> int:
        """Return how many exchanges wait in a lane; polls are scheduled, not queued."""
        return 0 if lane is Lane.POLL else len(self._queue.waiting(lane))

    @property
    def loss_reason(self) -> str:
        """Why the port could not be opened, or was lost, the last time that happened; empty if it never did."""
        return self._loss_reason

    @property
    def is_open(self) -> bool:
        """Whether exchanges can be sent."""
        return self._line is not None

    @property
    def is_idle(self) -> bool:
        """Whether nothing is on the wire and nothing is waited for."""
        return self._line is not None and self._line.phase is Phase.IDLE

    def on_time(self, now_s: float) -> bool:
        """Tell whether the bus does its work at `now_s`, in loop time: keeps a line moving, or tries to get one."""
        if self._line is None:
            return now_s <= self._tried_at_s + LONGEST_REOPEN_S + LONGEST_OPENING_S
        return self._line.on_time(now_s)

    @property
    def baud(self) -> int:
        """The rate in use, or the rate of the next opening."""
        return self._line.wire.baud if self._line else self.settings.baud

    @property
    def fixed_baud(self) -> bool:
        """Whether the port cannot change its rate."""
        return self._line is not None and self._line.wire.fixed_baud

    def offers(self, baud: int) -> bool:
        """Tell whether the port can be set to a rate; without an open port nothing says that it cannot."""
        return self._line is None or self._line.wire.transport.offers(baud)

    def line_errors(self) -> LineErrors | None:
        """Return what the port's driver has counted since it was loaded; None without a port that counts."""
        return self._line.wire.transport.line_errors() if self._line else None

    async def wait_opened(self) -> None:
        """Return as soon as the line is open."""
        await self._opened.wait()

    async def wait_closed(self) -> None:
        """Return as soon as the line is lost or closed."""
        await self._closed.wait()

    def misses(self, node: int) -> int:
        """Return how many exchanges in a row this node has left unanswered."""
        return self._mute.misses.get(node, 0)

    def longest_s(self, exchange: Exchange[Any]) -> float:
        """Return how long an exchange occupies the line at most when nothing is lost, in seconds."""
        byte_s = self.settings.bits_per_byte / self.baud
        return (len(exchange.request) + exchange.reply_bytes) * byte_s + exchange.response_s

    def _require_changeable(self, baud: int) -> None:
        if self.fixed_baud:
            raise NotSupported(
                f"bus {self.settings.name}: the port cannot change its rate",
                remedy="configure the rate the far end uses",
            )
        if not self.offers(baud):
            raise NotSupported(f"bus {self.settings.name}: the port does not make {baud} baud", value=baud)

    @property
    def quarantine_s(self) -> float:
        """Duration of a resynchronisation after a lost reply, in seconds."""
        probe = self._resync.probe(self._mute.failing())
        flush_s = len(self._resync.flush) * self.settings.bits_per_byte / self.baud
        return self._resync.quiet_s + flush_s + self._resync.settle_s + (self.longest_s(probe) if probe else 0.0)

    async def _submit(
        self,
        exchange: Exchange[ReplyT],
        lane: Lane,
        *,
        then_baud: int | None = None,
        at_baud: int | None = None,
        once: bool = False,
    ) -> ReplyT:
        job = self._job(exchange, lane, once=once)
        job.then_baud, job.at_baud = then_baud, at_baud
        reply: ReplyT = await self._queued(job)
        return reply

    def _job(self, exchange: Exchange[Any], lane: Lane, *, once: bool = False) -> Job:
        attempts = 1 if once else self.settings.attempts
        condition = None if exchange.effect in ALWAYS_SENT else self.proofs.condition(exchange, lane)
        future: asyncio.Future[Any] = self._loop.create_future()
        return Job(exchange, lane, self._loop.time(), future, attempts=attempts, condition=condition)

    def _queued(self, job: Job) -> "asyncio.Future[Any]":
        if self._line is None:
            raise self._down()
        self._queue.push(job, job.lane)
        self._kick()
        return job.future

    def _kick(self) -> None:
        if self._line:
            self._line.kick()

    def _down(self) -> BusDown:
        return BusDown(
            f"bus {self.settings.name} is not open; nothing was sent",
            remedy="check the adapter and its cable",
        )

    # -- opening the port --------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Own the port until cancelled: open it, and open it again with bounded back-off whenever it is lost."""
        delay_s = pause_s = FIRST_REOPEN_S  # after one that does not open, and after one that does not stay open
        failure = ""
        while True:
            self._tried_at_s = self._loop.time()
            try:
                transport = await self._opener()
            except TransportLost as error:
                if error.message != failure:
                    log.warning("port not open", bus=self.settings.name, reason=error.message)
                    self._loss_reason = failure = error.message
                await asyncio.sleep(delay_s)
                delay_s = min(2 * delay_s, LONGEST_REOPEN_S)
                continue
            opened_s = self._loop.time()
            said = self._loop.call_later(STAYS_S if failure else 0.0, self._say_open)
            try:
                await self._use(transport)
            finally:
                said.cancel()
            stayed = self._loop.time() - opened_s >= STAYS_S
            if stayed or self._loss_reason != failure:
                log.warning("line lost", bus=self.settings.name, reason=self._loss_reason)
            failure = "" if stayed else self._loss_reason
            delay_s, pause_s = FIRST_REOPEN_S, FIRST_REOPEN_S if stayed else pause_s
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_REOPEN_S)

    def _say_open(self) -> None:
        log.info("line open", bus=self.settings.name, baud=self.settings.baud)

    async def _use(self, transport: Transport) -> None:
        """Serve the line until it is lost or the caller is cancelled; then every caller has its outcome."""
        self.statistics.openings += 1
        self.wire_log.add(self._loop.time(), WireEvent.OPENED)
        self._mute.forget()
        self._line = line = Line(self.settings, transport, self, self._resync, self.statistics, self.wire_log)
        self._closed.clear()
        self._opened.set()
        try:
            line.kick()
            await self._closed.wait()
        finally:
            line.close("the bus was closed", for_good=True)
            await transport.close()

    # -- for the line (see `Users`) ----------------------------------------------------------------------------------

    @override
    def take(self, now_s: float) -> Transaction | None:
        while job := self._queue.take_job(now_s):
            if job.condition and self._line and self._line.undelivered:
                self._line.deliver()  # permission is asked of all that the drives have said by now
            if job.may_go():
                break
        if job is None:
            poller = self._queue.polls.take(now_s)
            if poller is None:
                return None
            wanted_at_s, exchange = poller.due_at_s, poller.next_exchange(now_s)
            if exchange.effect is not READS:
                raise AssertionError(f"the poll {exchange.request.hex(' ')} does not say that it only reads")
            return PollTransaction(poller, exchange, wanted_at_s)
        job.attempts_left -= 1
        if isinstance(job, StopProbe):
            self.statistics.stop_wait.add(now_s - job.wanted_at_s)
        return job

    @override
    def sent(self, transaction: Transaction) -> None:
        if isinstance(transaction, PollTransaction) and (poller := transaction.poller) in self._pollers:
            self._queue.polls.schedule(poller, poller.due_at_s)

    @override
    def prepare_next(self, transaction: Transaction, asked_at_s: float, byte_s: float) -> None:
        # to choose a poll and its items takes longer than all else between two packets
        exchange = transaction.exchange
        reply_s = exchange.reply_bytes * byte_s
        at_s = self._order.free_at_s(exchange.node, asked_at_s, reply_s) if self._order else asked_at_s + reply_s
        if poller := self._queue.polls.choose_ahead(at_s):
            poller.prepare(at_s)

    @override
    def next_due_s(self) -> float:
        return self._queue.next_due_s()

    @override
    def stop_waits(self) -> bool:
        return self._queue.stop_waits()

    @override
    def failing(self) -> set[int]:
        return self._mute.failing()

    @override
    def answered(self, transaction: Transaction, timing: Timing | None = None) -> None:
        exchange, mute = transaction.exchange, self._mute
        if self._order and timing and transaction.lane is POLL:
            self._order.observe(exchange.node, timing)
        if not exchange.reply_bytes or exchange.node not in mute.misses:
            return
        self.proofs.answered(exchange.node)
        if (also := mute.answered(exchange.node)) is not None:
            for poller in self._pollers:
                if poller.node == also:
                    self._queue.schedule(poller, poller.due_at_s)

    @override
    def missed(self, transaction: Transaction, now_s: float) -> None:
        node = transaction.exchange.node
        self._mute.missed(node)
        self.proofs.missed(node, self._mute.misses[node])
        if isinstance(transaction, PollTransaction):
            pause_s = self._mute.pause_s(
                node, self.longest_s(transaction.exchange) + self.settings.margin_s + self.quarantine_s
            )
            self._schedule(transaction.poller, max(transaction.poller.due_at_s, now_s + pause_s))

    def _schedule(self, poller: Poller[Any], at_s: float) -> None:
        """Give a poller its next turn, unless it was removed while its poll was on the wire."""
        if poller in self._pollers:
            self._queue.schedule(poller, at_s)

    @override
    def again(self, transaction: Transaction) -> None:
        if isinstance(transaction, Job):
            self._queue.push_front(transaction, transaction.lane)

    @override
    def line_lost(self, reason: str) -> None:
        self._line = None
        self._tried_at_s = self._loop.time()
        self._loss_reason = reason
        self._opened.clear()
        self._closed.set()
        self._pollers.clear()
        self.proofs.lose_all(f"the line was lost ({reason})")
        for waiting in self._queue.drain():
            waiting.fail(BusDown(f"bus {self.settings.name} was lost ({reason}) before the exchange was complete"))
