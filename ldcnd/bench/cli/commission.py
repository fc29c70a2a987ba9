"""Commands that bring an axis into service and keep it there: the checklist, tuning, friction that grows."""

import asyncio
import getpass
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd import durable
from ldcnd.bench.cli.terminal_person import AssentingPerson, TerminalPerson
from ldcnd.bench.commissioning.checklist import STEPS, Checklist, ChecklistWalk, change_of
from ldcnd.bench.commissioning.checklist import axis_of as configured_axis
from ldcnd.bench.commissioning.gains import gain_proposals
from ldcnd.bench.commissioning.record import StepRecord
from ldcnd.bench.commissioning.report import html_of
from ldcnd.bench.kept_gains import KeptGains, file_of, kept_for
from ldcnd.bench.kept_gains import put_back as put_back_gains
from ldcnd.bench.known import BENCHES
from ldcnd.bench.person import Left, Person
from ldcnd.cli.connection import AXIS, AxisName, Target, with_target
from ldcnd.cli.output import FAILED, end_as_interrupted, on_end, show_lines
from ldcnd.cli.quantities import save_figure, stacked_rows
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import CONFIGURATION, Finite, NewFile, Quantity, TypedNumber, force_option, in_unit
from ldcnd.client.lease import program_name
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.edit import write_over
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError, NotSupported, WrongState
from ldcnd.contract.units import Dimension
from ldcnd.parts import require
from ldcnd.version import version

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ldcnd.bench.tuning.report import Tuned
    from ldcnd.bench.tuning.watching import ShadowAlarm


@click.command()
@click.argument("axis", type=AxisName("login"))
@click.option(
    "--config",
    type=CONFIGURATION,
    required=True,
    help="The rig's configuration (TOML); the record is kept beside it.",
)
@click.option("--step", "name", type=click.Choice(list(STEPS)), help="Run this step only, done or not.")
@click.option("--list", "only_list", is_flag=True, help="Show the checklist; run nothing.")
@click.option(
    "--report",
    type=NewFile(),
    help="Write a report of everything that is known at the end (HTML).",
)
@force_option
@click.option(
    "--for", "for_s", type=Finite(0, 3600, min_open=True), help="Longest motion of a step, seconds, instead of a key."
)
@click.option("--by", default=getpass.getuser, show_default="the login", help="Who answers, for the record.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines: the record of each step.")
@click.option(
    "--connect", "-e", multiple=True, envvar="LDCND_CONNECT", help="Zenoh endpoint of the daemon, or HOST:PORT."
)
@click.option("--login", type=CONFIGURATION, help="Zenoh configuration file, as `ldcnd pki` makes it.")
def commission(
    axis: str,
    config: Path,
    name: str | None,
    report: Path | None,
    for_s: float | None,
    by: str,
    connect: tuple[str, ...],
    login: Path | None,
    *,
    only_list: bool,
    as_json: bool,
) -> None:
    """Go through the checklist of AXIS, step by step; leave it at any question, and go on another time.

    Each step says what will move, how far and what catches it, and asks. It moves only while the space bar is held, or
    with --for for a time, and is halted at Ctrl-C and when the terminal goes. Proposed values are shown as a change of
    the configuration and written when you say so.
    """
    rig = load_config(config)
    configured_axis(rig, axis)
    target = Target.given(connect, (), login, rig.rig, as_json=as_json)
    person = TerminalPerson(for_s)

    async def work(client: RigClient) -> bool:
        checklist = Checklist(Rig(client, await client.daemon()), config, axis, person, by=by)
        session = _Session(target, person, checklist, config)
        try:
            if only_list:
                return await session.show_list()
            await session.walk.put_back_gains()
            return await session.go_through(name)
        except Left as left:
            person.tell(f"{left}; the same command goes on from here")
            return False
        finally:
            if report:
                _write_report(report, checklist, config)

    end_as_interrupted()
    if not target.run(work):
        sys.exit(FAILED)


