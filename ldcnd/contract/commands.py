"""The commands of an axis: one class for each command, and the base classes that they share.

A command is sent as the payload of a query on `@cmd/<axis>/<verb>`, or on `@cmd/_/<verb>` when it is about the rig. Its
class is the only definition: keys, schemas, time-outs, access rules and the tables of the command line, the console
and the documentation are derived from its attributes. Questions are in questions.py, commands about
parameters, traces and events beside their replies; `ldcnd.contract.catalogue` has them all.
"""

from collections.abc import Collection, Mapping
from enum import StrEnum
from functools import cache
from types import GenericAlias
from typing import TYPE_CHECKING, ClassVar, Generic, Literal, Self, TypeVar, get_args

from pydantic import ConfigDict, Field

from ldcnd.contract.errors import ErrorCode
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen
from ldcnd.contract.samples import StopCount

LATEST_NS = 2**63 - 1
"""The latest instant that every encoding takes, UTC in ns since 1970."""
LONGEST_NAME = 64
"""Longest name or id that a client may give, in characters."""
ANSWER_S = 5.0
"""Longest wait of a client for the reply to a command that is a few exchanges with its drive, in seconds."""
REPLAYED_WITHIN_S = 3600.0
"""Time for which a command id is remembered after the command has arrived, in seconds."""


class Verb(StrEnum):
    """The commands of an axis and the last chunks of their keys; a drive without the capability: not_supported."""

    POWER = "power"
    MOVE_ABSOLUTE = "move_absolute"
    MOVE_RELATIVE = "move_relative"
    MOVE_VELOCITY = "move_velocity"
    JOG = "jog"
    HALT = "halt"
    STOP = "stop"
    QUICK_STOP = "quick_stop"
    HOME = "home"
    PROBE = "probe"
    RESET = "reset"
    SET_POSITION = "set_position"
    SET_GAINS = "set_gains"
    LIST_PARAMETERS = "list_parameters"
    READ_PARAMETER = "read_parameter"
    READ_ALL_PARAMETERS = "read_all_parameters"
    WRITE_PARAMETER = "write_parameter"
    CLEAR_COUNTER = "clear_counter"
    RESTART_EEPROM_COUNT = "restart_eeprom_count"
    READ_ALARMS = "read_alarms"
    READ_MONITORS = "read_monitors"
    PLAN_PARAMETERS = "plan_parameters"
    MOVE_ANALOG = "move_analog"
    SET_PWM = "set_pwm"
    TRACK = "track"
    SET_OUTPUTS = "set_outputs"
    TRACE = "trace"
    TRACE_ABORT = "trace_abort"


class MotionKind(StrEnum):
    """Kind of a motion, for interlocks and sets of gains."""

    POSITION = "position"
    """A motion to a place: `move_absolute`, `move_relative`, groups, paths, `probe`, `track`, `move_analog`."""
    VELOCITY = "velocity"
    """A motion at a velocity or duty: `move_velocity`, `jog`, `set_pwm`."""
    HOME = "home"
    """The search for the reference position: `home`."""


_KINDS = {
    Verb.MOVE_VELOCITY: MotionKind.VELOCITY,
    Verb.JOG: MotionKind.VELOCITY,
    Verb.SET_PWM: MotionKind.VELOCITY,
    Verb.HOME: MotionKind.HOME,
}


def kind_of(verb: Verb) -> MotionKind:
    """Return the kind of the motion that a command begins."""
    return _KINDS.get(verb, MotionKind.POSITION)


class About(StrEnum):
    """Target of a command: an axis, or the rig as a whole."""

    AXIS = "axis"
    RIG = "rig"


class Effect(StrEnum):
    """Effect of a command on the rig."""

    QUESTION = "question"
    """Changes nothing: it needs no lease and leaves no event."""
    REST = "rest"
    """Brings an axis to rest: it needs no lease, is never late, and is carried out as often as it is sent."""
    MOTION = "motion"
    """May make an axis move: it is carried out at most once for each command id."""
    CHANGE = "change"
    """Changes something else: it is carried out at most once for each command id."""


