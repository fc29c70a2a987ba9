"""`ldcnd params`: the parameters of a drive, and files with their values."""

import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.sending import Shown, derived_question
from ldcnd.cli.typed import NewFile, WholeNumber, force_option, is_file
from ldcnd.client.parameters import Transfer, carry_out, plan_transfer, read_dump
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import NotANumber, read_word
from ldcnd.contract.parameters import (
    EepromCount,
    ListParameters,
    Memory,
    ParameterDump,
    ParameterList,
    ParameterReply,
    ParameterValue,
    PlannedParameters,
    PlannedWrite,
    ReadParameter,
    RestartEepromCount,
    WriteParameter,
)
from ldcnd.drives.family import HasParameterFiles
from ldcnd.drives.known import FAMILIES

LARGEST = 0xFFFF
FAMILY = next(family for family in FAMILIES.values() if isinstance(family, HasParameterFiles))
"""Whose drives files are about: there is one such family, so that files need not name it."""


@dataclass(frozen=True, slots=True)
class ParameterFile:
    """The contents of a file.

    Attributes:
        values: what was stored, by the names of the file.
        in_use: what was in use; empty in files of earlier versions.
        driver_type: of the drive; None where the file does not say.
    """

    values: Mapping[str, int]
    in_use: Mapping[str, int]
    driver_type: int | None

    def named(self) -> dict[str, int]:
        """Return the stored values by their numbers; what the manual does not list keeps its name."""
        return {FAMILY.parameter(name, value)[0]: value for name, value in self.values.items()}

    def check(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what is wrong with the values, and what deserves attention; sends nothing to a drive."""
        return FAMILY.check_parameters(self.values)


def as_toml(axis: str, reply: ParameterDump, read_at: datetime) -> str:
    """Return a dump as TOML, the digits of parameters that have some in remarks."""
    facts = reply.facts
    lines = [f'axis = "{axis}"', f"read_at = {read_at.isoformat(timespec='seconds')}"]
    if facts:
        switches = ", ".join(f'"{switch.lower()}"' for switch in facts.switches)
        lines += [
            f"driver_type = 0x{facts.driver_type:04X}",
            f"software_version = 0x{facts.software_version:04X}",
            f"unit = {facts.unit}",
            f"gain_switch = {facts.gain_switch}",
            f"switches_on = [{switches}]",
        ]
    lines += ["", "# in EEPROM", "[parameters]"]
    for value in reply.values:
        _, word, remarks = FAMILY.parameter(value.parameter, value.stored)
        lines.append(f"{value.parameter} = {word}  # {value.name}")
        lines += [f"#   {text}" for text in remarks]
    lines += ["", "# in RAM", "[in_use]"]
    lines += [f"{value.parameter} = {value.active}" for value in reply.values]
    return "\n".join(lines) + "\n"


def load_parameters(file: Path) -> ParameterFile:
    """Return what a file of parameters says.

    Raises:
        ConfigError: it is none.
    """
    try:
        document = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: not a file of parameters: {error}") from error
    if "parameters" not in document:
        raise ConfigError(f"{file}: not a file of parameters: there is no table [parameters]")
    driver_type = document.get("driver_type")
    if driver_type is not None and type(driver_type) is not int:
        raise ConfigError(f"{file}: driver_type: {driver_type!r} is not a number")
    return ParameterFile(
        _words(file, "parameters", document["parameters"]),
        _words(file, "in_use", document.get("in_use", {})),
        driver_type,
    )


def _words(file: Path, table: str, values: object) -> dict[str, int]:
    if not isinstance(values, dict):
        raise ConfigError(f"{file}: [{table}] is not a table")
    for name, value in values.items():
        if type(value) is not int or not 0 <= value <= LARGEST:
            raise ConfigError(f"{file}: {name}: {value!r} is not a word from 0 to {LARGEST}")
    return values


UNFINISHED = 1
"""Exit code: files or memories differ, or not everything was written."""


def _word(_context: click.Context, _parameter: click.Parameter, value: str) -> int:
    """Return a word without sign, given in decimal, or hexadecimal as 0x0101 or 0101H."""
    try:
        return read_word(value)
    except NotANumber as error:
        raise click.BadParameter(str(error)) from None


@click.group(cls=CommandGroup)
def command() -> None:
    """Read, write, save, compare and copy the parameters of a drive."""


def _known(reply: ParameterList, _axis: AxisInfo | None) -> Shown:
    for each in reply.parameters:
        limits = "-" if each.lowest is None else f"{each.lowest} to {each.highest}"
        hint = f" [{each.confidence}]" if each.confidence else ""
        cycle = ", from the next power-on" if each.power_cycle else ""
        digits = [f"         .{one.digit} {one.title} [{one.confidence}]" for one in each.digit_meanings]
        yield each, [f"{each.parameter}  {limits:>14} {each.unit or '':18}{hint:6} {each.name}{cycle}", *digits]


def _read(reply: ParameterReply, _axis: AxisInfo | None) -> Shown:
    yield reply, [_line(reply.value)]


def _counted(reply: EepromCount, _axis: AxisInfo | None) -> Shown:
    yield reply, [f"{reply.axis}: {reply.total} EEPROM writes; the drive before it had {reply.previous}"]


for each in (
    derived_question("list", ListParameters, shows=_known),
    derived_question("get", ReadParameter, "parameter", shows=_read),
    derived_question("restart-count", RestartEepromCount, shows=_counted, confirm="Was the drive of {axis} replaced?"),
):
    command.add_command(each)


@command.command("set")
@click.argument("axis", type=AXIS)
@click.argument("parameter")
@click.argument("value", callback=_word)
@click.option("--eeprom", is_flag=True, help="Write permanently; the memory endures 10,000 writes.")
@click.option("--unlisted", is_flag=True, help="Allow a number that the manual does not list.")
@click.option("--confirm-unit", type=WholeNumber(0, 15), help="The unit number that writing Pn000 leads to.")
@with_target
def set_parameter(
    target: Target, axis: str, parameter: str, value: int, confirm_unit: int | None, *, eeprom: bool, unlisted: bool
) -> None:
    """Write VALUE to PARAMETER of AXIS, in RAM unless --eeprom is given."""
    request = WriteParameter(
        parameter=parameter,
        value=value,
        memory=Memory.EEPROM if eeprom else Memory.RAM,
        unlisted=unlisted,
        confirm_unit=confirm_unit,
    )
    reply = target.run(lambda client: client.command(axis, request))
    target.show(reply, f"{_line(reply.value)}{'' if reply.written else '  (was so already)'}")
    for remark in reply.remarks:
        print(remark, file=sys.stderr)


@command.command()
@click.argument("axis", type=AXIS)
@click.argument("file", type=NewFile(), required=False)
@force_option
@with_target
def dump(target: Target, axis: str, file: Path | None) -> None:
    """Write all parameters of AXIS as TOML to FILE or the terminal: both memories, type, version, switches, date.

    A FILE that is there already is kept: it may be the only copy of what another drive held.
    """
    text = as_toml(axis, target.run(lambda client: read_dump(client, axis)), datetime.now(UTC))
    if file:
        file.write_text(text, encoding="utf-8")
    else:
        print(text, end="")


@command.command()
@click.argument("file", type=click.Path(path_type=Path))
def check(file: Path) -> None:
    """Check FILE without a drive: names, ranges, digits; exits with 1 when it cannot be restored."""
    wrong, remarks = load_parameters(file).check()
    for text in wrong:
        print(f"wrong: {text}")
    for text in remarks:
        print(text)
    print(f"{file}: {'cannot be restored' if wrong else 'can be restored'}")
    sys.exit(UNFINISHED if wrong else 0)


@command.command()
@click.argument("left")
@click.argument("right", required=False)
@with_target
def diff(target: Target, left: str, right: str | None) -> None:
    """Show where LEFT and RIGHT differ, each an axis or a file; without RIGHT, the two memories of LEFT.

    A name with a dot or a slash is a file. Exits with 1 when they differ.
    """
    differing = _memories(target, left) if right is None else _sides(target, left, right)
    sys.exit(UNFINISHED if differing else 0)


@command.command()
@click.argument("axis", type=AXIS)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--ram", is_flag=True, help="Only try out: write RAM, and leave out what takes effect at power-on.")
@click.option("--dry-run", is_flag=True, help="List the writes, and send none.")
@click.option("--any-type", is_flag=True, help="Take values of another or of an unknown type of drive.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@with_target
def restore(target: Target, axis: str, file: Path, *, ram: bool, dry_run: bool, any_type: bool, yes: bool) -> None:
    """Make AXIS hold what FILE says; its unit number stays. Lists the writes, asks once, reads them back."""
    source = load_parameters(file)
    memory = Memory.RAM if ram else None
    _transfer(
        target, axis, source.values, source.driver_type, memory=memory, dry_run=dry_run, any_type=any_type, yes=yes
    )


@command.command()
@click.argument("source")
@click.argument("axis", type=AXIS)
@click.option("--dry-run", is_flag=True, help="List the writes, and send none.")
@click.option("--any-type", is_flag=True, help="Take values of another type of drive.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@with_target
def clone(target: Target, source: str, axis: str, *, dry_run: bool, any_type: bool, yes: bool) -> None:
    """Make AXIS hold what SOURCE has stored; its unit number stays. As restore, from drive to drive."""
    reply = target.run(lambda client: read_dump(client, source))
    values = {value.parameter: value.stored for value in reply.values}
    driver_type = reply.facts.driver_type if reply.facts else None
    _transfer(target, axis, values, driver_type, memory=None, dry_run=dry_run, any_type=any_type, yes=yes)


@command.command()
@click.argument("axis", type=AXIS)
@click.option("--dry-run", is_flag=True, help="List the writes, and send none.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@with_target
def save(target: Target, axis: str, *, dry_run: bool, yes: bool) -> None:
    """Write to EEPROM what AXIS has in use, so that it outlives power-off; its unit number stays."""
    reply = target.run(lambda client: read_dump(client, axis))
    values = {value.parameter: value.active for value in reply.values if value.differs}
    _transfer(target, axis, values, None, memory=Memory.EEPROM, dry_run=dry_run, any_type=True, yes=yes)


# -- transfer --------------------------------------------------------------------------------------------------------


def _transfer(
    target: Target,
    axis: str,
    values: Mapping[str, int],
    driver_type: int | None,
    *,
    memory: Memory | None,
    dry_run: bool,
    any_type: bool,
    yes: bool,
) -> None:
    """Plan, show, ask, write, read back; exits with 1 unless the drive holds the values in the end."""

    async def plan(client: RigClient) -> PlannedParameters:
        return await plan_transfer(client, axis, values, driver_type, memory=memory, any_type=any_type)

    async def first(client: RigClient) -> tuple[PlannedParameters, tuple[str, str]]:
        return await plan(client), (client.rig, (await client.daemon()).instance)

    planned, of = target.run(first)
    target.show(planned, *_plan_lines(axis, planned))
    if planned.problems:
        sys.exit(UNFINISHED)
    if dry_run or not planned.writes:
        return
    if not yes and not click.confirm(f"Send {len(planned.writes)} writes to {axis}?", err=True):
        raise click.Abort

    def progress(place: int, write: PlannedWrite) -> None:
        print(f"{place + 1} of {len(planned.writes)}: {_write_line(write)}", file=sys.stderr)

    async def work(client: RigClient) -> tuple[Transfer | None, PlannedParameters]:
        # while a person reads, a drive is replaced, or another daemon has an axis of that name
        now, same = await first(client)
        if (now, same) != (planned, of):
            return None, now
        done = await carry_out(client, axis, planned, progress)
        return done, await plan(client)

    transfer, left = target.run(work)
    if transfer is None:
        print(f"{axis} or its daemon is not what this plan was made for any more: nothing was written; plan it again")
        sys.exit(UNFINISHED)
    for line in _report_lines(axis, transfer, left):
        print(line)
    sys.exit(UNFINISHED if transfer.failed or left.writes else 0)


def _plan_lines(axis: str, plan: PlannedParameters) -> list[str]:
    lines = [f"cannot be done: {problem}" for problem in plan.problems]
    lines += [_write_line(write) for write in plan.writes]
    lines += [f"      {text}" for write in plan.writes for text in write.digits]
    lines += list(plan.remarks)
    if not plan.writes and not plan.problems:
        lines.append(f"{axis} holds these values already")
    return lines


def _write_line(write: PlannedWrite) -> str:
    return (
        f"{write.parameter} {write.memory.upper():6} {write.before} ({write.before:04X}H) -> {write.value}"
        f" ({write.value:04X}H), takes effect {write.effective}  {write.name}"
    )


def _report_lines(axis: str, transfer: Transfer, left: PlannedParameters) -> list[str]:
    lines = [f"{axis}: {len(transfer.done)} writes done", *transfer.remarks]
    if transfer.failed:
        write, error = transfer.failed
        lines.append(f"failed: {_write_line(write)}: {error.message} [{error.code}]")
        lines += [f"not tried: {_write_line(write)}" for write in transfer.left]
    if left.writes:
        names = ", ".join(dict.fromkeys(write.parameter for write in left.writes))
        lines.append(f"read back: {names} still differ; the same command again completes it")
    else:
        lines.append("read back: the drive holds the values")
    return lines


# -- comparing -------------------------------------------------------------------------------------------------------


def _memories(target: Target, name: str) -> int:
    """Show where the two memories of a drive, or of a file, differ; return how many do."""
    source = _source(target, name)
    if isinstance(source, ParameterFile):
        stored, active = source.named(), {**source.named(), **source.in_use}
    else:
        stored = {value.parameter: value.stored for value in source.values}
        active = {value.parameter: value.active for value in source.values}
    differing = [label for label in stored if active[label] != stored[label]]
    for label in differing:
        print(f"{label}  {active[label]} in use, {stored[label]} stored")
    return len(differing)


def _sides(target: Target, left: str, right: str) -> int:
    """Show where what two sides have stored differs, and what only one of them has; return how many do."""
    sides = [_stored(_source(target, name)) for name in (left, right)]
    differing = [label for label in dict.fromkeys([*sides[0], *sides[1]]) if sides[0].get(label) != sides[1].get(label)]
    for label in differing:
        texts = [f"{name}: {side.get(label, 'not there')}" for name, side in zip((left, right), sides, strict=True)]
        print(f"{label}  {', '.join(texts)}")
    return len(differing)


def _source(target: Target, name: str) -> ParameterFile | ParameterDump:
    if is_file(name):
        return load_parameters(Path(name))
    return target.run(lambda client: read_dump(client, name))


def _stored(source: ParameterFile | ParameterDump) -> dict[str, int]:
    if isinstance(source, ParameterFile):
        return source.named()
    return {value.parameter: value.stored for value in source.values}


def _line(value: ParameterValue) -> str:
    writes = (
        "" if value.eeprom_writes is None else f", {value.eeprom_writes} EEPROM writes ({value.eeprom_total} in all)"
    )
    return (
        f"{value.parameter}  {value.active} ({value.active:04X}H) in use, {value.stored} ({value.stored:04X}H) stored"
        f"{writes}  {value.name}"
    )
