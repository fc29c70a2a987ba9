"""Where an axis was at an instant: the answer to a query of `tele/<axis>/at`."""

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import InputLevels, Quality


class Within(Frozen):
    """A value that was not measured at its instant, and the bounds in which the true one lies."""

    value: float
    """The best estimate."""
    lower: float
    """The true value is not below this."""
    upper: float
    """The true value is not above this."""


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
    """The inputs, the same in the readings before and behind the instant; null where one of them changed meanwhile."""
    reason: str | None = None
    """Why nothing is known."""
