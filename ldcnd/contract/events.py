"""Events of commands: who moved what, when, with which result."""

from enum import StrEnum

from pydantic import Field

from ldcnd.contract.commands import About, Command, Effect
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen

ALARM_HISTORY = "alarm_history"
"""The verb of an event that no command has caused: a drive has entered an alarm in its own history."""
LATCH = "latch"
"""The verb of an event of the start: a stop is latched that an earlier daemon has kept."""
REFERENCE = "reference"
"""The verb of an event of the start: the reference that an earlier daemon has kept holds, or was refused."""
DRIVE_CHANGED = "drive_changed"
"""The verb of an event that no command has caused: a drive was reset, or changed by another program."""
INTERLOCK = "interlock"
"""The verb of an event that no command has caused: an interlock has ended a motion."""
LINK_LOST = "link_lost"
"""The verb of an event that no command has caused: a line or an I/O module has stopped answering; of a drive, a fault
says that."""
LINK_BACK = "link_back"
"""The verb of an event that no command has caused: a line, an I/O module or a drive answers again."""
UNSETTLED = "unsettled"
"""The verb of an event beside that of a motion that did not settle in its time."""


class CommandStatus(StrEnum):
    """How far a command has got; the last five are final."""

    ACCEPTED = "accepted"
    """Admitted: not refused yet."""
    EXECUTING = "executing"
    """The drive acknowledged it."""
    DONE = "done"
    """It ended as requested."""
    ABORTED = "aborted"
    """Another command, a stop or a loss policy ended it early."""
    REFUSED = "refused"
    """Nothing was sent to any drive."""
    FAILED = "failed"
    """The drive or the line failed."""
    UNKNOWN = "unknown"
    """It may or may not have been executed; the outcome is unknown."""


FINAL = frozenset(
    {
        CommandStatus.DONE,
        CommandStatus.ABORTED,
        CommandStatus.REFUSED,
        CommandStatus.FAILED,
        CommandStatus.UNKNOWN,
    }
)


class CommandOutcome(Frozen):
    """The outcome of a command: the reply to `@cmd/_/outcome`."""

    command_id: str
    """Id of the command."""
    axis: str
    """The axis."""
    verb: str
    """The verb of the command."""
    status: CommandStatus
    """How far it has got."""
    reason: str | None
    """Why, when it did not end as requested."""
    position: float | None = None
    """Position at the end of a motion, in axis units, measured after it; null where none was measured."""
    following_error: float | None = None
    """Target minus that position, in axis units; without a target what the drive reports, null where it does not."""
    settled: bool | None = None
    """Whether the axis came to rest within its window around the target in time; null for what has no target."""


class CommandEvent(CommandOutcome):
    """A command got further: published on `tele/<axis>/event`."""

    t: int
    """Instant of the event, UTC in ns since 1970; published up to 5 ms later."""
    seq: int = Field(ge=0)
    """Grows by one with every event of the axis."""
    run: str
    """The run of the daemon, as in `meta/daemon`: with another one, numbers restart."""
    number: int = Field(ge=0)
    """Grows by one with every event of the rig: a gap is filled by a request for what is missing."""
    axis: str
    """The axis, the I/O module or the line."""
    verb: str
    """The verb; `alarm_history` for an alarm that the drive has entered in its own history, `unsettled` for a
    motion that did not settle, `reference` for what became of a kept reference, `latch` for a stop that an earlier
    daemon has kept, `drive_changed` for a drive that was reset or that another program has changed, `interlock` for a
    motion that an interlock has ended, `link_lost` and `link_back` for what has stopped answering and answers again,
    and of an I/O module the situation for which its outputs were set, or `output_differs`: these have no request."""
    on: bool | None = None
    """Direction of `power`: true to close the loop, false to open it; null of every other verb."""
    client: str | None
    """The client, as it calls itself; not authenticated."""
    login: str | None = None
    """Common name of the certificate of the link that it came over; null behind a router, on links without certificates
    and when the sender does not say which link is its own: then nothing about it is authenticated."""
    reason: str | None = None
    """Why, when it did not end as requested; of one that moves nothing and is done, the values that it has set."""
    code: str | None = None
    """The error code, when there is one."""
    target: float | None = None
    """Position at which the motion is to come to rest, in axis units; null of what names none before it has begun, and
    of a motion that a command is to end."""
    last_position: float | None = None
    """Position that was read last when a motion ended otherwise than by coming to rest, such as one that was aborted,
    in axis units: the axis may have moved on. Null where `position` is known, and where it was never read."""


class EventList(Frozen):
    """Events, oldest first: the reply to `@cmd/_/events`."""

    run: str
    """The run of the daemon that they are of."""
    first_number: int = Field(ge=0)
    """Number from which on nothing was left out; above the requested number when that was discarded."""
    next_number: int = Field(ge=0)
    """First number of the next request."""
    end_number: int = Field(ge=0)
    """The number of the event that comes next."""
    events: tuple[CommandEvent, ...]
    """The events."""


class ReadOutcome(Command[CommandOutcome]):
    """Query the outcome of a command."""

    verb = "outcome"
    about = About.RIG
    effect = Effect.QUESTION

    command_id: str
    """Id of the command."""


class ReadEvents(Command[EventList]):
    """Query events: the latest, or those from a number on."""

    verb = "events"
    about = About.RIG
    effect = Effect.QUESTION

    axis: str | None = None
    """Axis whose events are wanted; none means all."""
    count: int = Field(default=100, ge=1, le=1000)
    """Maximum number, and never more than one reply takes."""
    from_number: int | None = Field(default=None, ge=0, le=LARGEST_INTEGER)
    """The first of these and later ones; the latest when missing."""
