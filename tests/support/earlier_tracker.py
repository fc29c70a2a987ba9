"""State of one axis: maps readings and commands to PLCopen states. Pure; time is an input."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ldcnd.axis.rest import Settling
from ldcnd.axis.status import ActiveCommand, Completion
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.fault_pages import page_of
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState, Moving, PastFault, Quality
from ldcnd.drives.driver import AxisReading, Fault, StopMode
from ldcnd.line.exchange import Timing
from ldcnd.line.proof import Proof

MISSES_UNTIL_DOWN = 3
"""Consecutive polls without a reply after which the drive counts as lost, or with replies that cannot be used after
which what it does is not understood."""
REST_S = 0.25
"""Shortest time within `REST_COUNTS` that proves rest of a shaft without a profile of this daemon, seconds."""
REST_COUNTS = 5
"""Highest less lowest position of a shaft at rest: a closed loop hunts by some counts. More than 20 counts/s never pass
for rest."""
MOST_REST_S = 2.0
"""A shaft that crept out of that band must stay in it for twice as long as it took, at most this."""
LEAST_WINDOW_COUNTS = 5.0
"""A closed loop hunts by some counts."""
WINDOW_OF_EL = 1 / 400
"""Settle window as a fraction of the position error limit: that is some hundred times the error at rest."""
SHORTEST_READING_PAUSE_S = 0.005
"""Shortest time between two readings of an axis that settles."""
LINK_LOST = Fault("link_lost", "the drive does not answer; check its power and the line, then send reset")
LINK_BLOCKED = (
    "the drive does not answer, nor does {before}, before it on the line and needed to reach it: switch that on first,"
    " then send reset"
)
NOT_IDENTIFIED = Fault(
    "not_identified",
    "what answers is not known to be this drive: only what stops it is sent; correct the wiring or the configuration",
)
STOP_UNCONFIRMED = Fault(
    "stop_unconfirmed",
    "a stop was requested and the drive has not confirmed it; it is sent again until the drive does",
    stops=False,
)
LOOP_OPENED = Fault("loop_opened", "the drive opened its position loop by itself; find out why, then send reset")

NOT_SETTLED = Fault(
    "not_settled",
    "the axis did not stay within its window around the target in time; check for a jam, the load and the gains,"
    " then send reset",
)
JUMPED = Fault(
    "position_jump",
    "the position has changed by more than the axis can have moved; check the encoder, its cable and the coupling,"
    " then send reset and home",
    loses_position=True,
)
READINGS_CONTRADICT = Fault(
    "readings_contradict",
    "the drive replies, and its readings contradict each other and what was commanded; a stop was sent; switch the axis"
    " off, check gains, servo rate divisor and encoder, then send reset and home",
    loses_position=True,
)
REPLIES_UNUSABLE = Fault(
    "replies_unusable",
    "the drive replies, but polls reach it damaged or its replies make no sense: it is not known what it does; a stop"
    " was sent; check the line for noise and its termination, then send reset",
)
REFERENCE_REFUSED = Fault(
    "reference_refused",
    "the reference that an earlier daemon has kept was refused",
    stops=False,
)
DRIVE_RESET = Fault(
    "drive_reset",
    "the drive's position counter has restarted at 0: it was reset, or another program has set the counter; keep other"
    " programs off the line, then send reset and home",
    loses_position=True,
)
DRIVE_CHANGED = Fault(
    "drive_changed",
    "the drive is not as this daemon has left it; the events say what differs: undo it, or take it over",
    stops=False,
)
OF_DAEMON = (
    DRIVE_CHANGED,
    DRIVE_RESET,
    LINK_LOST,
    LOOP_OPENED,
    JUMPED,
    NOT_IDENTIFIED,
    NOT_SETTLED,
    READINGS_CONTRADICT,
    REFERENCE_REFUSED,
    REPLIES_UNUSABLE,
    STOP_UNCONFIRMED,
)
"""Faults that the daemon finds; the drive tells all others."""
OF_DAEMON_CODES = frozenset(fault.code for fault in OF_DAEMON)
STRENGTH = {StopMode.SMOOTH: 0, StopMode.ABRUPT: 1, StopMode.OFF: 2}
"""Of two stops that no drive has confirmed, the stronger one is sent again."""


MOTION_STATES = frozenset(
    {AxisState.HOMING, AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION, AxisState.STOPPING}
)


class SettleJudge:
    """Decides from readings behind the end of a profile whether an axis has settled.

    Attributes:
        settling: by which numbers.
        begun: the profile was seen to have ended.
    """

    def __init__(self, settling: Settling) -> None:
        self.settling = settling
        self.begun = False
        self._until_s = 0.0
        self._inside_since_s: float | None = None

    def observed(self, reading: AxisReading, at_s: float) -> bool | None:
        """Take a reading whose profile has ended; return whether it has settled, None while that is open."""
        settling = self.settling
        if not self.begun:
            self.begun, self._until_s = True, at_s + settling.timeout_s
        if abs(settling.target_counts - reading.position_counts) > settling.window_counts:
            self._inside_since_s = None
        elif self._inside_since_s is None:
            self._inside_since_s = at_s
        if self._inside_since_s is not None and at_s - self._inside_since_s >= settling.time_s:
            return True
        return False if at_s >= self._until_s else None


Ended = Callable[[ActiveCommand, CommandStatus, str | None, bool | None], None]
"""Takes a command that is over, how it ended, why when it was not done, and whether it has settled, None where that
means nothing."""


def _ignore_end(_command: ActiveCommand, _status: CommandStatus, _reason: str | None, _settled: bool | None) -> None:  # noqa: FBT001
    pass


def _ignore(_fault: PastFault) -> None:
    pass


def _ignore_latch() -> None:
    pass


QUALITIES = {LinkState.UP: Quality.GOOD, LinkState.DEGRADED: Quality.UNCERTAIN, LinkState.DOWN: Quality.BAD}
"""Quality of a value read just now, by the drive's link."""


