"""How one axis is brought to rest, whatever its state, its link, a latch or what waits: nothing in here may refuse it.

A stop never waits for commands: it makes their permits void, withdraws what is still queued, and whatever a command
does next finds that the epoch has moved on. A stop that no drive has confirmed, or that its readings do not show, stays
to be sent: its line sends it again, before anything else to this drive.
"""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.axis.commands import AxisCommands
from ldcnd.axis.events import (
    PowerSwitched,
    StopConfirmed,
    StopDue,
    StopLatch,
    StopOverdue,
    StopSent,
    StopUnconfirmed,
)
from ldcnd.axis.latches import LatchKeeper
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Gate, Permit
from ldcnd.axis.rest import REST_COUNTS
from ldcnd.axis.status import AskedStop, AxisStatus, OpenStop
from ldcnd.axis.step import LEFT
from ldcnd.axis.telemetry import Note
from ldcnd.axis.turns import CommandQueue
from ldcnd.contract.commands import AxisCommand, CommandReply, Halt, Power, QuickStop, Stop, Verb
from ldcnd.contract.errors import BusError, CommandAborted, StopLatched
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import Moving
from ldcnd.drives.axis_config import LossPolicy
from ldcnd.drives.driver import AxisReading, StopMode
from ldcnd.line.bus import Bus
from ldcnd.log import get_logger

log = get_logger("axis")

STOP_ROUNDS = 5
"""Rounds of the bus's own attempts before a stop that is not confirmed is reported as such."""
READ_WITHIN_S = 5.0
"""Time in which a drive that was not read yet is to confirm what it is sent first, seconds; after that it counts as not
confirmed. A line that is searched at its rate after reset first, and then at its own, takes one or two."""
SETTLES_WITHIN_S = 0.25
"""Time within which a shaft follows its finished profile, seconds."""
FOUND_OPEN = "sent because its loop was open when its line was taken over"
OVERTAKES = {Verb.POWER: "power off"}
"""What is said of a command that overtakes others, where it is not its name."""
BY_MODE = {StopMode.SMOOTH: Verb.HALT, StopMode.ABRUPT: Verb.QUICK_STOP, StopMode.OFF: Verb.POWER}
"""How that is called by which the daemon itself brings an axis to rest."""
UNDERSTOOD_NO_MORE = {LossPolicy.QUICK_STOP: StopMode.ABRUPT, LossPolicy.POWER_OFF: StopMode.OFF}
"""How a motion is stopped that is not understood any more, by `loss.bus`; smoothly otherwise."""


def stop_mode_of(command: AxisCommand[CommandReply]) -> StopMode | None:
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


@dataclass(frozen=True, slots=True)
class OwnStop:
    """What became of one stop.

    Attributes:
        confirmed: its drive has confirmed it.
        count: the `stops` of the axis directly behind it: those that came while it was waited for are none of its own.
    """

    confirmed: bool
    count: int


