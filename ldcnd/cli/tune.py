"""`ldcnd tune`: gains that a host finds: identify, propose, apply and verify when a person agrees."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.bench.person import Left
from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.cli.output import FAILED
from ldcnd.cli.terminal_person import AssentingPerson, TerminalPerson
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.kept_gains import KeptGains, file_of, kept_for
from ldcnd.client.kept_gains import put_back as put_back_gains
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError, NotSupported, WrongState
from ldcnd.drives.known import FAMILIES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ldcnd.bench.tuning.ldcn.guided import Tuned

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
    """Find gains for AXIS: move it a little, identify it, propose, apply, verify.

    An axis whose gains are registers must be off and stay where it is then. It is off afterwards. What it will do is
    said before it moves; it moves within the stated distance only. The old gains come back at Ctrl-C, on any fault, and
    when the new ones are not better; if this program or its host dies, --put-back restores them. It needs the extra
    `tune`. A drive that tunes itself is not tuned here.
    """
    info = target.run(lambda client: axis_of(client, axis))
    if put_back:
        kept = target.run(lambda client: _put_back(client, axis))
        gains = ", ".join(f"{name} = {value}" for name, value in kept.gains.items())
        target.show(kept, f"{axis}: off, with its old gains: {gains}")
        return
    family = FAMILIES.get(info.family)
    if family is None or not family.is_tuned_by_host:
        raise NotSupported(f"axis {axis}: the gains of a {info.model} are not found by the host", axis=axis)
    _require_numpy()
    figure = stacked_rows(ROWS)[0] if plot else None  # missing matplotlib is reported before anything moves
    if dry_run:
        _plan(target, axis, within)
        return
    tuned = _tune(target, axis, within, bandwidth_hz, asks=not yes)
    if figure and plot:
        _draw(figure, tuned)
        save_figure(figure, plot)
    _show(target, tuned)


async def _put_back(client: RigClient, axis: str) -> KeptGains:
    rig = Rig(client, await client.daemon())
    kept = kept_for(rig.name, axis)
    if kept is None:
        raise WrongState(
            f"axis {axis}: no gains of an unfinished tuning are kept on this host ({file_of(rig.name, axis)})",
            axis=axis,
            remedy="type it on the host that tuned; or restart the daemon, which loads the configured gains",
        )
    await put_back_gains(rig, kept, program_name("ldcnd tune"))
    return kept


def _plan(target: Target, axis: str, within: float | None) -> None:
    from ldcnd.bench.tuning.ldcn import plan as plans  # noqa: PLC0415 - needs an optional package
    from ldcnd.bench.tuning.ldcn import report as reports  # noqa: PLC0415 - likewise

    plan = target.run(lambda client: plans.plan(client, axis, within))
    target.show(reports.plan_reported(plan), *plan.lines, "Nothing was sent to the drive.")


def _tune(target: Target, axis: str, within: float | None, bandwidth_hz: float | None, *, asks: bool) -> "Tuned":
    """Tune an axis.

    Raises:
        click.Abort: the person has left, or did not agree to the proposal; the old gains are back.
    """
    from ldcnd.bench.tuning.ldcn import guided  # noqa: PLC0415 - needs an optional package

    async def tuned(client: RigClient) -> "Tuned | None":
        person = TerminalPerson(None) if asks else AssentingPerson(None)
        try:
            return await guided.tune(client, person, axis, within, bandwidth_hz)
        except Left:
            return None

    end_as_interrupted()
    outcome = target.run(tuned)
    if outcome is None:
        raise click.Abort
    if outcome.report.after is None and outcome.report.objection is None:
        target.show(outcome.report)
        raise click.Abort
    return outcome


def _show(target: Target, tuned: "Tuned") -> None:
    from ldcnd.bench.tuning.ldcn import guided  # noqa: PLC0415 - needs an optional package

    report = tuned.report
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
