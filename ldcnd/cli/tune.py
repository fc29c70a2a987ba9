"""`ldcnd tune`: identify an axis, propose gains, apply and verify them when a person agrees."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.cli.output import FAILED
from ldcnd.cli.terminal_person import AssentingPerson, TerminalPerson
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.errors import ConfigError, WrongState
from ldcnd.person import Left

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ldcnd.client.kept_gains import KeptGains
    from ldcnd.tuning.ldcn.guided import Tuned

ROWS = 2
"""Of the picture: positions above, following errors below."""
STYLES = {"new gains, predicted": "--", "command": ":k"}


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
        gains = ", ".join(f"{name} = {value}" for name, value in kept.gains.items())
        target.show(kept, f"{axis}: off, with its old gains: {gains}")
        return
    _require_numpy()
    from ldcnd.tuning.ldcn import guided  # noqa: PLC0415 - needs an optional package
    from ldcnd.tuning.ldcn import plan as plans  # noqa: PLC0415 - likewise
    from ldcnd.tuning.ldcn import report as reports  # noqa: PLC0415 - likewise

    figure = stacked_rows(ROWS)[0] if plot else None  # missing matplotlib is said before anything moves
    if dry_run:
        plan = target.run(lambda client: plans.plan(client, axis, within))
        target.show(reports.plan_reported(plan), *plan.lines, "Nothing was sent to the drive.")
        return

    async def tuned(client: RigClient) -> "Tuned | None":
        await axis_of(client, axis)
        person = AssentingPerson(None) if yes else TerminalPerson(None)
        try:
            return await guided.tune(client, person, axis, within, bandwidth_hz)
        except Left:
            return None

    end_as_interrupted()
    outcome = target.run(tuned)
    if outcome is None:
        raise click.Abort
    report = outcome.report
    if report.after is None and report.objection is None:
        target.show(report)
        raise click.Abort
    if figure and plot:
        _draw(figure, outcome)
        save_figure(figure, plot)
    target.show(report, *guided.table(report), *guided.ending(report))
    if not report.applied:
        sys.exit(FAILED)


def _require_numpy() -> None:
    """Refuse to begin without the optional package.

    Raises:
        ConfigError: it is missing.
    """
    if find_spec("numpy") is None:
        raise ConfigError("tuning needs numpy; install it with: pip install 'ldcnd[tune]'")


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


def _draw(figure: "Figure", tuned: "Tuned") -> None:
    """Draw the test moves: positions, and what they are behind the command."""
    above, below = figure.axes
    for curve in tuned.curves:
        times_ms = [each * 1e3 for each in curve.times_s]
        style = STYLES.get(curve.label, "-")
        above.plot(times_ms, curve.positions, style, label=curve.label)
        below.plot(times_ms, curve.following_errors, style, label=curve.label)
    unit = tuned.report.unit
    above.set_ylabel(f"position\n[{unit}]")
    below.set_ylabel(f"following error\n[{unit}]")
    below.set_xlabel("ms")
    above.legend(fontsize="small")
    figure.suptitle(f"{tuned.report.axis}: test move")
