"""Groups of commands whose modules are loaded when they are used: most of a call's time is loading modules."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click


class LazyGroup(click.Group):
    """A group that imports a command when it is used.

    Args:
        homes: the module of each command, and behind a colon its name there, which is `command` otherwise.
        given: as `click.Group` takes it.
    """

    def __init__(self, *given: Any, homes: Mapping[str, str], **named: Any) -> None:  # noqa: ANN401 - click's own
        super().__init__(*given, **named)
        self._homes = homes

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names in the order of the table."""
        return list(self._homes)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import the command's module and return the command."""
        if cmd_name not in self._homes:
            return None
        module, _, name = self._homes[cmd_name].partition(":")
        command = getattr(import_module(module), name or "command")
        if not isinstance(command, click.Command):
            raise TypeError(f"{self._homes[cmd_name]} is no command")
        return command
