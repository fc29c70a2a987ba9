"""`ldcnd tune` of a drive that tunes itself: what it says of that, and gains of its parameters that are tried."""

from typing import TYPE_CHECKING

import click

from ldcnd.bench.person import Left
from ldcnd.bench.tuning.smartstep import guided, session
from ldcnd.cli.connection import Target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.output import FAILED
from ldcnd.cli.terminal_person import TerminalPerson
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.meta import AxisInfo

if TYPE_CHECKING:
    from ldcnd.cli.tune import TuneOptions


def tune(target: Target, info: AxisInfo, options: "TuneOptions") -> None:
    """Show the drive's own tuning, and try gains."""
    options.refuse("this drive tunes itself: it is not identified here", "bandwidth_hz", "within", "plot")
    wanted = dict(map(_value, options.values))
    found = target.run(lambda client: session.read_tuning(client, info.axis))
    if wanted:
        session.check_wanted(found, wanted)
    if not wanted or options.dry_run:
        others = f"Try others: ldcnd tune {info.axis} --set {session.GAINS[0]}=VALUE"
        target.show(found, *guided.shown(found), guided.plan(wanted) if wanted else others)
        return
    person, record_s = TerminalPerson(None), options.record_s or guided.RECORD_S
    person.tell(*guided.shown(found), guided.plan(wanted))
    end_as_interrupted()

    async def work(client: RigClient) -> session.SmartStepTuning | None:
        try:
            return await guided.tune(client, person, found, wanted, record_s, asks=not options.yes)
        except Left:
            return None

    tried = target.run(work)
    if tried is None:
        raise click.Abort
    target.show(tried, *guided.table(tried), guided.ending(tried))
    if not tried.kept:
        raise SystemExit(FAILED)


def _value(text: str) -> tuple[str, int]:
    value = guided.typed(text)
    if value is None:
        raise click.BadParameter(f"{text!r} is not {guided.EXAMPLE}", param_hint="--set")
    return value
