"""What befalls one axis: what is observed of it, what is commanded, and what forbids it to move."""

from dataclasses import dataclass, field

from ldcnd.axis.course import Pace
from ldcnd.axis.following import Following
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import ActiveCommand, LatchedBy, SoftLimits, Unsure
from ldcnd.contract.commands import Verb
from ldcnd.contract.samples import PastFault
from ldcnd.drives.driver import AxisReading, Fault, StopMode

# -- what is observed ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ReadingTaken:
    """A reading was accepted.

    Attributes:
        reading: what the drive shows.
        sent_at_s: when it was requested, in loop time.
        now_ns: when it was true, UTC; it stamps the faults that the reading brings up.
        true_until_s: the latest instant at which it can have been true, in loop time; that of the request without one.
    """

    reading: AxisReading
    sent_at_s: float
    now_ns: int
    true_until_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LimitsSet:
    """The axis has other software limits."""

    limits: SoftLimits


@dataclass(frozen=True, slots=True)
class LookTaken:
    """A reading out of turn shows whether the shaft turns."""

    reading: AxisReading


@dataclass(frozen=True, slots=True)
class LoopSeen:
    """How the loop of a drive was found that was not read yet."""

    enabled: bool


@dataclass(frozen=True, slots=True)
class PollMissed:
    """A poll brought nothing.

    Attributes:
        now_ns: when, UTC.
        another: something answers which is not known to be this drive.
        before: the silent drive before it on its line, without which no packet reaches it; empty without one.
    """

    now_ns: int
    another: bool
    before: str = ""


@dataclass(frozen=True, slots=True)
class DriveLost:
    """The drive is gone: nothing is known any more, and nothing resumes. The first fields are those of `PollMissed`.

    Attributes:
        asked: it was asked in vain; otherwise one that was never heard is not missed before its line is up.
    """

    now_ns: int
    another: bool
    before: str = ""
    asked: bool = False


@dataclass(frozen=True, slots=True)
class ReplyUnusable:
    """The drive replies, but not with a reading. That is not silence: the link is degraded, never down."""

    now_ns: int


@dataclass(frozen=True, slots=True)
class ReadingsContradicted:
    """The drive replies, and what it shows is not understood."""

    now_ns: int


@dataclass(frozen=True, slots=True)
class FaultFound:
    """The next reading shows what this daemon has neither done nor commanded: a fault until reset."""

    fault: Fault


@dataclass(frozen=True, slots=True)
class ReferenceRefused:
    """The reference that an earlier daemon has kept does not hold: a warning until there is another one."""

    reason: str


@dataclass(frozen=True, slots=True)
class PlaceKnown:
    """The place of the axis is known: it was homed, set, or kept.

    Attributes:
        scale: its coordinates from now on.
        resting: the axis stands at a place that nothing has sent it to, as after `set_position`.
        stood: it stood there when an earlier daemon kept it, and is still there.
    """

    scale: AxisScale
    resting: bool = False
    stood: bool = False


@dataclass(frozen=True, slots=True)
class PlaceUnknown:
    """The place of the axis is not known any more: its drive is about to get another one."""


# -- what is commanded -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CommandBegun:
    """A motion is about to start; whatever ran before was aborted by it."""

    command: ActiveCommand


@dataclass(frozen=True, slots=True)
class CommandGoesOn:
    """The command under way is about to take its next motion, or comes to rest; one that is over does not begin again.

    Attributes:
        command: as it is from now on.
    """

    command: ActiveCommand

    @property
    def command_id(self) -> str:
        """Its id."""
        return self.command.command_id


@dataclass(frozen=True, slots=True)
class MotionStarted:
    """The drive has acknowledged the motion, or may have: only readings requested from now on count for the command.

    Attributes:
        command_id: of the command whose motion it is.
        now_s: when, in loop time.
        target_counts: where its command ends, counts; None when it has no end of its own, or that is not certain.
        approached: it comes from the side that the configuration names.
        pace: of one that another motion goes over into; None for one that begins at rest.
        unsure: why it is not known whether it has begun; None when the drive shows it.
        following: by what its encoder is to be seen to count; None where nothing says how far its profile goes.
        profile: speed and acceleration of one that goes on from another motion, in counts; None of others.
        onwards: it goes on in the direction in which the shaft turns.
        endless: what the drive runs does not end by itself: its profile is done as soon as its velocity is reached.
            There is no default: a shaft that creeps must not pass for one that stands.
    """

    command_id: str
    now_s: float
    endless: bool = field(kw_only=True)
    target_counts: int | None = None
    approached: bool = False
    pace: Pace | None = None
    unsure: Unsure | None = None
    following: Following | None = None
    profile: tuple[float, float] | None = None
    onwards: bool = False


