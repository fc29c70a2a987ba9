"""`ldcnd tune`: identify an axis, propose gains, apply and verify them when a person agrees."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.cli.output import FAILED, show_lines
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.errors import ConfigError, WrongState

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ldcnd.client.kept_gains import KeptGains
    from ldcnd.tuning.ldcn.plan import Plan
    from ldcnd.tuning.ldcn.report import MoveFigures, TuningReport
    from ldcnd.tuning.ldcn.response import Floats
    from ldcnd.tuning.ldcn.session import Findings, Verified
    from ldcnd.tuning.ldcn.verdict import Measured

ROWS = 2
"""Of the picture: positions above, following errors below."""


@click.command()
@click.argument("axis", type=AXIS)
@click.option(
    "--bandwidth",
    "bandwidth_hz",
    type=Finite(1, 200),
    help="Wanted crossover of the loop, Hz; that which settles soonest when missing.",
)
@click.option(
    "--within",
    type=Finite(0, min_open=True),
    help="Stay within this distance of where the axis stands, in its unit; 2000 counts when missing.",
)
@click.option("--dry-run", is_flag=True, help="Say what it would do, and do nothing.")
@click.option("--yes", is_flag=True, help="Do not ask before moving, nor before applying.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw the test moves, measured beside predicted, to a picture such as a PNG; needs the extra `plot`.",
)
@click.option("--put-back", is_flag=True, help="Put back the gains that a tuning has left behind that was cut short.")
@with_target
def command(
    target: Target,
    axis: str,
    bandwidth_hz: float | None,
    within: float | None,
    plot: Path | None,
    *,
    dry_run: bool,
    yes: bool,
    put_back: bool,
) -> None:
    """Find gains for AXIS (LDCN and NMC drives): move it a little, identify it, propose, apply, verify.

    The axis must be off and stay where it is then. It is off afterwards. What it will do is said before it moves; it
    moves within the stated distance only. The old gains come back at Ctrl-C, on any fault, and when the new ones are
    not better; if this program or its host dies, --put-back restores them. Needs the extra `tune`.
    """
    if put_back:
        kept = target.run(lambda client: _put_back(client, axis))
        target.show(kept, f"{axis}: off, with its old gains: {_gains(kept.gains)}")
        return
    _require_numpy()
    from ldcnd.tuning.ldcn import plan as plans  # noqa: PLC0415 - needs an optional package
    from ldcnd.tuning.ldcn import report as reports  # noqa: PLC0415 - likewise
    from ldcnd.tuning.ldcn import session  # noqa: PLC0415 - likewise

    figure = stacked_rows(ROWS)[0] if plot else None  # missing matplotlib is said before anything moves

    async def planned(client: RigClient) -> "Plan":
        await axis_of(client, axis)
        return await plans.plan(client, axis, within)

    plan = target.run(planned)
    if dry_run:
        target.show(reports.plan_reported(plan), *plan.lines, "Nothing was sent to the drive.")
        return
    show_lines(*plan.lines, err=target.as_json)
    if not yes:
        click.confirm(f"Move {axis} now?", abort=True, err=True)
    end_as_interrupted()
    found = target.run(lambda client: session.measure(client, plan, bandwidth_hz, _tell))
    if not yes:
        show_lines(*_table(reports.reported(found)), err=target.as_json)
        if not click.confirm(f"Load these gains into {axis} and make the test move?", err=True):
            target.show(reports.reported(found), f"{axis}: off, with its old gains")
            raise click.Abort
    verified = target.run(lambda client: session.verify(client, found, _tell))
    report = reports.reported(found, verified)
    if plot and figure:
        _draw(figure, found, verified)
        save_figure(figure, plot)
    target.show(report, *_table(report), *_ending(report))
    if not report.applied:
        sys.exit(FAILED)


def _require_numpy() -> None:
    """Refuse to begin without the optional package.

    Raises:
        ConfigError: it is missing.
    """
    if find_spec("numpy") is None:
        raise ConfigError("tuning needs numpy; install it with: pip install 'ldcnd[tune]'")


def _tell(line: str) -> None:
    show_lines(line, err=True)


async def _put_back(client: RigClient, axis: str) -> "KeptGains":
    from ldcnd.client.kept_gains import file_of, kept_for, put_back  # noqa: PLC0415 - nothing else needs it

    await axis_of(client, axis)
    rig = Rig(client, await client.daemon())
    kept = kept_for(rig.name, axis)
    if kept is None:
        raise WrongState(
            f"axis {axis}: no gains of an unfinished tuning are kept on this host ({file_of(rig.name, axis)})",
            axis=axis,
            remedy="type it on the host that tuned; or restart the daemon, which loads the configured gains",
        )
    await put_back(rig, kept, "ldcnd tune")
    return kept


def _gains(gains: dict[str, int]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in gains.items())


def _table(report: "TuningReport") -> list[str]:
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
        f"old gains: {_gains(report.old_gains)}",
        f"new gains: {_gains(report.gains)}",
        f"bandwidth {margins.bandwidth_hz:.1f} Hz, phase margin {margins.phase_deg:.0f} degrees, gain margin {gain}",
        f"test move of {report.distance:g} {report.unit}:",
        *("  " + " ".join(f"{cell:>18}" for cell in row) for row in rows),
    ]


def _shown(figures: "MoveFigures | None", title: str, unit: str) -> str:
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


def _ending(report: "TuningReport") -> list[str]:
    if not report.applied:
        return [f"{report.axis}: not better: {report.objection}; it is off, with its old gains"]
    return [
        f"{report.axis}: off, with the new gains until the next start of the daemon; to keep them, configure:",
        f"gains = {{ {_gains(report.gains)} }}",
    ]


def _draw(figure: "Figure", found: "Findings", verified: "Verified") -> None:
    """Draw the first way of each test move: positions, and what they are behind the command."""
    above, below = figure.axes
    scale = found.plan.units(1.0)

    def line(move: "Measured", positions: "Floats", label: str, style: str = "-") -> None:
        """Draw it forward, whichever way it went."""
        forward = scale if move.commanded[-1] >= 0 else -scale
        above.plot(move.times_s * 1e3, positions * forward, style, label=label)
        below.plot(move.times_s * 1e3, (move.commanded - positions) * forward, style, label=label)

    for move in found.before[:1]:
        line(move, move.positions, "old gains, measured")
    for move in verified.after[:1]:
        line(move, move.positions, "new gains, measured")
        line(move, move.predicted, "new gains, predicted", "--")
        line(move, move.commanded, "command", ":k")
    above.set_ylabel(f"position\n[{found.plan.info.unit}]")
    below.set_ylabel(f"following error\n[{found.plan.info.unit}]")
    below.set_xlabel("ms")
    above.legend(fontsize="small")
    figure.suptitle(f"{found.plan.info.axis}: test move")