class Ends(StrEnum):
    """When a command is over."""

    WITH_REPLY = "with_reply"
    """With its reply: the drive has acknowledged it and nothing is left to do."""
    BY_READING = "by_reading"
    """When a later reading of the drive shows it, such as a move that has settled."""


class Capability(StrEnum):
    """Function of a drive that a command needs."""

    MOTION = "motion"
    """A position loop that takes commands over its line."""
    PARAMETERS = "parameters"
    """Parameters that can be read over its line."""
    TRACES = "traces"
    """Values that can be polled."""


class Role(StrEnum):
    """Permissions of a login."""

    VIEWER = "viewer"
    """Reads and asks everything, and may stop."""
    OPERATOR = "operator"
    """Reads, stops and commands."""
    DAEMON = "daemon"
    """Serves a rig; listens."""
    ROUTER = "router"
    """Carries messages between the others, and keeps viewers and operators apart; listens."""


ReplyT_co = TypeVar("ReplyT_co", bound=Frozen, covariant=True)


def _schema_title(command: type) -> str:
    """Return the title of a command's schema: `MoveAbsoluteRequest` for `move_absolute`."""
    verb = getattr(command, "verb", None)
    return command.__name__ if verb is None else "".join(map(str.capitalize, verb.split("_"))) + "Request"


class Command(Frozen, Generic[ReplyT_co]):
    """The base of all commands, generic in the type of the reply.

    Attributes:
        verb: last chunk of its key.
        about: whether it names an axis.
        effect: what it does to the rig.
        ends: when it is over.
        calms: the field, and its value, with which it takes energy out, of a class that does so by its values.
        answer_s: longest wait of a client for its reply, in seconds.
    """

    model_config = ConfigDict(model_title_generator=_schema_title)

    verb: ClassVar[str]
    about: ClassVar[About]
    effect: ClassVar[Effect] = Effect.CHANGE
    ends: ClassVar[Ends] = Ends.WITH_REPLY
    calms: ClassVar[tuple[str, object] | None] = None
    answer_s: ClassVar[float] = ANSWER_S

    if not TYPE_CHECKING:  # the reply is no part of the fields: pydantic need not make a model for each

        def __class_getitem__(cls, reply: object) -> GenericAlias:
            """Return the class with the type of its reply."""
            return GenericAlias(cls, reply)

    @property
    def takes_energy_out(self) -> bool:
        """Whether it does nothing but bring an axis to rest or switch it off: nothing refuses such a command."""
        return self.effect is Effect.REST or (self.calms is not None and getattr(self, self.calms[0]) == self.calms[1])

    @classmethod
    def may_take_energy_out(cls) -> bool:
        """Tell whether some command of this class does: of a class that says so by its values, not every one."""
        return cls.effect is Effect.REST or cls.calms is not None

    @classmethod
    def needs_lease(cls) -> bool:
        """Tell whether it is refused without a lease where leases are required."""
        return cls.effect is Effect.MOTION or (cls.effect is Effect.CHANGE and cls.about is About.AXIS)

    @classmethod
    def role(cls) -> Role:
        """Return the lowest role of a login that may send it."""
        return Role.VIEWER if cls.effect is Effect.QUESTION else Role.OPERATOR

    @classmethod
    def reply_model(cls) -> type[ReplyT_co]:
        """Return the type of the command's reply."""
        return _reply_model(cls)

    @classmethod
    def summary(cls) -> str:
        """Return the first line of the class's docstring."""
        return (cls.__doc__ or "").strip().partition("\n")[0]


@cache
def _reply_model(command: type[Command[ReplyT_co]]) -> type[ReplyT_co]:
    for base in command.__mro__:
        for generic in vars(base).get("__orig_bases__", ()):
            for reply in get_args(generic):
                if isinstance(reply, type):
                    return reply
    raise TypeError(f"{command.__name__} does not say what it is answered with")


