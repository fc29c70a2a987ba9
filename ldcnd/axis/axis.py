"""One axis at work: takes commands in turn, lets stops overtake them, digests readings, publishes.

Commands of one axis run one after another: one that finds the axis free in the task of its caller, who then does not
wait for another one, those that had to wait in the axis's own. A stop never waits for them: it withdraws what is still
queued, and whatever a command does next finds that the epoch has moved on.
"""

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from ldcnd.axis import guards
from ldcnd.axis.clock import Clock
from ldcnd.axis.commands import AxisCommands
from ldcnd.axis.guards import UNCONDITIONAL, Gate, Permit, Right, Unmoved
from ldcnd.axis.host_tracer import HostTracer, host_channels
from ldcnd.axis.kept import KeptFiles
from ldcnd.axis.latches import LatchKeeper
from ldcnd.axis.motion import AxisMotion, MotionPlan, preview
from ldcnd.axis.parameters import Parameters
from ldcnd.axis.plausibility import ROUNDS, CounterStep, PlausibilityGate, ReadingVerdict, agree
from ldcnd.axis.procedures.jog import Hold
from ldcnd.axis.recorder import TraceRecorder
from ldcnd.axis.reference import ReferenceKeeper
from ldcnd.axis.state import (
    DRIVE_CHANGED,
    DRIVE_RESET,
    REFERENCE_REFUSED,
    REST_COUNTS,
    AxisTracker,
    ObservedTracker,
)
from ldcnd.axis.telemetry import Arrivals, AxisTelemetry, Note, OnEnded
from ldcnd.contract import events
from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    Capability,
    CommandReply,
    Effect,
    Halt,
    Jog,
    Move,
    MoveAbsolute,
    Power,
    Preview,
    PreviewReply,
    QuickStop,
    ReportShadow,
    ShadowReply,
    Stop,
    Verb,
)
from ldcnd.contract.errors import (
    BadReply,
    BusError,
    CommandAborted,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    PacketRejected,
    StopLatched,
    TooManyRequests,
    WrongState,
)
from ldcnd.contract.events import ALARM_HISTORY, REFERENCE, CommandStatus
from ldcnd.contract.rig_commands import FrozenPosition
from ldcnd.contract.samples import AxisState, LinkState, Moving, TelemetryItem
from ldcnd.drives.axis_config import AxisConfig, LossPolicy
from ldcnd.drives.driver import AxisReading, Drive, Fault, Moves, Readable, StopMode
from ldcnd.drives.network import BringUpReport
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.drives.tracer import Tracer
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Timing
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

log = get_logger("axis")

NO_COMMAND_HELPS = "the drive takes no command for that: use its own inputs and its own tool"
QUEUED_COMMANDS = 8
HALTS_WITHIN_S = 1.0
"""Longest time that an aborting move is left without an answer while the axis comes to rest, seconds."""
STOP_ROUNDS = 5
"""Rounds of the bus's own attempts before a stop that is not confirmed is reported as such."""


OVERTAKES = {Verb.POWER: "power off"}
"""What is said of a command that overtakes others, where it is not its name."""
UNDERSTOOD_NO_MORE = {LossPolicy.QUICK_STOP: StopMode.ABRUPT, LossPolicy.POWER_OFF: StopMode.OFF}
"""How a motion is stopped that is not understood any more, by `loss.bus`; smoothly otherwise."""


def takes_energy_out(command: AxisCommand[CommandReply]) -> StopMode | None:
    """Return how a command brings its motor to rest; None for a command that does anything else."""
    match command:
        case Stop() | Halt():
            return StopMode.SMOOTH
        case QuickStop():
            return StopMode.ABRUPT
        case Power(on=False):
            return StopMode.OFF
        case _:
            return None


Obey = Callable[[Permit, AxisCommand[CommandReply]], Awaitable[CommandReply]]


@dataclass(frozen=True, slots=True)
class WaitingCommand:
    """A command that found the axis at work, and the caller who waits for its answer."""

    permit: Permit
    request: AxisCommand[CommandReply]
    future: "asyncio.Future[CommandReply]"

    async def carry_out(self, obey: Obey) -> None:
        """Let it have its turn, unless it was answered meanwhile or its caller has gone."""
        if self.future.done():
            return
        try:
            reply = await obey(self.permit, self.request)
        except Exception as error:  # noqa: BLE001 - the caller gets it whole; dispatch.py translates
            self.refuse(error)
            return
        if not self.future.done():
            self.future.set_result(reply)

    def refuse(self, error: Exception) -> None:
        """Give the caller an error, unless it has an answer or has gone."""
        if not self.future.done():
            self.future.set_exception(error)


