"""Commands of the rig as a whole: moves of several axes, the speed override, snapshots, loss drills, wire logs."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from ldcnd.contract import leases
from ldcnd.contract.commands import LATEST_NS, About, Command, CommandReply, Effect, Ends, MoveAbsolute
from ldcnd.contract.events import ReadEvents, ReadOutcome
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen
from ldcnd.contract.samples import StopCount

TOGETHER_S = 10.0
"""Longest wait for the start of several axes: each has its turn first, and proves that it started; seconds."""


class AxisMove(MoveAbsolute):
    """The share of one axis; it can carry a command id of its own."""

    model_config = ConfigDict(title="AxisMove")

    axis: str
    """The axis."""

    def absolute(self) -> MoveAbsolute:
        """Return the move as a command to its axis."""
        return MoveAbsolute(**{name: value for name, value in self if name in MoveAbsolute.model_fields})


class LinePath(StrEnum):
    """The way that the axes of a group take between them."""

    INDEPENDENT = "independent"
    """Each at its own velocity: they start together and arrive when each is there."""
    LINEAR = "linear"
    """On a straight line: they ramp alike and arrive together."""


class MoveTogetherReply(Frozen):
    """Every drive has proven that it started."""

    replies: tuple[CommandReply, ...]
    """One for each axis, in the order of the request."""
    deviation: float | None = Field(default=None, ge=0)
    """How far from the line the axes get at most, by their profiles; null when they keep to none."""


class GroupMoves(Frozen):
    """The moves of the axes of a group."""

    moves: tuple[AxisMove, ...] = Field(min_length=2, max_length=31)
    """Exactly the members of a group, each once."""
    path: LinePath = LinePath.INDEPENDENT
    """The way between. On a line a velocity and an acceleration are the highest that the axis has on it."""
    max_deviation: float | None = Field(default=None, gt=0)
    """A line that would be left by more than this is refused; in the unit of the axes, each of which counts with the \