class AxisCommand(Command[ReplyT_co], Generic[ReplyT_co]):
    """The base of commands to one axis, with the fields that prove permission and prevent a second execution.

    Attributes:
        capability: function of a drive that it needs.
    """

    about: ClassVar[About] = About.AXIS
    capability: ClassVar[Capability] = Capability.MOTION
    verb: ClassVar[Verb]

    command_id: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    """Names the command; the same id is carried out at most once and answered alike. Given by the daemon if missing.
    Remembered for an hour, and under a lease with a sequence for as long as the daemon runs; what may be delivered
    later than that carries `not_after` or `instance`."""
    client: str | None = Field(default=None, max_length=LONGEST_NAME)
    """Sender: a name for people, in events and the log; not authenticated. A lease has its own."""
    lease: str | None = None
    """The lease under which it is sent."""
    sequence: int | None = Field(default=None, ge=0, le=LARGEST_INTEGER)
    """Grows with every command under the lease; an older one that comes later is refused."""
    instance: str | None = None
    """The run of the daemon for which it is meant, as in `meta/daemon`. A restart discards all command ids; with this
    field a command that is sent again after a restart is refused instead of being carried out twice."""
    not_after: int | None = Field(default=None, ge=0, le=LATEST_NS)
    """Do not start it after this instant, UTC in ns since 1970; needs clocks that agree."""
    after_stops: StopCount | None = None
    """The `stops` of the axis's state when it was asked for: with another number a stop, halt or power off has come
    since, and it is refused. A daemon that was started again counts from 0: `instance` tells that. What takes energy
    out is carried out all the same."""


class CommandReply(Frozen):
    """The drive acknowledged the command, or it waits for another one to end.

    Values are those requested, as rounded by the drive's registers.
    """

    command_id: str
    """Names the command in `state`, in events and in the log."""
    status: Literal["accepted"] = "accepted"
    """Accepted: acknowledged by the drive, or waiting as `waits_for` says; not yet complete."""
    waits_for: str | None = None
    """The command that must end before this one begins, by id; its planned values are not known before. An event says
    when it begins, or why it does not. Null when the drive has acknowledged it."""
    axis: str
    """The axis."""
    verb: str
    """The command."""
    position: float | None = None
    """Target in axis units."""
    velocity: float | None = None
    """Velocity in axis units a second."""
    acceleration: float | None = None
    """Acceleration in axis units a second squared."""
    duration_s: float | None = Field(default=None, ge=0)
    """How long the profile takes, without settling; for set_pwm how long the duty stays on."""
    ends: str | None = None
    """What ends a move_velocity that nobody stops, and when, for people; the event of that end says it again. Null for
    all others."""
    target: int | None = None
    """Target in A/D counts, for an analog move."""
    duty: float | None = None
    """Duty as the drive's register makes it, -1 to 1."""
    since: int | None = None
    """Instant at which the motion was accepted, the same as in the command of `state`; null for a command that
    begins none."""
    stops: StopCount | None = None
    """The `stops` of the state behind a command that takes energy out; null for all others."""


