"""`ldcnd commission`: the checklist that takes an axis from its first motion to a configuration and a report."""

import getpass
import sys
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd import durable
from ldcnd.bench.commissioning.checklist import STEPS, Checklist, axis_of
from ldcnd.bench.commissioning.record import StepRecord
from ldcnd.bench.commissioning.report import html_of
from ldcnd.bench.commissioning.walk import Walk
from ldcnd.bench.person import Left, Person
from ldcnd.cli.connection import AxisName, Target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.output import FAILED, show_lines
from ldcnd.cli.terminal_person import TerminalPerson
from ldcnd.cli.typed import Finite, NewFile, force_option
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.version import version


@click.command()
@click.argument("axis", type=AxisName("login"))
@click.option(
    "--config",
    type=click.Path(path_type=Path, dir_okay=False),
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
@click.option("--login", type=click.Path(path_type=Path), help="Zenoh configuration file, as `ldcnd pki` makes it.")
def command(
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
    axis_of(rig, axis)
    target = Target(connect, (), login, rig.rig, as_json=as_json)
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
        self.walk = Walk(checklist, person, str(config), self._show)

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
