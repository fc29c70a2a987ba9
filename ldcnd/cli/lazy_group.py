"""Groups of commands whose modules are loaded when they are used: most of a call's time is loading modules."""

import re
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click

_NEGATIVE = re.compile(r"^-(?=[.,]?[0-9])")
_MINUS = "\u2212"


class LazyGroup(click.Group):
    """A group with commands that are imported when they are used.

    Args:
        homes: the module of such a command, and behind a colon its name there, which is `command` otherwise.
        given: as `click.Group` takes it.
    """

    def __init__(self, *given: Any, homes: Mapping[str, str], **named: Any) -> None:  # noqa: ANN401 - click's own
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
        if cmd_name not in self._homes:
            return super().get_command(ctx, cmd_name)
        module, _, name = self._homes[cmd_name].partition(":")
        command = getattr(import_module(module), name or "command")
        if not isinstance(command, click.Command):
            raise TypeError(f"{self._homes[cmd_name]} is no command")
        return command


def _with_values(args: list[str]) -> list[str]:
    """Return arguments in which negative numbers have the Unicode minus: click would read `-1e3` as `-1 -e 3`.

    What follows `--` belongs to another program.
    """
    end = args.index("--") if "--" in args else len(args)
    return [*(_NEGATIVE.sub(_MINUS, arg) if _NEGATIVE.match(arg) else arg for arg in args[:end]), *args[end:]]
