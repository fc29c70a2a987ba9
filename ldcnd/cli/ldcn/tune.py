"""`ldcnd tune` of an axis whose gains a host finds: identify, propose, apply and verify when a person agrees."""

import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

import click

from ldcnd.bench.person import Left
from ldcnd.cli.connection import Target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.figure import save_figure, stacked_rows
from ldcnd.cli.output import FAILED
from ldcnd.cli.terminal_person import AssentingPerson, TerminalPerson
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.meta import AxisInfo

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ldcnd.bench.tuning.ldcn.guided import Tuned
    from ldcnd.cli.tune import TuneOptions

ROWS = 2
"""Of the picture: positions above, following errors below."""
STYLES = {"new gains, predicted": "--", "command": ":k"}


def tune(target: Target, info: AxisInfo, options: "TuneOptions") -> None:
    """Tune an axis of an LDCN or NMC drive."""
    options.refuse("the gains of this drive are found, not typed; see `ldcnd axis gains`", "values", "record_s")
    _require_numpy()
    from ldcnd.bench.tuning.ldcn import guided  # noqa: PLC0415 - needs an optional package
    from ldcnd.bench.tuning.ldcn import plan as plans  # noqa: PLC0415 - likewise
    from ldcnd.bench.tuning.ldcn import report as reports  # noqa: PLC0415 - likewise

    axis = info.axis
    figure = stacked_rows(ROWS)[0] if options.plot else None  # missing matplotlib is said before anything moves
    if options.dry_run:
        plan = target.run(lambda client: plans.plan(client, axis, options.within))
        target.show(reports.plan_reported(plan), *plan.lines, "Nothing was sent to the drive.")
        return

    async def tuned(client: RigClient) -> "Tuned | None":
        person = AssentingPerson(None) if options.yes else TerminalPerson(None)
        try:
            return await guided.tune(client, person, axis, options.within, options.bandwidth_hz)
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
    if figure and options.plot:
        _draw(figure, outcome)
        save_figure(figure, options.plot)
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