class StopReply(Frozen):
    """The stop was sent; which axes confirmed it by the time of this answer."""

    status: Literal["stopping"] = "stopping"
    """Stopping: latched, nothing moves again before reset."""
    axes: tuple[str, ...]
    """The axes concerned."""
    confirmed: tuple[str, ...]
    """The axes whose drives acknowledged the stop."""
    unstoppable: tuple[str, ...] = ()
    """The axes that no stop reaches over their line, and that no latch holds: what moves them goes on."""
    standing: tuple[str, ...] = ()
    """Those of them that stood when their drive was read last."""
    kept: tuple[str, ...] = ()
    """The axes whose latch is on the disk of the daemon: it outlasts a restart. The others lose it when the daemon
    ends: none is kept without a `state_dir`."""
    warning: str = ""
    """That the latches cannot be written to the `state_dir`, and why, for a person; empty where they are."""
    shortfall: str = ""
    """What may move on, and what to do, for a person; empty when every drive that takes a stop has confirmed it and
    all others stood when they were read last."""
    outcome: str = ""
    """That the stop is latched, and which drives have confirmed it, for a person; empty where no axis has a latch."""
    unreached: str = ""
    """That axes stand although no stop reaches them, and which, for a person; empty where there is none."""
    stops: dict[str, StopCount] = Field(default_factory=dict)
    """The `stops` of the states behind it, by axis."""

    @classmethod
    def of(
        cls,
        axes: tuple[str, ...],
        *,
        confirmed: Collection[str],
        unstoppable: Collection[str],
        standing: Collection[str],
        kept: Collection[str],
        stops: Mapping[str, int],
        warning: str = "",
    ) -> Self:
        """Return the reply about these axes, in their order, in words too."""
        pending = [name for name in axes if name not in confirmed and name not in unstoppable]
        out_of_reach = tuple(name for name in axes if name in unstoppable)
        said = [f"NOT confirmed: {', '.join(pending)}; the latch holds, look at the machine"] if pending else []
        at_rest = tuple(name for name in out_of_reach if name in standing)
        done = tuple(name for name in axes if name in confirmed)
        going = [name for name in out_of_reach if name not in standing]
        if going:
            said.append(f"NOT stopped: {', '.join(going)}; the drive takes no stop over its line and has no latch")
        return cls(
            axes=axes,
            confirmed=done,
            unstoppable=out_of_reach,
            standing=at_rest,
            kept=tuple(name for name in axes if name in kept),
            warning=warning,
            shortfall=f"{'. '.join(said)}. Use the machine's emergency stop." if said else "",
            outcome=f"stop latched, confirmed by {', '.join(done) or 'none'}" if len(out_of_reach) < len(axes) else "",
            unreached=f"No stop reaches {', '.join(at_rest)}: no motion at the last reading." if at_rest else "",
            stops=dict(stops),
        )


class RemedyStep(Frozen):
    """A command that a remedy names, so that it can be said as what is typed or pressed."""

    verb: str
    """The command."""
    said: str
    """The words of the remedy that name it."""
    arguments: dict[str, bool | float | str | tuple[str, ...]] = Field(default_factory=dict)
    """The arguments of the command."""


class ReceivedError(Frozen):
    """Why a query was not carried out, as a client reads it: a newer daemon may have more codes."""

    code: str = Field(description="what went wrong")
    message: str = Field(description="Sentence for a person: what, to whom, which value, which limit.")
    retryable: bool = Field(description="Whether the same request may be sent again without harm and may then succeed.")
    axis: str | None = Field(default=None, description="Axis concerned.")
    value: float | str | None = Field(default=None, description="Offending value, in the unit that the caller used.")
    limit: float | str | None = Field(default=None, description="Limit that the value broke.")
    nearest: float | None = Field(default=None, description="Closest value that would be accepted.")
    remedy: str | None = Field(default=None, description="Remedy: what to do about it.")
    steps: tuple[RemedyStep, ...] = Field(default=(), description="Commands that the remedy names, in their order.")
    page: str | None = Field(default=None, description="Path of its page below a console or the documentation.")


class ErrorReply(ReceivedError):
    """Why a query was not carried out; sent as JSON in an error reply, whatever the query's encoding."""

    code: ErrorCode = Field(description="Code of the error, out of a closed list.")


# -- motion ----------------------------------------------------------------------------------------------------------


class Power(AxisCommand[CommandReply]):
    """Close or open the position loop; nothing moves."""

    verb = Verb.POWER
    calms = ("on", False)

    on: bool
    """True closes the loop at the present position, false opens it and disables the amplifier."""


