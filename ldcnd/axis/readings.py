"""The readings of one axis: judged, digested, published; and what it means when a poll brings none.

A reading that cannot be true never leaves this module. One that shows what this daemon has neither done nor commanded
is reported, and what is not understood any more is stopped.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ldcnd.axis.clock import Clock
from ldcnd.axis.commands import AxisCommands
from ldcnd.axis.events import DriveLost, FaultFound, PollMissed, ReadingsContradicted, ReplyUnusable
from ldcnd.axis.faults import DRIVE_CHANGED, DRIVE_RESET, JUMPED, NOT_SETTLED
from ldcnd.axis.history import ReadingRing
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.plausibility import ROUNDS, CounterStep, PlausibilityGate, ReadingVerdict, agree
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import AxisStatus, CommandEnd
from ldcnd.axis.stopping import AxisStops
from ldcnd.axis.telemetry import Note
from ldcnd.axis.tracker import AxisTracker
from ldcnd.axis.turns import CommandQueue
from ldcnd.contract import events
from ldcnd.contract.errors import BadReply, BusError, PacketRejected
from ldcnd.contract.events import ALARM_HISTORY, UNSETTLED, CommandStatus
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.rig_commands import FrozenPosition
from ldcnd.contract.samples import LinkState, TelemetryItem
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading, Fault, Moves
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Timing
from ldcnd.log import get_logger

log = get_logger("axis")

WITH_ERROR = frozenset({TelemetryItem.POSITION})
"""A reading out of turn tells the following error, too: by it a motion that another host has stopped is known."""
END_ITEMS = frozenset({TelemetryItem.POSITION, TelemetryItem.VELOCITY})
"""Items published with the reading that ends a command, besides those requested."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """Where a command has ended, in axis units.

    Attributes:
        position: as clients see it.
        following_error: target minus position; without a target what the drive reports, None where it does not.
        settled: whether the axis came to rest within its window in time; None for what has no target.
        last_position: that was read last, of a command that no reading has ended; None where one has.
    """

    position: float | None
    following_error: float | None
    settled: bool | None
    last_position: float | None = None


OnEnded = Callable[[CommandEnd, Arrival | None], None]
"""Takes a command that is over, how it ended, why when it was not done, and where; None where no reading shows it."""


def arrival_of(end: CommandEnd, reading: AxisReading, scale: AxisScale) -> Arrival:
    """Return where a command has ended that a reading has ended."""
    lag, settling = reading.following_error_counts, end.command.settling
    if settling:
        lag = settling.target_counts - reading.position_counts
    following_error = None if lag is None else lag / scale.counts_per_unit
    return Arrival(scale.shown_at(reading.position_counts), following_error, end.settled)


class ReadingOutOfTurn:
    """Reads the state of a drive out of turn, until two readings agree."""

    def __init__(
        self, drive: Moves, bus: Bus, plausibility: PlausibilityGate, tracker: AxisTracker, clock: Clock
    ) -> None:
        self._drive = drive
        self._bus = bus
        self._plausibility = plausibility
        self._tracker = tracker
        self._clock = clock

    async def __call__(self) -> AxisReading:
        """Return the second of two readings that agree.

        Raises:
            BadReply: they do not, or agree on a place that no motion can have led to, as late replies of another drive.
            BusError: the line failed.
        """
        name, exchange = self._drive.spec.name, self._drive.reading(WITH_ERROR)
        before_s = self._clock.now_s()
        before = await self._bus.execute(exchange)
        for _ in range(ROUNDS):
            asked_s = self._clock.now_s()
            reading = await self._bus.execute(exchange)
            if agree(before, reading, self._clock.now_s() - before_s):
                if not self._plausibility.is_out_of_reach(reading, self._clock.now_s()):
                    return reading
                self._bus.distrust()
                scale = self._tracker.status.scale
                place = scale.position(reading.position_counts)
                raise BadReply(
                    f"axis {name}: it shows {place:g} {scale.unit}, where no motion can have led since its last"
                    " reading; nothing was started",
                    axis=name,
                    value=place,
                    remedy="send it again; if that fails as well, look for an adapter that holds replies back",
                )
            before, before_s = reading, asked_s
        raise BadReply(
            f"axis {name}: its readings contradict each other; nothing was started",
            axis=name,
            remedy="check the line for noise, then send it again",
        )


class AxisReadings:
    """Digests the readings of one axis.

    Attributes:
        returned: called when the drive replies again after it was out of reach, once its state is known.
        ask_at: has the drive read at an instant of the loop's clock, besides its ordinary polls.
        history: the last readings.
    """

    def __init__(
        self,
        motion: AxisMotion,
        bus: Bus,
        plausibility: PlausibilityGate,
        queue: CommandQueue,
        commands: AxisCommands,
        stops: AxisStops,
        on_ended: OnEnded,
        note: Note,
    ) -> None:
        self.returned: Callable[[], None] | None = None
        self.ask_at: Callable[[float], None] | None = None
        self._motion = motion
        self._name = name = motion.tracker.name
        self._proof = bus.proofs.expect(motion.driver.spec.address, f"axis {name}", name)
        self._tracker = motion.tracker
        self._telemetry = motion.telemetry
        self._clock = motion.clock
        self._bus = bus
        self._plausibility = plausibility
        self._queue = queue
        self._commands = commands
        self._stops = stops
        self._on_ended = on_ended
        self._note = note
        self._digested: AxisReading | None = None
        self.history = _ring(motion.config)
        self._over: tuple[CommandEnd, Arrival] | None = None
        motion.tracker.watch(self._watch, "last_end")
        motion.tracker.watch(self._watch_course, "command", "state", "speed_share")

    def reconfigure(self, config: AxisConfig) -> None:
        """Take rates and scale of another configuration."""
        rate_hz = config.rates.position
        if config.signed_counts_per_unit != self.history.counts_per_unit:
            self.history = _ring(config)
        elif rate_hz != self.history.rate_hz:
            self.history.repoll(rate_hz, self._clock.now_ns())

    @property
    def seen(self) -> bool:
        """Whether the drive was read at all."""
        return self._tracker.reading is not None

    @property
    def are_of_the_drive(self) -> bool:
        """Whether what is read is known to come from the drive that is meant."""
        return self._proof.holds

    # -- what polls bring --------------------------------------------------------------------------------------------

    def judge(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> bool:
        """Take a reading if the drive can have got there; true when it has to be read again first."""
        tracker, status = self._tracker, self._tracker.status
        if status.stop and status.stop_due:
            self._stops.wanted.set()  # it replies again, whatever it says
        if not self._proof.holds:
            self._count_miss()  # from its drive: who answers was not identified
            return False
        # a command that waits has sent nothing yet
        standing = status.command is None and status.at_rest and not self._queue.at_work.locked()
        judged = self._plausibility.judge(reading, timing, standing=standing)
        if judged.verdict is ReadingVerdict.BELIEVED:
            if judged.confirmed:
                if judged.step:
                    self._take_step(judged.step, reading)
                # items that only the first of two readings has are valid as well
                first, first_timing = judged.confirmed
                self._digest(first, first.asked - asked, first_timing)
            self._digest(reading, asked, timing)
            return False
        if judged.verdict is ReadingVerdict.CONTRADICTS:
            now_ns = self._clock.now_ns()
            before = tracker.status
            if tracker.take(ReadingsContradicted(now_ns)).contradicts and not before.contradicts:
                log.error("readings contradict each other", axis=self._name, counts=reading.position_counts)
                self._stops.stop_what_is_not_understood(self._motion.config.loss.bus)
            self._queue.changed.set()
            self.history.forget()
            self._telemetry.publish_stale(tracker.status, now_ns)
        if judged.foreign:
            self._bus.distrust()  # another drive's reply that came late would be followed by others
        return judged.verdict is ReadingVerdict.ASK_AGAIN

    def accept(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> None:
        """Process a reading that is not to be judged; that of a drive which was not identified says nothing."""
        if self._proof.holds:
            self._digest(reading, asked, timing)
        else:
            self._count_miss()  # from its drive: who answers was not identified

    def miss(self, error: BusError) -> None:
        """Take note that a poll brought nothing, or nothing that can be used."""
        # a damaged reply of who was not identified is no sign of life of this drive
        if not (self._proof.holds and isinstance(error, PacketRejected | BadReply)):
            self._count_miss()
            return
        now_ns, before = self._clock.now_ns(), self._tracker.status
        if self._tracker.take(ReplyUnusable(now_ns)).replies_unusable and not before.replies_unusable:
            log.error("replies cannot be used", axis=self._name, reason=error.message)
            self._stops.stop_what_is_not_understood(self._motion.config.loss.bus)
            self._queue.changed.set()
        self._telemetry.publish_stale(self._tracker.status, now_ns)

    def take_monitor(self, value: MonitorValue, timing: Timing) -> None:
        """Take a monitor from the family's own poller."""
        t, t_error_ns = self._clock.stamp(timing)
        self._telemetry.publish_monitor(value, self._tracker.status.quality, t, t_error_ns)

    def take_alarm(self, alarm: Fault) -> None:
        """Take an alarm that the drive has entered in its own history."""
        reason = f"{alarm.text}: new in the alarm history of the drive"
        self._note(self._name, ALARM_HISTORY, CommandStatus.FAILED, reason, alarm.code)

    def ask_soon(self) -> None:
        """Have the drive read in time for what the axis does now; see `_ask_in_time`."""
        self._ask_in_time(self._clock.now_s())

    def frozen_at(self, counts: int) -> FrozenPosition:
        """Return a position that was frozen in the drive, as the reply to a snapshot has it."""
        scale = self._tracker.status.scale
        return FrozenPosition(
            axis=self._name,
            position=scale.shown_at(counts),
            counts=counts,
            unit=scale.unit,
            referenced=self._tracker.status.referenced,
        )

    def at(self, t: int) -> AxisInstant:
        """Return where the axis was at an instant, UTC in ns since 1970."""
        return self.history.at(t, self._tracker.status.scale, self._motion.config.limits.velocity)

    def between(self, t: int, until: int) -> Iterator[AxisInstant]:
        """Yield the same of the first instant of a range, of each reading in it, and of its last instant."""
        return self.history.between(t, until, self._tracker.status.scale, self._motion.config.limits.velocity)

    # -- what the line says ------------------------------------------------------------------------------------------

    def explain_loss(self) -> None:
        """Say of a drive that is out of reach what is known by now of the reason."""
        if self._tracker.status.link is LinkState.DOWN:
            now_ns = self._clock.now_ns()
            lost = DriveLost(now_ns, self._proof.is_another, self._proof.blocked_by)
            self._telemetry.publish_state(self._tracker.take(lost), now_ns)

    def disconnect(self) -> None:
        """The drive is out of reach, or has lost power."""
        self.history.forget()
        self._plausibility.after_gap()
        now_ns = self._clock.now_ns()
        self._telemetry.publish_stale(
            self._tracker.take(DriveLost(now_ns, self._proof.is_another, self._proof.blocked_by)), now_ns
        )

    def report_restart(self) -> None:
        """Its drive has lost power or was reset, and is about to answer again."""
        self._report_change(DRIVE_RESET, "it has lost power or was reset, and gets its address again")

    # -- digesting ---------------------------------------------------------------------------------------------------

    def _digest(self, reading: AxisReading, asked: frozenset[TelemetryItem], timing: Timing) -> None:
        tracker, before, earlier = self._tracker, self._tracker.status, self._tracker.reading
        altered = earlier.altered if earlier else ""
        if reading.altered != altered or not reading.profile_done:  # a call less for each poll of what stands
            self._audit(reading, timing, altered)
        t, t_error_ns = self._clock.stamp(timing)
        # until it is taken: a command that ends in between has ended with it
        self._digested = reading
        status = tracker.observe(reading, timing, t)
        self._digested = None
        # the first reading of all is no return: there was nothing to lose
        if before.link is LinkState.DOWN and earlier is not None and self.returned:
            self.returned()
        if status.reference_lost and not before.reference_lost:
            log.warning("reference lost", axis=self._name, faults=[fault.code for fault in reading.faults])
        self._queue.changed.set()
        if self._commands.procedure is not None or reading.cut_short:
            self._commands.observed(reading, timing)
            if self._commands.step_due:
                self._queue.wake()
        if self._stops.inherited:
            self._stops.watch_inherited(reading, timing.sent_at_s)
        # a client that waits for the end reads the position next: it must be that of the end
        if self._over:
            asked |= END_ITEMS
        self._telemetry.publish(tracker.status, reading, asked, t, t_error_ns)
        if TelemetryItem.POSITION in asked:  # of the others some drives have a position of before
            if reading.pieces and reading.pieces.recounted:
                self.history.forget()
            self.history.take(reading, tracker.status, t, t_error_ns)
        if before.command:
            self._report_end()
            self._ask_in_time(timing.sent_at_s)
            self._motion.reference.woken.set()

    def _watch_course(self, _before: AxisStatus, after: AxisStatus) -> None:
        self.history.alter(self._clock.now_ns(), after, approaches=self._motion.config.approach is not None)

    def _watch(self, _before: AxisStatus, after: AxisStatus) -> None:
        """Report a command that is over; one that a reading has ended is reported behind the reading."""
        end, reading = after.last_end, self._digested
        if end is None:
            return
        if reading is None:  # nothing shows where it comes to rest
            last = self._tracker.reading
            seen = None if last is None else after.scale.shown_at(last.position_counts)
            self._on_ended(end, Arrival(None, None, None, seen))
        else:
            self._over = end, arrival_of(end, reading, after.scale)

    def _report_end(self) -> None:
        """Report the command that the reading has ended, now that the reading is published."""
        over, self._over = self._over, None
        if over is None:
            return
        end, arrival = over
        self._on_ended(end, arrival)
        settling = end.command.settling
        if end.settled is False and settling:
            scale = self._tracker.status.scale
            said = (
                f"{end.command.verb} did not stay within {abs(settling.window_counts / scale.counts_per_unit):.6g}"
                f" {scale.unit} of its target for {settling.time_s:g} s in {settling.timeout_s:g} s; it is"
                f" {arrival.following_error:.6g} {scale.unit} off"
            )
            log.warning("not settled", axis=self._name, reason=said)
            self._note(self._name, UNSETTLED, CommandStatus.FAILED, said, NOT_SETTLED.code)

    def _audit(self, reading: AxisReading, timing: Timing, altered: str) -> None:
        """Report changes of the drive that this daemon has not made; the tracker has not seen the reading yet."""
        tracker = self._tracker
        if reading.altered != altered:
            if reading.altered:
                self._report_change(DRIVE_CHANGED, reading.altered)
        elif reading.profile_done or not reading.enabled or not self._stops.possible:
            return
        elif (
            tracker.status.at_rest
            and not tracker.status.command
            and self._queue.free
            and tracker.status.concerns(timing)
        ):
            tracker.take(FaultFound(DRIVE_CHANGED))
            self._report_change(DRIVE_CHANGED, "it began to move without a command of this daemon")

    def _take_step(self, step: CounterStep, reading: AxisReading) -> None:
        """No motion has led to where the drive is: its counter was set, or the encoder slips."""
        self.history.forget()
        if step is CounterStep.ZEROED:
            self._tracker.take(FaultFound(DRIVE_RESET))
            self._report_change(DRIVE_RESET, "its position counter has restarted at 0")
        else:
            log.error("position jumped", axis=self._name, counts=reading.position_counts)
            self._tracker.take(FaultFound(JUMPED))
        self._stops.stop_what_is_not_understood(self._motion.config.loss.bus)

    def _report_change(self, fault: Fault, what: str) -> None:
        log.warning("drive was reset or changed by another program", axis=self._name, what=what)
        self._note(self._name, events.DRIVE_CHANGED, CommandStatus.FAILED, what, fault.code)

    def _count_miss(self) -> None:
        before, now_ns = self._tracker.status, self._clock.now_ns()
        status = self._tracker.take(PollMissed(now_ns, self._proof.is_another, self._proof.blocked_by))
        if status.link is not before.link or status.faults != before.faults:
            log.warning("drive does not answer", axis=self._name, link=status.link.value)
            if status.link is LinkState.DOWN:
                self.history.forget()
                self._plausibility.after_gap()
            self._telemetry.publish_stale(status, now_ns)

    def _ask_in_time(self, at_s: float) -> None:
        """Have the drive read when the motion under way should end, and while it settles, whatever the rates."""
        read_at_s = min(self._tracker.status.next_reading_s(at_s), at_s + self._commands.watch_s)
        if self.ask_at and not math.isinf(read_at_s):
            self.ask_at(read_at_s)


def _ring(config: AxisConfig) -> ReadingRing:
    return ReadingRing(config.rates.position, config.signed_counts_per_unit)
