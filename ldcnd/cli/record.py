"""`ldcnd record`: what a rig publishes, in MCAP files for Foxglove and PlotJuggler."""

import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.recording_file import EXIT_INCOMPLETE, RECORDING, require_mcap, tell_damages, utc
from ldcnd.cli.typed import Whole
from ldcnd.client.rig_client import RigClient

FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(invoke_without_command=True)
@click.option(
    "--out",
    "-o",
    type=FILE,
    help="The file to write, NAME.mcap; strftime codes stand for the start in UTC: run-%Y%m%d-%H%M%S.mcap, %% for %.",
)
@click.option("--rotate-mb", type=Whole(1), default=250, show_default=True, help="Begin a new file then.")
@with_target
def command(target: Target, out: Path | None, rotate_mb: int) -> None:
    """Record everything that a rig publishes until SIGTERM or SIGINT; a killed recorder loses one second at most."""
    if click.get_current_context().invoked_subcommand:
        return
    if out is None:
        raise click.UsageError("--out is missing")
    require_mcap()
    out = dated(out, datetime.now(UTC))
    try:
        target.run(lambda client: _record(client, out, rotate_mb * 1_000_000))
    except OSError as error:
        raise click.ClickException(f"{error.filename or out}: cannot be written: {error.strerror}") from error


@command.command("recover")
@click.argument("damaged", type=RECORDING)
@click.argument("whole", type=FILE)
def recover_file(damaged: Path, whole: Path) -> None:
    """Copy what can be read of DAMAGED, such as NAME.mcap.part after a power cut, into WHOLE."""
    require_mcap()
    from ldcnd.lab.recording.recovery import recover  # noqa: PLC0415 - needs an optional package

    saved = recover(damaged, whole)
    tell_damages(damaged, saved.damages)
    until = f", the last of {utc(saved.last_ns)}" if saved.messages else ""
    click.echo(f"{saved.messages} messages recovered{until}; {saved.losses.missing.total()} missing in between")


@command.command("export")
@click.argument("recording", type=RECORDING)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
def export(recording: Path, folder: Path) -> None:
    """Write RECORDING into FOLDER as CSV: a table for each topic, a row for each message, a column for each value."""
    require_mcap()
    from ldcnd.lab.recording.tables import export_tables  # noqa: PLC0415 - needs an optional package

    done = export_tables(recording, folder)
    click.echo(f"{done.rows} messages in {len(done.tables)} tables in {folder}")
    if done.damages:
        tell_damages(recording, done.damages)
        sys.exit(EXIT_INCOMPLETE)


def dated(pattern: Path, start: datetime) -> Path:
    """Return a path with the start of the recording in the place of its strftime codes; files after it have numbers."""
    return Path(start.strftime(str(pattern)))


async def _record(client: RigClient, out: Path, rotate_bytes: int) -> None:
    from ldcnd.lab.recording.recorder import KEPT_SAMPLES, LINGER_S, Recorder  # noqa: PLC0415 - needs an optional package

    recorder = Recorder(out, await client.descriptions(), time.time_ns, rotate_bytes, client.descriptions)
    on_end(recorder.end)
    try:
        with recorder:
            async with client.published(recorder.take, KEPT_SAMPLES, LINGER_S) as gave_way:
                click.echo(f"recording rig {client.rig} to {out}", err=True)
                await recorder.run(gave_way)
    finally:
        click.echo(recorder.summary, err=True)  # only now: until the subscriptions are gone, more is recorded
