"""Where an axis was at an instant: the answer to a query of `tele/<axis>/at`."""

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import Quality


class Within(Frozen):
    """A value that was not measured at its instant, and the bounds in which the true one lies."""

    value: float
    """The best estimate."""
    lower: float
    """The true value is not below this."""
    upper: float
    """The true value is not above this."""


class InputLevels(Frozen):
    """The inputs of a drive, the same in the readings before and behind an instant; null while one is not shown."""

    reverse_limit: bool | None
    """Level of the reverse limit switch input."""
    forward_limit: bool | None
    """Level of the forward limit switch input."""
    index: bool | None
    """Level of the encoder's index."""
    stop_input: bool | None
    """The stop input is open."""
    amplifier_enable: bool | None
    """The amplifier enable."""


class AxisInstant(Frozen):
    """Place and velocity of an axis at an instant, in the coordinates of then: `_time` of the selector names it.

    `_time` is ns since 1970 (UTC), RFC 3339, or `now(-2s)`. Readings of the last 600 s answer, from two polls ago on.
    """

    t: int
    """The instant, UTC in ns since 1970."""
    unit: str
    """The axis unit."""
    quality: Quality
    """How much it is worth; bad where nothing is known."""
    position: Within | None = None
    """Position in axis units, counted through all turns; null where it is not known."""
    velocity: Within | None = None
    """Velocity in axis units a second; likewise."""
    inputs: InputLevels | None = None
    """The inputs; null where one of them changed meanwhile."""
    reason: str | None = None
    """Why nothing is known."""
