"""The state of one axis as a value: what was observed of it, what was commanded, and what forbids it to move.

Nothing else knows any of it. step.py has the one function that makes a status from the one before; telemetry.py
publishes it as it is.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from operator import attrgetter
from typing import Any

from ldcnd.axis.coast import Coast
from ldcnd.axis.course import Braking, Pace, ToldAnew, Way
from ldcnd.axis.faults import NOT_FOLLOWED, READINGS_CONTRADICT, REPLIES_UNUSABLE
from ldcnd.axis.following import BRAKES_SHARE, Following
from ldcnd.axis.rest import NOTHING_SEEN, RestEvidence, SensorEnd, SettleProgress, Settling, window_counts
from ldcnd.axis.scale import AxisScale
from ldcnd.contract.commands import Verb
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState, Moving, Quality, StateSample, Unseen
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import Fault, StopMode
from ldcnd.line.exchange import Timing

SHORTEST_READING_PAUSE_S = 0.005
"""Shortest time between two readings of an axis that settles."""
STRENGTH = {StopMode.SMOOTH: 0, StopMode.ABRUPT: 1, StopMode.OFF: 2}
"""Stop modes, weakest first; a pending stop is only replaced by a stronger one."""
QUALITIES = {LinkState.UP: Quality.GOOD, LinkState.DEGRADED: Quality.UNCERTAIN, LinkState.DOWN: Quality.BAD}
"""Quality of a value read just now, by the drive's link."""


class Completion(Enum):
    """When a command is done."""

    PROFILE = "profile"
    """The drive says the profile has ended."""
    REST = "rest"
    """The profile has ended and nothing moves."""
    PROCEDURE = "procedure"
    """The procedure that follows it says so."""


@dataclass(frozen=True, slots=True)
class SoftLimits:
    """The limits of an axis by which its readings are judged.

    Attributes:
        low: lowest position, in axis units; minus infinity without one.
        high: highest position; infinity without one.
        window_counts: how far beyond them an axis may stand that was sent to one, in counts.
        slowing_counts_per_s2: how fast its shaft slows down at most with its motor off; None where that is not known.
        braking_counts_per_s2: how fast it slows down at most in a motion; None where either is not known.
        unseen: what is known of the rest of its shaft before it is first read.
        stalls: what it meets may stop it.
    """

    low: float = -math.inf
    high: float = math.inf
    window_counts: float = 0.0
    slowing_counts_per_s2: float | None = None
    braking_counts_per_s2: float | None = None
    unseen: RestEvidence = NOTHING_SEEN
    stalls: bool = False

    @classmethod
    def of(cls, config: AxisConfig) -> "SoftLimits":
        """Return those that an axis is configured with."""
        low, high = config.limits.position_min, config.limits.position_max
        scale, acceleration = abs(config.signed_counts_per_unit), config.limits.acceleration
        speed = scale * (config.limits.velocity or config.velocity)
        return cls(
            -math.inf if low is None else low,
            math.inf if high is None else high,
            window_counts(config),
            speed / config.coast_s if config.coast_s else None,
            BRAKES_SHARE * scale * acceleration if config.coast_s and acceleration else None,
            RestEvidence(unseen_s=UNSEEN_SHARE * config.coast_s) if config.coast_s else NOTHING_SEEN,
            config.settle.stalls,
        )

    def span(self, scale: AxisScale) -> tuple[float, float]:
        """Return the lowest and the highest count of a drive that they allow."""
        ends = (edge * scale.counts_per_unit + scale.origin_counts for edge in (self.low, self.high))
        low, high = sorted(ends)
        return low - self.window_counts, high + self.window_counts


UNLIMITED = SoftLimits()
UNSEEN_SHARE = 4.0
"""Longest coasting as a multiple of `coast_s`, which is the shortest: a runaway is faster than the velocity limit."""


@dataclass(frozen=True, slots=True)
class Unsure:
    """A motion of which it is not known whether it has begun: nothing of its command is started before that is known.

    Attributes:
        why: in words.
        from_rest: it was to begin from rest, so that a drive that moves has begun it.
    """

    why: str
    from_rest: bool


@dataclass(frozen=True, slots=True)
class ActiveCommand:
    """A motion under way.

    Attributes:
        command_id: as in the reply.
        verb: the command.
        since_ns: when it was accepted, UTC.
        state: the axis state while it runs.
        completion: what ends it.
        opens_loop: it runs or ends with the position loop open, so an open loop is no failure.
        target: where it ends, in axis units; None when it has no end of its own.
        duration_s: of its profile, without settling; None when it has no end of its own.
        settling: when it counts as settled; None when the end of its profile is its end.
        way: to its target; None when it has no end of its own.
        sensor_end: where its analog sensor ends it; None of a motion in counts.
    """

    command_id: str
    verb: Verb
    since_ns: int
    state: AxisState
    completion: Completion
    opens_loop: bool = False
    target: float | None = None
    duration_s: float | None = None
    settling: Settling | None = None
    way: Way | None = None
    sensor_end: SensorEnd | None = None

    @property
    def goal(self) -> float | None:
        """Where it is to come to rest, in axis units; None of a motion that a command is to end."""
        return None if self.state is AxisState.CONTINUOUS_MOTION else self.target


