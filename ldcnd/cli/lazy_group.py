"""Groups of commands whose modules are loaded when they are used: most of a call's time is loading modules."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click


class LazyGroup(click.Group):
    """A group with commands that are imported when they are used.

    Args:
        homes: the module of such a command, and behind a colon its name there, which is `command` otherwise.
        given: as `click.Group` takes it.
    """

    def __init__(self, *given: Any, homes: Mapping[str, str], **named: Any) -> None:  # noqa: ANN401 - click's own
        super().__init__(*given, **named)
        self._homes = homes

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