class _Session:
    """One call of the command.

    Attributes:
        walk: of its person through the checklist.
    """

    def __init__(self, target: Target, person: Person, checklist: Checklist, config: Path) -> None:
        self._target = target
        self._person = person
        self._checklist = checklist
        self.walk = ChecklistWalk(checklist, person, str(config), self._show)

    async def show_list(self) -> bool:
        """Show every step with what is known of it."""
        await self._refresh()
        for name in STEPS:
            self._show(self._checklist.record.of(name))
        return True

    async def go_through(self, name: str | None) -> bool:
        """Go through one step, or through all open ones; tell whether none has failed."""
        await self._refresh()
        if name:
            return await self.walk.one(name) is not False
        name = self._checklist.next_open()
        while name:
            goes_on = await self.walk.one(name)
            if goes_on is not None:
                return goes_on
            name = self._checklist.next_open(after=name)
        self._person.tell("the end of the checklist; --list shows it, --report writes it")
        return True

    async def _refresh(self) -> None:
        self._person.tell(*await self._checklist.refresh())

    def _show(self, kept: StepRecord) -> None:
        result = kept.result
        proposes = "; proposes " + ", ".join(f"{each.name} = {each.literal}" for each in result.proposals)
        text = kept.reopened or result.text or STEPS[kept.step].title
        state = result.state.value.replace("_", " ")
        self._target.show(kept, f"{kept.step:8} {state:12} {text}{proposes if result.proposals else ''}")


def _write_report(path: Path, checklist: Checklist, config: Path) -> None:
    at = datetime.now(UTC).isoformat(timespec="seconds")
    text = html_of(checklist.record, STEPS, config.read_text(encoding="utf-8"), version(), at)
    try:
        durable.replace(path, text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    show_lines(f"{path}: written", err=True)


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
    type=Quantity(0, min_open=True),
    help="Stay within this distance of where the axis stands, in its unit; 2000 counts when missing.",
)
@click.option("--dry-run", is_flag=True, help="Say what it would do, and do nothing.")
@click.option("--yes", is_flag=True, help="Do not ask before moving, nor before applying.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw the test moves, measured beside predicted, to a picture such as a PNG; needs the extra `plot`.",
)
@click.option(
    "--write",
    "file",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Write the gains into this configuration, after showing the change.",
)
@click.option("--put-back", is_flag=True, help="Put back the gains that a tuning has left behind that was cut short.")
@with_target
def tune(
    target: Target,
    axis: str,
    bandwidth_hz: float | None,
    within: TypedNumber | None,
    plot: Path | None,
    file: Path | None,
    *,
    dry_run: bool,
    yes: bool,
    put_back: bool,
) -> None:
    """Find gains for AXIS: move it a little, identify it, propose, apply, verify.

    An axis whose gains are registers must be off and stay where it is then. It is off afterwards. What it will do is
    said before it moves; it moves within the stated distance only. The old gains come back at Ctrl-C, on any fault, and
    when the new ones are not better; if this program or its host dies, --put-back restores them. It needs the extra
    `bench`. A drive that tunes itself is not tuned here.
    """
    info = target.run(lambda client: axis_of(client, axis))
    if put_back:
        kept = target.run(lambda client: _put_back(client, axis))
        gains = ", ".join(f"{name} = {value}" for name, value in kept.gains.items())
        target.show(kept, f"{axis}: off, with its old gains: {gains}")
        return
    if file:
        configured_axis(load_config(file), axis)
    family = BENCHES.get(info.family)
    if family is None or not family.is_tuned_by_host:
        raise NotSupported(f"axis {axis}: the gains of a {info.model} are not found by the host", axis=axis)
    require("numpy")
    figure = stacked_rows(ROWS)[0] if plot else None  # missing matplotlib is reported before anything moves
    distance = None if within is None else in_unit(within, "within", info, Dimension.POSITION)
    if dry_run:
        _plan(target, axis, distance)
        return
    tuned = _tune(target, axis, distance, bandwidth_hz, asks=not yes)
    if figure and plot:
        _draw(figure, tuned)
        save_figure(figure, plot)
    _show(target, tuned)
    if file:
        _write_gains(file, axis, tuned, asks=not yes)


