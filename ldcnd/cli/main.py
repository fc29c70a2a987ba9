"""The entry point: finds the subcommand's module only when it is called, so that help and completion stay quick."""

import gc
import os
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any, NoReturn

import click

from ldcnd.cli.output import DONE, EXIT_CODES, OPTIONS_TYPED, exit_code, print_under_any_encoding
from ldcnd.contract.errors import LdcndError

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


COMMANDS = {
    "run": ("ldcnd.cli.run", "Run the daemon."),
    "check-config": ("ldcnd.cli.prepare:check_config", "Validate a configuration without opening anything."),
    "plan": ("ldcnd.cli.prepare:plan", "Show what the lines of a configuration promise, before any hardware is there."),
    "scan": ("ldcnd.cli.examine:scan", "Find out which drives are on a port, at which rate and in which state."),
    "commission": (
        "ldcnd.cli.commission:commission",
        "Go through the checklist of an axis: from its first motion to a report.",
    ),
    "sim": ("ldcnd.cli.sim", "Simulate a line of drives behind a pseudo-terminal."),
    "stop": ("ldcnd.cli.rig:stop", "Stop every axis of a rig, or one, and latch."),
    "reset": ("ldcnd.cli.rig:reset", "Clear stop latches and faults of all axes."),
    "power": ("ldcnd.cli.rig:power", "Close or open the position loops of all axes."),
    "axis": ("ldcnd.cli.axis", "List, watch, move, stop and home axes of a running daemon."),
    "group": ("ldcnd.cli.group", "Move several axes together."),
    "lease": ("ldcnd.cli.rig:lease", "See who controls which axis; hold control."),
    "top": ("ldcnd.cli.top", "Show every axis and line of a rig, what is wrong first."),
    "why": ("ldcnd.cli.looking:why", "Tell why an axis cannot move, and what would clear that."),
    "fleet": ("ldcnd.cli.looking:fleet", "Show every rig, axis, version and health that can be reached."),
    "fault": ("ldcnd.cli.looking:fault", "Explain a fault or an error code: what to check, how to clear it."),
    "events": ("ldcnd.cli.looking:events", "Show who moved what, when, with which result."),
    "drill": ("ldcnd.cli.rig:drill", "Rehearse the loss of a client, a line or the daemon."),
    "bus": ("ldcnd.cli.bus", "Show the lines of a running daemon."),
    "speed": ("ldcnd.cli.rig:speed", "Show or set the speed override of the rig."),
    "console": ("ldcnd.cli.serve:console", "Show rigs in a browser."),
    "metrics": ("ldcnd.cli.serve:metrics", "Serve the health of a running daemon to Prometheus."),
    "record": ("ldcnd.cli.record:record", "Record a rig to MCAP; recover and convert recordings."),
    "plot": ("ldcnd.cli.record:plot", "Draw an axis of a recording."),
    "epics": ("ldcnd.cli.serve:epics", "Serve axes as EPICS motor records."),
    "ros2": ("ldcnd.cli.serve:ros2", "Publish joint states and diagnostics to a ROS 2 graph."),
    "foxglove": ("ldcnd.cli.serve:foxglove", "Show a running rig live in Foxglove, read-only."),
    "params": ("ldcnd.cli.params", "Read, write, save and compare the parameters of a drive."),
    "trace": ("ldcnd.cli.trace", "Record an axis against time, show the result, draw it."),
    "tune": (
        "ldcnd.cli.commission:tune",
        "Find gains for an axis: move it a little, identify it, propose, apply, verify.",
    ),
    "shadow": (
        "ldcnd.cli.commission:shadow",
        "Watch axes for growing friction, a changed load, a coupling that slips.",
    ),
    "doctor": ("ldcnd.cli.examine:doctor", "Examine a line by reading only, before a daemon uses it."),
    "accept": ("ldcnd.cli.examine:accept", "Try real drives against what the documents say, and keep a report of it."),
    "pki": ("ldcnd.cli.pki", "Make certificates and access rules for a network with mutual TLS."),
    "schema": ("ldcnd.cli.prepare:schema", "Write the JSON Schemas of the public models."),
}


class Program(LazyGroup):
    """All commands; its help names them without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


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
        cli.main(standalone_mode=False)
        sys.stdout.flush()
    except (
        click.ClickException,
        click.Abort,
        KeyboardInterrupt,
        BrokenPipeError,
        LdcndError,
        ModuleNotFoundError,
        BaseExceptionGroup,
    ) as error:
        sys.exit(exit_code(error))
    finally:
        gc.enable()
    sys.exit(DONE)