class RestJudge:
    """Decides from readings whether a shaft stands.

    The velocity of a status packet has no fraction, and a drive in velocity mode says that its profile is done as soon
    as the velocity is reached: a shaft that creeps below one count per tick shows velocity 0 and a finished profile. So
    one reading proves rest only of a closed loop whose profile this daemon commanded, in which done means at rest; of
    any other it takes positions.

    Attributes:
        rests: whether it does; None while that is not known.
        turns: the latest reading shows a velocity.
        commanded: the drive's profile is one of this daemon's.
    """

    def __init__(self) -> None:
        self.rests: bool | None = None
        self.turns = False
        self.commanded = False
        self._since_s: float | None = None  # from when on positions have stayed together
        self._low = self._high = 0
        self._quiet_s = REST_S

    def forget(self, *, rests: bool | None = None, commanded: bool = False) -> None:
        """Discard the readings so far: the drive was out of reach, or something was commanded."""
        self.rests, self.turns, self.commanded = rests, False, commanded
        self._since_s, self._quiet_s = None, REST_S

    def observed(self, reading: AxisReading, at_s: float) -> None:
        """Take a reading that was requested at an instant, in loop time."""
        position = reading.position_counts
        runs = reading.enabled and not reading.profile_done
        if runs or abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s:
            self.rests, self.turns, self._since_s, self._quiet_s = False, True, None, REST_S
            return
        if self.commanded and reading.enabled:
            self.rests = True
            return
        if self._since_s is None:
            self.turns, self._since_s, self._low, self._high = False, at_s, position, position
            return
        self._low, self._high = min(self._low, position), max(self._high, position)
        held_s = at_s - self._since_s
        if self._high - self._low > REST_COUNTS:
            self.rests, self._quiet_s = False, min(max(2 * held_s, REST_S), MOST_REST_S)
            self._since_s, self._low, self._high = at_s, position, position
        elif held_s >= self._quiet_s:
            self.rests = True