class AxisStops:
    """Brings one axis to rest.

    Attributes:
        possible: the drive takes stops over its line.
        wanted: set when a stop waits to be sent again; its line, which sees to that, puts one of all its axes here.
        inherited: a motion that an earlier host has left may still run.
        line_up: its line is up and its drive is polled; while it is not, the line sends stops when it can.
        latches: keeps what forbids the axis to move; a stop is answered when that is kept.
    """

    def __init__(
        self,
        motion: AxisMotion,
        bus: Bus,
        gate: Gate,
        queue: CommandQueue,
        commands: AxisCommands,
        next_command_id: Callable[[], str],
        note: Note,
    ) -> None:
        self.possible = Verb.STOP in motion.driver.capabilities
        self.wanted = asyncio.Event()
        self.inherited = False
        self.line_up = False
        self.latches: LatchKeeper | None = None
        self._name = motion.tracker.name
        self._drive = motion.driver
        self._tracker = motion.tracker
        self._telemetry = motion.telemetry
        self._clock = motion.clock
        self._bus = bus
        self._gate = gate
        self._queue = queue
        self._commands = commands
        self._next_command_id = next_command_id
        self._note = note
        self._acknowledged = motion.stop_acknowledged
        motion.tracker.watch(self._watch, "stop", "off_again")
        self._due_since_s = math.inf
        self._done: tuple[float, int, bool] | None = None  # since when, where, and whether it had time to settle

    async def stop(self, mode: StopMode, verb: Verb = Verb.STOP) -> OwnStop:
        """Stop at once, whatever the state, and latch; return what became of it; see `bring_to_rest`.

        The latch and the new epoch hold from this call on, confirmed or not. A drive that takes no stop over its line
        is not latched either: nothing could clear that, and nothing here moves it.
        """
        if not self.possible:
            log.warning("this drive cannot be stopped over its line", axis=self._name)
            return OwnStop(confirmed=False, count=self._tracker.status.stops)
        self._tracker.take(StopLatch())
        log.info(verb.value, axis=self._name, mode=mode.value)
        own = await self.bring_to_rest(mode, verb)
        if self.latches:
            await self.latches.settled()
        return own

    @property
    def latch_is_kept(self) -> bool:
        """Whether the stop that is latched is on the disk, so that it outlasts the daemon."""
        return self.latches is not None and self.latches.holds(self._name)

    async def bring_to_rest(
        self, mode: StopMode, verb: Verb | None = None, by: Permit | None = None, command_id: str | None = None
    ) -> OwnStop:
        """Stop at once, before anything that waits; return what became of it.

        Args:
            mode: how.
            verb: the command, for the events; without one a motion was halted by the daemon.
            by: permit of the command that goes on afterwards; those of all before it are void.
            command_id: of the command that asks for it; the next one of the daemon when missing.
        """
        if not self.possible:
            return OwnStop(confirmed=False, count=self._tracker.status.stops)
        asked_for, name = verb is not None, verb or BY_MODE[mode]
        cause = verb or Verb.HALT
        # before its packet: whatever comes to its turn from here on finds that it is void
        overtaken = self.overtake(by, by.verb if by else OVERTAKES.get(cause, cause))
        count, confirmed = self._tracker.status.stops, False  # others that come from here on are none of its own
        stop = self._tracker.take(StopSent(mode, name)).stop
        try:
            if self.line_up:  # else its line sends it as the first thing that it can, behind the question for its loop
                # what waits on the line; the packet on the wire is over before the stop goes
                self._bus.withdraw(self._drive.spec.address, overtaken)
                confirmed = await self._send(stop.mode if stop else mode, cause, STOP_ROUNDS, command_id)
            return OwnStop(confirmed, count)
        finally:
            # also when this is cancelled: what is not confirmed by now its line sends again
            if still := self._tracker.status.stop:
                first = still.asked[0].verb if still.asked else name
                if asked_for or self._tracker.status.was_read:
                    self.require(still.mode, first)
                else:  # no client has asked for it: the daemon does not know what the drive does
                    self._tracker.take(StopDue(still.mode, LEFT, first))
                    self.wanted.set()
            self._publish()

    def overtake(self, by: Permit | None, cause: str) -> StopLatched | CommandAborted:
        """Make void what waits or moves, all or what is older than the caller; return the refusal, with the cause."""
        self._gate.overtake(by, cause)
        asyncio.get_running_loop().call_soon(self._publish)  # behind the packet of a stop, which waits for nothing
        overtaken = self._gate.overtaken("a queued command")
        self._queue.refuse(overtaken)
        return overtaken

    def require(self, mode: StopMode, verb: Verb = Verb.STOP) -> None:
        """Have a stop sent by the line, before anything else to this drive, until the drive confirms it."""
        self._tracker.take(StopUnconfirmed(self._clock.now_ns(), mode, verb=verb))
        self.wanted.set()

    def stop_what_is_not_understood(self, policy: LossPolicy) -> None:
        """Have a motor that may have voltage stopped at once; its line sends that again until the drive confirms it."""
        if not self._tracker.status.energised or not self.possible:
            return
        self.overtake(None, "the stop of a motion that is not understood")
        self.require(UNDERSTOOD_NO_MORE.get(policy, StopMode.SMOOTH))

    async def send_pending(self) -> None:
        """Send a stop again that the drive has not confirmed, whatever the state of the axis."""
        stop = self._tracker.status.stop
        if stop is None:  # such a stop was confirmed while the axis was read
            if self._tracker.status.off_again and not await self._send(StopMode.OFF, Verb.STOP, rounds=1):
                self.require(StopMode.OFF)
            return
        confirmed = await self._send(stop.mode, stop.asked[0].verb if stop.asked else Verb.STOP, rounds=1)
        if not confirmed and self._tracker.status.was_read:  # it answers at this rate, and does not confirm
            self._tracker.take(StopOverdue(self._clock.now_ns()))
        self._publish()

    def note_overdue(self) -> None:
        """Have a stop counted as not confirmed that was to be sent to a drive which was not read in time."""
        if self._clock.now_s() - self._due_since_s >= READ_WITHIN_S:
            self._tracker.take(StopOverdue(self._clock.now_ns()))

    def switch_off(self) -> None:
        """Have the motor switched off by the first packet to its drive."""
        if self.possible:
            self._tracker.take(StopDue(StopMode.OFF, FOUND_OPEN))

    def inherit(self) -> None:
        """Its drive is as another host has left it: what moves in it without an end is to be brought to rest."""
        self.inherited = self.possible

    def note_power_loss(self) -> None:
        """Note that the drive was reset or had no power: the motion to be stopped has ended."""
        self.inherited = False
        self._tracker.take(StopConfirmed())

    def watch_inherited(self, reading: AxisReading, at_s: float) -> None:
        """Have a motion stopped that an earlier host has left, if its profile is done and yet it goes on.

        So does velocity mode as soon as its velocity is reached; a trapezoid is done when it stands, and settles.
        """
        status, position = self._tracker.status, reading.position_counts
        # this daemon moves it now, or it has come to rest by itself
        if status.command is not None or status.at_rest:
            self.inherited, self._done = False, None
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
            self.inherited, self._done = False, None
            log.warning("motion without an end found", axis=self._name)
            self.require(StopMode.SMOOTH)

    async def _send(self, mode: StopMode, verb: Verb, rounds: int, command_id: str | None = None) -> bool:
        """Send a stop, in rounds, until the drive confirms it; return whether it has."""
        tracker, status = self._tracker, self._tracker.status
        if not status.energised:
            mode = StopMode.OFF  # a stop must not close the loop of a disabled axis
        stands = verb is Verb.HALT and status.command is None and status.moving is Moving.NO
        for _ in range(rounds):
            try:
                # a drive that is being switched off makes it a power-off, which is confirmed then
                mode = await self._drive.stop(mode)
            except BusError as error:
                known = status.stop and status.stop.fault  # while a line is down this comes again with every try
                (log.debug if known else log.error)("stop not confirmed", axis=self._name, reason=error.message)
                # to nobody who is known to be there its line sends it, beside the search for who has lost power
                if self._bus.is_open and tracker.proof.holds:
                    continue
                return False
            if mode is StopMode.OFF:
                self._commands.switched_off()
                tracker.take(PowerSwitched(on=False, now_s=self._clock.now_s(), by=command_id))
            elif not stands:  # what was proven to stand is not watched coming to rest, and keeps its target
                self._commands.brought_to_rest(command_id or self._next_command_id(), verb)
            if not stands:
                self._acknowledged(mode)
            before, after = tracker.status.stop, tracker.take(StopConfirmed(mode)).stop
            if before:
                self._tell_late(before, after.asked if after else ())
            return True
        return False

    def _tell_late(self, before: OpenStop, after: tuple[AskedStop, ...]) -> None:
        """Tell of each command by its own name that its drive has not confirmed at first, and does now."""
        for asked in before.asked:
            if asked.how and asked not in after:
                tell, what = (log.warning, "confirmed late") if before.fault else (log.info, "confirmed")
                tell(what, axis=self._name, verb=asked.verb.value, how=asked.how)
                self._note(self._name, asked.verb, CommandStatus.DONE, asked.how, None)

    def _watch(self, before: AxisStatus, after: AxisStatus) -> None:
        """Have a stop sent that is due, such as one that readings call for."""
        if after.stop_due is not before.stop_due:
            self._due_since_s = self._clock.now_s() if after.stop_due else math.inf
        if (after.stop_due and not before.stop_due) or (after.off_again and not before.off_again):
            self.wanted.set()

    def _publish(self) -> None:
        self._telemetry.publish_state(self._tracker.status, self._clock.now_ns())
