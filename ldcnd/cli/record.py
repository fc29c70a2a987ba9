"""`ldcnd record`: what a rig publishes, in MCAP files for Foxglove and PlotJuggler."""

import asyncio
import signal
import sys
import time
from pathlib import Path
from typing import TextIO

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.client.rig_client import RigClient
from ldcnd.errors import ConfigError
from ldcnd.model.frozen import Frozen

FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(invoke_without_command=True)
@click.option("--out", "-o", type=FILE, help="The file to write, NAME.mcap.")
@click.option("--rotate-mb", type=click.IntRange(1), default=1000, show_default=True, help="Begin a new file then.")
@with_target
def command(target: Target, out: Path | None, rotate_mb: int) -> None:
    """Record everything that a rig publishes until SIGTERM or SIGINT."""
    if click.get_current_context().invoked_subcommand:
        return
    if out is None:
        raise click.UsageError("--out is missing")
    target.run(lambda client: _record(client, out, rotate_mb * 1_000_000))


@command.command("recover")
@click.argument("damaged", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.argument("whole", type=FILE)
def recover_file(damaged: Path, whole: Path) -> None:
    """Copy what can be read of DAMAGED, such as NAME.mcap.part after a power cut, into WHOLE."""
    _require_mcap()
    from ldcnd.recording.mcap_file import recover  # noqa: PLC0415 - needs an optional package

    click.echo(f"{recover(damaged, whole)} messages recovered")


@command.command("export")
@click.argument("recording", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--csv", "table", type=click.File("w", encoding="utf-8"), default=sys.stdout, help="Table to write.")
def export(recording: Path, table: TextIO) -> None:
    """Write RECORDING as a table: one row for each value of each message."""
    _require_mcap()
    from ldcnd.recording.mcap_file import export_csv  # noqa: PLC0415 - needs an optional package

    export_csv(recording, table)


async def _record(client: RigClient, out: Path, rotate_bytes: int) -> None:
    _require_mcap()
    from ldcnd.recording.recorder import Recorder  # noqa: PLC0415 - needs an optional package

    descriptions: dict[str, Frozen] = {"daemon": await client.daemon()}
    descriptions |= {f"axis_{axis.axis}": axis for axis in await client.axes()}
    descriptions |= {f"bus_{bus.bus}": bus for bus in await client.buses()}
    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ending.set)
    with Recorder(out, descriptions, time.time_ns, rotate_bytes) as recorder:
        async with client.published(recorder.take):
            click.echo(f"recording rig {client.rig} to {out}", err=True)
            await ending.wait()
    click.echo(f"{recorder.messages} messages", err=True)


def _require_mcap() -> None:
    try:
        import mcap  # noqa: F401, PLC0415 - an optional package
    except ImportError as error:
        raise ConfigError("mcap is not installed", remedy="install ldcnd[record]") from error