number of its own unit."""


class MoveTogether(GroupMoves, Command[MoveTogetherReply]):
    """Start absolute moves of the axes of one configured group in the same servo cycle, or none of them."""

    verb = "move_together"
    effect = Effect.MOTION
    about = About.RIG
    ends = Ends.BY_READING
    answer_s = TOGETHER_S


class AxisPath(AxisMove):
    """The share of one axis in a path: `position` is its end; velocity and acceleration are the highest on the way."""

    model_config = ConfigDict(title="AxisPath")

    via: tuple[float, ...] = Field(default=(), max_length=5000)
    """Positions at the corners before the end, in axis units; equally many for all axes."""


class PathReply(Frozen):
    """The axes walk along the path: the reply to `@cmd/_/path`."""

    replies: tuple[CommandReply, ...]
    """One for each axis, in the order of the request."""
    duration_s: float
    """Duration to the last point, in seconds, without settling."""
    deviation: float = Field(ge=0)
    """How far from the polyline the axes get at most, by the points; what their servos lag behind comes on top."""
    rate_hz: float
    """Points a second."""
    ahead_s: float
    """Maximum time that the axes run on if the daemon dies, seconds."""


class WalkPath(Command[PathReply]):
    """Walk the axes of one configured group along a polyline, or none of them; for drives with path mode.

    A stop, a fault, a lost lease or a lost packet of any axis stops all of them. They slow down at corners so that no
    axis is accelerated by more than it may be.
    """

    verb = "path"
    effect = Effect.MOTION
    about = About.RIG
    ends = Ends.BY_READING
    answer_s = TOGETHER_S

    moves: tuple[AxisPath, ...] = Field(min_length=2, max_length=31)
    """Exactly the members of a group, each once."""
    speed: float | None = Field(default=None, gt=0)
    """Along the path, in axis units a second; as fast as the axes allow when missing."""
    max_deviation: float | None = Field(default=None, gt=0)
    """A path that would be left by more than this is refused; in the unit of the axes."""


class AxisShare(Frozen):
    """The share of one axis in moves that were only planned."""

    axis: str
    """The axis."""
    position: float
    """Position at the end, in axis units."""
    velocity: float
    """Velocity that the registers would hold, units a second."""
    acceleration: float
    """Acceleration that the registers would hold, units a second squared."""
    duration_s: float
    """Duration of its profile, in seconds, without settling."""


class PreviewTogetherReply(Frozen):
    """The moves as they would be; nothing was sent: the reply to `@cmd/_/preview_together`."""

    shares: tuple[AxisShare, ...]
    """One for each axis, in the order of the request."""
    duration_s: float
    """Duration of the longest profile, in seconds, without settling."""
    deviation: float | None = Field(default=None, ge=0)
    """Deviation from the straight line that the reply to `move_together` would name."""


class PreviewTogether(GroupMoves, Command[PreviewTogetherReply]):
    """Preview `move_together`; no effect. Refused where that would be for its values."""

    verb = "preview_together"
    about = About.RIG
    effect = Effect.QUESTION


class SpeedOverrideReply(Frozen):
    """The speed override from now on: the reply to `@cmd/_/set_speed_override`."""

    percent: float
    """Speed override, in percent of each commanded velocity."""
    changed: tuple[str, ...]
    """Axes whose motion under way goes on at another velocity."""
    unchanged: tuple[str, ...] = ()
    """Axes whose motion under way goes on at the velocity with which it began."""
    halted: tuple[str, ...]
    """Axes that were commanded to halt, because it is 0, or because they could not be told to be slower."""
    confirmed: tuple[str, ...] = ()
    """Those of them whose drives acknowledged that."""
    shortfall: str = ""
    """The axes that may move on all the same, and what to do, for a person; empty when all drives have confirmed it."""
    stops: dict[str, StopCount] = Field(default_factory=dict)
    """The `stops` of the states behind it, by axis."""


class SetSpeedOverride(Command[SpeedOverrideReply]):
    """Scale every velocity of the rig, of motions that begin and of those under way where the drive takes it.

    At 0 everything that moves is halted and no motion begins; nothing goes on by itself afterwards.
    """

    verb = "set_speed_override"
    about = About.RIG
    calms = ("percent", 0.0)

    percent: float = Field(ge=0, le=100)
    """Speed override, in percent of each commanded velocity; 100 when the daemon starts. Set-points of `track` and
    duties of `set_pwm` are not scaled."""
    client: str | None = Field(default=None, max_length=64)
    """The requester, for the log."""
    leases: tuple[str, ...] = Field(default=(), max_length=256)
    """The sender's leases. To raise the override they must cover every axis of which a motion would need one; lowering
    it needs none."""
    after_stops: dict[str, StopCount] = Field(default_factory=dict, max_length=256)
    """The `after_stops` of commands of an axis, by axis, to raise it."""


class FrozenPosition(Frozen):
    """Position of one axis at the instant of a snapshot."""

    axis: str
    """The axis."""
    position: float
    """Position, in axis units."""
    counts: int
    """Raw encoder counts of the drive."""
    unit: str
    """The axis unit."""
    referenced: bool
    """The position means something; see the state of the axis."""


class CapturedInputs(Frozen):
    """Inputs of an I/O module at the instant of a snapshot."""

    module: str
    """The module."""
    levels: tuple[bool, ...]
    """Levels of the lines, the first is line 1."""
    counter: int = Field(ge=0)
    """Raw count of its counter or timer."""
    proven: bool
    """The count shows that this was captured now; while nothing is counted the module cannot prove it."""


class SnapshotReply(Frozen):
    """Positions of all axes of a line, frozen by one packet: the reply to `@cmd/_/snapshot`."""

    bus: str
    """The line."""
    t: int
    """Instant at which all of them were true, UTC in ns since 1970."""
    t_error_ns: int = Field(ge=0)
    """Every one of the true instants lies within this many ns of `t`."""
    positions: tuple[FrozenPosition, ...]
    """One for each axis."""
    io: tuple[CapturedInputs, ...] = ()
    """One for each I/O module with a name."""


class Snapshot(Command[SnapshotReply]):
    """Freeze the positions of all axes of a line, and its I/O modules' inputs, at one instant.

    Nothing moves or stops. The drives' home registers are overwritten, so no axis may be homing.
    """

    verb = "snapshot"
    about = About.RIG

    bus: str
    """Line to read; it needs `snapshot = true`."""


Line = Annotated[int, Field(ge=1, le=12)] | Annotated[str, Field(pattern="^[a-z][a-z0-9_]*$", max_length=64)]
"""A line of an I/O module, by its number or its configured name."""


class IoReply(Frozen):
    """The module acknowledged it; what its pins show now."""

    module: str
    """The module."""
    levels: tuple[bool, ...]
    """Levels of the lines, the first is line 1; an output that is shorted shows the level of its pin."""
    outputs: tuple[int, ...] | None
    """Lines that are outputs."""
    names: dict[str, int] = Field(default_factory=dict)
    """The lines that have a name in the configuration."""


class SetIo(Command[IoReply]):
    """Set outputs of an I/O module; what is left out stays as it is.

    What they switch the daemon knows only by its interlocks. They keep their state when the daemon is killed: the
    module has no watchdog.
    """

    verb = "set_io"
    about = About.RIG

    module: str
    """Configured name of the module."""
    high: tuple[Line, ...] = ()
    """Lines, by number or name, that are driven high. Only those that are configured as outputs can be; one that
    becomes an output may be low for the time between two packets, and where that fails until it is written again."""
    low: tuple[Line, ...] = ()
    """Lines that are driven low."""
    inputs: tuple[Line, ...] = ()
    """Lines that are inputs from now on: driven from outside, or pulled up."""
    pwm1: float | None = Field(default=None, ge=0, le=1)
    """Share of time for which PWM output 1 is on."""
    pwm2: float | None = Field(default=None, ge=0, le=1)
    """Duty of output 2, in the same way."""
    client: str | None = Field(default=None, max_length=64)
    """The requester, for events and the log; without it the holder of the lease."""
    lease: str | None = None
    """The sender's lease: it must cover all axes on the module's line, where a motion of them would need one."""
    leases: tuple[Annotated[str, Field(max_length=64)], ...] = Field(default=(), max_length=128)
    """Further leases of the sender, where the axes of the line are under several."""
    not_after: int | None = Field(default=None, ge=0, le=LATEST_NS)
    """The `not_after` of commands of an axis, until its first packet."""
    after_stops: dict[str, StopCount] = Field(default_factory=dict, max_length=256)
    """The `after_stops` of commands of an axis, by axis."""


class IoTimer(StrEnum):
    """Input of the counter of an I/O module."""

    OFF = "off"
    """Nothing: it keeps its count."""
    TIMER = "timer"
    """Clocks of 5 MHz."""
    COUNTER = "counter"
    """Rising edges of line 10, which must be an input."""


class SetIoTimer(Command[IoReply]):
    """Choose what the counter of an I/O module counts; there is no command that sets it."""

    verb = "set_io_timer"
    about = About.RIG

    module: str
    """Configured name of the module."""
    mode: IoTimer
    """Input of the counter."""
    prescale: Literal[1, 2, 4, 8] = 1
    """Edges or clocks for each count."""
    lease: str | None = None
    """Lease, see `set_io`."""
    leases: tuple[Annotated[str, Field(max_length=64)], ...] = Field(default=(), max_length=128)
    """Further leases."""


class OverrideReply(Frozen):
    """The interlock does not bind for a time: the reply to `@cmd/_/override_interlock`."""

    interlock: str
    """Name of the interlock."""
    seconds: float
    """Duration of the override, in seconds; 0 when it was taken back."""
    client: str
    """The client that holds the lease."""


class OverrideInterlock(Command[OverrideReply]):
    """Lift one interlock for service, for a time and no longer than the lease lasts; each override is an event."""

    verb = "override_interlock"
    about = About.RIG

    interlock: str
    """Name of the interlock."""
    seconds: float = Field(ge=0, le=600)
    """Duration, in seconds; 0 takes the override back."""
    reason: str = Field(min_length=1, max_length=200)
    """Reason, for events and log."""
    lease: str
    """The sender's lease: it must cover the axis that the interlock binds, or all axes on the line of its output."""


