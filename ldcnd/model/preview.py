"""What a move would do: asked before it is commanded."""

from pydantic import Field

from ldcnd.model.errors import ErrorReply
from ldcnd.model.frozen import Frozen


class PlanRequest(Frozen):
    """Ask what a motion would do; exactly one of position, distance and velocity-alone says which motion is meant."""

    position: float | None = None
    """A move to this position, in axis units."""
    distance: float | None = None
    """A move by this distance, in axis units."""
    velocity: float | None = None
    """Speed of the move; alone: a motion at this velocity, signed. Units a second."""
    acceleration: float | None = Field(default=None, gt=0)
    """Units a second squared; the axis default when missing."""


class PlanReply(Frozen):
    """What the motion would be; nothing was sent: the reply to `@cmd/<axis>/plan`."""

    axis: str
    """The axis."""
    refusal: ErrorReply | None
    """Why its values would be refused, with the nearest that would not; null when they would be accepted."""
    obstacles: tuple[str, ...]
    """What else is in the way now; see `why`."""
    position: float | None = None
    """Where it would end, in axis units; null when it has no end."""
    velocity: float | None = None
    """Velocity that the registers would hold, units a second."""
    velocity_error: float | None = None
    """Held minus asked."""
    acceleration: float | None = None
    """Acceleration that the registers would hold, units a second squared."""
    acceleration_error: float | None = None
    """Held minus asked."""
    duration_s: float | None = None
    """Of the profile, without settling; null when it has no end."""
    packets: tuple[str, ...] = ()
    """What would be sent, in hexadecimal."""
    bus_s: float | None = None
    """For how long that would occupy the line at most, in seconds."""
