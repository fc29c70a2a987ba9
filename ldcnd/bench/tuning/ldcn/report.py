"""What tuning has found out, proposed and measured: one document, for people and programs."""

import math
from collections.abc import Sequence

from ldcnd.bench.person import MoveCurve
from ldcnd.bench.tuning.ldcn.plan import Plan
from ldcnd.bench.tuning.ldcn.response import Figures, Floats
from ldcnd.bench.tuning.ldcn.session import Findings, VerifiedMove, registers_of
from ldcnd.bench.tuning.ldcn.verdict import Measured, worst
from ldcnd.contract.frozen import Frozen


class TuningPlan(Frozen):
    """What `ldcnd tune --dry-run` says it would do."""

    axis: str
    """The axis."""
    unit: str
    """Its unit."""
    within: float
    """It stays so near to where it stands, in axis units."""
    within_counts: int
    """Likewise, in counts."""
    lines: tuple[str, ...]
    """The same and the rest for people."""


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


def plan_reported(planned: Plan) -> TuningPlan:
    """Return a plan as a document."""
    counts = planned.bounds.within_counts
    return TuningPlan(
        axis=planned.info.axis,
        unit=planned.info.unit,
        within=planned.units(counts),
        within_counts=counts,
        lines=planned.lines,
    )


def reported(found: Findings, verified: VerifiedMove | None = None) -> TuningReport:
    """Return everything that was found out, as one document."""
    planned, plant, spread = found.plan, found.known.plant, found.known.interval
    info = planned.info
    units = {
        "acceleration": "counts/s^2 per PWM step",
        "damping_per_s": "1/s",
        "friction_pwm": "PWM steps",
        "load_pwm": "PWM steps",
        "delay_s": "s",
        "backlash_counts": "counts",
    }
    margins = found.proposal.margins
    return TuningReport(
        axis=info.axis,
        unit=info.unit,
        within=planned.units(planned.bounds.within_counts),
        farthest=planned.units(max(found.farthest_counts, verified.farthest_counts if verified else 0)),
        plant={
            name: Estimate(value=getattr(plant, name), interval=getattr(spread, name), unit=unit)
            for name, unit in units.items()
        },
        left_counts=found.known.left_counts,
        distance=planned.units(abs(found.move.distance_counts)),
        old_gains=found.old,
        gains=registers_of(found.proposal.gains, found.old),
        margins=LoopMargins(
            bandwidth_hz=margins.crossover_hz,
            phase_deg=margins.phase_deg,
            gain_db=margins.gain_db if math.isfinite(margins.gain_db) else None,
        ),
        predicted=_shown(planned, found.proposal.figures),
        before=_shown_worst(planned, found.before),
        after=_shown_worst(planned, verified.after) if verified else None,
        objection=verified.objection if verified else None,
        applied=verified is not None and verified.objection is None,
    )


def curves_of(found: Findings, verified: VerifiedMove | None = None) -> tuple[MoveCurve, ...]:
    """Return the first way of each test move: measured with the old gains, with the new ones, predicted, commanded."""
    drawn = [("old gains, measured", move, move.positions) for move in found.before[:1]]
    for move in verified.after[:1] if verified else ():
        drawn += [
            ("new gains, measured", move, move.positions),
            ("new gains, predicted", move, move.predicted),
            ("command", move, move.commanded),
        ]
    return tuple(_curve(found.plan, label, move, positions) for label, move, positions in drawn)


def _curve(planned: Plan, label: str, move: Measured, positions: Floats) -> MoveCurve:
    scale = planned.units(1.0) * (1 if move.commanded[-1] >= 0 else -1)
    return MoveCurve(
        label=label,
        times_s=tuple(map(float, move.times_s)),
        positions=tuple(map(float, positions * scale)),
        following_errors=tuple(map(float, (move.commanded - positions) * scale)),
    )


def _shown_worst(planned: Plan, moves: Sequence[Measured]) -> MoveFigures | None:
    figures = worst(moves)
    return _shown(planned, figures) if figures else None


def _shown(planned: Plan, figures: Figures) -> MoveFigures:
    return MoveFigures(
        settling_s=figures.settling_s,
        settled=figures.settled,
        overshoot=figures.overshoot,
        following_error=planned.units(figures.following_error_counts),
        error=planned.units(figures.error_counts),
    )
