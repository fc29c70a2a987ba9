"""One axis at work: puts its parts together, and carries out its commands one after another.

A command that finds the axis free is carried out in the task of its caller, who then does not wait for another one;
those that had to wait are carried out in the axis's own. A stop never waits for them: see stopping.py.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from ldcnd.axis import guards
from ldcnd.axis.clock import Clock
from ldcnd.axis.commands import AxisCommands
from ldcnd.axis.events import (
    ControlChanged,
    LimitsSet,
    LoopSeen,
    PlaceKnown,
    PlaceUnknown,
    ReferenceRefused,
    SpeedOverridden,
)
from ldcnd.axis.faults import REFERENCE_REFUSED
from ldcnd.axis.host_tracer import HostTracer, host_channels
from ldcnd.axis.kept import KeptFiles
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.obstacles import Obstacles
from ldcnd.axis.parameters import Parameters
from ldcnd.axis.permit import UNCONDITIONAL, Gate, Permit, Right
from ldcnd.axis.plausibility import PlausibilityGate
from ldcnd.axis.preview import preview
from ldcnd.axis.procedures.group import GroupMoveRequest
from ldcnd.axis.procedures.jog import Hold
from ldcnd.axis.procedures.path import PathShareRequest
from ldcnd.axis.readings import AxisReadings, OnEnded, ReadingOutOfTurn
from ldcnd.axis.recorder import TraceRecorder
from ldcnd.axis.reference import ReferenceKeeper
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import AxisStatus, SoftLimits
from ldcnd.axis.stopping import AxisStops, stop_mode_of
from ldcnd.axis.succession import Succession
from ldcnd.axis.telemetry import AxisTelemetry, Note
from ldcnd.axis.tracker import AxisTracker
from ldcnd.axis.turns import CommandQueue
from ldcnd.axis.unmoved import Unmoved
from ldcnd.contract.commands import (
    AxisCommand,
    Capability,
    CommandReply,
    Effect,
    Jog,
    Power,
    QuickStop,
    Stop,
    Verb,
)
from ldcnd.contract.errors import (
    InterlockViolated,
    LdcndError,
    OutcomeUnknown,
    WrongState,
)
from ldcnd.contract.events import REFERENCE, CommandStatus
from ldcnd.contract.questions import Preview, PreviewReply
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading, Drive, Moves, Readable, StopMode
from ldcnd.drives.network import BringUpReport
from ldcnd.drives.tracer import Tracer
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Timing
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

log = get_logger("axis")

FIRST_READING_DELAY_S = 0.005
"""Delay between the start of a motion and the request for the reading at its end, seconds."""
GAINS_BACK_S = 10.0
"""Longest wait for rest before the loop of an axis with gains of a trial is opened, seconds."""


def _no_note(_axis: str, _verb: str, _status: CommandStatus, _reason: str, _code: str | None) -> None:
    pass


class AxisService:
    """The commands, the state and the telemetry of one axis.

    Attributes:
        config: of the axis, as it is now.
        driver: its drive.
        tracker: its state.
        telemetry: publishes it.
        reference: keeps its reference.
        traces: takes its traces.
        stops: brings it to rest.
        succession: has moves wait for their turn.
        obstacles: what keeps it from commands.
        readings: digests what polls bring.
        gate: permits its commands.
        motion: starts and ends its motions.
        commands: carries them out.
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
        self._bus = bus
        self._clock = clock
        self._next_command_id = next_command_id
        self._note = note
        self._moves = moves = driver if isinstance(driver, Moves) else Unmoved(driver)
        proof = bus.proofs.expect(driver.spec.address, f"axis {config.name}", config.name)
        limits = SoftLimits.of(config)
        status = AxisStatus(
            config.name, AxisScale.of(config), Verb.STOP in driver.capabilities, limits, rest=limits.unseen
        )
        self.tracker = AxisTracker(status, proof)
        self.telemetry = AxisTelemetry(publisher, config.name, driver, adc_volts=config.adc_volts)
        self._plausibility = plausibility = PlausibilityGate(config)
        self.gate = Gate(moves, self.tracker, plausibility)
        self.reference = ReferenceKeeper(config, driver, self.tracker, clock, kept, references=keeps_reference)
        self._recalled: float | None = None
        self._left_as: tuple[AxisReading, Timing] | None = None  # of the drive, before its place was judged
        self._gains_due_back = False  # gains were taken back, and the loop that holds them is still closed
        read = ReadingOutOfTurn(moves, bus, plausibility, self.tracker, clock)
        self.motion = AxisMotion(config, moves, self.tracker, self.telemetry, clock, read, self.reference)
        self.commands = AxisCommands(self.motion)
        self._queue = CommandQueue(config.name)
        self.stops = AxisStops(self.motion, bus, self.gate, self._queue, self.commands, next_command_id, note)
        self.succession = Succession(self.motion, self.commands, self._queue, self.stops)
        self.obstacles = Obstacles(self.motion, self.gate)
        self.readings = AxisReadings(
            self.motion, bus, plausibility, self._queue, self.commands, self.stops, ended, note
        )
        self._parameters = Parameters(driver, driver.parameters) if driver.parameters else None
        self.traces = TraceRecorder(config.name, self._tracer(driver), publisher, clock)

    def _tracer(self, driver: Drive) -> Tracer:
        """Return the drive's own recorder, or the host's."""
        if driver.tracer:
            return driver.tracer
        readable = driver if isinstance(driver, Readable) else self._moves
        channels = host_channels(readable, lambda: self.tracker.status.scale)
        return HostTracer(self._bus, readable, channels, self._require_reachable)

    # -- life ----------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Carry out commands, one after another, until cancelled; then every caller has its answer."""
        waiting = None
        try:
            while True:
                if not self.commands.step_due:
                    await self._queue.woken(self.commands.deadline_s)
                async with self._queue.at_work:
                    # a due step may be the stop of what runs: no row of commands keeps it back
                    waiting = None if self.commands.step_is_due else self._queue.take()
                    if waiting:
                        await waiting.carry_out(self._obey)
                    else:
                        await self._step()
        finally:
            if waiting:
                waiting.refuse(self.gate.ending())
            self.close()

    def close(self) -> None:
        """Begin no motion any more: the daemon ends. What waits is refused; stops go on."""
        self.gate.close()
        self._queue.refuse(self.gate.ending())

    def reconfigure(self, config: AxisConfig) -> None:
        """Take other limits and speeds, for commands that come from now on; what moves is not touched."""
        self.config = config
        self.tracker.take(LimitsSet(SoftLimits.of(config)))
        self.motion.reconfigure(config)
        self._plausibility.reconfigure(config)
        self.readings.reconfigure(config)

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
        self.tracker.take(ReferenceRefused(refused))
        self._note(name, REFERENCE, CommandStatus.REFUSED, f"not kept: {refused}", REFERENCE_REFUSED.code)
        try:
            await self.reference.forget()
        except WrongState as error:
            log.error("kept reference not removed", axis=name, reason=error.message)

    def connected(self, *, placed: bool) -> None:
        """The line came up; `placed` when 0 is where the drive was powered on, and that is the reference."""
        self.stops.line_up = True
        # what was recalled counts once: when the line comes up again it proves nothing
        origin_counts, self._recalled = 0.0 if placed else self._recalled, None
        if origin_counts is None:
            self.tracker.take(PlaceUnknown())
        else:
            scale = replace(self.tracker.status.scale, origin_counts=origin_counts)
            self.tracker.take(PlaceKnown(scale, stood=not placed and self.reference.stood))
        self.reference.woken.set()
        if self._left_as:
            (reading, timing), self._left_as = self._left_as, None
            self.readings.accept(reading, reading.asked, timing)

    def disconnected(self) -> None:
        """The drive is out of reach, or has lost power."""
        self.traces.disconnected()
        self.readings.disconnect()

    def brought_up(self, *, reset: bool, is_open: bool) -> None:
        """Its drive was found by a bring-up of its line: what moves in it without an end is to be brought to rest.

        Args:
            reset: it was reset.
            is_open: its loop is open: nothing in the drive ends a raw duty that an earlier host has left. Otherwise a
                stop before the first reading keeps it closed.
        """
        self._left_as = None
        if reset:
            self.stops.note_power_loss()
        elif is_open:
            self.stops.switch_off()
        else:
            self.stops.inherit()
            if self.stops.possible and not self.readings.seen:
                self.tracker.take(LoopSeen(enabled=True))

    # -- commands ------------------------------------------------------------------------------------------------------

    @property
    def at_work(self) -> bool:
        """Whether it carries out a command, moves, or may move for all that is known."""
        return self.tracker.status.command is not None or self.tracker.status.moving is not Moving.NO

    def permit(self, command_id: str, verb: Verb, right: Right = UNCONDITIONAL) -> Permit:
        """Return permission for a command that was admitted just now; a stop makes it void."""
        return self.gate.permit(command_id, verb, right)

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
        if self.stops.possible and (mode := stop_mode_of(command)):
            if isinstance(command, Power):
                await self._ask_to_open_loop(permit)
            return await self._take_energy_out(permit, command, mode)
        self.obstacles.check_takes(command.verb)
        self.succession.beginning += command.effect is Effect.MOTION
        try:
            if not self._queue.free:
                permit.ask()
                return await self._queue.wait(permit, command)
            async with self._queue.at_work:
                return await self._obey(permit, command)
        except LdcndError:
            if command.effect is Effect.MOTION:
                self.succession.note_failure()
            raise
        finally:
            self.succession.beginning -= command.effect is Effect.MOTION
            self._queue.changed.set()
            if self.commands.procedure is not None:
                self._queue.wake()  # for the steps of what has begun

    async def _ask_to_open_loop(self, permit: Permit) -> None:
        """Bring an axis to rest that an interlock keeps from being switched off: a load would fall; nothing else does.

        Raises:
            InterlockViolated: it holds its position.
        """
        try:
            permit.ask_to_open_loop()
        except InterlockViolated:
            await self.stops.bring_to_rest(StopMode.SMOOTH)
            raise

    async def _take_energy_out(
        self, permit: Permit, command: AxisCommand[CommandReply], mode: StopMode
    ) -> CommandReply:
        """Send it, whatever the state, the link, a latch or what waits: nothing here may refuse it.

        Raises:
            OutcomeUnknown: the drive has not confirmed it; it is sent again until it does.
        """
        if isinstance(command, Stop | QuickStop):
            own = await self.stops.stop(mode, command.verb)
        else:
            own = await self.stops.bring_to_rest(mode, command.verb, command_id=permit.command_id)
        if not own.confirmed:
            name = self.config.name
            raise OutcomeUnknown(
                f"axis {name}: the drive has not confirmed {command.verb} yet; it is sent again until it does",
                axis=name,
                value=command.verb.value,
                remedy="look whether the axis moves; check the power of the drive and its line",
            )
        return CommandReply(command_id=permit.command_id, axis=self.config.name, verb=command.verb, stops=own.count)

    def show(self) -> None:
        """Publish the state once more; what is read is published by its polls.

        Clients wait for the first state of an axis before they command it: before its drive was read there is none, but
        for a stop that an earlier daemon has left.
        """
        self.stops.note_overdue()
        status = self.tracker.status
        if status.was_read or status.stop_latched or status.stop_due:
            self.telemetry.publish_state(status, self._clock.now_ns(), due=True)

    def controlled_by(self, client: str | None) -> None:
        """Publish who controls the axis from now on; None when no client does."""
        self.telemetry.publish_state(self.tracker.take(ControlChanged(client)), self._clock.now_ns())

    def stops_behind(self, share: float) -> int:
        """Return the `stops` directly behind `set_speed_share`, when that is called next: at 0 it makes one itself."""
        return self.tracker.status.stops + (share <= 0)

    async def set_speed_share(
        self, share: float, turn: asyncio.Lock
    ) -> Literal["changed", "unchanged", "halted", "unconfirmed", "unstoppable"] | None:
        """Take another speed override, 0 to 1; return what becomes of the motion under way, None without one.

        At 0 it is halted, and so is one that cannot be told to be slower: unconfirmed where its drive has not said so,
        unstoppable where it takes no stop over its line.

        Args:
            share: of every velocity.
            turn: to tell a drive another speed, which has to go out soon behind a reading: one at a time on a line.

        Raises:
            LdcndError: a motion under way could not be changed; those that begin have the new one all the same.
        """
        before = self.tracker.status.speed_share
        self.telemetry.publish_state(self.tracker.take(SpeedOverridden(share)), self._clock.now_ns())
        if share <= 0:
            now = self.tracker.status
            is_off = now.was_read and now.link is LinkState.UP and now.state is AxisState.DISABLED
            if not self.at_work or is_off:
                # what has yet to begin its motion must not do so once the override is raised
                self.stops.overtake(None, "a speed override of 0 %")
                return None
            if not self.stops.possible:
                self.stops.overtake(None, "a speed override of 0 %")
                return "unstoppable"
            own = await self.stops.bring_to_rest(StopMode.SMOOTH)
            return "halted" if own.confirmed else "unconfirmed"
        if self.commands.has_speed_to_tell:
            async with self._queue.at_work, turn:
                changed = await self.commands.change_speed()
        else:  # its own steps must not wait for the turns of others
            changed = self.commands.step_to_speed()
        self._queue.wake()
        if changed:
            return changed
        return "unchanged" if share != before and self.tracker.status.command is not None else None

    def begin_hold(self, command_id: str, request: Jog) -> Hold:
        """Remember who holds a jog, from its command on."""
        return self.commands.holds.begin(command_id, request, self._clock.now_s())

    def renew_jog(self, request: Jog, command_id: str) -> CommandReply:
        """Keep a jog alive, at the velocity requested now; begins nothing.

        Raises:
            LeaseExpired: the jog is over.
            RequestRefused: a limit forbids the velocity.
        """
        reply = self.commands.renew_jog(request, command_id)
        self._queue.wake()
        return reply

    async def take_gains_back(self, *, at_end: bool = False) -> None:
        """Control has ended: open the loop at rest if gains were lent; the next motion loads those of before.

        A closed loop is not given other gains: any position error would become a jump. What goes on moving with them is
        brought to rest after a while, and at once when the daemon ends; a loop that an interlock keeps closed is opened
        once that allows it.

        Args:
            at_end: the daemon ends: the axis is brought to rest at once. A call from before returns, and this one takes
                over.
        """
        gains = self.commands.gains
        if gains.take_back():
            log.warning("lent gains taken back", axis=self.config.name)
            self._gains_due_back = True
        if not self._gains_due_back:
            return
        stop_at_s, told = self._clock.now_s() + (0.0 if at_end else GAINS_BACK_S), ""
        # no more once another client's motion has loaded them
        while gains.differ and self.tracker.status.energised:
            if self.gate.closed and not at_end:
                return
            busy = self.at_work or self.succession.busy
            if not busy:
                kept = self._keeps_loop_closed()
                if not kept:
                    break
                if kept != told:
                    log.warning("loop not opened", axis=self.config.name, reason=kept)
                if at_end:
                    return
                told = kept
            elif self._clock.now_s() >= stop_at_s:
                await self.stops.bring_to_rest(StopMode.SMOOTH)
                stop_at_s = self._clock.now_s() + GAINS_BACK_S
            await self._changes(stop_at_s if busy else None)
        self._gains_due_back = False
        if gains.differ:
            await self.stops.bring_to_rest(StopMode.OFF)

    async def _changes(self, by_s: float | None) -> None:
        """Return when something has changed, or at an instant in loop time."""
        self._queue.changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(by_s):
                await self._queue.changed.wait()

    def _keeps_loop_closed(self) -> str:
        """Return why an interlock keeps the loop closed; empty when none does."""
        try:
            self.permit("", Verb.POWER).ask_to_open_loop()
        except InterlockViolated as error:
            return error.message
        return ""

    def preview(self, request: Preview, obstacles: tuple[str, ...]) -> PreviewReply:
        """Tell what a motion would do; no effect. See `preview`."""
        return preview(self.motion, self.commands.gains, self._bus, request, obstacles)

    async def _look(self) -> None:
        """Read how a drive was left, or what became of it while it was out of reach.

        Raises:
            LdcndError: as `AxisMotion.read`.
        """
        asked_s = self._clock.now_s()
        reading = await self.motion.read()
        now_s = self._clock.now_s()
        timing = Timing(asked_s, asked_s, now_s, now_s)
        if self.stops.line_up and self.readings.are_of_the_drive:
            self.readings.accept(reading, reading.asked, timing)
            return
        self.tracker.take(LoopSeen(reading.enabled))
        if self.readings.are_of_the_drive:  # it has no place yet, and a stop may hide the fault that it shows
            self._left_as = reading, timing

    async def send_pending_stop(self) -> None:
        """Send a stop again that the drive has not confirmed, whatever the state of the axis."""
        if not (self.tracker.status.stop_due or self.tracker.status.off_again):
            return
        holds = (stop := self.tracker.status.stop) is not None and stop.mode is not StopMode.OFF
        try:
            if not self.readings.seen or self.tracker.status.link is LinkState.DOWN:
                await self._look()
        except LdcndError as error:
            # one that holds would close an open loop; one that comes now withdraws the reading, and is sent itself
            if holds and not self.readings.seen:
                tell = log.warning if self.tracker.status.stop_pending else log.info
                tell("not read yet, its stop waits", axis=self.config.name, reason=error.message)
                return
            log.debug("stop sent to a drive that cannot be read", axis=self.config.name, reason=error.message)
        await self.stops.send_pending()

    async def _obey(self, permit: Permit, command: AxisCommand[CommandReply]) -> CommandReply:
        permit.ask()
        if command.capability is Capability.TRACES:
            return await self.traces.carry_out(permit.command_id, command)
        if self._parameters and command.capability is Capability.PARAMETERS:
            return await self._parameters.carry_out(permit.command_id, command)
        try:
            return await self.commands.carry_out(permit, command)
        except OutcomeUnknown:
            # its network has sent each member a stop, once: that of a member which did not hear is sent until it has
            if isinstance(command, GroupMoveRequest | PathShareRequest) and self.tracker.status.is_at(
                permit.command_id
            ):
                self.stops.require(StopMode.SMOOTH)
            raise
        finally:
            begun = self.tracker.status.command
            if (begun and begun.settling) or not math.isinf(self.commands.watch_s):
                # the caller that waits for the reply goes first
                asyncio.get_running_loop().call_later(FIRST_READING_DELAY_S, self.readings.ask_soon)

    def _require_reachable(self) -> None:
        guards.check_reachable(self.tracker)

    async def _step(self) -> None:
        """Let the procedure under way take its step, if one is due."""
        if not self.commands.step_is_due:
            return
        try:
            await self.commands.step()
        except LdcndError as error:
            log.warning("step of a command not taken", axis=self.config.name, reason=error.message)
        self.readings.ask_soon()