class CommandQueue:
    """Order of the commands of one axis.

    Attributes:
        at_work: held while a command or a step is carried out.
    """

    def __init__(self, axis: str) -> None:
        self.at_work = asyncio.Lock()
        self._axis = axis
        self._waiting: deque[WaitingCommand] = deque()
        self._woken = asyncio.Event()

    @property
    def free(self) -> bool:
        """Whether a command that comes now need not wait for another one, or for a step."""
        return not (self._waiting or self.at_work.locked())

    async def wait(self, permit: Permit, request: AxisCommand[CommandReply]) -> CommandReply:
        """Wait behind all others; return the answer.

        Raises:
            TooManyRequests: too many wait already.
            LdcndError: as the command itself, or as those that wait were refused.
        """
        if len(self._waiting) >= QUEUED_COMMANDS:
            raise TooManyRequests(
                f"axis {self._axis}: {QUEUED_COMMANDS} commands wait already",
                axis=self._axis,
                limit=QUEUED_COMMANDS,
                remedy="wait for a reply before sending the next command",
            )
        future: asyncio.Future[CommandReply] = asyncio.get_running_loop().create_future()
        self._waiting.append(WaitingCommand(permit, request, future))
        self.wake()
        return await future

    def take(self) -> WaitingCommand | None:
        """Remove and return the command that has waited longest, or None when none does."""
        return self._waiting.popleft() if self._waiting else None

    def refuse(self, error: LdcndError) -> None:
        """Refuse all commands that wait."""
        while waiting := self.take():
            waiting.refuse(error)

    def wake(self) -> None:
        """Wake the task of the axis to check for work."""
        self._woken.set()

    async def woken(self, deadline_s: float) -> None:
        """Return when a command waits, when the axis was woken, or at the deadline, in loop time."""
        if self._waiting:
            return
        self._woken.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(None if math.isinf(deadline_s) else deadline_s):
                await self._woken.wait()


END_ITEMS = frozenset({TelemetryItem.POSITION, TelemetryItem.VELOCITY})
"""Items published with the reading that ends a command, besides those requested."""


def _no_note(_axis: str, _verb: str, _status: CommandStatus, _reason: str, _code: str | None) -> None:
    pass


FIRST_READING_DELAY_S = 0.005
"""Delay between the start of a motion and the request for the reading at its end, seconds."""
SETTLES_WITHIN_S = 0.25
"""Time within which a shaft follows its finished profile, seconds."""
GAINS_BACK_S = 10.0
"""Longest wait for rest before the loop of an axis with gains of a trial is opened, seconds."""


