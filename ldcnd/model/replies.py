"""What a command query is answered with when it is not refused."""

from typing import Literal

from pydantic import Field

from ldcnd.model.frozen import Frozen


class CommandReply(Frozen):
    """The drive acknowledged the command. Values are what the drive's registers make of those that were asked for."""

    command_id: str
    """Names the command in `state`, in events and in the log."""
    status: Literal["accepted"] = "accepted"
    """Accepted: acknowledged by the drive, not yet complete."""
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
    target: int | None = None
    """Target in A/D counts, for an analog move."""
    duty: float | None = None
    """Duty as the drive's register makes it, -1 to 1."""


class StopReply(Frozen):
    """The stop was sent; which axes confirmed it by the time of this answer."""

    status: Literal["stopping"] = "stopping"
    """Stopping: latched, nothing moves again before reset."""
    axes: tuple[str, ...]
    """The axes concerned."""
    confirmed: tuple[str, ...]
    """The axes whose drives acknowledged the stop."""
