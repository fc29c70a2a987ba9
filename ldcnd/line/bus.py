"""One bus: owns the port, reopens it after a loss, and queues the exchanges of its users for the line."""

import asyncio
from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar

from typing_extensions import override

from ldcnd.contract.errors import (
    BadReply,
    BusDown,
    BusError,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    PacketRejected,
    ReplyTimeout,
    TransportLost,
)
from ldcnd.line.adapter import LineErrors
from ldcnd.line.exchange import Exchange, Lane, Poller, Resync, Timing
from ldcnd.line.flight_recorder import BusStatistics, LatencyHistogram, WireEvent, WireLog
from ldcnd.line.line import Line, Listener, Phase
from ldcnd.line.proof import ALWAYS_SENT, MISSES_UNTIL_LOST, Condition, Proofs
from ldcnd.line.schedule import Schedule
from ldcnd.line.settings import BusSettings
from ldcnd.line.transaction import Transaction
from ldcnd.line.transport import Opener, Transport
from ldcnd.log import get_logger

ReplyT = TypeVar("ReplyT")

log = get_logger("bus")

FIRST_REOPEN_S = 0.1
LONGEST_REOPEN_S = 2.0
STAYS_S = 3.0
"""A port that is lost sooner than this was not really open: as of a serial server that accepts and closes, seconds."""
SENT_IN_VAIN = "sent once, in vain or with its reply lost, and not again; look at what it was to do before you go on:"
LONGEST_OPENING_S = 10.0
"""Upper bound of closing a lost port and opening it again, seconds; both are bounded by themselves."""


_guest: ContextVar[str] = ContextVar("guest", default="")


class caused_by:  # noqa: N801 - read as a statement
    """Mark in the wire log what is sent for this context, and for the tasks that begin in it, as caused by a guest."""

    __slots__ = ("_name", "_token")

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._token = _guest.set(self._name)

    def __exit__(self, *_raised: object) -> None:
        _guest.reset(self._token)


class only_during:  # noqa: N801 - read as a statement
    """Let what is queued in this context be sent only as long as the line is open as it is: not after the next opening.

    What was learned of nodes before a loss says nothing behind it, and whoever sleeps in between hears of no loss. It
    is void when the context ends, also for tasks that were created in it, and stops are not subject to it.
    """

    __slots__ = ("_bus", "_opening", "_token")

    def __init__(self, bus: "Bus", opening: int) -> None:
        self._bus = bus
        self._opening: int | None = opening

    def __enter__(self) -> None:
        self._token = _during.set(self)

    def __exit__(self, *_raised: object) -> None:
        self._opening = None
        _during.reset(self._token)

    def is_over(self, bus: "Bus") -> bool:
        """Tell whether a line is not open any more as it was."""
        return self._bus is bus and self._opening not in (None, bus.statistics.openings)


_during: ContextVar[only_during | None] = ContextVar("during", default=None)


