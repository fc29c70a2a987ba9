"""Questions about an axis: why it cannot move, what a motion would do; and what an observer has found."""

from pydantic import Field
from typing_extensions import override

from ldcnd.contract.commands import LATEST_NS, About, Command, Direction, Effect, ErrorReply, RemedyStep, Verb
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen
from ldcnd.contract.samples import MOST_SHADOW_FIGURES, ShadowFigure


class Cause(Frozen):
    """One thing that forbids a motion."""

    code: str
    """The error code that a motion would be refused with."""
    text: str
    """The obstacle, in one sentence."""
    remedy: str | None
    """The command, or the hand, that clears it."""
    steps: tuple[RemedyStep, ...] = ()
    """The commands that the remedy names, in their order."""
    page: str | None = None
    """Path of its page below a console or the documentation."""
    passes: bool = False
    """It ends with the motion under way: a move with another `buffer_mode` than refuse is not refused for it."""


class Hindered(Frozen):
    """Commands of an axis that the same obstacles forbid, or none."""

    verbs: tuple[str, ...]
    """The commands; `power` is to close the loop, as to open it is never refused."""
    causes: tuple[Cause, ...]
    """The obstacles; the first is what they would be refused with, if their values are right."""


class WhyReply(Frozen):
    """The causal chain: the reply to `@cmd/<axis>/why`."""

    axis: str
    """The axis."""
    can_move: bool
    """Whether a motion within the limits, or the command that was asked about, would be accepted from the sender."""
    causes: tuple[Cause, ...]
    """The obstacles, in the order in which they have to be cleared."""
    first_fault: str | None
    """The first fault since the last reset, a warning only if none stops; null when there was none."""
    overrides: tuple[str, ...] = ()
    """Overridden interlocks that bind the axis or an output of its line: which, by whom, for how long still; for
    people."""
    commands: tuple[Hindered, ...] = ()
    """What forbids each command of the axis, if that was asked."""


class Why(Command[WhyReply]):
    """Report why an axis cannot move."""

    verb = "why"
    about = About.AXIS
    effect = Effect.QUESTION

    lease: str | None = None
    """The lease under which the motion would be sent."""
    absolute: bool = True
    """Whether the motion would name a position, which needs a referenced axis."""
    command: Verb | None = None
    """Command that is asked about; any motion, with or without a position, when missing."""
    each_command: bool = False
    """Whether to say of each command of the axis as well what forbids it."""


class PreviewReply(Frozen):
    """The motion as it would be; nothing was sent: the reply to `@cmd/<axis>/preview`."""

    axis: str
    """The axis."""
    refusal: ErrorReply | None
    """Why its values would be refused, with the nearest that would not; null when they would be accepted."""
    obstacles: tuple[str, ...]
    """The other obstacles now; see `why`."""
    position: float | None = None
    """Position at the end, in axis units; null when the motion has no end."""
    ends: str | None = None
    """What ends a motion at a velocity that nobody stops, and when, for people; null for all others."""
    approach_from: float | None = None
    """Position to which the axis would go first, to come to its end from the configured side; null when one motion
    will do."""
    velocity: float | None = None
    """Velocity that the registers would hold, units a second."""
    velocity_error: float | None = None
    """Held velocity minus the requested one at the speed override of the rig, units a second."""
    acceleration: float | None = None
    """Acceleration that the registers would hold, units a second squared."""
    acceleration_error: float | None = None
    """Held minus requested acceleration, units a second squared."""
    duration_s: float | None = None
    """Duration of the profile, in seconds, without settling; null when it has no end."""
    packets: tuple[str, ...] = ()
    """The packets that would be sent, without those that only read, in hexadecimal."""
    bus_s: float | None = None
    """Longest time for which these would occupy the line, in seconds."""


class Preview(Command[PreviewReply]):
    """Compute what a motion would do; exactly one of position, distance and velocity alone selects the motion."""

    verb = "preview"
    about = About.AXIS
    effect = Effect.QUESTION

    position: float | None = None
    """A move to this position, in axis units."""
    direction: Direction | None = None
    """Way to turn to a position on an axis with a modulo."""
    distance: float | None = None
    """A move by this distance, in axis units."""
    velocity: float | None = None
    """Speed of the move; alone: a motion at this velocity, signed. Units a second."""
    acceleration: float | None = Field(default=None, gt=0)
    """Units a second squared; the axis default when missing."""

    @property
    def motion(self) -> Verb:
        """The command that would begin the motion."""
        if self.position is not None:
            return Verb.MOVE_ABSOLUTE
        return Verb.MOVE_VELOCITY if self.distance is None else Verb.MOVE_RELATIVE


class ShadowReply(Frozen):
    """What an observer says was published: the reply to `@cmd/<axis>/report_shadow`."""

    axis: str
    """The axis."""


class ReportShadow(Command[ShadowReply]):
    """Publish what an observer has found in the motions of an axis, on `tele/<axis>/shadow`; it stops nothing."""

    verb = "report_shadow"
    about = About.AXIS

    t: int = Field(ge=0, le=LATEST_NS)
    """Instant of the last position that the observer has seen, UTC in ns since 1970."""
    learning: bool
    """It still learns what is usual."""
    judged: int = Field(ge=0, le=LARGEST_INTEGER)
    """Motions that have taught or were judged since the observer began."""
    figures: tuple[ShadowFigure, ...] = Field(default=(), max_length=MOST_SHADOW_FIGURES)
    """Those of which enough is known."""

    @classmethod
    @override
    def needs_lease(cls) -> bool:
        return False  # an observer speaks for the daemon, and controls no axis


COMMANDS: tuple[type[Command[Frozen]], ...] = (Why, Preview, ReportShadow)
"""The commands of this file."""
