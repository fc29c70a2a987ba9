"""Where each verb can be reached: as a method of the client, and by a command of the command line."""

import functools
import inspect
from collections.abc import Iterator
from types import CodeType, FunctionType

import click

from ldcnd.cli.main import cli
from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, Command
from ldcnd.contract.frozen import Frozen
from tools.verb_methods import method_name

PLACES = ("client", "command line")
LEASE = "part of `Rig.control`"
EXPLAINED = {
    ("acquire", "client"): LEASE,
    ("renew", "client"): LEASE,
    ("release", "client"): LEASE,
    ("events", "client"): "`Rig.events` follows them without gaps",
    ("wire_log", "client"): "for people: `ldcnd bus wire-log`",
    ("rehearse", "client"): "for people: `ldcnd drill`",
    ("release", "command line"): "a lease of the command line ends with its command",
    ("stop", "command line"): "`ldcnd stop`, by the stops' own key",
    ("outcome", "command line"): "`--wait` of each command that has an end",
    ("rehearse", "command line"): "`ldcnd drill`",
    ("report_shadow", "command line"): "`ldcnd shadow`",
}
"""Why a verb is not in a place; everything else is there."""
METHODS_OF_RIGS = {
    "holders",
    "outcome",
    "move_together",
    "path",
    "preview_together",
    "set_speed_override",
    "snapshot",
    "set_io",
    "set_io_timer",
    "override_interlock",
    "send_guest_away",
    "reload",
}


def empty_cells() -> list[tuple[str, str]]:
    """Return what is neither there nor explained."""
    return [(command.verb, place) for command in COMMANDS for place in PLACES if not _cell(command, place)]


def needless_explanations() -> list[tuple[str, str]]:
    """Return what is explained although it is there."""
    by_verb = {command.verb: command for command in COMMANDS}
    return [(verb, place) for verb, place in EXPLAINED if _found(by_verb[verb], place)]


def _cell(command: type[Command[Frozen]], place: str) -> str:
    return _found(command, place) or EXPLAINED.get((command.verb, place), "")


def _found(command: type[Command[Frozen]], place: str) -> str:
    if place == "command line":
        return _commands_that_send(command)
    kind = Axis if command.about is About.AXIS else Rig
    name = method_name(command) if command.about is About.AXIS else command.verb
    known = command.about is About.AXIS or name in METHODS_OF_RIGS
    return f"`{kind.__name__}.{name}`" if known and hasattr(kind, name) else ""


def _commands_that_send(command: type[Command[Frozen]]) -> str:
    """Return the commands of the command line from whose code the class is reached."""
    return ", ".join(path for path, reached in _command_line() if command in reached and path.split()[1] != "drill")


@functools.cache
def _command_line() -> list[tuple[str, set[object]]]:
    """Return every command of the command line with the functions and classes that its code names."""
    return [
        (path, _reached(command.callback, set()))
        for path, command in _leaves(cli, "ldcnd", click.Context(cli))
        if isinstance(command.callback, FunctionType)
    ]


def _leaves(command: click.Command, path: str, context: click.Context) -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield path, command
        return
    for name in command.list_commands(context):
        if found := command.get_command(context, name):
            yield from _leaves(found, f"{path} {name}", context)


def _reached(function: FunctionType, reached: set[object]) -> set[object]:
    bare = inspect.unwrap(function)
    if bare in reached or not bare.__module__.startswith("ldcnd"):
        return reached
    reached.add(bare)
    closed = inspect.getclosurevars(bare).nonlocals.values()
    named = (bare.__globals__.get(name) for code in _codes(bare.__code__) for name in code.co_names)
    for value in (*closed, *named):
        if isinstance(value, type):
            reached.add(value)
        elif isinstance(value, FunctionType):
            _reached(value, reached)
    return reached


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)
