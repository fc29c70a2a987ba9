"""Tuning with a person: what would move is said and agreed to, what was found is shown, gains are loaded on consent.

The lines that show a report are here, too, for whoever prints one.
"""

from dataclasses import dataclass

from ldcnd.bench.person import MoveCurve, Person
from ldcnd.bench.tuning.ldcn.plan import plan
from ldcnd.bench.tuning.ldcn.report import MoveFigures, TuningReport, curves_of, reported
from ldcnd.bench.tuning.ldcn.session import measure, verify
from ldcnd.client.rig_client import RigClient


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
        (title, *(_shown(figures, title, report.unit) for figures in columns.values()))
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


def _shown(figures: MoveFigures | None, title: str, unit: str) -> str:
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