class BufferMode(StrEnum):
    """Effect of a move on an axis that moves already; PLCopen's buffer modes, and a refusal."""

    REFUSE = "refuse"
    """The move is refused: the sender was not aware of the motion under way. A motion at a velocity takes another
    velocity all the same."""
    ABORTING = "aborting"
    """The command under way ends as aborted. The axis is halted first, but for a PIC-SERVO SC on a move or jog: that
    drive goes on to the new goal within the new velocity and acceleration, without a halt."""
    BUFFERED = "buffered"
    """The move waits until the command under way has ended. It is answered at once, with the command it waits for; a
    halt or a stop withdraws it."""


class RampedCommand(AxisCommand[CommandReply]):
    """The base of commands that set a shaft going by a ramp."""

    effect = Effect.MOTION
    ends = Ends.BY_READING

    acceleration: float | None = Field(default=None, gt=0)
    """Acceleration in units a second squared; the axis default when missing."""


class ProfiledCommand(RampedCommand):
    """The base of commands that go at a speed towards an end."""

    velocity: float | None = Field(default=None, gt=0)
    """Speed in units a second; the axis default when missing."""


class Move(RampedCommand):
    """The base of the moves."""

    buffer_mode: BufferMode = BufferMode.REFUSE
    """Effect if the axis moves already."""


class Direction(StrEnum):
    """Way in which an axis with a modulo turns to a position; PLCopen's directions."""

    SHORTEST_WAY = "shortest_way"
    POSITIVE = "positive"
    NEGATIVE = "negative"


class MoveAbsolute(Move, ProfiledCommand):
    """Move to a position on a trapezoidal profile."""

    verb = Verb.MOVE_ABSOLUTE

    position: float
    """Target in axis units; on an axis with a modulo any turn of it is meant."""
    direction: Direction | None = None
    """Way to turn, on an axis with a modulo only; the shortest when missing."""


class MoveRelative(Move, ProfiledCommand):
    """Move by a distance from the commanded position; becomes absolute when it is admitted."""

    verb = Verb.MOVE_RELATIVE

    distance: float
    """Distance in axis units, signed."""


class MoveVelocity(Move):
    """Move at a constant velocity until the next command, the software limit, or the end of its duration.

    On an axis that moves so already it changes velocity and acceleration on the fly, and its duration begins again.
    """

    verb = Verb.MOVE_VELOCITY

    velocity: float
    """Velocity in units a second, positive forward, not 0."""
    duration_s: float | None = Field(default=None, gt=0, le=86_400)
    """Duration at the velocity, in seconds, at most the axis's `longest_run_s`; that, or without it the software limit
    ahead or `jog_horizon_s`, when missing. The drive itself ends it with a ramp, also when daemon and client are gone:
    it is a move of so many units."""


SHORTEST_HOLD_S, LONGEST_HOLD_S = 0.2, 1.0
"""Bounds of `Jog.hold_s`, in seconds."""


class Jog(Move):
    """Run at a velocity for as long as the client renews the hold; ends by itself when no renewal arrives.

    The first one begins the jog. Later ones that carry its `command_id` in `renews` keep it alive, and may change its
    velocity; they begin nothing: a jog that is over stays over. `halt` ends it.
    """

    verb = Verb.JOG

    velocity: float
    """Velocity in units a second, positive forward, not 0."""
    hold_s: float = Field(default=0.4, ge=SHORTEST_HOLD_S, le=LONGEST_HOLD_S)
    """Longest time between two renewals, in seconds by the clock of the daemon; then it ends the jog."""
    renews: str | None = Field(default=None, min_length=1, max_length=LONGEST_NAME)
    """The command id of the jog that goes on; without it a new one begins. A renewal leaves no event."""


class Halt(AxisCommand[CommandReply]):
    """Decelerate to standstill; another command may follow."""

    verb = Verb.HALT
    effect = Effect.REST
    ends = Ends.BY_READING


