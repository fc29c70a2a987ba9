"""`ldcnd tune` of a drive that tunes itself: what it says of that, and gains of its parameters that are tried."""

from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import Target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.output import FAILED
from ldcnd.cli.terminal_person import TerminalPerson
from ldcnd.client.kept_gains import KeptGains
from ldcnd.client.rig_client import RigClient
from ldcnd.drivers.smartstep.parameters import find_parameter
from ldcnd.model.meta import AxisInfo
from ldcnd.person import Left
from ldcnd.tuning.smartstep import session

if TYPE_CHECKING:
    from ldcnd.cli.tune import TuneOptions

RECORD_S = 2.0


def tune(target: Target, info: AxisInfo, options: "TuneOptions") -> None:
    """Show the drive's own tuning, and try gains."""
    options.refuse("this drive tunes itself: it is not identified here", "bandwidth_hz", "within", "plot")
    wanted = dict(map(_value, options.values))
    found = target.run(lambda client: session.read_tuning(client, info.axis))
    if not wanted or options.dry_run:
        if wanted:
            session.check_wanted(found, wanted)
        tries = f"Try others: ldcnd tune {info.axis} --set {session.GAINS[0]}=VALUE" if not wanted else _plan(wanted)
        target.show(found, *_shown(found), tries)
        return
    record_s = options.record_s or RECORD_S
    person = TerminalPerson(None)
    person.tell(*_shown(found), _plan(wanted))
    if not options.yes:
        click.confirm(f"Try these gains on {info.axis} now?", abort=True, err=True)
    end_as_interrupted()

    async def moves(what: str) -> None:
        """Have the machine moved while the drive records."""
        line = f"{info.axis}: let the machine move it for {record_s:g} s; recorded with {what}"
        person.tell(line)
        if not options.yes:
            await person.ask("Enter begins")

    async def accepted(tried: session.SmartStepTuning) -> bool:
        """Keep gains that are at least as good, or that the person wants."""
        if options.yes:
            return tried.objection is None
        person.tell(*_table(tried), *([tried.objection] if tried.objection else []))
        return await person.confirm(f"keep them in the RAM of {info.axis}")

    async def work(client: RigClient) -> session.SmartStepTuning | None:
        try:
            return await session.try_gains(client, found, wanted, record_s, moves, accepted, person.tell)
        except Left:
            return None

    tried = target.run(work)
    if tried is None:
        raise click.Abort
    target.show(tried, *_table(tried), _ending(tried))
    if not tried.kept:
        raise SystemExit(FAILED)


def put_back(target: Target, kept: KeptGains) -> None:
    """Put back gains that a tuning has left behind."""
    target.run(lambda client: session.put_back(client, kept))
    target.show(kept, f"{kept.axis}: its old gains are in RAM: {_gains(kept.gains)}")


def _value(text: str) -> tuple[str, int]:
    name, _, value = text.partition("=")
    parameter = find_parameter(name)
    if parameter is None or not value.isdecimal():
        raise click.BadParameter(f"{text!r} is not NAME=VALUE, such as Pn100=80", param_hint="--set")
    return parameter.label, int(value)


def _gains(gains: dict[str, int]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in gains.items())


def _plan(wanted: dict[str, int]) -> str:
    return (
        f"It would write {_gains(wanted)} to RAM, between two records of a move that the machine makes, and put the old"
        " values back unless they are kept. Nothing here moves the motor."
    )


def _shown(found: session.SmartStepTuning) -> list[str]:
    result = found.auto_tuning_result_percent
    lines = [*found.auto_tuning, f"auto-tuning result (Fn007): {'not read' if result is None else f'{result} %'}"]
    if found.auto_tuning_runs:
        lines.append("Online auto-tuning runs: the drive goes on changing what it uses of these gains.")
    if found.switches_rule:
        lines.append(f"Its gain switch decides ({found.gain_switch:X}), not these parameters.")
    for name, value in found.gains.items():
        stored = f" ({value.stored} is stored)" if value.differs else ""
        lines.append(f"{name} = {value.active}  {value.name}{stored}")
    return lines


def _table(tried: session.SmartStepTuning) -> list[str]:
    old = {name: tried.gains[name].active for name in tried.tried}
    rows: list[tuple[str, ...]] = [("", "old gains", "new gains")]
    for title, name, form in (
        ("top speed", "top_speed_rpm", "{:.0f} r/min"),
        ("largest deviation", "largest_deviation", "{:.0f} units"),
        ("typical deviation", "typical_deviation", "{:.1f} units"),
        ("in position", "in_position", "{:.0%}"),
    ):
        shown = ["-" if each is None else form.format(getattr(each, name)) for each in (tried.before, tried.after)]
        rows.append((title, *shown))
    return [
        f"old gains: {_gains(old)}",
        f"new gains: {_gains(tried.tried)}",
        *("  " + " ".join(f"{cell:>18}" for cell in row) for row in rows),
    ]


def _ending(tried: session.SmartStepTuning) -> str:
    if not tried.kept:
        return f"{tried.axis}: {tried.objection or 'not wanted'}; its old gains are back in RAM"
    name, value = next(iter(tried.tried.items()))
    return (
        f"{tried.axis}: the new gains are in RAM until it is powered off; to store them:"
        f" ldcnd params set {tried.axis} {name} {value} --eeprom"
    )