class AxisTracker:
    """The state of one axis, changed only by what was observed or commanded.

    Attributes:
        has_reference: the drive can be homed, or its position be set.
        found: takes every fault as it comes up.
        latch_changed: called when a stop is latched or not confirmed, when the axis falls into error_stop, and when
            either is over.
        unconfirmed: the strongest stop that the drive has not confirmed, from when it is sent; None without one.
        stop_pending: that one was sent in vain, or is yet to be sent: nothing moves until it is confirmed.
        refused: why the reference that an earlier daemon has kept was refused; empty when none was, and once there is
            another one.
        reference_lost: the place was known and is not any more, until it is known again; a reset does not clear it.
        settle: judges the end of the motion under way; None where the end of its profile is its end.
        target: where the axis was sent last, or came to rest after anything else, in axis units; None while it is
            neither, and while nothing holds it.
        proof: that who answers is its drive; None for an axis without a line.
        holder: the client in control; None without one.
    """

    has_reference = True

    def __init__(self, name: str, unit: str, ended: Ended = _ignore_end, proof: Proof | None = None) -> None:
        """Begin in ignorance.

        Args:
            name: of the axis.
            unit: of the axis.
            ended: called for every command that is over.
            proof: that who answers is its drive.
        """
        self._ended = ended
        self.proof = proof
        self.name = name
        self.unit = unit
        self.state = AxisState.DISABLED
        self.enabled = False
        self._referenced = self.reference_lost = False
        self.position_lost = False
        self.stop_latched = False
        self.unconfirmed: StopMode | None = None
        self.stop_pending = False
        self.link = LinkState.DOWN
        self.command: ActiveCommand | None = None
        self.last_error: str | None = None
        self.target: float | None = None
        self.active_faults: tuple[FaultEntry, ...] = ()
        self.first_fault: FaultEntry | None = None
        self.speed_share = 1.0
        self.holder: str | None = None
        self._failure: str | None = None
        self.found: Callable[[PastFault], None] = _ignore
        self.latch_changed: Callable[[], None] = _ignore_latch
        self.refused = ""
        self._own: tuple[Fault, ...] = ()  # faults that this daemon has found, until reset
        self.settle: SettleJudge | None = None
        self._ends_at_s: float | None = None  # when the profile under way should end
        self._misses = self._in_vain = 0
        self._effective_from_s = 0.0
        self._rest = RestJudge()

    # -- for other modules -------------------------------------------------------------------------------------------

    def shown(self) -> dict[str, Any]:
        """Return the fields of a state sample besides when, in its order; compared after every poll, so no model."""
        return {
            "quality": Quality.UNCERTAIN if self.position_lost and self.link is LinkState.UP else QUALITIES[self.link],
            "state": self.state,
            "enabled": self.enabled,
            "referenced": self._referenced,
            "moving": self.moving,
            "link": self.link,
            "stop_latched": self.stop_latched,
            "stop_pending": self.stop_pending,
            "command": self.command,
            "last_error": self.last_error,
            "has_reference": self.has_reference,
            "reference_lost": self.reference_lost,
            "target": self.target,
            "speed_override": 100.0 * self.speed_share,
            "holder": self.holder,
        }

    @property
    def referenced(self) -> bool:
        """Whether the place is known."""
        return self._referenced

    @referenced.setter
    def referenced(self, known: bool) -> None:
        self.reference_lost = not known and (self._referenced or self.reference_lost)
        self._referenced = known

    @property
    def speed_override(self) -> float:
        """Percent of every velocity."""
        return 100.0 * self.speed_share

    @property
    def moving(self) -> Moving:
        """Whether the axis moves, as far as readings tell; never "no" without readings that prove it."""
        if self.link is not LinkState.UP:
            return Moving.UNKNOWN
        if self._rest.rests is False or (self.command and self.state in MOTION_STATES):
            return Moving.YES
        return Moving.NO if self._rest.rests else Moving.UNKNOWN

    @property
    def quality(self) -> Quality:
        """Quality of a value read just now; never good while it is not known where the axis is."""
        quality: Quality = self.shown()["quality"]
        return quality

    @property
    def at_rest(self) -> bool:
        """Whether the readings prove that nothing moves."""
        return self._rest.rests is True

    @property
    def coasts(self) -> bool:
        """Whether the shaft is seen to turn while the motor is off."""
        return self._rest.turns and not self.enabled

    @property
    def energised(self) -> bool:
        """Whether the motor gets voltage: the loop is closed, or open for a command that wants it so."""
        return self.enabled or (self.command is not None and self.command.opens_loop)

    @property
    def came_to_rest(self) -> bool:
        """Whether a closed loop without a target stands at a place to which no command has sent it."""
        return not self.command and not self.position_lost and self.moving is Moving.NO

    def concerns(self, timing: Timing) -> bool:
        """Tell whether a reading was requested after the latest command took effect."""
        return timing.sent_at_s >= self._effective_from_s

    # -- what was observed -------------------------------------------------------------------------------------------

    def observed(self, reading: AxisReading, timing: Timing, now_ns: int) -> None:
        """Digest a reading; `now_ns`, when it was true in UTC, stamps the faults that it brings up."""
        faults = (*reading.faults, *self._own_now()) if self._own else reading.faults
        if reading.altered and DRIVE_CHANGED not in faults:
            faults = (*faults, DRIVE_CHANGED)
        self._misses = self._in_vain = 0
        self.link = LinkState.UP
        if faults or self.active_faults:
            self._faults(faults, now_ns)
            self.position_lost = any(fault.loses_position for fault in faults)
            if self.position_lost:
                self.referenced, self.target = False, None
        if timing.sent_at_s < self._effective_from_s:
            return  # requested before the latest command took effect: says nothing about it
        self._rest.observed(reading, timing.sent_at_s)
        if reading.cut_short and self.command:
            self._failure = reading.cut_short
        self.enabled = reading.enabled
        if not reading.enabled:
            self.target = None
        if faults and any(fault.stops for fault in faults):
            self._fail(f"the drive reports a fault{'; its position is lost' if self.position_lost else ''}")
        elif self.enabled:
            self._enabled_reading(reading, timing.sent_at_s, now_ns)
        elif self.command and self.command.opens_loop:
            pass
        elif self.state not in (AxisState.DISABLED, AxisState.ERROR_STOP):
            self._faults((*faults, LOOP_OPENED), now_ns)
            self._fail(LOOP_OPENED.text)

    def _enabled_reading(self, reading: AxisReading, at_s: float, now_ns: int) -> None:
        command = self.command
        if command is None:
            if self.state is not AxisState.ERROR_STOP and (
                self._rest.rests is not None or self.state is AxisState.DISABLED
            ):
                self.state = AxisState.STANDSTILL if self._rest.rests else AxisState.DISCRETE_MOTION
            return
        match command.completion:
            case Completion.PROFILE if reading.profile_done:
                self._profile_ended(command, reading, at_s, now_ns)
            case Completion.REST if reading.profile_done and self.at_rest:
                self.finished()
            case _:
                pass

    def _profile_ended(self, command: ActiveCommand, reading: AxisReading, at_s: float, now_ns: int) -> None:
        judge = self.settle
        if judge is None or self._failure:
            self.finished()
            return
        settled = judge.observed(reading, at_s)
        if settled is None:
            return
        if settled or not judge.settling.faults:
            self.finished(settled=settled)
            return
        self._own = (*self._own, NOT_SETTLED)
        self._faults((*reading.faults, *self._own), now_ns)
        off = judge.settling.target_counts - reading.position_counts
        self._fail(f"{command.verb} did not settle: {off} counts off", settled=False)

    def next_reading_s(self, at_s: float) -> float | None:
        """Return when to read the axis so that the end of its motion is seen in time; None when there is none soon.

        Args:
            at_s: when it was read last, or is.
        """
        judge, ends_at_s = self.settle, self._ends_at_s
        if judge is None or ends_at_s is None:
            return None
        if at_s < ends_at_s:
            return ends_at_s
        if not judge.begun and at_s > ends_at_s + judge.settling.timeout_s:
            return None  # not as planned: the ordinary polls tell
        return at_s + max(judge.settling.time_s / 2, SHORTEST_READING_PAUSE_S)

    def refuse_reference(self, reason: str) -> None:
        """The reference that an earlier daemon has kept does not hold: a warning until there is another one."""
        self.refused, self.reference_lost = reason, True
        text = f"{REFERENCE_REFUSED.text}: {reason}; home the axis, or set its position"
        self._own = (*self._own, replace(REFERENCE_REFUSED, text=text))

    def changed_by_another(self, fault: Fault) -> None:
        """The next reading shows what this daemon has not done to the drive; until reset."""
        self.target = None
        if fault not in self._own:
            self._own = (*self._own, fault)

    def jumped(self) -> None:
        """The next reading shows a position that no motion has led to: a fault until reset."""
        self.target = None
        if JUMPED not in self._own:
            self._own = (*self._own, JUMPED)

    def contradicted(self, now_ns: int) -> bool:
        """The drive replies, and what it shows is not understood; tell whether that is new since the last reset."""
        self._misses = self._in_vain = 0
        self.link = LinkState.UP
        self._rest.forget()
        new = READINGS_CONTRADICT not in self._own
        if new:
            self._own = (*self._own, READINGS_CONTRADICT)
            self._faults(self._own, now_ns)
        self.position_lost, self.referenced = True, False
        if self.state is not AxisState.DISABLED:
            self._fail(READINGS_CONTRADICT.text)
        return new

    def replied_in_vain(self, now_ns: int) -> bool:
        """The drive replies, but not with a reading; tell whether that is now so for too long.

        That is not silence: the link is degraded, never down.
        """
        self._misses, self._in_vain = 0, self._in_vain + 1
        if self.link is LinkState.UP:
            self.link = LinkState.DEGRADED
        if self._in_vain < MISSES_UNTIL_DOWN or REPLIES_UNUSABLE in self._own or self.link is LinkState.DOWN:
            return False
        self._rest.forget()
        self._own = (*self._own, REPLIES_UNUSABLE)
        self._faults(self._own, now_ns)
        if self.state is not AxisState.DISABLED:
            self._fail(REPLIES_UNUSABLE.text)
        return True

    def missed(self, now_ns: int) -> None:
        """Count a poll that brought nothing."""
        self._misses += 1
        if self._misses >= MISSES_UNTIL_DOWN:
            self.disconnected(now_ns)
        elif self.link is LinkState.UP:
            self.link = LinkState.DEGRADED

    def disconnected(self, now_ns: int) -> None:
        """The drive is gone: nothing is known any more, and nothing resumes."""
        another = self.proof is not None and self.proof.is_another
        before = self.proof.blocked_by if self.proof else ""
        lost = replace(LINK_LOST, text=LINK_BLOCKED.format(before=before)) if before else LINK_LOST
        was_up = self.link is not LinkState.DOWN
        if not (was_up or another) and any(fault.code == lost.code for fault in self.active_faults):
            self._faults((lost,), now_ns)  # what is before it is known by now, or answers again
            return
        if not was_up and (not another or any(fault.code == NOT_IDENTIFIED.code for fault in self.active_faults)):
            return
        self.link = LinkState.DOWN
        self.referenced, self.target = False, None
        self._rest.forget()
        self._faults((NOT_IDENTIFIED if another else lost,), now_ns)
        if was_up and self.state is not AxisState.DISABLED:
            self._fail(LINK_LOST.text)

    def _faults(self, faults: tuple[Fault, ...], now_ns: int) -> None:
        known = {entry.code: entry for entry in self.active_faults}
        if self.stop_pending:
            faults = (*faults, STOP_UNCONFIRMED)
        self.active_faults = tuple(self._entry(known.get(fault.code), fault, now_ns) for fault in faults)
        if self.first_fault is None:
            causes = (fault for fault in self.active_faults if fault.code != REFERENCE_REFUSED.code)
            self.first_fault = next(causes, None)

    def _own_now(self) -> tuple[Fault, ...]:
        """Return the faults that this daemon has found, without a refusal that another reference has made void."""
        if self.refused and self.referenced:
            self.refused = ""
            self._own = tuple(fault for fault in self._own if fault.code != REFERENCE_REFUSED.code)
        return self._own

    def _entry(self, known: FaultEntry | None, fault: Fault, now_ns: int) -> FaultEntry:
        if known is None:
            return self._entered(fault, now_ns)
        return known if known.text == fault.text else known.model_copy(update={"text": fault.text})

    def _entered(self, fault: Fault, now_ns: int) -> FaultEntry:
        entry = _entry(fault, now_ns)
        self.found(entry.past)
        return entry

    def _fail(self, reason: str, *, settled: bool | None = None) -> None:
        if self.state is not AxisState.ERROR_STOP:
            self.state = AxisState.ERROR_STOP
            self.latch_changed()
        self._end(CommandStatus.FAILED, reason, settled=settled)

    def _end(self, status: CommandStatus, reason: str | None = None, *, settled: bool | None = None) -> None:
        command, self.command = self.command, None
        self._failure = self.settle = self._ends_at_s = None
        if math.isinf(self._effective_from_s):
            self._effective_from_s = 0.0  # the drive never took it, so there is nothing to wait for: readings count
        if status is not CommandStatus.DONE:
            self.target = None
        if command is None:
            return
        if reason:
            self.last_error = f"{command.verb}: {reason}"
        self._ended(command, status, reason, settled)

    def looked_at(self, reading: AxisReading) -> None:
        """Take from a reading out of turn whether the shaft turns."""
        self._rest.turns = abs(reading.velocity_counts_per_s) > reading.velocity_resolution_counts_per_s

    # -- what was commanded ------------------------------------------------------------------------------------------

    def begin(self, command: ActiveCommand, now_s: float) -> None:
        """A motion is about to start; whatever ran before was aborted by it."""
        if self.command is None:
            self.last_error = None
        elif self.command.command_id != command.command_id:
            self._end(CommandStatus.ABORTED, f"aborted by {command.verb}")
            if command.state is not AxisState.STOPPING:
                self.last_error = None  # the motion goes on as another command's
        self.command = command
        self.target = None if command.state is AxisState.CONTINUOUS_MOTION else command.target
        self.state = command.state
        self.settle = SettleJudge(command.settling) if command.settling else None
        self._ends_at_s = None
        self._effective_from_s = now_s
        self._rest.forget(rests=False, commanded=self._rest.commanded)

    def started(self, now_s: float) -> None:
        """Note the acknowledgement: only readings requested from now on count for the command."""
        self._effective_from_s = now_s
        if self.command and self.command.duration_s is not None:
            self._ends_at_s = now_s + self.command.duration_s
        self._rest.forget(rests=False, commanded=True)

    def ends_after(self, rest_s: float, now_s: float, now_ns: int) -> None:
        """Shift the expected end of the profile: the motion under way goes on at another speed."""
        if self.command:
            self.command = replace(self.command, duration_s=(now_ns - self.command.since_ns) / 1e9 + rest_s)
            self._ends_at_s = now_s + rest_s

    def failing(self, reason: str) -> None:
        """Note why the active command will fail once the axis has come to rest."""
        self._failure = reason

    def finished(self, error: str | None = None, *, settled: bool | None = None) -> None:
        """The active command is over: done, settled or not, or ended as `error` says."""
        error = error or self._failure
        self._end(CommandStatus.FAILED if error else CommandStatus.DONE, error, settled=settled)
        self.state = AxisState.STANDSTILL if self.enabled else AxisState.DISABLED

    def latch_stop(self) -> None:
        """Latch a stop: nothing moves again before reset."""
        self.stop_latched = True
        self.latch_changed()

    def stop_sent(self, mode: StopMode) -> StopMode:
        """Note that a stop is about to be sent; return how: as the strongest of those that are not confirmed."""
        self.unconfirmed = max(mode, self.unconfirmed or mode, key=STRENGTH.__getitem__)
        return self.unconfirmed

    def stop_unconfirmed(self, now_ns: int, mode: StopMode = StopMode.SMOOTH) -> None:
        """Note a stop that no drive has confirmed yet."""
        self.stop_sent(mode)
        if not self.stop_pending:
            self.stop_pending = True
            self.active_faults = (*self.active_faults, _entry(STOP_UNCONFIRMED, now_ns))
            self.latch_changed()

    def stop_confirmed(self, mode: StopMode = StopMode.OFF) -> None:
        """Note that the drive has confirmed a stop, unless a stronger one is not confirmed yet.

        One that cannot be moving, because it was reset or had no power, has confirmed every stop.
        """
        if self.unconfirmed is not None and STRENGTH[self.unconfirmed] > STRENGTH[mode]:
            return
        self.unconfirmed = None
        self.active_faults = tuple(fault for fault in self.active_faults if fault.code != STOP_UNCONFIRMED.code)
        if self.stop_pending:
            self.stop_pending = False
            self.latch_changed()

    def recall(
        self, *, stopped: bool, again: StopMode | None, in_error: bool, first: PastFault | None, now_ns: int
    ) -> None:
        """Begin with the latch that an earlier daemon has kept; what it stopped is to be stopped again.

        Args:
            stopped: a stop is latched.
            again: how it is to be stopped, if it was not confirmed, or may not have been sent; None when it stood.
            in_error: it is in error_stop.
            first: what brought it there.
            now_ns: when, UTC.
        """
        self.stop_latched = stopped
        if again is not None:
            self.stop_unconfirmed(now_ns, again)
        if in_error:
            self.state = AxisState.ERROR_STOP
            self.first_fault = FaultEntry(**first.model_dump(), page=page_of(first.code)) if first else None

    def powered(self, *, on: bool, now_s: float) -> None:
        """The drive acknowledged a change of power."""
        self._effective_from_s = now_s
        self._end(CommandStatus.ABORTED, "aborted by power")
        self.enabled = on
        self._rest.forget(rests=True if on else None, commanded=on)
        if self.state is not AxisState.ERROR_STOP:
            self.state = AxisState.STANDSTILL if on else AxisState.DISABLED

    def switched(self, *, on: bool, now_s: float) -> None:
        """The loop was opened or closed in the course of a command, which goes on."""
        self._effective_from_s = now_s
        self.enabled = on
        self._rest.forget(rests=False, commanded=self._rest.commanded)

    def cleared(self, now_s: float) -> None:
        """Reset of an axis that stands: latch and first cause are cleared; the next readings show what remains."""
        self._effective_from_s = now_s
        self.stop_latched = False
        self.position_lost = False
        self._own = ()
        self.active_faults = ()
        self.first_fault = None
        self.last_error = None
        self.state = AxisState.STANDSTILL if self.enabled else AxisState.DISABLED
        self.latch_changed()