@dataclass(frozen=True, slots=True)
class CommandEnd:
    """A command that is over.

    Attributes:
        command: as it was.
        status: how it ended.
        reason: why it was not done; None when it was.
        settled: whether it has settled; None where that means nothing.
        by: verb and id of the command that has ended it; None where none has, or where it is not known.
    """

    command: ActiveCommand
    status: CommandStatus
    reason: str | None
    settled: bool | None
    by: tuple[Verb, str] | None = None

    def told(self, client: str | None) -> str | None:
        """Return the reason with the client whose command has ended it."""
        if self.by is None or self.reason is None or client is None:
            return self.reason
        said = aborted_by(self.by[0])
        return f"{said} of {client}{self.reason.removeprefix(said)}"


def aborted_by(verb: Verb) -> str:
    """Return how the reason begins of a command that another one has ended."""
    return f"aborted by {verb}"


@dataclass(frozen=True, slots=True)
class AskedStop:
    """One of the commands that an unconfirmed stop stands for.

    Attributes:
        verb: its name.
        mode: how it brings the motor to rest.
        how: why its line sends it, for the event that it was confirmed; empty while it is first on its way.
    """

    verb: Verb
    mode: StopMode
    how: str = ""


@dataclass(frozen=True, slots=True)
class OpenStop:
    """A stop that the drive has not confirmed.

    Attributes:
        mode: the strongest of those that were sent or are to be.
        fault: what is published of it, from when on it was asked for in vain: nothing moves then until it is confirmed.
            None while it is on its way for the first time.
        asked: the commands that asked for it, in their order; each has an event under its own name.
        unread: it is to be sent as well, because its drive was not read yet; without a fault none is known to have
            failed.
    """

    mode: StopMode
    fault: FaultEntry | None = None
    asked: tuple[AskedStop, ...] = ()
    unread: bool = False


@dataclass(frozen=True, slots=True)
class LatchedBy:
    """Who has latched a stop.

    Attributes:
        t: when, UTC in ns since 1970.
        client: as it calls itself; None where it did not say.
        login: whose link it came over; None where that has no certificate.
    """

    t: int
    client: str | None = None
    login: str | None = None


@dataclass(frozen=True, slots=True)
class CommandProgress:
    """What has become of the command under way so far; with its end it begins anew.

    Attributes:
        unsure: why it is not known whether its motion has begun; None when the drive has shown it.
        failure: why it will fail once the axis has come to rest.
        way: where the axis may be until then; None before the first reading, and without a target.
        pace: how fast it may be, once it has taken a new speed or target in motion; None otherwise.
        told_anew: whether its drive has heard the speed that it was told on its way; None of one that it began with.
        ends_at_s: when its profile should end, in loop time.
        settle: how far the axis has settled; None before the end of its profile, and without a target.
    """

    unsure: Unsure | None = None
    failure: str | None = None
    way: Way | None = None
    pace: Pace | None = None
    told_anew: ToldAnew | None = None
    ends_at_s: float | None = None
    settle: SettleProgress | None = None


JUST_BEGUN = CommandProgress()
PUBLISHED = tuple(name for name in StateSample.model_fields if name not in {"t", "t_error_ns", "seq"})
"""What a state sample says of a status: each is an attribute of it."""
_published_of = attrgetter(*PUBLISHED)