class Rehearsal(StrEnum):
    """Who is to disappear."""

    DAEMON_STOP = "daemon_stop"
    """Do to the axis what its policy says for the end of the daemon, without ending."""
    BUS_LOSS = "bus_loss"
    """Drop the axis's line and open it again."""


class RehearsalReply(Frozen):
    """The loss was played: the reply to `@cmd/_/rehearse`."""

    kind: Rehearsal
    """Who disappeared."""
    axis: str
    """The axis."""
    policy: str
    """The configured policy for this loss."""


class Rehearse(Command[RehearsalReply]):
    """Rehearse a loss on one axis."""

    model_config = ConfigDict(title="RehearsalRequest")

    verb = "rehearse"
    about = About.RIG
    answer_s = 30.0

    kind: Rehearsal
    """Who is to disappear."""
    axis: str
    """Whose policy is rehearsed; a lost line concerns all axes on it."""
    lease: str | None = None
    """The sender's lease: it must cover the axis, or all axes on the line, where a motion of them would need one."""


class ConfigChange(Frozen):
    """A key at which the configuration file differs from what the daemon runs with."""

    key: str
    """Path of the key, such as `bus.line0.axis.x.limits.velocity`."""
    before: str | None
    """Value that the daemon runs with, a number of an axis with the unit that people read; null where there is none."""
    after: str | None
    """Value in the file; null where there is none."""
    restart: bool
    """Whether only a restart of the daemon takes it."""
    axis: str | None = None
    """Axis that keeps its value because another client controls it."""
    held_by: str | None = None
    """That client."""

    @property
    def taken(self) -> bool:
        """Whether a reload takes it."""
        return not self.restart and self.held_by is None

    def __str__(self) -> str:
        """Return it in words, for people."""
        words = f"{self.key}: {self.before or 'not set'} -> {self.after or 'not set'}"
        if self.restart:
            return f"{words} (needs a restart of the daemon)"
        return words if self.taken else f"{words} (not taken: {self.held_by} controls axis {self.axis})"