class AxisService:
    """The commands, the state and the telemetry of one axis.

    Attributes:
        stop_wanted: set when a stop waits to be sent again; its line sees to that.
        line_up: its line is ready for stops; while it is not, they wait for it.
        returned: called when the drive replies again after it was out of reach, once its state is known.
        ask_at: has the drive read at an instant of the loop's clock, besides its ordinary polls.
        latches: keeps what forbids the axis to move; a stop is answered when that is kept.
    """

    def __init__(
        self,
        config: AxisConfig,
        bus: Bus,
        driver: Drive,
        publisher: Publisher,
        clock: Clock,
        next_command_id: Callable[[], str],
        ended: OnEnded,
        note: Note = _no_note,
        *,
        kept: KeptFiles | None = None,
        keeps_reference: bool = False,
    ) -> None:
        self.config = config
        self.driver = driver
        self.stoppable = Verb.STOP in driver.capabilities
        tracker = AxisTracker if self.stoppable else ObservedTracker
        self._proof = bus.proofs.expect(driver.spec.address, f"axis {config.name}", config.name)
        self._arrivals = Arrivals(config, self._shown_at, ended, note)
        self.tracker = tracker(config.name, config.unit, self._arrivals.ended, self._proof)
        self.telemetry = AxisTelemetry(
            publisher,
            self.tracker,
            config.signed_counts_per_unit,
            adc_full_scale=driver.adc_full_scale,
            adc_volts=config.adc_volts,
            shows_inputs=driver.shows_inputs,
            modulo=config.modulo,
        )
        self._moves = moves = driver if isinstance(driver, Moves) else Unmoved(driver)
        self._plausibility = PlausibilityGate(config)
        self._gate = Gate(moves, self.tracker, self._plausibility.expect)
        self._bus = bus
        self._clock = clock
        self._next_command_id = next_command_id
        self._note = note
        self.reference = ReferenceKeeper(
            config, driver, self.tracker, self.telemetry, clock, kept, references=keeps_reference
        )
        self._recalled: float | None = None
        self._motion = AxisMotion(config, moves, self.tracker, self.telemetry, clock, self._read, self.reference)
        self._commands = AxisCommands(self._motion)
        self._queue = CommandQueue(config.name)
        self._parameters = Parameters(driver, driver.parameters) if driver.parameters else None
        self.traces = TraceRecorder(config.name, self._tracer(driver), publisher, clock)
        self.stop_wanted = asyncio.Event()
        self.returned: Callable[[], None] | None = None
        self.ask_at: Callable[[float], None] | None = None
        self.latches: LatchKeeper | None = None
        self.line_up = False
        self._inherited = False
        self._altered = ""
        self._done: tuple[float, int, bool] | None = None  # since when, where, and whether it had time to settle
        self._seen = False
        self._successors = asyncio.Lock()
        self._changed = asyncio.Event()
        self._last_in_turn = ""  # the last move that came to wait for its turn

    def _tracer(self, driver: Drive) -> Tracer:
        """Return the drive's own recorder, or the host's."""
        if driver.tracer:
            return driver.tracer
        readable = driver if isinstance(driver, Readable) else self._moves
        channels = host_channels(
            readable, self.config.unit, self.config.signed_counts_per_unit, self.telemetry.position
        )
        return HostTracer(self._bus, readable, channels, self._require_reachable)

    # -- life --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Carry out commands, one after another, until cancelled; then every caller has its answer."""
        waiting = None
        try:
            while True:
                if not self._commands.step_due:
                    await self._queue.woken(self._commands.deadline_s)
                async with self._queue.at_work:
                    waiting = self._queue.take()
                    if waiting:
                        await waiting.carry_out(self._obey)
                    else:
                        await self._step()
        finally:
            if waiting:
                waiting.refuse(self._gate.ending())
            self.close()

    def close(self) -> None:
        """Begin no motion any more: the daemon ends. What waits is refused; stops go on."""
        self._gate.close()
        self._changed.set()
        self._queue.refuse(self._gate.ending())

    def reconfigure(self, config: AxisConfig) -> None:
        """Take other limits and speeds, for commands that come from now on; what moves is not touched."""
        self.config = config
        self._motion.reconfigure(config)
        self._plausibility.reconfigure(config)

    async def recall(self, report: BringUpReport) -> None:
        """Take up the reference that an earlier daemon has kept, if everything proves it; the line has come up."""
        name = self.config.name
        reset = "its line was reset" if report.reset else ""
        interrupted = "its drive had lost power" if name in report.restarted else reset
        origin, refused = await self.reference.recall(report.baud, report.identities.get(name, ""), interrupted)
        self._recalled = origin
        if origin is not None:
            log.info("reference kept", axis=name)
            self._note(name, REFERENCE, CommandStatus.DONE, "kept: it is as an earlier daemon has left it", None)
        if not refused:
            return
        log.warning("kept reference refused", axis=name, reason=refused)
        self.tracker.refuse_reference(refused)
        self._note(name, REFERENCE, CommandStatus.REFUSED, f"not kept: {refused}", REFERENCE_REFUSED.code)
        try:
            await self.reference.forget()
        except WrongState as error:
            log.error("kept reference not removed", axis=name, reason=error.message)

    def connected(self, *, placed: bool) -> None:
        """The line came up; `placed` when 0 is where the drive was powered on, and that is the reference."""
        self.line_up = True
        self.tracker.referenced = placed or self._recalled is not None
        if self.tracker.referenced:
            self.telemetry.origin_counts = 0.0 if placed else self._recalled or 0.0
        self._recalled = None
        self.reference.woken.set()

    def disconnected(self) -> None:
        """The drive is out of reach, or has lost power."""
        self.traces.disconnected()
        self._plausibility.after_gap()
        self.tracker.disconnected(self._clock.now_ns())
        self.telemetry.stale(self._clock.now_ns())

    def judged(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> bool:
        """Take a reading if the drive can have got there; true when it has to be read again first."""
        tracker = self.tracker
        if tracker.stop_pending:
            self.stop_wanted.set()  # it replies again, whatever it says
        if not self._proof.holds:
            self._nothing_came()  # from its drive: who answers was not identified
            return False
        # a command that waits has sent nothing yet
        standing = tracker.command is None and tracker.at_rest and not self._queue.at_work.locked()
        judged = self._plausibility.judge(reading, timing, standing=standing)
        if judged.verdict is ReadingVerdict.BELIEVED:
            if judged.confirmed:
                if judged.step:
                    self._stepped(judged.step, reading)
                # items that only the first of two readings has are valid as well
                first, first_timing = judged.confirmed
                self._observe(first, first.asked - asked, first_timing)
            self._observe(reading, asked, timing)
            return False
        if judged.verdict is ReadingVerdict.CONTRADICTS:
            now_ns = self._clock.now_ns()
            if tracker.contradicted(now_ns):
                log.error("readings contradict each other", axis=self.config.name, counts=reading.position_counts)
                self._stop_what_is_not_understood()
            self._changed.set()
            self.telemetry.stale(now_ns)
        if judged.foreign:
            self._bus.distrust()  # another drive's reply that came late would be followed by others
        return judged.verdict is ReadingVerdict.ASK_AGAIN

    def _stepped(self, step: CounterStep, reading: AxisReading) -> None:
        """No motion has led to where the drive is: its counter was set, or the encoder slips."""
        if step is CounterStep.ZEROED:
            self._changed_by_another(DRIVE_RESET, "its position counter has restarted at 0")
        else:
            log.error("position jumped", axis=self.config.name, counts=reading.position_counts)
            self.tracker.jumped()
        self._stop_what_is_not_understood()

    def _stop_what_is_not_understood(self) -> None:
        """Have a motor that may have voltage stopped at once; its line sends that again until the drive confirms it."""
        if not self.tracker.energised or not self.stoppable:
            return
        self._overtake(None, "the stop of a motion that is not understood")
        self._not_confirmed(UNDERSTOOD_NO_MORE.get(self.config.loss.bus, StopMode.SMOOTH))

    def observed(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> None:
        """Process an accepted reading; that of a drive which was not identified says nothing about the axis."""
        if self._proof.holds:
            self._observe(reading, asked, timing)
        else:
            self._nothing_came()  # from its drive: who answers was not identified

    def _observe(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> None:
        tracker, arrivals = self.tracker, self._arrivals
        was_away = self._seen and tracker.link is LinkState.DOWN
        self._seen = True
        had_lost_reference = tracker.reference_lost
        if tracker.command:
            arrivals.reading = reading
        if reading.altered != self._altered or not reading.profile_done:  # a call less for each poll of what stands
            self._audit(reading, timing)
        t, t_error_ns = self._clock.stamp(timing)
        tracker.observed(reading, timing, t)
        if was_away and self.returned:
            self.returned()
        if tracker.reference_lost and not had_lost_reference:
            log.warning("reference lost", axis=self.config.name, faults=[fault.code for fault in reading.faults])
        self._changed.set()
        self._motion.reading = reading
        if self._commands.procedure is not None:
            self._commands.observed(reading, timing)
            if self._commands.step_due:
                self._queue.wake()
        if self._inherited:
            self._end_what_has_no_end(reading, timing.sent_at_s)
        if arrivals.over:
            asked |= END_ITEMS
        self.telemetry.reading(reading, asked, t, t_error_ns)
        if arrivals.reading:
            arrivals.report()
            self._ask_in_time(timing.sent_at_s)
            self.reference.woken.set()

    def _audit(self, reading: AxisReading, timing: Timing) -> None:
        """Report changes of the drive that this daemon has not made; the tracker has not seen the reading yet."""
        tracker = self.tracker
        if reading.altered != self._altered:
            self._altered = reading.altered
            if reading.altered:
                self._say_changed(DRIVE_CHANGED, reading.altered)
        elif reading.profile_done or not reading.enabled or not self.stoppable:
            return
        elif tracker.at_rest and not tracker.command and self._queue.free and tracker.concerns(timing):
            self._changed_by_another(DRIVE_CHANGED, "it began to move without a command of this daemon")

    def _changed_by_another(self, fault: Fault, what: str) -> None:
        self.tracker.changed_by_another(fault)
        self._say_changed(fault, what)

    def _say_changed(self, fault: Fault, what: str) -> None:
        log.warning("drive was reset or changed by another program", axis=self.config.name, what=what)
        self._note(self.config.name, events.DRIVE_CHANGED, CommandStatus.FAILED, what, fault.code)

    def restarted(self) -> None:
        """Its drive has lost power or was reset, and is about to answer again."""
        self._say_changed(DRIVE_RESET, "it has lost power or was reset, and gets its address again")

    def _ask_soon(self) -> None:
        self._ask_in_time(self._clock.now_s())

    def _shown_at(self, counts: int) -> float:
        return self.telemetry.within_turn(self.telemetry.position(counts))[0]

    def _ask_in_time(self, at_s: float) -> None:
        """Have the drive read when the motion under way should end, and while it settles, whatever the rates."""
        read_at_s = min(self.tracker.next_reading_s(at_s) or math.inf, at_s + self._commands.watch_s)
        if self.ask_at and not math.isinf(read_at_s):
            self.ask_at(read_at_s)

    def missed(self, error: BusError) -> None:
        """Take note that a poll brought nothing, or nothing that can be used."""
        if not (self._proof.holds and isinstance(error, PacketRejected | BadReply)):
            self._nothing_came()
            return
        now_ns = self._clock.now_ns()
        if self.tracker.replied_in_vain(now_ns):
            log.error("replies cannot be used", axis=self.config.name, reason=error.message)
            self._stop_what_is_not_understood()
            self._changed.set()
        self.telemetry.stale(now_ns)

    def _nothing_came(self) -> None:
        before = self.tracker.link
        self.tracker.missed(self._clock.now_ns())
        if self.tracker.link is not before:
            log.warning("drive does not answer", axis=self.config.name, link=self.tracker.link.value)
            if self.tracker.link is LinkState.DOWN:
                self._plausibility.after_gap()
            self.telemetry.stale(self._clock.now_ns())

    def monitored(self, value: MonitorValue, timing: Timing) -> None:
        """Take a monitor from the family's own poller."""
        t, t_error_ns = self._clock.stamp(timing)
        self.telemetry.monitor(value, t, t_error_ns)

    def alarmed(self, alarm: Fault) -> None:
        """Take an alarm that the drive has entered in its own history."""
        reason = f"{alarm.text}: new in the alarm history of the drive"
        self._note(self.config.name, ALARM_HISTORY, CommandStatus.FAILED, reason, alarm.code)

    def frozen_at(self, counts: int) -> FrozenPosition:
        """Return a position that was frozen in the drive, as the reply to a snapshot has it."""
        return FrozenPosition(
            axis=self.config.name,
            position=self._shown_at(counts),
            counts=counts,
            unit=self.config.unit,
            referenced=self.tracker.referenced,
        )

    @property
    def at_work(self) -> bool:
        """Whether it carries out a command, moves, or may move for all that is known."""
        return self.tracker.command is not None or self.tracker.moving is not Moving.NO

    # -- commands ----------------------------------------------------------------------------------------------------

    def permit(self, command_id: str, verb: Verb, right: Right = UNCONDITIONAL) -> Permit:
        """Return permission for a command that was admitted just now; a stop makes it void."""
        return self._gate.permit(command_id, verb, right)

    async def execute(self, command: AxisCommand[CommandReply], permit: Permit | None = None) -> CommandReply:
        """Carry out a command in its turn; returns once the drive has acknowledged it.

        Args:
            command: what to do.
            permit: as made when it was admitted; a caller inside the daemon needs none.

        Raises:
            RequestRefused: it cannot be done; nothing was sent.
            BusError: the line failed; `OutcomeUnknown` when the drive may have started.
        """
        permit = permit or self.permit(self._next_command_id(), command.verb)
        if self.stoppable and (mode := takes_energy_out(command)):
            return await self._take_energy_out(permit, command, mode)
        self._check_takes(command.verb)
        if not self._queue.free:
            permit.ask()
            return await self._queue.wait(permit, command)
        try:
            async with self._queue.at_work:
                return await self._obey(permit, command)
        finally:
            if self._commands.procedure is not None:
                self._queue.wake()  # for the steps of what has begun

    def _check_takes(self, verb: Verb) -> None:
        if verb not in self.driver.capabilities:
            raise NotSupported(
                f"axis {self.config.name}: {self.config.model} cannot {verb}", axis=self.config.name, value=verb.value
            )

    def obstacles(self, verb: Verb) -> list[tuple[LdcndError, bool]]:
        """Return all that a command would be refused with now, the first first; and whether that ends with a motion."""
        try:
            self._check_takes(verb)
        except NotSupported as error:
            return [(error, False)]
        found = guards.obstacles(guards.needs(verb), self.tracker, self._moves)
        if guards.goes_on(verb, self.tracker):
            return [(error, False) for error, guard in found if guard is not guards.check_stands]
        return [(error, guard is guards.check_stands) for error, guard in found]

    def obstacles_to_motion(self, *, absolute: bool) -> list[tuple[LdcndError, bool]]:
        """Return all that keeps the axis from a motion, the faults of its drive one by one."""
        able = self.driver.capabilities
        moves = any(command.effect is Effect.MOTION and verb in able for verb, command in AXIS_COMMANDS.items())
        absolute = absolute and Verb.MOVE_ABSOLUTE in able
        row = guards.needs(Verb.MOVE_ABSOLUTE if absolute else Verb.MOVE_RELATIVE) if moves else guards.AT_ALL
        found = list(guards.obstacles(row, self.tracker, self._moves))
        name = self.config.name
        first = [error for error, guard in found if guard in (guards.check_reachable, guards.check_not_latched)]
        faults = [guards.fault(name, each) for each in self.tracker.active_faults if each.source == "drive"]
        causes = [(error, False) for error in (*first, *faults)]
        causes += [(error, guard is guards.check_stands) for error, guard in found if error not in first]
        if not moves:
            text = f"axis {name}: its drive takes no motion over the line"
            causes.append((NotSupported(text, axis=name, remedy=NO_COMMAND_HELPS), False))
        return causes

    async def _take_energy_out(
        self, permit: Permit, command: AxisCommand[CommandReply], mode: StopMode
    ) -> CommandReply:
        """Send it, whatever the state, the link, a latch or what waits: nothing here may refuse it.

        Raises:
            OutcomeUnknown: the drive has not confirmed it; it is sent again until it does.
        """
        if isinstance(command, Stop | QuickStop):
            confirmed = await self.stop(mode)
        else:
            confirmed = await self.bring_to_rest(mode, command.verb, command_id=permit.command_id)
        if not confirmed:
            name = self.config.name
            raise OutcomeUnknown(
                f"axis {name}: the drive has not confirmed {command.verb} yet; it is sent again until it does",
                axis=name,
                value=command.verb.value,
                remedy="look whether the axis moves; check the power of the drive and its line",
            )
        return CommandReply(command_id=permit.command_id, axis=self.config.name, verb=command.verb)

    async def in_turn(
        self,
        move: Move,
        permit: Permit,
        execute: Callable[[], Awaitable[CommandReply]],
        waits: Callable[[str], None] = lambda _: None,
    ) -> CommandReply:
        """Carry out a move after what the axis is doing: after having halted that, or after its end.

        An aborting move that would be refused halts nothing.

        Args:
            move: the move.
            permit: of it.
            execute: begins it.
            waits: called with the id of the command that it waits for: at once for a buffered move, and for an aborting
                one when the axis takes long to come to rest.

        Raises:
            StopLatched: a stop came first.
            CommandAborted: a halt, or a later aborting move, came first.
            LdcndError: as the move itself, and as `Permit.ask_to_move`: also what has changed while it waited.
        """
        ahead = self._last_in_turn if self._successors.locked() else self._active_id
        patience_s = math.inf
        if move.buffer_mode is BufferMode.ABORTING and self.tracker.command:
            permit.ask_to_move()
            self._commands.check(move)
            if self._commands.retargets(move):
                self._overtake(permit, permit.verb)
                return await execute()
            await self.bring_to_rest(StopMode.SMOOTH, by=permit)
            patience_s = HALTS_WITHIN_S
        elif move.buffer_mode is BufferMode.BUFFERED and ahead is not None:
            permit.ask()
            if self.tracker.command and self.tracker.command.verb is not Verb.HOME and isinstance(move, MoveAbsolute):
                self._commands.check(move)  # what can be told now is not kept for later
            waits(ahead)
        self._last_in_turn = permit.command_id
        async with self._successors:  # those who wait are served in the order in which they came
            deadline_s = self._clock.now_s() + patience_s
            while self.tracker.command:
                self._changed.clear()
                try:
                    async with asyncio.timeout_at(None if math.isinf(deadline_s) else deadline_s):
                        await self._changed.wait()
                except TimeoutError:
                    deadline_s = math.inf
                    waits(self._active_id or permit.command_id)
                permit.ask()
            permit.ask()
            return await execute()

    @property
    def _active_id(self) -> str | None:
        return self.tracker.command.command_id if self.tracker.command else None

    async def set_speed_share(self, share: float) -> tuple[bool, bool]:
        """Take another speed override, 0 to 1; return whether what moves goes on at another speed, or was halted.

        Raises:
            LdcndError: a motion under way could not be changed; those that begin have the new one all the same.
        """
        self.tracker.speed_share = share
        self.telemetry.state(self._clock.now_ns())
        if share <= 0:
            if not self.at_work or self.tracker.state is AxisState.DISABLED:
                return False, False
            await self.bring_to_rest(StopMode.SMOOTH)
            return False, True
        async with self._queue.at_work:
            changed = await self._commands.change_speed()
        self._queue.wake()
        return changed, False

    def begin_hold(self, command_id: str, request: Jog) -> Hold:
        """Remember who holds a jog, from its command on."""
        return self._commands.holds.begin(command_id, request, self._clock.now_s())

    def renew_jog(self, request: Jog, command_id: str) -> CommandReply:
        """Keep a jog alive, at the velocity requested now; begins nothing.

        Raises:
            LeaseExpired: the jog is over.
            RequestRefused: a limit forbids the velocity.
        """
        reply = self._commands.renew_jog(request, command_id)
        self._queue.wake()
        return reply

    async def take_gains_back(self) -> None:
        """Control has ended: open the loop at rest if gains were lent; the next motion loads those of before.

        A closed loop is not given other gains: any position error would become a jump.
        """
        if not self._commands.take_gains_back():
            return
        log.warning("lent gains taken back", axis=self.config.name)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GAINS_BACK_S):
                while self.at_work and self._commands.gains_differ and not self._gate.closed:
                    self._changed.clear()
                    await self._changed.wait()
        if self._commands.gains_differ:  # else another client's motion has loaded them already
            await self.bring_to_rest(StopMode.OFF)

    def planned(self, move: MoveAbsolute) -> tuple[AxisMotion, MotionPlan]:
        """Return what this axis would do for its share of a group move, by itself; no effect.

        Raises:
            RequestRefused: its values are refused.
        """
        motion = self._motion
        return motion, motion.plan_to(motion.unwrapped(move.position, move.direction), move.velocity, move.acceleration)

    def preview(self, request: Preview, obstacles: tuple[str, ...]) -> PreviewReply:
        """Tell what a motion would do; no effect. See `preview`."""
        return preview(self._motion, self._bus, request, obstacles)

    def report_shadow(self, report: ReportShadow) -> ShadowReply:
        """Publish what an observer says of this axis; no effect."""
        self.telemetry.shadow(report)
        return ShadowReply(axis=self.config.name)

    async def stop(self, mode: StopMode) -> bool:
        """Stop at once, whatever the state, and latch; return whether the drive confirmed it.

        The latch and the new epoch hold from this call on, confirmed or not. A drive that takes no stop over its line
        is not latched either: nothing could clear that, and nothing here moves it.
        """
        if not self.stoppable:
            log.warning("this drive cannot be stopped over its line", axis=self.config.name)
            return False
        self.tracker.latch_stop()
        log.info("stop", axis=self.config.name, mode=mode.value)
        confirmed = await self.bring_to_rest(mode, Verb.STOP)
        if self.latches:
            await self.latches.settled()
        return confirmed

    @property
    def latch_is_kept(self) -> bool:
        """Whether the stop that is latched is on the disk, so that it outlasts the daemon."""
        return self.latches is not None and self.latches.holds(self.config.name)

    async def bring_to_rest(
        self, mode: StopMode, verb: Verb = Verb.HALT, by: Permit | None = None, command_id: str | None = None
    ) -> bool:
        """Stop at once, before anything that waits; return whether the drive confirmed it.

        Args:
            mode: how.
            verb: the command, for the events.
            by: permit of the command that goes on afterwards; all others are void.
            command_id: of the command that asks for it; the next one of the daemon when missing.
        """
        if not self.stoppable:
            return False
        overtaken = self._overtake(by, by.verb if by else OVERTAKES.get(verb, verb))
        mode = self.tracker.stop_sent(mode)
        try:
            if not self.line_up:
                return False  # its line is being brought up, or is down: it is the first thing that is sent then
            self._bus.withdraw(self.driver.spec.address, overtaken)
            return await self._confirmed_stop(mode, verb, STOP_ROUNDS, command_id)
        finally:
            if self.tracker.unconfirmed is not None:
                self._not_confirmed(self.tracker.unconfirmed)
            self.telemetry.state(self._clock.now_ns())

    def _overtake(self, by: Permit | None, cause: str) -> StopLatched | CommandAborted:
        """Make all queued commands and permits void, except the caller's; return the refusal, which names the cause."""
        self._gate.overtake(by, cause)
        self._changed.set()
        overtaken = self._gate.overtaken("a queued command")
        self._queue.refuse(overtaken)
        return overtaken

    async def send_pending_stop(self) -> None:
        """Send a stop again that the drive has not confirmed, whatever the state of the axis."""
        if not self.tracker.stop_pending:
            return
        try:
            if not self._seen:  # a stop would close the loop of a disabled axis: see how the drive was left
                asked_s = self._clock.now_s()
                reading = await self._read()
                now_s = self._clock.now_s()
                if self._proof.holds:
                    self.observed(reading, reading.asked, Timing(asked_s, asked_s, now_s, now_s))
                else:
                    self.tracker.enabled = reading.enabled
        except LdcndError as error:  # a stop that comes now withdraws the reading, and is sent itself
            log.warning("stop not sent again", axis=self.config.name, reason=error.message)
            return
        mode = self.tracker.unconfirmed
        if mode is None:
            return  # such a stop was confirmed while the axis was read
        if await self._confirmed_stop(mode, Verb.STOP, rounds=1):
            log.warning("stop confirmed late", axis=self.config.name)
            self._note(
                self.config.name, Verb.STOP, CommandStatus.DONE, "confirmed late, when the drive answered again", None
            )
        self.telemetry.state(self._clock.now_ns())

    def switch_off(self) -> None:
        """Have the motor switched off by the first packet to its drive."""
        if self.stoppable:
            self.tracker.stop_unconfirmed(self._clock.now_ns(), StopMode.OFF)

    def taken_over(self) -> None:
        """Its drive is as another host has left it: what moves in it without an end is to be brought to rest.

        Its loop is closed, or `switch_off` would have been called: a stop before the first reading keeps it so.
        """
        self._inherited = self.stoppable
        if self.stoppable and not self._seen:
            self.tracker.enabled = True

    def _end_what_has_no_end(self, reading: AxisReading, at_s: float) -> None:
        """Have a motion stopped that an earlier host has left, if its profile is done and yet it goes on.

        So does velocity mode as soon as its velocity is reached; a trapezoid is done when it stands, and settles.
        """
        tracker, position = self.tracker, reading.position_counts
        if tracker.command is not None or tracker.at_rest:
            self._inherited, self._done = False, None
        elif not (reading.enabled and reading.profile_done):
            self._done = None
        elif self._done is None:
            self._done = (at_s, position, False)
        else:
            since_s, was_at, settled = self._done
            if at_s - since_s < SETTLES_WITHIN_S:
                return
            if not settled or abs(position - was_at) <= REST_COUNTS:
                self._done = (at_s, position, True)
                return
            self._inherited, self._done = False, None
            log.warning("motion without an end found", axis=self.config.name)
            self._not_confirmed(StopMode.SMOOTH)

    def cannot_move(self) -> None:
        """Note that the drive was reset or had no power: the motion to be stopped has ended."""
        self._inherited = False
        self.tracker.stop_confirmed()

    async def _confirmed_stop(self, mode: StopMode, verb: Verb, rounds: int, command_id: str | None = None) -> bool:
        if not self.tracker.energised:
            mode = StopMode.OFF  # a stop must not close the loop of a disabled axis
        stands = verb is Verb.HALT and self.tracker.command is None and self.tracker.moving is Moving.NO
        for _ in range(rounds):
            try:
                mode = await self._moves.stop(mode)
            except BusError as error:
                log.error("stop not confirmed", axis=self.config.name, reason=error.message)
                if self._bus.is_open:
                    continue
                return False
            if mode is StopMode.OFF:
                self._commands.switched_off()
                self.tracker.powered(on=False, now_s=self._clock.now_s())
            elif not stands:  # what was proven to stand is not watched coming to rest, and keeps its target
                self._commands.brought_to_rest(command_id or self._next_command_id(), verb)
            self.tracker.stop_confirmed(mode)
            return True
        return False

    def _not_confirmed(self, mode: StopMode) -> None:
        """A stop stays to be sent: its line sends it again, before anything else to this drive."""
        self.tracker.stop_unconfirmed(self._clock.now_ns(), mode)
        self.stop_wanted.set()

    async def _obey(self, permit: Permit, command: AxisCommand[CommandReply]) -> CommandReply:
        permit.ask()
        if command.capability is Capability.TRACES:
            return await self.traces.carry_out(permit.command_id, command)
        if self._parameters and command.capability is Capability.PARAMETERS:
            return await self._parameters.carry_out(permit.command_id, command)
        try:
            return await self._commands.carry_out(permit, command)
        finally:
            if self.tracker.settle or not math.isinf(
                self._commands.watch_s
            ):  # the caller that waits for the reply goes first
                asyncio.get_running_loop().call_later(FIRST_READING_DELAY_S, self._ask_soon)

    def _require_reachable(self) -> None:
        guards.check_reachable(self.tracker)

    async def _read(self) -> AxisReading:
        """Read the drive's state out of turn, until two readings agree.

        Raises:
            BadReply: they do not, or agree on a place that no motion can have led to, as late replies of another drive.
            BusError: the line failed.
        """
        exchange = self._moves.reading(frozenset())
        before = await self._bus.execute(exchange)
        for _ in range(ROUNDS):
            reading = await self._bus.execute(exchange)
            if agree(before, reading):
                if not self._plausibility.is_out_of_reach(reading, self._clock.now_s()):
                    return reading
                self._bus.distrust()
                place = self.telemetry.position(reading.position_counts)
                raise BadReply(
                    f"axis {self.config.name}: it shows {place:g} {self.config.unit}, where no motion can have led"
                    " since its last reading; nothing was started",
                    axis=self.config.name,
                    value=place,
                    remedy="send it again; if that fails as well, look for an adapter that holds replies back",
                )
            before = reading
        raise BadReply(
            f"axis {self.config.name}: its readings contradict each other; nothing was started",
            axis=self.config.name,
            remedy="check the line for noise, then send it again",
        )

    async def _step(self) -> None:
        """Let the procedure under way take its step, if one is due."""
        if not self._commands.step_due and self._clock.now_s() < self._commands.deadline_s:
            return
        try:
            await self._commands.step()
        except LdcndError as error:
            log.warning("step of a command not taken", axis=self.config.name, reason=error.message)
        self._ask_in_time(self._clock.now_s())