def _write_gains(file: Path, axis: str, tuned: "Tuned", *, asks: bool) -> None:
    """Write the gains of an axis into a configuration, as the step `gains` of `ldcnd commission` does.

    Raises:
        click.Abort: the person did not agree; the drive has the gains all the same.
        ConfigError: it cannot be written; likewise.
    """
    change = change_of(file, axis, gain_proposals(tuned.report.gains))
    if change is None:
        show_lines(f"{file} has these gains", err=True)
        return
    show_lines(*change.lines, err=True)
    if asks and not click.confirm(f"write this into {file}", err=True):
        raise click.Abort
    write_over(file, change.before, change.text)
    show_lines(f"{file} is written: the daemon loads these gains from its next start on", err=True)


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
    from ldcnd.bench.tuning import plan as plans  # noqa: PLC0415 - needs an optional package
    from ldcnd.bench.tuning import report as reports  # noqa: PLC0415 - likewise

    plan = target.run(lambda client: plans.plan(client, axis, within))
    target.show(reports.plan_reported(plan), *plan.lines, "Nothing was sent to the drive.")


def _tune(target: Target, axis: str, within: float | None, bandwidth_hz: float | None, *, asks: bool) -> "Tuned":
    """Tune an axis.

    Raises:
        click.Abort: the person has left, or did not agree to the proposal; the old gains are back.
    """
    from ldcnd.bench.tuning import report as reports  # noqa: PLC0415 - needs an optional package

    async def tuned(client: RigClient) -> "Tuned | None":
        person = TerminalPerson(None) if asks else AssentingPerson(None)
        try:
            return await reports.tune(client, person, axis, within, bandwidth_hz)
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
    from ldcnd.bench.tuning import report as reports  # noqa: PLC0415 - needs an optional package

    report = tuned.report
    target.show(report, *reports.table(report), *reports.ending(report))
    if not report.applied:
        sys.exit(FAILED)


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


@click.command()
@click.argument(
    "reports", metavar="REPORT...", nargs=-1, required=True, type=click.Path(path_type=Path, dir_okay=False)
)
@with_target
def shadow(target: Target, reports: tuple[Path, ...]) -> None:
    """Watch axes for friction, load and coupling (LDCN drives that report their position error), until SIGTERM.

    Each REPORT is what `ldcnd tune AXIS --json` has printed; it names the axis. The first 100 motions teach what is
    usual, and are kept on this host; later ones are compared. It takes no lease, moves nothing and stops nothing.
    Needs the extra `bench`.
    """
    require("numpy")
    from ldcnd.bench.tuning.watching import read_report, watch  # noqa: PLC0415 - needs an optional package

    plants = [read_report(path) for path in reports]
    twice = {plant.axis for plant in plants if [each.axis for each in plants].count(plant.axis) > 1}
    if twice:
        raise ConfigError(f"two reports are of axis {min(twice)}", value=min(twice), remedy="name the newer one only")

    async def work(client: RigClient) -> None:
        ending = asyncio.Event()
        on_end(ending.set)
        await watch(client, plants, lambda alarm: target.show(alarm, _line(alarm)), _tell, ending)

    target.run(work)


def _tell(line: str) -> None:
    show_lines(line, err=True)


def _line(alarm: "ShadowAlarm") -> str:
    at = datetime.fromtimestamp(alarm.t / 1e9, UTC).isoformat(timespec="seconds")
    if alarm.over:
        return f"{at} {alarm.axis}: {alarm.figure} is as usual again: {alarm.value:.3g} {alarm.unit}"
    low = "" if alarm.low is None else f"{alarm.low:.3g} to "
    return (
        f"{at} {alarm.axis}: {alarm.figure} is {alarm.value:.3g} {alarm.unit} over {alarm.motions} motions,"
        f" {alarm.latest:.3g} in the last five; usual is {alarm.usual:.3g}, allowed {low or 'up to '}{alarm.high:.3g}:"
        f" {alarm.meaning}"
    )