def _entry(fault: Fault, now_ns: int) -> FaultEntry:
    return FaultEntry(
        code=fault.code,
        text=fault.text,
        since=now_ns,
        source="daemon" if fault.code in OF_DAEMON_CODES else "drive",
        stops=fault.stops,
        page=page_of(fault.code),
    )


class ObservedTracker(AxisTracker):
    """An `AxisTracker` without commands: Disabled, Standstill, moving, ErrorStop as the drive shows them.

    Others send such an axis: it has no target that is known here.
    """

    came_to_rest = False

    has_reference = False

    def observed(self, reading: AxisReading, timing: Timing, now_ns: int) -> None:
        """Digest a reading."""
        self._misses = self._in_vain = 0
        self.link = LinkState.UP
        self._faults((*reading.faults, DRIVE_CHANGED) if reading.altered else reading.faults, now_ns)
        if not self.active_faults:
            self.first_fault = None
        # such a drive shows the speed in coarse steps, and its position comes from another poll
        self._rest.rests = abs(reading.velocity_counts_per_s) <= reading.velocity_resolution_counts_per_s
        self.enabled = reading.enabled
        self.state = self._shown(reading)

    def _shown(self, reading: AxisReading) -> AxisState:
        if any(fault.stops for fault in reading.faults):
            return AxisState.ERROR_STOP
        if not reading.enabled:
            return AxisState.DISABLED
        return AxisState.STANDSTILL if self.at_rest else AxisState.DISCRETE_MOTION