class ReloadReply(Frozen):
    """Changes of the configuration file: the reply to `@cmd/_/reload`."""

    changes: tuple[ConfigChange, ...]
    """Every key that differs, at most 100."""
    more: int = Field(default=0, ge=0)
    """Number of further keys that differ."""
    applied: bool
    """Whether the changes are in use that need no restart, and are of no axis that another client controls."""
    revision: str
    """Revision of the file as it was read, for a request that applies what was shown."""

    def lines(self) -> list[str]:
        """Return the changes for people, one in a line."""
        lines = [str(each) for each in self.changes]
        if self.more:
            lines.append(f"and {self.more} more")
        if not lines:
            lines.append("the daemon runs with what is in the file")
        elif self.applied:
            rest = self.more or any(not each.taken for each in self.changes)
            lines.append("reloaded; what is not taken, or needs a restart, stays as it is" if rest else "reloaded")
        return lines


class Reload(Command[ReloadReply]):
    """Read the configuration file again, and take what needs no restart; a motion under way keeps its values.

    What such a motion has still to begin, as the last leg of an approach, is held to the new ones.
    """

    verb = "reload"
    about = About.RIG
    answer_s = 15.0

    dry_run: bool = False
    """Whether the changes are only named."""
    revision: str | None = Field(default=None, max_length=64)
    """Revision whose changes were shown; with another one in the file the request is refused."""
    leases: tuple[Annotated[str, Field(max_length=64)], ...] = Field(default=(), max_length=128)
    """Leases of the sender. An axis that another client controls keeps its settings."""


class WireLogReply(Frozen):
    """Some consecutive records of a line, oldest first: the reply to `@cmd/_/wire_log`."""

    bus: str
    """The line."""
    family: str
    """The drive family on it: how the bytes are to be read."""
    zero: int
    """The wall time at which the records' clock was 0, UTC in ns since 1970."""
    started: float
    """Reading of that clock when the daemon was started, in seconds."""
    now: float
    """Reading of that clock at this reply, in seconds."""
    first_record: int = Field(ge=0)
    """Number of the first record in `lines`; records are counted since the daemon started."""
    next_record: int = Field(ge=0)
    """Number of the record behind the last one in `lines`: first number of the next request."""
    end_record: int = Field(ge=0)
    """Number that the next record to happen will get; equal to `next_record` when this reply has all."""
    lines: tuple[str, ...]
    """One record each: seconds, event, bytes in hexadecimal, and perhaps a remark behind a number sign."""


class ReadWireLog(Command[WireLogReply]):
    """Query the records of a line in the last seconds."""

    verb = "wire_log"
    about = About.RIG
    effect = Effect.QUESTION

    bus: str
    """Name of the line."""
    seconds: float = Field(default=10.0, gt=0, le=86_400)
    """How far back, in seconds; what is older than the recorder keeps is gone."""
    from_record: int | None = Field(default=None, ge=0, le=LARGEST_INTEGER)
    """Go on from this record; null for the first one within `seconds`."""


COMMANDS: tuple[type[Command[Frozen]], ...] = (
    *leases.COMMANDS,
    ReadOutcome,
    ReadEvents,
    Rehearse,
    MoveTogether,
    PreviewTogether,
    WalkPath,
    SetSpeedOverride,
    ReadWireLog,
    Snapshot,
    SetIo,
    SetIoTimer,
    OverrideInterlock,
    Reload,
)
"""The commands about the rig, those about control and events included."""