class Stop(AxisCommand[CommandReply]):
    """Decelerate to standstill and latch: nothing moves again before reset."""

    verb = Verb.STOP
    effect = Effect.REST


class QuickStop(AxisCommand[CommandReply]):
    """Stop without a ramp, holding position, and latch: nothing moves again before reset."""

    verb = Verb.QUICK_STOP
    effect = Effect.REST


class HomeMethod(StrEnum):
    """Signal that marks the reference position."""

    INDEX = "index"
    FORWARD_LIMIT = "forward_limit"
    REVERSE_LIMIT = "reverse_limit"
    POSITION_ERROR = "position_error"
    CURRENT = "current"


class HomeStop(StrEnum):
    """How the motor stops when the reference position was found."""

    SMOOTH = "smooth"
    """Decelerate, then hold."""
    ABRUPT = "abrupt"
    """Hold at once."""
    OFF = "off"
    """Open the loop: the motor coasts and the axis is disabled afterwards."""


class Home(RampedCommand):
    """Find the reference position; missing values come from the axis's configuration.

    An axis that stands on the limit switch it is to run onto moves off it first.
    """

    verb = Verb.HOME
    # one leg that ends where it has captured, whatever the configuration says of finding and of moving on
    alone: ClassVar[bool] = False

    method: HomeMethod | None = None
    """Signal that marks the reference position."""
    velocity: float | None = None
    """Search velocity in units a second, positive forward, not 0. On the index at most 0.75 of an index width in a \
servo cycle: a faster search is refused with the nearest velocity."""
    find_velocity: float | None = Field(default=None, gt=0)
    """Speed at which a limit switch is found first, in units a second; the axis then moves off it and comes back at \
`velocity` to take the reference over. A missing one, and any other method, searches at `velocity` alone."""
    position: float | None = None
    """Value of the reference position, in axis units."""
    timeout_s: float | None = Field(default=None, gt=0, le=3600)
    """Longest search, in seconds; moving off a limit switch first counts as a search of its own."""
    distance: float | None = Field(default=None, gt=0)
    """Longest search, in axis units; a missing one is as far as the velocity goes in that time."""
    stop: HomeStop | None = None
    """How the motor stops there."""
    move_to: float | None = None
    """Position to move to afterwards, in axis units; without one the axis stays where the motor stopped."""


class ProbeSource(StrEnum):
    """Signal that latches the position of a probe."""

    INDEX = "index"
    FORWARD_LIMIT = "forward_limit"
    REVERSE_LIMIT = "reverse_limit"
    CURRENT = "current"


class ProbeStop(StrEnum):
    """How the motor stops when something was latched."""

    SMOOTH = "smooth"
    """Decelerate, then hold."""
    ABRUPT = "abrupt"
    """Hold at once."""


class Probe(ProfiledCommand):
    """Move until an input changes and latch the position there; it is published on `latch`, the reference stays.

    Exactly one of position and distance says where the move ends when no input comes; then the command has failed.
    """

    verb = Verb.PROBE

    sources: tuple[ProbeSource, ...] = Field(min_length=1, max_length=4)
    """Signals that latch: any change of a limit switch input, an index pulse, the current limit; the first counts. On
    the index the speed is at most 0.75 of an index width in a servo cycle; the slower, the surer is the position."""
    position: float | None = None
    """Position at which the move ends at the latest, in axis units; needs a referenced axis."""
    distance: float | None = None
    """How far it goes at most, in axis units, signed."""
    stop: ProbeStop = ProbeStop.SMOOTH
    """How the motor stops there."""


class Reset(AxisCommand[CommandReply]):
    """Clear the stop latch and the drive's faults; after a drive fault the axis is disabled. Nothing moves."""

    verb = Verb.RESET

    faults_only: bool = False
    """Clear faults, and no latch: refused while a stop is latched. Programs that go on by themselves send it so."""


class SetPosition(AxisCommand[CommandReply]):
    """Set the position of an axis at standstill; afterwards it is referenced."""

    verb = Verb.SET_POSITION

    position: float
    """New value of the present position, in axis units."""