@dataclass(frozen=True, slots=True)
class SpeedChanged:
    """The motion under way goes on at another speed, and ends after `rest_s`; `pace` is what is to be seen of it.

    `target_counts` is where it ends then; None where that stays. `profile` is its speed and acceleration, in counts.
    `doubt` says why its drive may not have heard, and goes on as before; empty where it has acknowledged it.
    """

    rest_s: float
    now_s: float
    now_ns: int
    pace: Pace | None = None
    target_counts: int | None = None
    profile: tuple[float, float] | None = None
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class CommandFailing:
    """The command under way will fail, for a reason, once the axis has come to rest.

    Attributes:
        command_id: of the command; None of a motion without one.
        reason: why.
        interlock: the rule that ends it and what that lacks; empty where none does.
    """

    command_id: str | None
    reason: str
    interlock: str = ""


@dataclass(frozen=True, slots=True)
class CommandOver:
    """The command under way is over: done, or ended as `error` says.

    Attributes:
        command_id: of the command.
        error: why it has failed; None when it was done.
    """

    command_id: str
    error: str | None = None


@dataclass(frozen=True, slots=True)
class PowerSwitched:
    """The drive has acknowledged a change of power; `by` is the id of the command that it has carried out."""

    on: bool
    now_s: float
    by: str | None = None


@dataclass(frozen=True, slots=True)
class LoopSwitched:
    """The loop was opened or closed in the course of a command, which goes on."""

    on: bool
    now_s: float


@dataclass(frozen=True, slots=True)
class ControlChanged:
    """Another client is in control from now on; None when none is."""

    holder: str | None


@dataclass(frozen=True, slots=True)
class SpeedOverridden:
    """The rig has another speed override: the share of every velocity, 0 to 1."""

    share: float


# -- what forbids motion, and its end --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Overtaken:
    """All that was sent to the axis before is void: by a stop of any kind, an interlock, lost control or a loss."""


@dataclass(frozen=True, slots=True)
class StopLatch:
    """A stop is latched: nothing moves again before reset."""


@dataclass(frozen=True, slots=True)
class LatchNamed:
    """It is known who has latched the stop; who has latched it first stays."""

    by: LatchedBy


@dataclass(frozen=True, slots=True)
class StopSent:
    """A stop is about to be sent, as the strongest of those that are not confirmed; `verb` asked for it."""

    mode: StopMode
    verb: Verb = Verb.STOP


@dataclass(frozen=True, slots=True)
class StopAcknowledged:
    """The drive has acknowledged a stop, which the readings requested from now on are to show.

    Attributes:
        mode: how it was stopped.
        now_s: when, in loop time.
        deceleration_counts_per_s2: that the drive holds for it; None while it is not known.
    """

    mode: StopMode
    now_s: float
    deceleration_counts_per_s2: float | None


@dataclass(frozen=True, slots=True)
class StopUnconfirmed:
    """No drive has confirmed a stop, or it is yet to be sent; `how` is said once it was."""

    now_ns: int
    mode: StopMode = StopMode.SMOOTH
    how: str = "confirmed late, when the drive answered again"
    verb: Verb = Verb.STOP


@dataclass(frozen=True, slots=True)
class StopDue:
    """A stop is to be sent because the drive was not read yet; none is known to have failed, see `StopUnconfirmed`."""

    mode: StopMode
    how: str
    verb: Verb = Verb.STOP


@dataclass(frozen=True, slots=True)
class StopOverdue:
    """The drive could not be sent in time what was due: it counts as not confirmed."""

    now_ns: int


@dataclass(frozen=True, slots=True)
class StopConfirmed:
    """The drive has confirmed a stop; a stronger one that is not confirmed yet stands.

    A drive that cannot be moving, because it was reset or had no power, has confirmed every stop.
    """

    mode: StopMode = StopMode.OFF


@dataclass(frozen=True, slots=True)
class LatchRecalled:
    """The axis begins with the latch that an earlier daemon has kept; what it stopped is to be stopped again.

    Attributes:
        stopped: a stop is latched.
        again: how it is to be stopped; None when nothing was stopped.
        in_error: it is in error_stop.
        first: what brought it there.
        now_ns: when, UTC.
        confirmed: as far as the earlier daemon knew it, no stop was asked for in vain.
        by: who has latched the stop.
    """

    stopped: bool
    again: StopMode | None
    in_error: bool
    first: PastFault | None
    now_ns: int
    confirmed: bool = False
    by: LatchedBy | None = None


@dataclass(frozen=True, slots=True)
class ResetDone:
    """An axis that stands was reset: latch and first cause are cleared; the next readings show what remains."""

    now_s: float


AxisEvent = (
    ReadingTaken
    | LimitsSet
    | LookTaken
    | LoopSeen
    | PollMissed
    | DriveLost
    | ReplyUnusable
    | ReadingsContradicted
    | FaultFound
    | ReferenceRefused
    | PlaceKnown
    | PlaceUnknown
    | CommandBegun
    | CommandGoesOn
    | MotionStarted
    | SpeedChanged
    | CommandFailing
    | CommandOver
    | PowerSwitched
    | LoopSwitched
    | SpeedOverridden
    | ControlChanged
    | Overtaken
    | StopLatch
    | StopSent
    | StopAcknowledged
    | StopUnconfirmed
    | StopConfirmed
    | LatchRecalled
    | LatchNamed
    | StopDue
    | StopOverdue
    | ResetDone
)