class Job(Transaction):
    """An exchange that a caller waits for; its future gets exactly one outcome, `timing` says when that was.

    Args:
        exchange: request and expected reply.
        lane: the lane in which it waits.
        loop: the bus's.
        attempts: how often it is sent in all, if it may be repeated.
        condition: see `Transaction`.
        sent: see `Bus.execute`.
    """

    __slots__ = ("_doubted", "_sent", "attempts", "attempts_left", "condition", "future", "guest", "timing")
    proves = False

    def __init__(
        self,
        exchange: Exchange[Any],
        lane: Lane,
        loop: asyncio.AbstractEventLoop,
        attempts: int,
        condition: Condition | None = None,
        sent: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(exchange, lane, loop.time())
        self.condition: Condition | None = condition
        self.guest = _guest.get()
        self.future: asyncio.Future[Any] = loop.create_future()
        self.timing: Timing | None = None
        self.attempts = self.attempts_left = attempts
        self._doubted = False
        self._sent = sent

    @property
    @override
    def abandoned(self) -> bool:
        return self.future.done()

    @property
    @override
    def doubted(self) -> bool:
        return self._doubted

    @override
    def doubt(self) -> None:
        self._doubted = True

    @override
    def may_go(self, now_s: float) -> bool:
        if self.condition:
            try:
                self.condition()
            except LdcndError as error:
                self.refuse(error)
                return False
        self.attempts_left -= 1  # what the condition forbids was no attempt
        self._doubted = False
        if self._sent:
            self._sent()
        return True

    @override
    def refuse(self, error: LdcndError) -> None:
        # before a repetition: the node may have executed the packet before, although its reply was lost
        self.fail(error if self.attempts_left == self.attempts else error.although(SENT_IN_VAIN))

    @override
    def give_up(self) -> None:
        self.attempts_left = 0

    def fail(self, error: LdcndError) -> None:
        """Give the caller the error, unless it has gone."""
        if not self.future.done():
            self.future.set_exception(error)

    @override
    def completed(self, reply: bytes, timing: Timing) -> None:
        if self.future.done():
            return
        try:
            value = self.exchange.decode(reply)
        except BadReply as error:
            self.fail(error)
            return
        self.timing = timing
        self.future.set_result(value)

    @override
    def lost(self, error: BusError) -> bool:
        exchange = self.exchange
        # a position that is loaded again in mid-move is added to the first one on an LS-182AP, and a lost reply does
        # not say that the packet was lost (LS-182AP manual, Load Trajectory)
        if not exchange.repeatable:
            self.fail(
                OutcomeUnknown(
                    f"{error.message}; the packet {exchange.request.hex(' ')} must not be repeated and may or may not"
                    " have been executed",
                    remedy="read the axis state before anything else",
                )
            )
            return False
        if self.attempts_left > 0:
            return True
        self.fail(
            ReplyTimeout(
                f"no intact reply in {self.attempts} attempts: {error.message}",
                remedy="check the drive's power and address, and the cable",
            )
        )
        return False

    @override
    def rejected(self) -> bool:
        if self.attempts_left > 0:
            return True
        self.fail(
            PacketRejected(
                f"node {self.exchange.node} received {self.attempts} damaged packets and executed none of them",
                remedy="check cable, termination and baud rate",
            )
        )
        return False


class StopProbe(Job):
    """A harmless exchange in the place of a stop, to measure how long a stop would wait; it is not repeated."""

    __slots__ = ("_waits",)

    def __init__(self, exchange: Exchange[Any], loop: asyncio.AbstractEventLoop, waits: LatencyHistogram) -> None:
        super().__init__(exchange, Lane.STOP, loop, 1)
        self._waits = waits

    @override
    def may_go(self, now_s: float) -> bool:
        self._waits.add(now_s - self.wanted_at_s)
        return super().may_go(now_s)


class Bus:
    """The owner of one line; every method runs on the event loop that `run` runs on.

    Attributes:
        proofs: who is known to be at which address; what changes anything is sent to no other.
        listeners: hear each intact reply; see `Listener`.
        guests_s: how long the exchanges that a guest has caused have taken the line, seconds, by the name of the guest.
    """

    def __init__(self, settings: BusSettings, opener: Opener, resync: Resync | None = None) -> None:
        self.settings = settings
        self.statistics = BusStatistics()
        self.wire_log = WireLog(settings.recorded_s, settings.recorded_bytes)
        self._resync = resync or Resync()
        self.proofs = Proofs()
        self.listeners: list[Listener] = []
        self.guests_s: dict[str, float] = {}
        self._opener = opener
        self._loop = asyncio.get_running_loop()
        self._schedule: Schedule[Transaction] = Schedule(settings.cycle, self.proofs)
        self._line: Line | None = None  # None while the port is not open
        self._opened = asyncio.Event()
        self._closed = asyncio.Event()
        self._closed.set()
        self._loss_reason = ""
        self._failed: asyncio.Future[BaseException] = self._loop.create_future()
        self._tried_at_s = self._loop.time()  # when the port was last lost or tried

    # -- for users of the line ---------------------------------------------------------------------------------------

    async def execute(
        self,
        exchange: Exchange[ReplyT],
        lane: Lane = Lane.COMMAND,
        *,
        once: bool = False,
        sent: Callable[[], None] | None = None,
    ) -> ReplyT:
        """Run one exchange in its lane's turn and return the decoded reply.

        With `once` it is not sent again when the node reports that the packet was damaged: the damage may be in that
        report, and then the packet was executed. What no reading shows is told twice (`Exchange.unseen`). `sent` is
        called directly before each time that it is sent: what is refused or withdrawn before that was not.

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
        for _ in range(exchange.times):
            attempts = 1 if once else self.settings.attempts
            # each attempt costs the others a resynchronisation, too; the first answer of a node that was mute may be to
            # something older, and does not count
            if self.misses(exchange.node) > MISSES_UNTIL_LOST:
                attempts = min(attempts, 2)
            job = self._submit(exchange, lane, attempts, sent=sent)
            reply: ReplyT = await job.future
        return reply

    async def execute_timed(self, exchange: Exchange[ReplyT]) -> tuple[ReplyT, Timing]:
        """Run one command exchange; return the decoded reply, and when it happened.

        Raises:
            As `execute`.
        """
        job = self._submit(exchange)
        reply: ReplyT = await job.future
        if job.timing is None:
            raise AssertionError("a reply without the instant at which it came")
        return reply, job.timing

    async def change_baud(self, exchange: Exchange[ReplyT], baud: int) -> ReplyT:
        """Run the exchange that tells the nodes to change their rate, then change ours before anything else is sent.

        Raises:
            As `execute`; NotSupported when the transport cannot change to this rate.
        """
        self._require_changeable(baud)
        reply: ReplyT = await self._submit(exchange, then_baud=baud).future
        return reply

    async def execute_at(self, baud: int, exchange: Exchange[ReplyT]) -> ReplyT:
        """Run one command exchange at another rate than the line's, which it has back before anything else is sent.

        For a node that may be at that rate; to the others it is noise.

        Raises:
            As `execute`; NotSupported when the transport cannot change to this rate.
        """
        self._require_changeable(baud)
        reply: ReplyT = await self._submit(exchange, at_baud=baud).future
        return reply

    async def probe_stop_wait(self) -> None:
        """Measure how long a single stop would have to wait now, with a harmless exchange in its place.

        Real stops overtake it. The result is in `BusStatistics.stop_wait`. Without a node to probe, it does nothing.

        Raises:
            BusDown, ReplyTimeout, PacketRejected, BadReply: as `execute`; the probe is not repeated.
        """
        mute = self._schedule.mute
        exchange = self._resync.probe(mute.failing())
        # a line without any reply has better to do: each loss costs it a resynchronisation
        if exchange is None or exchange.node in mute.misses or self._line is None or not self._schedule.takes_probe():
            return
        probe = StopProbe(exchange, self._loop, self.statistics.stop_wait)
        self._schedule.push_probe(probe)
        self._line.kick()
        await probe.future

    def add_poller(self, poller: Poller[Any]) -> None:
        """Let a poller take part from its `due_at_s` on; adding it again only moves its turn.

        All pollers are removed when the line is lost; they are added again when the network is initialised again.
        """
        if self._is_over():
            return  # it would have gone with the line
        self._schedule.add(poller)
        if self._line:
            self._line.kick()

    def move_poller(self, poller: Poller[Any]) -> None:
        """Move the turn of a poller to its `due_at_s`; not of one that was removed, or went with the line."""
        self._schedule.reschedule(poller, poller.due_at_s)
        if self._line:
            self._line.kick()

    def remove_poller(self, poller: Poller[Any]) -> None:
        """Stop polling; a poll on the wire is still delivered."""
        self._schedule.remove(poller)

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
        for job in self._schedule.waiting(Lane.COMMAND):
            if job.exchange.node == node:
                job.refuse(error)

    def outrank(self, stop: Exchange[Any]) -> None:
        """Never send a stop again, nor at all where it waits: one that takes more out follows, and must come last."""
        error = ReplyTimeout("another stop outranks it, so it is not sent any more")
        for job in self._schedule.waiting(Lane.STOP):
            if job.exchange is stop:
                job.refuse(error)
        if self._line and (sent := self._line.on_wire) and sent.exchange is stop:
            sent.give_up()

    def waiting(self, lane: Lane) -> int:
        """Return how many exchanges wait in a lane; polls are scheduled, not queued."""
        return len(self._schedule.waiting(lane))

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
        return self._line.baud if self._line else self.settings.baud

    @property
    def fixed_baud(self) -> bool:
        """Whether the port cannot change its rate."""
        return self._line is not None and self._line.transport.fixed_baud

    def offers(self, baud: int) -> bool:
        """Tell whether the port can be set to a rate; without an open port nothing says that it cannot."""
        return self._line is None or self._line.transport.offers(baud)

    def line_errors(self) -> LineErrors | None:
        """Return what the port's driver has counted since it was loaded; None without a port that counts."""
        return self._line.transport.line_errors() if self._line else None

    async def wait_opened(self) -> int:
        """Return the number of the opening as soon as the line is open."""
        await self._opened.wait()
        return self.statistics.openings

    async def wait_closed(self, opening: int) -> None:
        """Return as soon as what was opened so is lost or closed; at once where the line is open anew since."""
        if opening == self.statistics.openings:
            await self._closed.wait()

    def _is_over(self) -> bool:
        during = _during.get()
        return during is not None and during.is_over(self)

    async def wait_failed(self) -> None:
        """Raise what a poller or listener has raised, as soon as one does; the line goes on."""
        raise await asyncio.shield(self._failed)

    def misses(self, node: int) -> int:
        """Return how many exchanges in a row this node has left unanswered."""
        return self._schedule.mute.misses.get(node, 0)

    def longest_s(self, exchange: Exchange[Any]) -> float:
        """Return how long an exchange occupies the line at most when nothing is lost, in seconds."""
        return exchange.longest_s(self._byte_s)

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
        return self._resync.longest_s(self._byte_s, self._schedule.mute.failing())

    @property
    def _byte_s(self) -> float:
        return self.settings.bits_per_byte / self.baud

    def _submit(
        self,
        exchange: Exchange[Any],
        lane: Lane = Lane.COMMAND,
        attempts: int | None = None,
        *,
        then_baud: int | None = None,
        at_baud: int | None = None,
        sent: Callable[[], None] | None = None,
    ) -> Job:
        """Queue an exchange; the outcome is that of the job's future."""
        # here, in the caller's context: when its turn comes, another one is running
        condition = None if exchange.effect in ALWAYS_SENT else self.proofs.condition(exchange, lane)
        job = Job(exchange, lane, self._loop, attempts or self.settings.attempts, condition, sent)
        job.then_baud, job.at_baud = then_baud, at_baud
        if self._line is None or (lane is not Lane.STOP and self._is_over()):
            raise self._down()
        self._schedule.push(job, lane)
        if job.guest:
            job.future.add_done_callback(partial(self._taken, job))
        # it may be sent at once, and the port be lost over it: the job has its outcome then
        self._line.kick()
        return job

    def _taken(self, job: Job, _done: "asyncio.Future[Any]") -> None:
        """Count what an exchange of a guest has taken; one without a reply has cost others all that it took."""
        now_s = self._loop.time()
        took_s = job.timing.received_at_s - job.timing.sent_at_s if job.timing else now_s - job.wanted_at_s
        self.guests_s[job.guest] = self.guests_s.get(job.guest, 0.0) + took_s

    def _down(self) -> BusDown:
        return BusDown(
            f"bus {self.settings.name} is not open; nothing was sent",
            remedy="check the adapter and its cable",
        )

    # -- opening the port --------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Own the port until cancelled: open it, and open it again with bounded back-off whenever it is lost."""
        delay_s = pause_s = FIRST_REOPEN_S  # after one that does not open, and after one that does not stay open
        failure, stayed = "", True
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
            # of a port that did not stay the last time, the log says nothing before it has stayed
            said = self._loop.call_later(0.0 if stayed else STAYS_S, self._say_open)
            try:
                await self._use(transport)
            finally:
                said.cancel()
            stayed = self._loop.time() - opened_s >= STAYS_S
            if stayed or self._loss_reason != failure:
                log.warning("line lost", bus=self.settings.name, reason=self._loss_reason)
            failure = "" if stayed else self._loss_reason
            # a port that opens but does not stay must not be opened at full speed for ever
            delay_s, pause_s = FIRST_REOPEN_S, FIRST_REOPEN_S if stayed else pause_s
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_REOPEN_S)

    def _say_open(self) -> None:
        log.info("line open", bus=self.settings.name, baud=self.settings.baud)

    async def _use(self, transport: Transport) -> None:
        """Serve the line until it is lost or the caller is cancelled; then every caller has its outcome."""
        self.statistics.openings += 1
        self.wire_log.add(self._loop.time(), WireEvent.OPENED)
        # who was silent on the line before may be there now: it is polled at its rate, not ever more seldom
        self._schedule.mute.forget()
        self._line = line = Line(
            self.settings,
            transport,
            self._schedule,
            self._resync,
            self.statistics,
            self.wire_log,
            self._note_loss,
            report_failure=self._note_failure,
            listeners=self.listeners,
        )
        self._closed.clear()
        self._opened.set()
        try:
            line.kick()
            await self._closed.wait()
        finally:
            # before the port, which may drain for a second: no caller waits for that
            line.close("the bus was closed", for_good=True)
            await transport.close()

    def _note_loss(self, reason: str) -> None:
        """Take note that the line is lost: every exchange that waits has its outcome."""
        self._line = None  # first, so that nothing is queued by what follows
        self._tried_at_s = self._loop.time()
        self._loss_reason = reason
        self._opened.clear()
        self._closed.set()
        self.proofs.lose_all(f"the line was lost ({reason})")
        for waiting in self._schedule.drain():
            waiting.fail(BusDown(f"bus {self.settings.name} was lost ({reason}) before the exchange was complete"))

    def _note_failure(self, error: BaseException) -> None:
        """Take note of what a poller or listener has raised: said once, since it may raise at each reply."""
        if not self._failed.done():
            self._failed.set_result(error)
            message = f"bus {self.settings.name}: an internal error in what was told of a reply"
            self._loop.call_exception_handler({"message": message, "exception": error})
