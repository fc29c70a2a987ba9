"""What tuning has found out, proposed and measured: one document, and going through it with a person."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ldcnd.bench.person import MoveCurve, Person
from ldcnd.bench.tuning.plan import Plan, plan
from ldcnd.bench.tuning.response import Figures, Floats
from ldcnd.bench.tuning.session import Findings, VerifiedMove, measure, registers_of, verify
from ldcnd.bench.tuning.verdict import Measured, worst
from ldcnd.client.rig_client import RigClient
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


@dataclass(frozen=True, slots=True)
class Tuned:
    """What a person has let happen.

    Attributes:
        report: of it; without `after` where the proposal was not wanted.
        curves: the test moves, to be drawn.
    """

    report: TuningReport
    curves: tuple[MoveCurve, ...]


async def tune(
    client: RigClient, person: Person, name: str, within: float | None, bandwidth_hz: float | None
) -> Tuned | None:
    """Say what would move, identify an axis, propose gains, load and verify them, each when the person agrees.

    Args:
        client: of the rig.
        person: sees and decides.
        name: of the axis, which is off, and is off afterwards.
        within: the distance from where it stands that it may not leave, in axis units; 2000 counts when missing.
        bandwidth_hz: crossover that is wanted; chosen when None.

    Returns:
        None when it was not to move.

    Raises:
        Left: the person has left; the old gains are back.
        LdcndError: it cannot be tuned, or as the daemon refused it; likewise.
    """
    planned = await plan(client, name, within)
    person.tell(*planned.lines)
    if not await person.confirm(f"move {name} now"):
        return None
    found = await measure(client, planned, bandwidth_hz, person.tell)
    measured = reported(found)
    person.tell(*table(measured))
    if not await person.confirm(f"load these gains into {name} and make the test move"):
        person.tell(f"{name}: off, with its old gains")
        return Tuned(measured, curves_of(found))
    verified = await verify(client, found, person.tell)
    return Tuned(reported(found, verified), curves_of(found, verified))


def table(report: TuningReport) -> list[str]:
    """Return model, gains, and predicted beside measured."""
    plant = ", ".join(
        f"{name.split('_')[0]} {each.value:.4g} +- {each.interval:.2g} {each.unit}"
        for name, each in report.plant.items()
    )
    margins = report.margins
    gain = "no limit" if margins.gain_db is None else f"{margins.gain_db:.0f} dB"
    columns = {"old gains": report.before, "predicted": report.predicted, "new gains": report.after}
    rows = [("", *columns)] + [
        (title, *(_cell(figures, title, report.unit) for figures in columns.values()))
        for title in ("settling", "overshoot", "following error", "error at the end")
    ]
    return [
        f"model: {plant}",
        f"old gains: {listed(report.old_gains)}",
        f"new gains: {listed(report.gains)}",
        f"bandwidth {margins.bandwidth_hz:.1f} Hz, phase margin {margins.phase_deg:.0f} degrees, gain margin {gain}",
        f"test move of {report.distance:g} {report.unit}:",
        *("  " + " ".join(f"{cell:>18}" for cell in row) for row in rows),
    ]


def ending(report: TuningReport) -> list[str]:
    """Return which gains the axis has now, and why."""
    if not report.applied:
        return [f"{report.axis}: not better: {report.objection}; it is off, with its old gains"]
    return [
        f"{report.axis}: off, with the new gains until the next start of the daemon",
        "to keep them, configure, in the place of the gains that it has there:",
        f"gains = {{ {listed(report.gains)} }}",
    ]


def listed(gains: dict[str, int]) -> str:
    """Return gains as a configuration has them."""
    return ", ".join(f"{name} = {value}" for name, value in gains.items())


def _cell(figures: MoveFigures | None, title: str, unit: str) -> str:
    if figures is None:
        return "-"
    match title:
        case "settling":
            return f"{figures.settling_s * 1e3:.0f} ms" if figures.settled else "not settled"
        case "overshoot":
            return f"{figures.overshoot:.1%}"
        case "following error":
            return f"{figures.following_error:.4g} {unit}"
        case _:
            return f"{figures.error:.4g} {unit}"