@dataclass(frozen=True, slots=True)
class AxisStatus:
    """The state of one axis.

    Attributes:
        name: of the axis.
        scale: its coordinates.
        commanded: this daemon commands its drive. Others send one that is only observed: it has no command, no target
            and no reference here, and its drive alone says how it is.
        limits: its software limits.
        span: counts of its drive that these allow; it means something only while the axis is referenced.
        state: PLCopen state.
        enabled: its position loop is closed.
        referenced: its place is known.
        reference_lost: it was known and is not any more, until it is known again; a reset does not clear it.
        refused: why the reference that an earlier daemon has kept was refused; empty when none was, and once there is
            another one.
        position_lost: a fault says that what the drive counts is not where the axis is.
        stops: how often all that was sent to it before was made void, since this daemon began.
        stop_latched: a stop is latched; only a reset clears it.
        latched_by: who has latched it; None where that is not known.
        stop: the stop that the drive has not confirmed; None without one.
        braking: the stop that it has confirmed and that readings are yet to show; None without one.
        driven_open: its motor may have voltage while its loop is open: from a raw duty on until a reading shows a
            closed loop, or rest after a stop.
        off_again: its line is to switch such a motor off again, because its shaft still turns.
        link: whether its drive answers.
        was_read: it was read since this daemon began; until then `state` and `enabled` say nothing of it.
        misses: polls in a row without a reply.
        in_vain: replies in a row that could not be used.
        command: what is under way.
        progress: what has become of that so far.
        following: by what its encoder is to be seen to count in a motion; None once it has.
        coast: how it slows down, in a motion where that is bounded, and with its motor off; None while it stands.
        effective_from_s: only readings requested from then on show the latest command, in loop time; infinite until the
            drive has acknowledged it.
        last_end: how the last command ended.
        last_error: why, when it was not done, until the next command is accepted or the axis is reset.
        interlock: the rule that has ended it and what that lacks, for as long; empty where none has.
        target: where the axis was sent last, or came to rest after anything else, in axis units; None while it is
            neither, and while nothing holds it.
        target_counts: where the last motion leads, with what is to follow under its command, counts; None when that has
            no end, or was followed by something else.
        approached: that motion came from the side that the configuration names.
        faults: what stands now, without a pending stop.
        own: faults that this daemon has found, until reset.
        first_fault: the fault that came first since the last reset; a warning gives way to what stops the axis.
        speed_share: share of every velocity that the speed override leaves, 0 to 1.
        holder: the client in control; None without one.
        rest: what readings prove of its rest.
    """

    name: str
    scale: AxisScale
    commanded: bool = True
    limits: SoftLimits = UNLIMITED
    span: tuple[float, float] = (-math.inf, math.inf)
    state: AxisState = AxisState.DISABLED
    enabled: bool = False
    referenced: bool = False
    reference_lost: bool = False
    refused: str = ""
    position_lost: bool = False
    stops: int = 0
    stop_latched: bool = False
    latched_by: LatchedBy | None = None
    stop: OpenStop | None = None
    braking: Braking | None = None
    driven_open: bool = False
    off_again: bool = False
    link: LinkState = LinkState.DOWN
    was_read: bool = False
    misses: int = 0
    in_vain: int = 0
    command: ActiveCommand | None = None
    progress: CommandProgress = JUST_BEGUN
    following: Following | None = None
    coast: Coast | None = None
    effective_from_s: float = 0.0
    last_end: CommandEnd | None = None
    last_error: str | None = None
    interlock: str = ""
    target: float | None = None
    target_counts: int | None = None
    approached: bool = False
    faults: tuple[FaultEntry, ...] = ()
    own: tuple[Fault, ...] = ()
    first_fault: FaultEntry | None = None
    speed_share: float = 1.0
    holder: str | None = None
    rest: RestEvidence = NOTHING_SEEN

    @property
    def unit(self) -> str:
        """The axis unit."""
        return self.scale.unit

    @property
    def has_reference(self) -> bool:
        """Whether its drive can be homed, or its position be set."""
        return self.commanded

    @property
    def ends_at_s(self) -> float | None:
        """When the profile under way should end, in loop time; None without one."""
        return self.progress.ends_at_s

    @property
    def goes_on(self) -> bool:
        """Whether the end of the profile that its drive shows is not the end of what is under way: another follows."""
        if self.command is None:
            return False
        # while a start is not acknowledged the drive shows the end of what went before
        return self.command.completion is Completion.PROCEDURE or math.isinf(self.effective_from_s)

    @property
    def is_braking(self) -> bool:
        """Whether readings are yet to show a stop that the drive has confirmed."""
        return (self.braking is not None or self.off_again) and self.link is not LinkState.DOWN

    @property
    def stop_due(self) -> bool:
        """Whether the line is to send a stop: nothing moves until the drive confirms it."""
        return self.stop is not None and (self.stop.unread or self.stop.fault is not None)

    @property
    def stop_pending(self) -> bool:
        """Whether a stop that is due was asked for in vain, and not only for want of a reading."""
        return self.stop is not None and self.stop.fault is not None

    @property
    def active_faults(self) -> tuple[FaultEntry, ...]:
        """What stands now; a stop that is not confirmed comes last."""
        stop = self.stop
        return (*self.faults, stop.fault) if stop and stop.fault else self.faults

    @property
    def speed_override(self) -> float:
        """Percent of every velocity."""
        return 100.0 * self.speed_share

    @property
    def motion_hidden_by(self) -> str:
        """Code of the fault behind which readings do not prove that the axis stands; empty without one."""
        first = self.first_fault
        if self.following and self.following.given_up:
            return NOT_FOLLOWED.code
        if not self.faults and first is None:
            return ""
        entries = self.faults if first is None else (*self.faults, first)
        return next((entry.code for entry in entries if entry.hides_motion), "")

    @property
    def rest_unproven_by(self) -> str:
        """The same, also of a motion in which the shaft is yet to be seen to move."""
        unseen = self.following is not None and self.following.is_unseen
        return NOT_FOLLOWED.code if unseen else self.motion_hidden_by

    @property
    def moving(self) -> Moving:
        """Whether the axis moves, as far as readings tell; never "no" without readings that prove it."""
        # one that cannot be read may do anything, and so may one whose start was not confirmed
        if self.link is not LinkState.UP or (self.progress.unsure and self.progress.unsure.from_rest):
            return Moving.UNKNOWN
        rests = self.rest.rests
        if rests is False or (self.command and self.state.is_motion):
            return Moving.YES
        # every poll passes here: asked only where there may be an answer
        hidden = (self.faults or self.first_fault or self.following) and self.rest_unproven_by
        return Moving.NO if rests and not hidden and self.unseen is None else Moving.UNKNOWN

    @property
    def to_be_stopped(self) -> bool:
        """Whether a stop may take something out: it moves, or may under voltage."""
        only_hidden = self.at_rest and not self.energised and bool(self.motion_hidden_by)
        return self.moving is not Moving.NO and not only_hidden

    @property
    def quality(self) -> Quality:
        """Quality of a value read just now: whether the drive counts it; `referenced` tells whether it is a place."""
        link = self.link
        hidden = (self.faults or self.first_fault or self.following) and self.motion_hidden_by
        return Quality.UNCERTAIN if link is LinkState.UP and (self.position_lost or hidden) else QUALITIES[link]

    @property
    def at_rest(self) -> bool:
        """Whether the readings show that nothing moves; a fault may hide motion, see `moving`."""
        return self.rest.rests is True and not (self.following and self.following.is_awaited)

    @property
    def stands_when_done(self) -> bool:
        """Whether the axis stands as soon as its drive shows a finished profile and no velocity; see `RestEvidence`."""
        return self.rest.rests is True or self.rest.is_done_at_rest

    @property
    def coasts(self) -> bool:
        """Whether the shaft turns with the motor off, as a look or polls have shown: its encoder may have ceased."""
        return (self.rest.turns or self.coast is not None) and not self.enabled

    @property
    def unseen(self) -> Unseen | None:
        """Why the shaft may turn though it shows no count; None where something has shown that its encoder counts."""
        rest = self.rest
        if not rest.unseen_s or (rest.is_done_at_rest if self.enabled else rest.rests):
            return None
        if self.enabled:
            return Unseen.UNDER_POWER
        return Unseen.LEFT_TURNING if rest.left_turning else Unseen.MOTOR_OFF

    @property
    def energised(self) -> bool:
        """Whether the motor gets voltage: the loop is closed, or open for a command that wants it so."""
        return self.enabled or (self.command is not None and self.command.opens_loop)

    @property
    def contradicts(self) -> bool:
        """Whether what its drive shows was not understood since the last reset."""
        return READINGS_CONTRADICT in self.own

    @property
    def replies_unusable(self) -> bool:
        """Whether its drive has replied for too long with what is no reading, since the last reset."""
        return REPLIES_UNUSABLE in self.own

    def sample_fields(self) -> dict[str, Any]:
        """Return the fields of a state sample besides when, in its order; compared after every poll, so no model."""
        return dict(zip(PUBLISHED, _published_of(self), strict=True))

    def is_at(self, command_id: str | None) -> bool:
        """Tell whether a command is under way; with None, whether none is."""
        return (self.command.command_id if self.command else None) == command_id

    def has_done(self, command_id: str) -> bool:
        """Tell whether the latest command that is over is this one, and was done."""
        end = self.last_end
        return end is not None and end.command.command_id == command_id and end.status is CommandStatus.DONE

    def concerns(self, timing: Timing) -> bool:
        """Tell whether a reading was requested after the latest command took effect."""
        return timing.sent_at_s >= self.effective_from_s

    def next_reading_s(self, at_s: float) -> float:
        """Return when to read the axis so that the end of its motion is seen in time; infinite when there is none soon.

        Args:
            at_s: when it was read last, or is.
        """
        settling, ends_at_s = self.command.settling if self.command else None, self.ends_at_s
        if settling is None or ends_at_s is None:
            return math.inf
        if at_s < ends_at_s:
            return ends_at_s
        if self.progress.settle is None and at_s > ends_at_s + settling.timeout_s:
            return math.inf  # not as planned: the ordinary polls tell
        # two readings at least within the time for which it must have stayed
        return at_s + max(settling.time_s / 2, SHORTEST_READING_PAUSE_S)


def new_faults(before: AxisStatus, after: AxisStatus) -> Iterator[FaultEntry]:
    """Yield the faults that have come up from one status to the next."""
    if after.faults is not before.faults:
        for entry in after.faults:
            if not any(entry is each for each in before.faults):
                yield entry
