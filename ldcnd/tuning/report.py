"""What tuning has found out, proposed and measured: one document, for people and programs."""

from ldcnd.model.frozen import Frozen


class Estimate(Frozen):
    """A quantity of the model, and how well it is known."""

    value: float
    """The best estimate."""
    interval: float
    """Half the width of the 95 % interval."""
    unit: str
    """Unit of both."""


class MoveFigures(Frozen):
    """Figures of the test move there and back, the worse of the two ways; predicted ones are of one way."""

    settling_s: float
    """From the end of the commanded motion until the position stays near the goal, seconds."""
    settled: bool
    """It stays there."""
    overshoot: float
    """Farthest beyond the goal, as a share of the distance."""
    following_error: float
    """The largest, in axis units."""
    error: float
    """Position error at the end, in axis units."""


class LoopMargins(Frozen):
    """Stability margins of the proposed loop on the estimated plant."""

    bandwidth_hz: float
    """Where the gain of the loop is 1."""
    phase_deg: float
    """Phase margin."""
    gain_db: float | None
    """Gain margin; null where the phase never reaches -180 degrees."""


class TuningReport(Frozen):
    """The result of `ldcnd tune`."""

    axis: str
    """The axis."""
    unit: str
    """Its unit."""
    within: float
    """The stated distance: no farther than this from where it stood, in axis units."""
    farthest: float
    """The farthest place that traces show, likewise."""
    plant: dict[str, Estimate]
    """The identified model."""
    left_counts: float
    """Standard deviation of what the model leaves of the traces, counts."""
    distance: float
    """Of the test move, in axis units."""
    old_gains: dict[str, int]
    """As they were before."""
    gains: dict[str, int]
    """As proposed."""
    margins: LoopMargins
    """Of the proposal."""
    predicted: MoveFigures
    """Of the test move with the proposal, by the model."""
    before: MoveFigures | None
    """Measured with the old gains; null where the drive gave up, or the model forbade the try."""
    after: MoveFigures | None = None
    """Measured with the proposal; null where it was not tried, or the drive gave up."""
    objection: str | None = None
    """Why the proposal is not better; null where it is at least as good, or was not tried."""
    applied: bool = False
    """The proposed gains are in the drive; otherwise the old ones are."""
