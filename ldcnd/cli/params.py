"""`ldcnd params`: the parameters of a drive, one by one or all at once, to and from TOML."""

import sys
import tomllib
from pathlib import Path
from typing import TypeVar

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.client.rig_client import RigClient
from ldcnd.errors import ConfigError, LdcndError
from ldcnd.model.commands import CommandReply
from ldcnd.model.parameters import (
    ListParameters,
    Memory,
    ParameterDump,
    ParameterReply,
    ParameterValue,
    ReadAllParameters,
    ReadParameter,
    WriteParameter,
)

ReplyT = TypeVar("ReplyT", bound=CommandReply)

PATIENCE_S = 60.0
"""All parameters of a slow drive on a bad line."""
LARGEST = 0xFFFF


def _word(_context: click.Context, _parameter: click.Parameter, value: str) -> int:
    """Return a word without sign, given in decimal or as 0x and hexadecimal digits."""
    try:
        word = int(value, 0)
    except ValueError:
        raise click.BadParameter(f"{value!r} is not a number") from None
    if not 0 <= word <= LARGEST:
        raise click.BadParameter(f"{value} is not 0 to {LARGEST}")
    return word


@click.group()
def command() -> None:
    """Read, write, save and compare the parameters of a drive."""


@command.command("list")
@click.argument("axis")
@with_target
def list_parameters(target: Target, axis: str) -> None:
    """Show what is known of the parameters of AXIS; ranges are hints, the drive decides."""
    request = ListParameters()
    reply = target.run(lambda client: client.command(axis, request))
    for each in reply.parameters:
        limits = "-" if each.lowest is None else f"{each.lowest} to {each.highest}"
        hint = f" [{each.confidence}]" if each.confidence else ""
        cycle = ", from the next power-on" if each.power_cycle else ""
        target.show(each, f"{each.parameter}  {limits:>14} {each.unit or '':18}{hint:6} {each.name}{cycle}")


@command.command()
@click.argument("axis")
@click.argument("parameter")
@click.option("--unlisted", is_flag=True, help="Allow a number that the manual does not list.")
@with_target
def get(target: Target, axis: str, parameter: str, *, unlisted: bool) -> None:
    """Show PARAMETER (Pn100, or its name) of AXIS in both memories."""
    request = ReadParameter(parameter=parameter, unlisted=unlisted)
    reply = target.run(lambda client: client.command(axis, request))
    target.show(reply, _line(reply.value))


@command.command("set")
@click.argument("axis")
@click.argument("parameter")
@click.argument("value", callback=_word)
@click.option("--eeprom", is_flag=True, help="Write for good; the memory endures 10,000 writes.")
@click.option("--unlisted", is_flag=True, help="Allow a number that the manual does not list.")
@click.option("--confirm-unit", type=click.IntRange(0, 15), help="The unit number that writing Pn000 leads to.")
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
    reply = target.run(lambda client: _write(client, axis, request))
    target.show(reply, f"{_line(reply.value)}{'' if reply.written else '  (was so already)'}")
    for remark in reply.remarks:
        print(remark, file=sys.stderr)


@command.command()
@click.argument("axis")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@with_target
def dump(target: Target, axis: str, file: Path | None) -> None:
    """Write all parameters of AXIS as TOML to FILE, or to the terminal."""
    text = as_toml(axis, target.run(lambda client: _read_all(client, axis)))
    if file:
        file.write_text(text, encoding="utf-8")
    else:
        print(text, end="")


@command.command()
@click.argument("axis")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@with_target
def diff(target: Target, axis: str, file: Path | None) -> None:
    """Show where the memories of AXIS differ from each other, or from FILE; exits with 1 when they do."""
    wanted = load_values(file) if file else None
    differing = 0
    for value in target.run(lambda client: _read_all(client, axis)).values:
        saved = value.stored if wanted is None else wanted.get(value.parameter, value.stored)
        if (saved, value.stored) == (value.active, value.active):
            continue
        differing += 1
        of_file = "" if wanted is None else f", {saved} in the file"
        target.show(value, f"{value.parameter}  {value.active} in use, {value.stored} stored{of_file}  {value.name}")
    sys.exit(1 if differing else 0)


@command.command()
@click.argument("axis")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--eeprom", is_flag=True, help="Write for good; the memory endures 10,000 writes.")
@with_target
def restore(target: Target, axis: str, file: Path, *, eeprom: bool) -> None:
    """Write what FILE says to AXIS, where it differs; Pn000 is left out, because it holds the unit number."""
    memory = Memory.EEPROM if eeprom else Memory.RAM
    values = {name: value for name, value in load_values(file).items() if name != "Pn000"}

    async def work(client: RigClient) -> list[ParameterReply | LdcndError]:
        outcomes: list[ParameterReply | LdcndError] = []
        for name, value in values.items():
            try:
                outcomes.append(await _write(client, axis, WriteParameter(parameter=name, value=value, memory=memory)))
            except LdcndError as error:
                outcomes.append(error)
        return outcomes

    failed = False
    for outcome in target.run(work):
        if isinstance(outcome, LdcndError):
            failed = True
            print(f"{outcome.message} [{outcome.code}]", file=sys.stderr)
        elif outcome.written:
            target.show(outcome, _line(outcome.value))
    sys.exit(1 if failed else 0)


def as_toml(axis: str, reply: ParameterDump) -> str:
    """Return a dump as TOML: what is stored, with a remark where another value is in use."""
    lines = [f'axis = "{axis}"', "", "[parameters]"]
    for value in reply.values:
        in_use = f", in use {value.active}" if value.differs else ""
        lines.append(f"{value.parameter} = {value.stored}  # {value.name}{in_use}")
    return "\n".join(lines) + "\n"


def load_values(file: Path) -> dict[str, int]:
    """Return the values of a dump.

    Raises:
        ConfigError: it is none.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))["parameters"]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"{file}: not a dump of parameters: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{file}: [parameters] is not a table")
    for name, value in values.items():
        if type(value) is not int or not 0 <= value <= LARGEST:
            raise ConfigError(f"{file}: {name}: {value!r} is not a word from 0 to {LARGEST}")
    return values


async def _read_all(client: RigClient, axis: str) -> ParameterDump:
    return await client.command(axis, ReadAllParameters())


async def _write(client: RigClient, axis: str, request: WriteParameter) -> ParameterReply:
    return await client.command(axis, request)


def _line(value: ParameterValue) -> str:
    writes = "" if value.eeprom_writes is None else f", {value.eeprom_writes} EEPROM writes"
    return (
        f"{value.parameter}  {value.active} ({value.active:04X}H) in use, {value.stored} ({value.stored:04X}H) stored"
        f"{writes}  {value.name}"
    )