class SetGains(AxisCommand[CommandReply]):
    """Change the position loop of a drive; register values as in its manual, the missing ones stay as they are.

    What changes is the set in force, that of the last motion or power-on, and it stays so until the daemon restarts;
    `gain_set` puts another one in force.
    """

    verb = Verb.SET_GAINS

    gain_set: str | None = Field(default=None, max_length=LONGEST_NAME)
    """Configured set of gains to load, at standstill, and to change by the values besides it; a motion loads the set of
    its kind if kinds have sets."""
    kp: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Position gain."""
    kd: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Velocity gain."""
    ki: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Integral gain."""
    il: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Integration limit."""
    ol: int | None = Field(default=None, ge=0, le=0xFF)
    """Output limit."""
    cl: int | None = Field(default=None, ge=0, le=0xFF)
    """Current limit: 0 is off; odd where the sense voltage rises with the current, even where it falls."""
    el: int | None = Field(default=None, ge=0, le=0x7FFF)
    """Position error limit, in counts; at most 16383, PIC-SERVO SC 32767."""
    deadband: int | None = Field(default=None, ge=0, le=0xFF)
    """Amplifier deadband compensation."""
    sr: int | None = Field(default=None, ge=1, le=0xFF)
    """Servo rate divisor; it changes the unit of velocities in the drive, so only an axis at standstill accepts it."""
    lent: bool = False
    """The gains are for a trial: when control of the axis ends in any way, its loop is opened at rest, and the gains of
    before are loaded again before it closes. It needs a lease."""


class MoveAnalog(ProfiledCommand):
    """Move until the analog position sensor reads a value; the drive finds the direction itself."""

    verb = Verb.MOVE_ANALOG

    target: int = Field(ge=0, le=LARGEST_INTEGER)
    """A/D counts, 0 to full scale; the ends of the range mean a broken sensor and are refused."""
    timeout_s: float | None = Field(default=None, gt=0, le=3600)
    """Longest motion, in seconds; the axis's `analog.timeout_s` when missing. The daemon ends it, not the drive."""
    distance: float | None = Field(default=None, gt=0)
    """Longest way from where it begins, in axis units, and the way to stop behind it; the axis's `analog.distance` when
    missing, and without that as far as the velocity goes in the time. The daemon ends it, not the drive."""


class SetPwm(AxisCommand[CommandReply]):
    """Put a raw duty on the motor, with the position loop open, for a limited time; then the axis stops and holds."""

    verb = Verb.SET_PWM
    effect = Effect.MOTION
    ends = Ends.BY_READING

    duty: float = Field(ge=-1, le=1)
    """Share of the supply voltage, positive forward."""
    duration_s: float = Field(gt=0)
    """Duration, in seconds."""


class Track(AxisCommand[CommandReply]):
    """Go to a position at once, without a profile: one set-point of a stream."""

    verb = Verb.TRACK
    effect = Effect.MOTION
    ends = Ends.BY_READING

    position: float
    """Set-point in axis units."""


class PinMode(StrEnum):
    """Use of a limit switch pin."""

    INPUT = "input"
    HIGH = "high"
    LOW = "low"


class SetOutputs(AxisCommand[CommandReply]):
    """Use limit switch pins as outputs, or as inputs again; a missing pin stays as it is."""

    verb = Verb.SET_OUTPUTS

    limit1: PinMode | None = None
    """The pin of limit switch 1 (reverse)."""
    limit2: PinMode | None = None
    """The pin of limit switch 2 (forward)."""


COMMANDS: tuple[type[Command[Frozen]], ...] = (
    Power,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Jog,
    Halt,
    Stop,
    QuickStop,
    Home,
    Probe,
    Reset,
    SetPosition,
    SetGains,
    MoveAnalog,
    SetPwm,
    Track,
    SetOutputs,
)
"""The commands of this file."""
