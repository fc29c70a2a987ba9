"""The entry point: finds the subcommand's module only when it is called, so that help and completion stay quick."""

import gc
import os
import re
import shlex
import signal
import sys
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any, NoReturn

import click

from ldcnd.cli.names import COMMANDS, EXAMPLES, GROUPS, OPTIONS_TYPED, RENAMED, example_of
from ldcnd.cli.output import DONE, EXIT_CODES, EXPECTED, exit_code, print_under_any_encoding

_NEGATIVE = re.compile(r"^-(?=[.,]?[0-9])")
_MINUS = "\u2212"
LONGEST_SUMMARY = 200
"""Of a command in the help of its group, in characters."""
NO_HOMES: Mapping[str, str] = MappingProxyType({})


class CommandGroup(click.Group):
    """A group with commands that are imported when they are used; the help of each ends with an example.

    Args:
        homes: the module of such a command, and behind a colon its name there, which is `command` otherwise.
        given: as `click.Group` takes it.
    """

    def __init__(self, *given: Any, homes: Mapping[str, str] = NO_HOMES, **named: Any) -> None:  # noqa: ANN401 - click's
        super().__init__(*given, **named)
        self._homes = homes

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the command line, in which what begins like a negative number is a value."""
        return super().parse_args(ctx, _with_values(args))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted([*super().list_commands(ctx), *self._homes])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, whose module may be imported for that."""
        command = super().get_command(ctx, cmd_name)
        if command is None and cmd_name in self._homes:
            module, _, name = self._homes[cmd_name].partition(":")
            command = getattr(import_module(module), name or "command")
            if not isinstance(command, click.Command):
                raise TypeError(f"{self._homes[cmd_name]} is no command")
        if command:
            command.epilog = example_of(" ".join([*_words(ctx), cmd_name])) or command.epilog
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command of an argument line; one that stands elsewhere is refused with the words that reach it."""
        if not ctx.resilient_parsing and self.get_command(ctx, args[0]) is None and not args[0].startswith("-"):
            raise click.UsageError(self._not_here(ctx, *args), ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands, each with its first sentence whole."""
        found = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, each.get_short_help_str(LONGEST_SUMMARY)) for name, each in found.items() if each]
            )

    def _not_here(self, ctx: click.Context, name: str, *rest: str) -> str:
        here = _words(ctx)
        if now := RENAMED.get(before := " ".join([*here, name])):
            return f"There is no `ldcnd {before}` any more: type `ldcnd {shlex.join([*now.split(), *rest])}`."
        elsewhere = [name] if here and name in COMMANDS else ["axis", name]
        if " ".join(elsewhere) in EXAMPLES and elsewhere != [*here, name]:
            given = [word.replace(_MINUS, "-", 1) if word.startswith(_MINUS) else word for word in rest]
            return f"There is no `ldcnd {' '.join([*here, name])}`: type `ldcnd {shlex.join([*elsewhere, *given])}`."
        near = get_close_matches(name, self.list_commands(ctx), 1)
        meant = f" Did you mean {near[0]!r}?" if near else ""
        return f"No such command {name!r}.{meant}"


def _words(ctx: click.Context) -> list[str]:
    """Return the words behind the name of the program that lead to a context."""
    return [*_words(ctx.parent), str(ctx.info_name)] if ctx.parent else []


def _with_values(args: list[str]) -> list[str]:
    """Return arguments in which negative numbers have the Unicode minus: click would read `-1e3` as `-1 -e 3`.

    What follows `--` belongs to another program.
    """
    end = args.index("--") if "--" in args else len(args)
    return [*(_NEGATIVE.sub(_MINUS, arg) if _NEGATIVE.match(arg) else arg for arg in args[:end]), *args[end:]]


class Program(CommandGroup):
    """All commands; its help names them by their groups, without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """List the commands without importing them."""
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, summary) for name, (_, summary) in group.items()])


HELP = f"""Own RS-485 servo lines and expose their drives over Zenoh.

Exit codes:

\b
{"".join(f"{code:4}  {meaning}{chr(10)}" for code, meaning in EXIT_CODES.items())}"""


@click.group(
    cls=Program,
    homes={name: home for name, (home, _) in COMMANDS.items()},
    help=HELP,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="ldcnd")
def cli() -> None:
    """Find a command; its modules are loaded by now, and stay as long as the process."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


@cache
def _pause_collector() -> None:
    """Switch the collector off with the first command of a process, until `cli` switches it on.

    Modules leave nothing to collect, and looking for it takes an eighth of their time. Whether `cli` has frozen
    anything is not asked: the interpreter counts that object by object, 27 ms in a large process.
    """
    gc.disable()


def main() -> NoReturn:
    """Run the command line and exit with a documented code."""
    # looking for plugins of pydantic reads what every installed package says about itself
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    _pause_collector()
    print_under_any_encoding()
    OPTIONS_TYPED.set("")
    try:
        try:
            cli.main(standalone_mode=False)
            sys.stdout.flush()
        finally:
            # what is left is to say how it has ended: what interrupts the interpreter's end prints a traceback
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    except (*EXPECTED, BaseExceptionGroup) as error:
        sys.exit(exit_code(error))
    finally:
        gc.enable()
    sys.exit(DONE)
